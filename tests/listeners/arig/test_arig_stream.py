import dataclasses

import numpy as np
import pytest
import torch
from tiny_arig import arig_listener, arig_model, dyad_of, generate, noise_of, soft, streamed, talk

from sfms_robot import config
from sfms_robot.data import data_dir
from sfms_robot.errors import ModelError
from sfms_robot.frames import CHANNEL_INDEX, ListenerEvent
from sfms_robot.listeners.arig.model import ArigModel
from sfms_robot.listeners.arig.stream import ArigListener
from sfms_robot.listeners.torch_engine import torch_engine
from sfms_robot.signals.control import control_track

ABLATIONS = [
    {},
    {"context_chunks": 2},
    {"state_guidance": False},
    {"visual": False},
    {"discrete": True},
    {"interaction": "linear"},
    {"sound_frames": 1, "motion_frames": 1, "chunk_frames": 1},
    {"draws": "innovation"},
    {"events": True},
    {"events": True, "draws": "step"},
    {"events": True, "discrete": True},
    {"events": True, "draws": "innovation"},
    {"events": True, "draws": "innovation", "state_guidance": False},
    {"events": True, "draws": "innovation", "visual": False},
    {"events": True, "draws": "innovation", "sway": True},
]
NODS = [ListenerEvent("nod", start_s, 0.5, 0.1, 2) for start_s in (0.3, 0.9)]
FACE = [index for name, index in CHANNEL_INDEX.items() if index >= 6 and not name.startswith("eyeLook")]


@pytest.fixture(scope="module")
def tiny() -> ArigListener:
    return arig_listener()


def assert_stream_is_offline(listener: ArigListener, frames: int, atol: float) -> None:
    """Given the states that were drawn."""
    control = control_track(NODS, 0, frames + 1) if listener.settings.events else None
    memory, made, states, speaker = listener.start(3), [], [listener.start(3).state], talk(frames)
    for index, frame in enumerate(speaker):
        plan, memory = listener.step(frame, memory, None if control is None else control[index : index + 2])
        made.append(plan.frames[0])
        states.append(memory.state)
    dyad = dyad_of(listener, speaker, torch.from_numpy(np.stack(made)), control)
    told = torch.tensor([states]) if control is not None else None
    offline = generate(listener.model, dyad, noise_of(listener, frames, seed=3), told)
    assert 0 < np.stack(made)[:, FACE].min() and np.stack(made)[:, FACE].max() < 1
    np.testing.assert_allclose(np.stack(made), offline[0], atol=atol)


@pytest.mark.parametrize("changes", ABLATIONS, ids=str)
def test_stream_equals_offline(changes):
    assert_stream_is_offline(soft(arig_listener(**changes)), 31, 2e-5)


def shipped(name: str, **changes) -> ArigListener:
    """With the sizes of a shipped listener and seeded weights; told of nothing, as its paper has it."""
    settings = config.load(config.Arig, data_dir("configs") / "listeners" / name / "config.yaml")
    settings = settings.model_copy(update={"events": False, "draws": "motion", **changes})
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return ArigListener(settings, torch_engine(ArigModel(settings)))


SHIPPED = ["arig-small", pytest.param("arig-paper", marks=pytest.mark.slow)]


@pytest.mark.parametrize("name", SHIPPED)
def test_stream_equals_offline_at_the_shipped_sizes(name: str):
    assert_stream_is_offline(soft(shipped(name, precision="fp32")), 20, 1e-4)


def bytes_of(value) -> int:
    if dataclasses.is_dataclass(value):
        return sum(bytes_of(getattr(value, field.name)) for field in dataclasses.fields(value))
    if not isinstance(value, np.ndarray):
        return 0
    return value.nbytes if value.base is None else max(value.nbytes, getattr(value.base, "nbytes", 0))


def test_memory_takes_the_same_room_at_every_step(tiny):
    """The context of the tiny model is full after twelve."""
    memory, speaker, room = tiny.start(1), talk(10), {}
    room[0] = bytes_of(memory)
    for index in range(1, 301):
        _, memory = tiny.step(speaker[index % 10], memory)
        room[index] = bytes_of(memory)
    assert room[0] > 0 and set(room.values()) == {room[0]}


def test_sound_that_is_not_finite_is_silence(tiny):
    speaker = talk(10)
    broken = [dataclasses.replace(f, audio=f.audio * np.nan, agent_audio=f.agent_audio * np.inf) for f in speaker]
    silent = [dataclasses.replace(f, audio=f.audio * 0, agent_audio=f.agent_audio * 0) for f in speaker]
    np.testing.assert_array_equal(streamed(tiny, broken), streamed(tiny, silent))


@pytest.mark.parametrize("size", [1e4, 1e30, -1e38])
def test_what_is_beyond_all_faces_is_not_seen_and_loudness_without_measure_is_lived_through(tiny, size: float):
    speaker = talk(10)
    wild = [dataclasses.replace(f, face=dataclasses.replace(f.face, pose=f.face.pose * 0 + size)) for f in speaker]
    blind = [dataclasses.replace(f, face=None) for f in speaker]
    np.testing.assert_array_equal(streamed(tiny, wild), streamed(tiny, blind))
    loud = [dataclasses.replace(f, audio=np.full_like(f.audio, size), agent_audio=-f.audio * size) for f in speaker]
    with np.errstate(over="ignore"):
        assert np.isfinite(streamed(tiny, loud[:3] + speaker)).all()


def test_features_that_nothing_here_computes_cannot_be_run():
    model = arig_model(sound="wav2vec2")
    with pytest.raises(ModelError, match="'wav2vec2': such a model can be trained and evaluated, not run"):
        ArigListener(model.settings, torch_engine(model))
