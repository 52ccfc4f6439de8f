"""An ARIG small enough to build in every test, and a stream computed from whole arrays."""

import numpy as np
import torch
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, FaceFrame, SpeakerFrame
from sfms_robot.listeners import audio_frontend
from sfms_robot.listeners.arig.model import ArigDyad, ArigModel
from sfms_robot.listeners.arig.stream import FIRST, ArigListener
from sfms_robot.listeners.stream_rng import Use, normals
from sfms_robot.listeners.torch_engine import torch_engine

RAW = {
    "kind": "arig", "width": 16, "feedforward": 24, "heads": 2, "chunk_frames": 3, "context_chunks": 4,
    "context_layers": 2, "diffusion": {"width": 10, "steps": 4, "train_steps": 50},
}  # fmt: skip


def arig_model(**changes) -> ArigModel:
    settings = config.parse(config.Arig, RAW | changes, "tiny")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return ArigModel(settings)


def arig_listener(**changes) -> ArigListener:
    model = arig_model(**changes)
    return ArigListener(model.settings, torch_engine(model))


def soft(listener: ArigListener) -> ArigListener:
    """Whose motion is small and inside 0..1, where nothing is clipped, and whose states last some frames."""
    model = listener.model
    with torch.no_grad():
        model.motion_std.fill_(0.02)
        model.motion_mean.copy_(0.5 * model.is_drawn)
        if model.settings.draws == "innovation":
            model.rho.fill_(0.9)
        if model.states is not None and model.settings.events:
            model.states.durations.copy_(torch.linspace(1, 6, 33).expand(7, -1))
    return listener


def talk(frames: int, seed: int = 0, face: bool = True, audio: bool = True, agent: bool = True) -> list[SpeakerFrame]:
    """Both tracks speak in turns of some frames."""
    rng, out = np.random.default_rng(seed), []
    for index in range(frames):
        time_s = (index + 1) * FRAME_S
        level = np.where(np.sin(index / np.array([4.0, 5.0]) + seed) > 0, 0.2, 0.001)
        mine, theirs = (rng.normal(0, each, FRAME_SAMPLES).astype(np.float32) for each in level)
        shown = FaceFrame.of(time_s, rng.uniform(0, 0.3, 58)) if face else None
        out.append(SpeakerFrame(time_s, theirs if audio else theirs[:0], shown, mine if agent else None))
    return out


def streamed(
    listener: ArigListener, speaker: list[SpeakerFrame], seed: int = 1, control: np.ndarray | None = None
) -> np.ndarray:
    """(T, 58): frame t is the plan made at the speaker's frame t, told of rows t and t + 1 of control (T + 1, K)."""
    memory, out = listener.start(seed), []
    for index, frame in enumerate(speaker):
        plan, memory = listener.step(frame, memory, None if control is None else control[index : index + 2])
        out.append(plan.frames[0])
    return np.stack(out)


def noise_of(listener: ArigListener, frames: int, seed: int = 1) -> torch.Tensor:
    """What a stream of that seed draws: (1, frames, steps, channels)."""
    shape = listener.noise_shape
    noise = [normals(seed, frame, Use.NOISE, *shape) for frame in range(1, 1 + frames)]
    return torch.from_numpy(np.stack(noise))[None]


def dyad_of(
    listener: ArigListener, speaker: list[SpeakerFrame], agent_motion: torch.Tensor, control: np.ndarray | None = None
) -> ArigDyad:
    """Frames 0..T of a stream of T steps; agent_motion (T, C) is what it made of frames 1..T.

    The agent says nothing in frame 0; what it says at step t belongs to frame t + 1. Nothing looks at the user's last.
    """
    silence = np.zeros(FRAME_SAMPLES, np.float32)

    def samples(track):
        return np.concatenate([s if s is not None and len(s) else silence for s in track])

    user, user_voiced = audio_frontend.track(samples([frame.audio for frame in speaker] + [None]))
    agent, agent_voiced = audio_frontend.track(samples([frame.agent_audio for frame in speaker]))
    faces = [frame.face.motion if frame.face else np.zeros(58, np.float32) for frame in speaker]
    still = torch.tensor(listener.space.neutral, dtype=torch.float32)[None]
    return ArigDyad(
        user_sound=torch.from_numpy(user)[None],
        user_heard=torch.tensor([[len(frame.audio) > 0 for frame in speaker] + [False]]),
        agent_sound=torch.from_numpy(np.concatenate([agent[:1], agent]))[None],
        agent_heard=torch.tensor([[False] + [frame.agent_audio is not None for frame in speaker]]),
        user_motion=torch.from_numpy(np.stack([*faces, faces[-1]]))[None],
        user_seen=torch.tensor([[frame.face is not None for frame in speaker] + [False]]),
        agent_motion=torch.cat([still, agent_motion])[None],
        voiced=torch.from_numpy(np.stack([np.r_[False, agent_voiced], user_voiced], axis=-1))[None],
        control=None if control is None else torch.from_numpy(control)[None],
    )


def losses(model: ArigModel, dyad: ArigDyad, states: torch.Tensor, seed: int = 0):
    """Return equation (3) and the cross-entropy of the states (None without); every frame is given the true past."""
    found = model.condition(dyad, torch.where(states < 0, FIRST, states))
    standard = model.standardise(dyad.agent_motion)
    wanted = model.moved(standard[:, 1:], standard[:, :-1], model.rows(dyad)).flatten(0, 1)
    motion = model.sample_loss(found.z.flatten(0, 1), wanted, generator=torch.Generator().manual_seed(seed))
    if found.states is None:
        return motion, None
    return motion, F.cross_entropy(found.states.transpose(1, 2), states[:, 1:], reduction="none")


@torch.no_grad()
def generate(model: ArigModel, dyad: ArigDyad, noise: torch.Tensor, states: torch.Tensor | None = None) -> torch.Tensor:
    """Return motion (B, N-1, C) of frames 1..N-1 from the given past; noise (B, N-1, *noise_shape)."""
    found = model.condition(dyad, states)
    made = model.sample(found.z.flatten(0, 1), noise.flatten(0, 1)).view(found.moved.shape)
    last = model.standardise(dyad.agent_motion[:, :-1])
    return model.restore(model.drawn(made, last, model.rows(dyad), dyad.voiced[:, 1:, 0]))
