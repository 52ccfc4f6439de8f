import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_arig import RAW, arig_model, losses

from sfms_robot import config
from sfms_robot.config.listener import STATES
from sfms_robot.listeners.arig.model import ArigDyad, ArigModel
from sfms_robot.listeners.arig.modules import LongRange
from sfms_robot.listeners.arig.stream import rotary
from sfms_robot.signals.control import COLUMNS

ABLATIONS = [
    {}, {"context_chunks": 2}, {"state_guidance": False}, {"visual": False}, {"discrete": True},
    {"interaction": "linear"}, {"motion_space": "deca56"}, {"sound": "wav2vec2"}, {"draws": "innovation"},
    {"events": True}, {"events": True, "draws": "innovation"}, {"events": True, "discrete": True}, {"phase": False},
]  # fmt: skip


@pytest.fixture(scope="module")
def tiny() -> ArigModel:
    return arig_model(events=True)


def random_dyad(model: ArigModel, frames: int = 14, batch: int = 2, seed: int = 0) -> ArigDyad:
    drawn = torch.Generator().manual_seed(seed)
    sound, motion = (batch, frames, model.sound_width), (batch, frames, model.channels)

    def chance(*shape):
        return torch.rand(shape, generator=drawn) > 0.3

    return ArigDyad(
        user_sound=torch.randn(sound, generator=drawn),
        user_heard=chance(batch, frames),
        agent_sound=torch.randn(sound, generator=drawn),
        agent_heard=chance(batch, frames),
        user_motion=torch.randn(motion, generator=drawn),
        user_seen=chance(batch, frames),
        agent_motion=torch.randn(motion, generator=drawn),
        voiced=chance(batch, frames, 2),
        control=torch.rand((batch, frames, len(COLUMNS)), generator=drawn) if model.settings.events else None,
    )


def long_range(**changes) -> LongRange:
    raw = RAW | {"width": 8, "feedforward": 16, "heads": 2} | changes
    return LongRange(config.parse(config.Arig, raw, "tiny"))


def states_of(dyad: ArigDyad, seed: int = 0) -> torch.Tensor:
    return torch.randint(0, len(STATES), dyad.user_heard.shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("changes", ABLATIONS, ids=str)
def test_gradients_reach_every_parameter(changes):
    model = arig_model(**changes)
    dyad = random_dyad(model)
    motion, state = losses(model, dyad, states_of(dyad))
    assert motion.shape == (2 * 13,) and bool(motion.isfinite().all())
    assert (state is None) == (not model.settings.state_guidance)
    (motion.mean() + (0.0 if state is None else state.mean())).backward()
    unmoved = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert unmoved == []


@given(frame=st.integers(1, 13), field=st.sampled_from([field.name for field in dataclasses.fields(ArigDyad)]))
def test_a_frame_is_made_from_what_equation_1_allows(tiny, frame: int, field: str):
    """Both people up to T - 1, and of T the agent's sound and events: nothing of that or later changes z of T."""
    first = frame + 1 if field.startswith(("agent_sound", "agent_heard", "control")) else frame
    dyad, other = random_dyad(tiny), random_dyad(tiny, seed=7)
    mixed = torch.cat([getattr(dyad, field)[:, :first], getattr(other, field)[:, first:]], dim=1)
    if field == "voiced":  # of the agent now, of the user one frame before
        mixed[:, frame, 0] = dyad.voiced[:, frame, 0]
    with torch.no_grad():
        z = tiny.condition(dyad).z
        after = tiny.condition(dataclasses.replace(dyad, **{field: mixed})).z
    torch.testing.assert_close(after[:, :frame], z[:, :frame], rtol=0, atol=1e-5)


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(ArigDyad)])
def test_everything_that_is_told_counts(tiny, field: str):
    dyad, other = random_dyad(tiny), random_dyad(tiny, seed=7)
    with torch.no_grad():
        z = tiny.condition(dyad).z
        after = tiny.condition(dataclasses.replace(dyad, **{field: getattr(other, field)})).z
    assert not torch.allclose(after, z)


@torch.no_grad()
def test_a_summary_sees_the_chunks_before_it_alone_and_how_far_apart_they_are_not_when():
    """Frames 0..2 are chunk 0; of it frame 4 sees the summary of frame 2 alone."""
    torch.manual_seed(0)
    long = long_range(context_layers=1, chunk_frames=3, context_chunks=2)
    x = torch.randn(1, 9, 8)

    def changed_by(frame: int) -> list[bool]:
        other = x.clone()
        other[:, frame] = torch.randn(8)
        return (long(other) - long(x)).abs().amax(-1)[0].gt(1e-6).tolist()

    assert changed_by(1) == [frame == 1 for frame in range(9)]
    assert changed_by(2) == [frame in (2, 3, 4, 5) for frame in range(9)]  # capacity 2: this chunk and one before
    torch.manual_seed(0)
    long = long_range(context_layers=2, chunk_frames=1, context_chunks=4)
    past, summary = torch.randn(3, 1, 8), torch.randn(1, 8)

    def cis(first: int) -> torch.Tensor:
        cache = [torch.zeros(1, 2, 3, 4)] * 4
        for index, each in enumerate([*past, summary]):
            place = torch.from_numpy(rotary(np.array([first + index]), 4))
            made, keys = long.step(each, cache, torch.arange(3)[None] >= 3 - index, place)
            cache = [
                torch.cat([old[:, :, 1:], new[:, :, None]], dim=2)
                for old, new in zip(cache, keys.unbind(1), strict=True)
            ]
        return made

    torch.testing.assert_close(cis(0), cis(500_000), rtol=1e-4, atol=1e-5)  # days later
