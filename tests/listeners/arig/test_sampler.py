import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot import config
from sfms_robot.listeners.arig.sampler import CodeHead, Denoiser, noise_levels


def denoiser(**changes) -> Denoiser:
    raw = {"width": 12, "steps": 5, "train_steps": 40} | changes
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = Denoiser(("jawOpen", "eyeBlinkLeft", "eyeBlinkRight"), 8, config.parse(config.Diffusion, raw, "tiny"))
    with torch.no_grad():
        model.low.fill_(-1e6)
        model.high.fill_(1e6)
    return model


@torch.no_grad()
def test_sampling_is_equation_4_where_nothing_is_clamped_and_ddim_keeps_the_noise_it_found():
    model = denoiser()
    z, noise = torch.randn(4, 8), torch.randn(4, 5, 3)
    alpha_bar, x = noise_levels(model.settings)[model.levels], noise[:, 0]
    for step, level in enumerate(reversed(model.levels)):
        index = len(model.levels) - 1 - step
        before = alpha_bar[index - 1] if index else torch.tensor(1.0)
        alpha = alpha_bar[index] / before
        found = model(x, model.modulate(z, model.level(torch.full((4,), level))))
        mean = (x - (1 - alpha) / (1 - alpha_bar[index]).sqrt() * found) / alpha.sqrt()
        sigma = ((1 - alpha) * (1 - before) / (1 - alpha_bar[index])).sqrt()
        x = (mean + (sigma * noise[:, step + 1] if index else 0)).float()
    torch.testing.assert_close(model.sample(z, noise), x, rtol=1e-3, atol=1e-3)
    model = denoiser(sampler="ddim")
    z, noise = torch.randn(4, 8), torch.randn(4, 5, 3)
    alpha_bar, x = noise_levels(model.settings)[model.levels].float(), noise[:, 0]
    for index in reversed(range(5)):
        level = model.level(torch.full((4,), model.levels[index]))
        found = model(x, model.modulate(z, level))
        clean = (x - (1 - alpha_bar[index]).sqrt() * found) / alpha_bar[index].sqrt()
        before = alpha_bar[index - 1] if index else torch.tensor(1.0)
        x = before.sqrt() * clean + (1 - before).sqrt() * found
    torch.testing.assert_close(model.sample(z, noise), x, rtol=1e-3, atol=1e-3)


def test_the_levels_of_noise_are_dense_where_motion_is_small_if_asked():
    """Between the two schedules both ends agree; below 0.28 deviations, a frame's step, lie 18 and 41 in 100."""
    noise = {}
    for schedule in ("cosine", "logarithmic"):
        levels = noise_levels(config.Diffusion(schedule=schedule))
        assert len(levels) == 1000 and bool((levels.diff() < 0).all()) and float(levels[0]) > 0.999
        noise[schedule] = ((1 - levels) / levels).sqrt()
    assert float(noise["logarithmic"][-1]) == pytest.approx(float(noise["cosine"][-1]))
    fine = {schedule: float((values < 0.28).double().mean()) for schedule, values in noise.items()}
    assert fine["cosine"] < 0.2 and fine["logarithmic"] > 0.4


@torch.no_grad()
def test_a_temperature_of_some_channels_scales_the_noise_that_is_added_to_them():
    model = denoiser(temperature=0.3, temperatures={"eye": 2.0, "jaw": (1.4, 0.2)})
    z, noise = torch.randn(2, 8), torch.randn(2, 5, 3)
    temperature = torch.tensor([[1.4, 2.0, 2.0], [1.0, 2.0, 2.0], [0.6, 2.0, 2.0], [0.2, 2.0, 2.0]])
    scaled = torch.cat([noise[:, :1], noise[:, 1:] * temperature], dim=1)
    torch.testing.assert_close(model.sample(z, noise), denoiser().sample(z, scaled))


@torch.no_grad()
@given(seed=st.integers(0, 1000), sampler=st.sampled_from(["ddpm", "ddim"]), steps=st.integers(1, 8))
def test_no_sample_leaves_the_range_that_was_set(seed: int, sampler: str, steps: int):
    model = denoiser(sampler=sampler, steps=steps)
    model.low.fill_(-0.5)
    model.high.copy_(torch.tensor([0.0, 0.5, 1.0]))
    drawn = torch.Generator().manual_seed(seed)
    out = model.sample(torch.randn(6, 8, generator=drawn), 5 * torch.randn(6, steps, 3, generator=drawn))
    assert bool(((out >= model.low - 1e-5) & (out <= model.high + 1e-5)).all())


@torch.no_grad()
def test_codes_are_drawn_by_their_probability_and_noise_for_another_number_of_steps_is_refused():
    with pytest.raises(ValueError, match="noise for 4 steps, the sampler takes 5"):
        denoiser().sample(torch.randn(1, 8), torch.randn(1, 4, 3))
    torch.manual_seed(0)
    head, z = CodeHead(3, 8, 8, (3, 2)), torch.randn(1, 8)
    kinds, counts = head.sample(z.expand(4000, 8), torch.randn(4000, 1, 1)).unique(dim=0, return_counts=True)
    assert len(kinds) <= 6
    alpha_bar = torch.softmax(head.classify(z), -1)[0].sort().values
    torch.testing.assert_close(counts.sort().values / 4000, alpha_bar[-len(kinds) :], rtol=0, atol=0.03)
