"""Laws of the training loop, on a toy: whatever interrupts a run, the weights are those of a run left alone."""

import math
import shutil
import signal
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from safetensors.torch import load_file
from torch import nn

from sfms_robot import config
from sfms_robot.errors import ConfigError, ModelError
from sfms_robot.lab.learning.job import Job, Run
from sfms_robot.lab.learning.training_loop import checkpoint_file, fit, optimizer, peek, schedule


def toy(identity=None, loss=None, held_out=None, seed=3, **phase) -> Job:
    """Two layers with dropout between (global random numbers), data from the loop's generator, two optimizers."""
    torch.manual_seed(seed)
    model = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.5), nn.Linear(8, 1))
    chosen = config.parse(config.Phase, {"steps": 12, "batch": 4, "learning_rate": 0.05} | phase, "toy")

    def loss_of(step: int, generator: torch.Generator, batch: int) -> torch.Tensor:
        x = torch.randn(batch, 4, generator=generator)
        out = ((model(x) - x.sum(1, keepdim=True)) ** 2).mean()
        return out if loss is None else loss(step, out)

    def error() -> float:
        return float((model(torch.ones(1, 4)) - 4).abs() + 0 * torch.rand(1))

    return Job(
        name="toy",
        model=model,
        optimizers=[optimizer(model[0].parameters(), 0.05, 0.01), optimizer(model[2].parameters(), 0.02, 0.0)],
        loss_of=loss_of,
        held_out=held_out or error,
        frames_per_step=4,
        phase=chosen,
        seed=seed,
        identity={"seed": seed, "toy": chosen.identity()} | (identity or {}),
    )


def interrupt_after(step: int):
    def watch(report):
        if report.position.step == step:
            signal.raise_signal(signal.SIGINT)

    return watch


def outcome_without_origin(outcome):
    return replace(outcome, resumed_at=None)


def weights(job: Job) -> list[torch.Tensor]:
    return [value.clone() for value in job.model.state_dict().values()]


def same(one: list[torch.Tensor], two: list[torch.Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


@pytest.fixture(scope="module")
def left_alone(tmp_path_factory):
    job = toy(evaluate_every=3)
    outcome = fit(job, tmp_path_factory.mktemp("alone"))
    return weights(job), outcome


@pytest.mark.parametrize("stops", [[k] for k in range(1, 12)] + [[2, 5, 6]])
def test_interrupted_anywhere_and_resumed_equals_left_alone(left_alone, tmp_path, stops):
    for stop in stops:
        with pytest.raises(KeyboardInterrupt, match=f"after step {stop} of 12.*--resume continues"):
            fit(toy(evaluate_every=3), tmp_path, Run(resume=stop != stops[0], watches=(interrupt_after(stop),)))
        torch.manual_seed(99)  # another process would not have these random numbers
    job = toy(evaluate_every=3)
    outcome = fit(job, tmp_path, Run(resume=True))
    assert same(weights(job), left_alone[0])
    assert outcome.resumed_at == stops[-1]
    assert outcome_without_origin(outcome) == outcome_without_origin(left_alone[1])


@pytest.mark.parametrize("every", [1, 4, 5])
def test_resumed_from_a_checkpoint_before_a_crash_equals_left_alone(left_alone, tmp_path, every):
    def crash(report):
        if report.position.step == 9:
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        fit(toy(evaluate_every=3, checkpoint_every=every), tmp_path, Run(watches=(crash,)))
    job = toy(evaluate_every=3)  # how often to save is no part of what a run is
    assert fit(job, tmp_path, Run(resume=True)).resumed_at == 8 // every * every
    assert same(weights(job), left_alone[0])


def test_looking_at_the_held_out_loss_changes_no_weight(tmp_path):
    never, often = toy(evaluate_every=0), toy(evaluate_every=1)
    fit(never, tmp_path / "never")
    fit(often, tmp_path / "often")
    last = load_file(checkpoint_file(tmp_path / "often", "toy"))
    assert same(weights(never), [last[f"model.{name}"] for name in often.model.state_dict()])


def test_minutes_alone_make_checkpoints(tmp_path):
    seconds, steps_saved = iter(range(0, 10_000, 40)), []

    def look(report):
        left = peek(checkpoint_file(tmp_path, "toy"))
        steps_saved.append(left[0].step if left else 0)

    fit(toy(checkpoint_minutes=2.0), tmp_path, Run(watches=(look,)), clock=lambda: next(seconds))
    assert steps_saved == [0, 0, 0, 3, 3, 3, 6, 6, 6, 9, 9, 9]  # 40 s a step


def test_patience_stops_early_and_keeps_the_best_weights(tmp_path):
    errors, at_best = iter([5.0, 3.0, 4.0, 3.5, 9.0]), []
    job = toy(held_out=lambda: next(errors), evaluate_every=2, patience=2)

    def remember(report):
        if report.position.step == 4:
            at_best.extend(weights(job))

    outcome = fit(job, tmp_path, Run(watches=(remember,)))
    assert (outcome.stopped, outcome.steps, outcome.best_step, outcome.held_out) == ("patience", 8, 4, 3.0)
    assert same(weights(job), at_best)


def test_a_finished_run_resumes_into_its_weights_without_a_step(tmp_path):
    first = toy(evaluate_every=3)
    done = fit(first, tmp_path)
    again = toy(evaluate_every=3, loss=lambda step, loss: pytest.fail("a step was made"))
    assert fit(again, tmp_path, Run(resume=True)) == replace(done, resumed_at=12)
    assert same(weights(first), weights(again))


@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan])
def test_a_loss_that_is_not_finite_stops_and_leaves_weights_and_the_last_checkpoint(tmp_path, bad):
    job = toy(loss=lambda step, loss: loss * (bad if step == 7 else 1), checkpoint_every=5)
    before = []

    def remember(report):
        before[:] = weights(job)

    with pytest.raises(ModelError, match=r"toy: loss .* at step 7: not finite \(.*checkpoint-toy.* holds step 5\)"):
        fit(job, tmp_path, Run(watches=(remember,)))
    assert same(weights(job), before)
    saved = load_file(checkpoint_file(tmp_path, "toy"))
    assert all(value.isfinite().all() for value in saved.values())


def test_a_gradient_or_a_held_out_loss_that_is_not_finite_stops(tmp_path):
    job = toy(loss=lambda step, loss: (loss - loss.detach()).abs().sqrt() if step == 2 else loss)
    with pytest.raises(ModelError, match=r"gradient norm (nan|inf) at step 2: not finite \(there is no"):
        fit(job, tmp_path)
    with pytest.raises(ModelError, match="toy: held-out loss nan"):
        fit(toy(held_out=lambda: math.nan, evaluate_every=2), tmp_path)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"learning_rate": 0.1}, "toy.learning_rate = 0.05 there, 0.1 now"),
        ({"steps": 13}, "toy.steps = 12 there, 13 now"),
        ({"seed": 4}, "seed = 3 there, 4 now"),
        ({"identity": {"data": {"frames": 7}}}, "data.frames = 'not given' there, 7 now"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused_by_the_key_that_differs(tmp_path, changed, told):
    fit(toy(), tmp_path)
    with pytest.raises(ConfigError) as refused:
        fit(toy(**changed), tmp_path, Run(resume=True))
    assert told in str(refused.value) and "checkpoint-toy.safetensors" in str(refused.value)


def test_nothing_to_resume_and_a_checkpoint_of_another_model_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="checkpoint-toy.safetensors: no checkpoint to resume from"):
        fit(toy(), tmp_path, Run(resume=True))
    fit(toy(), tmp_path)
    other = nn.Linear(4, 1)
    job = replace(toy(), model=other, optimizers=[optimizer(other.parameters(), 0.05, 0.0)])
    with pytest.raises(ModelError, match="does not fit this version of the model"):
        fit(job, tmp_path, Run(resume=True))


@pytest.mark.parametrize("damage", [lambda whole: b"", lambda whole: whole[: len(whole) // 2], lambda whole: b"x" * 99])
def test_a_damaged_checkpoint_is_refused(tmp_path, damage):
    fit(toy(), tmp_path)
    file = checkpoint_file(tmp_path, "toy")
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(ModelError, match="checkpoint-toy.safetensors: not a readable checkpoint"):
        fit(toy(), tmp_path, Run(resume=True))


def test_beginning_anew_over_an_unfinished_run_is_warned_of(tmp_path, caplog):
    with pytest.raises(KeyboardInterrupt):
        fit(toy(), tmp_path, Run(watches=(interrupt_after(4),)))
    fit(toy(), tmp_path)
    assert "was at step 4, starts again; --resume would have continued" in caplog.text
    caplog.clear()
    fit(toy(), tmp_path)  # a finished one may be trained again without a word
    assert not caplog.text


def test_a_folder_that_cannot_be_made_is_said_before_the_first_step(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ConfigError, match="out: cannot be made a folder"):
        fit(toy(loss=lambda step, loss: pytest.fail("a step was made")), tmp_path / "out")


def test_a_folder_that_vanishes_is_one_line(tmp_path):
    folder = tmp_path / "out"
    with pytest.raises(ConfigError, match="checkpoint-toy.safetensors: cannot be written"):
        fit(toy(checkpoint_every=3), folder, Run(watches=(lambda report: shutil.rmtree(folder, ignore_errors=True),)))


def test_gradients_are_clipped_for_each_optimizer(tmp_path):
    seen, job = [], toy(loss=lambda step, loss: 1000 * loss, clip_norm=0.5)

    def look(report):
        seen.append(report.gradient_norm)
        for one in job.optimizers:
            gradients = [p.grad for group in one.param_groups for p in group["params"]]
            assert nn.utils.get_total_norm(gradients) <= 0.5 + 1e-4

    fit(job, tmp_path, Run(watches=(look,)))
    assert max(seen) > 0.5  # the report tells the norm before


def test_the_interrupt_handler_is_put_back(tmp_path):
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        fit(toy(), tmp_path, Run(watches=(interrupt_after(1),)))
    assert signal.getsignal(signal.SIGINT) is before


@given(st.integers(1, 5000), st.integers(0, 500))
@hypothesis_settings(deadline=None)
def test_the_rate_warms_up_to_one_and_falls_to_nearly_nothing(steps, warm_up):
    phase = config.Phase(steps=steps, batch=1, learning_rate=1.0, warm_up_steps=warm_up)
    rates = [schedule(step, phase) for step in range(steps)]
    top = rates.index(max(rates))
    assert all(0 < rate <= 1 for rate in rates)
    assert rates[: top + 1] == sorted(rates[: top + 1]) and rates[top:] == sorted(rates[top:], reverse=True)
    assert top <= max(1, steps // 10)


def test_both_optimizers_follow_the_schedule_from_their_own_rate(tmp_path):
    job, seen = toy(steps=20), []
    fit(job, tmp_path, Run(watches=(lambda report: seen.append([o.param_groups[0]["lr"] for o in job.optimizers]),)))
    assert seen == [[0.05 * schedule(s, job.phase), 0.02 * schedule(s, job.phase)] for s in range(20)]


def precision_of(tmp_path, precision, device="cpu"):
    """The numbers that a model on this device computes with."""
    job, seen = toy(precision=precision), set()
    model = job.model.to(device)

    def loss_of(step, generator, batch):
        x = torch.randn(4, 4, generator=generator).to(device)
        out = model(x)
        seen.add(out.dtype)
        return ((out - x.sum(1, keepdim=True)) ** 2).mean()

    assert math.isfinite(fit(replace(job, loss_of=loss_of, held_out=None), tmp_path).loss)
    return seen


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
@pytest.mark.parametrize("has_it", [True, False])
def test_bf16_is_for_processors_that_have_it(tmp_path, monkeypatch, precision, has_it):
    monkeypatch.setattr(torch.cpu, "_is_avx512_bf16_supported", lambda: has_it)
    wanted = torch.bfloat16 if has_it and precision == "bf16" else torch.float32
    assert precision_of(tmp_path, precision) == {wanted}


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_bf16_trains_on_a_gpu(tmp_path):
    assert precision_of(tmp_path, "bf16", "cuda") == {torch.bfloat16}
