import pytest
import torch
from tiny_arig import arig_listener, arig_model, talk
from torch import nn

from sfms_robot.listeners.arig import networks
from sfms_robot.listeners.arig.networks import Int8Linear

MIDDLE = {"width": 256, "feedforward": 512, "heads": 4, "context_chunks": 8, "precision": "int8"}

pytestmark = pytest.mark.skipif(not networks.supported(), reason="this processor has no fast integers")


def integers(module: nn.Module) -> list[str]:
    return [name for name, part in module.named_modules() if isinstance(part, Int8Linear)]


def test_a_layer_in_integers_is_the_layer_within_a_percent_or_two():
    torch.manual_seed(0)
    linear, x = nn.Linear(300, 200), torch.randn(7, 300)
    with torch.no_grad():
        found, exact = Int8Linear(linear)(x), linear(x)
    assert (found - exact).norm() < 0.02 * exact.norm()
    assert not torch.equal(found, exact)


def test_motion_differs_by_less_than_a_twentieth_of_its_spread():
    """Frame by frame: both models make every frame from the same memory."""
    exact, quick = arig_listener(**MIDDLE | {"precision": "fp32"}), arig_listener(**MIDDLE)
    memory, frames = exact.start(1), []
    for listener in (exact, quick):
        listener.model.motion_mean.fill_(0.5)  # inside 0..1, where nothing is clipped
        listener.model.motion_std.fill_(0.02)
    for frame in talk(40):
        fast_plan, _ = quick.step(frame, memory)
        plan, memory = exact.step(frame, memory)
        frames += [torch.from_numpy(made.frames[0]) for made in (plan, fast_plan)]
    exact_motion, quick_motion = torch.stack(frames[::2]), torch.stack(frames[1::2])
    distance = (quick_motion - exact_motion).square().mean(0).sqrt() / exact_motion.std(0)
    assert 0 < distance.mean() < 0.05


@pytest.mark.parametrize(("precision", "replaced"), [("fp32", False), ("int8", True), ("auto", True)])
def test_precision_decides(precision: str, replaced: bool):
    assert bool(integers(networks.with_precision(arig_model(**MIDDLE), precision))) == replaced


def test_sampler_and_small_layers_stay_exact():
    names = integers(networks.with_precision(arig_model(**MIDDLE), "int8"))
    assert any(name.startswith("short.") for name in names)
    assert not any(name.startswith("head.") for name in names)
    assert integers(networks.with_precision(arig_model(), "int8")) == []  # 16 wide


def test_graphs_have_the_blocks_of_the_sampler_in_integers_too():
    diffusion = {"width": 256, "steps": 4, "train_steps": 50, "blocks": 1}
    exact = {f"{name}.weight" for name in integers(networks.with_precision(arig_model(**MIDDLE), "int8"))}
    found = set(networks.large_layers(arig_model(**MIDDLE, diffusion=diffusion)))
    assert found - exact == {"head.modulation.linear.weight", "head.up.0.weight", "head.down.0.weight"}
