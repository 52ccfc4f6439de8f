"""SFMS as it runs: one speaker frame in, and on every `hop`-th a plan of the next 8 frames out.

Tokens once drawn stay drawn: a new plan keeps what is left of the one before and draws only the `hop` frames at its
far end. So a keyframe is decided (future - hop) to future frames ahead, 0.16 to 0.32 s with hop 4, and movement
that has begun toward it is never called off; re-planning cannot jitter. What is behind the last keyframe drawn is an
extrapolation, which the next plan may correct: it starts where the motion was, at the speed it had, and the difference
fades over `seam_frames`.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, POSE_CHANNELS, Plan, SpeakerFrame
from sfms_robot.listeners.graphs import graph
from sfms_robot.listeners.sfms.audio_frontend import AudioFrontend, AudioState
from sfms_robot.listeners.sfms.draw import Sampler
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context
from sfms_robot.listeners.space import MotionSpace

# Channels of any motion space that turn or move the head.
HEAD = frozenset(
    {*POSE_CHANNELS, *(f"{part}_{axis}" for part in ("rotation", "translation", "head") for axis in "xyz")}
)
NEUTRAL_STRIDE = 8  # frames between the keyframes of the neutral face a stream begins with


@dataclass(frozen=True)
class SpeakerState:
    """The speaker's last P frames, the newest last, as `predictor.Context` wants them (no batch).

    Attributes:
        audio: what unfinished features still need.
        rows: (R, bins) sound of the newest frame, standardised.
    """

    audio: AudioState
    rows: Tensor
    voice: Tensor
    heard: Tensor
    phase: Tensor
    face: Tensor
    face_known: Tensor


@dataclass(frozen=True)
class Memory:
    """What one stream remembers; values only: a step makes a new one.

    Attributes:
        frames: how many have been heard.
        speaker: of the last P frames.
        tokens: (P + H, G) own tokens up to now, those drawn for the future, UNDECIDED.
        path: (2 + H, C) standardised: the frame before, this frame, then the plan in force.
        random: state of the stream's own generator.
    """

    frames: int
    speaker: SpeakerState
    tokens: Tensor
    path: Tensor
    random: Tensor


@torch.no_grad()
def neutral_tokens(model: SfmsModel, space: MotionSpace, frames: int) -> Tensor:
    """(frames, G): a still, neutral face up to now, as tokens."""
    still = model.standardise(still_face(space, frames))[None]
    mask = torch.zeros(1, frames, model.tokenizer.member.shape[0])
    mask[:, (frames - 1) % NEUTRAL_STRIDE :: NEUTRAL_STRIDE] = 1.0
    return model.tokenizer.encode(still, mask)[0]


class Decode(nn.Module):
    """Tokens (B, P + H, G) -> the motion of their last frames (B, last, C)."""

    def __init__(self, model: SfmsModel, last: int) -> None:
        super().__init__()
        self.tokenizer, self.last = model.tokenizer, last

    def forward(self, tokens: Tensor) -> Tensor:
        return self.tokenizer.decode(tokens, last=self.last)


class SfmsListener:
    """`ports.Listener` over an SfmsModel. Holds weights only."""

    def __init__(
        self,
        settings: config.Sfms,
        model: SfmsModel,
        space: MotionSpace | None = None,
        frontend: AudioFrontend | None = None,
    ) -> None:
        self.settings = settings
        self.model = model.eval()
        self.space = space or MotionSpace.of(settings)
        self.frontend = frontend or AudioFrontend.of(settings)
        self.sampler = Sampler(settings, self.model)
        head = [float(channel in HEAD) for channel in settings.channels]
        self._smoothing = settings.sampling.smoothing * torch.tensor(head)
        self._neutral = neutral_tokens(self.model, self.space, settings.past_frames)
        self._decode = Decode(self.model, settings.future_frames + 2).eval()
        self._decode_one: Callable[..., Any] = self._decode

    def build_graphs(self) -> SfmsListener:
        """The weights stay as they are from now on: what a single stream computes of a plan becomes graphs. Itself."""
        memory = self.start(0)
        self.sampler.build_graphs(_context(memory.speaker, memory.tokens[None]))
        self._decode_one = graph(self._decode, (memory.tokens[None],))
        return self

    @property
    def hop(self) -> int:
        return self.settings.hop_frames

    @property
    def hops(self) -> Sequence[int]:
        """Those that `at_hop` may be asked for."""
        return range(1, self.horizon + 1) if self.settings.hop == "auto" else (self.hop,)

    def at_hop(self, hop: int) -> SfmsListener:
        """The same weights and graphs, planning every `hop` frames."""
        other = copy.copy(self)
        other.settings = self.settings.model_copy(update={"hop": hop})
        return other

    @property
    def horizon(self) -> int:
        return self.settings.future_frames

    @torch.no_grad()
    def start(self, seed: int) -> Memory:
        """Memory of a stream that has heard nothing and looked neutral so far."""
        p = self.settings.past_frames
        speaker = SpeakerState(
            audio=self.frontend.start(),
            rows=torch.zeros(self.frontend.shape),
            voice=torch.zeros(p, self.settings.predictor_width),
            heard=torch.zeros(p, dtype=torch.bool),
            phase=torch.zeros(p, self.frontend.phase_features),
            face=torch.zeros(p, self.space.dim),
            face_known=torch.zeros(p, dtype=torch.bool),
        )
        tokens, path = self.at_rest()
        return Memory(0, speaker, tokens, path, torch.Generator().manual_seed(seed).get_state())

    def at_rest(self) -> tuple[Tensor, Tensor]:
        """Tokens (P + H, G) and path (2 + H, C) of a neutral face that has no plan yet."""
        undecided = torch.full((self.horizon, self._neutral.shape[1]), UNDECIDED)
        return torch.cat([self._neutral, undecided]), self.model.standardise(still_face(self.space, 2 + self.horizon))

    def step(self, speaker: SpeakerFrame, memory: Memory) -> tuple[Plan | None, Memory]:
        """Take one frame; a Plan on every `hop`-th, None between. Never changes `memory` in place.

        Raises ValueError when the frame holds another number of samples than 640 or none.
        """
        plans, (now,) = self.step_many(speaker, [memory])
        return plans[0] if plans else None, now

    @torch.inference_mode()
    def step_many(self, speaker: SpeakerFrame, memories: Sequence[Memory]) -> tuple[list[Plan], list[Memory]]:
        """`step` of streams that began together and heard the same speaker ever since; no plans between hops.

        Each draws from its own randomness, as it would alone, at a fraction of the time.
        """
        heard = self._hear(speaker, memories[0].speaker)
        frames = memories[0].frames
        tokens, path = passed(torch.stack([m.tokens for m in memories]), torch.stack([m.path for m in memories]))
        random = [memory.random for memory in memories]
        plans: list[Plan] = []
        if frames % self.hop == 0:
            generators = [torch.Generator().set_state(state) for state in random]
            tokens, path = self.plan(_context(heard, tokens), path, generators)
            random = [generator.get_state() for generator in generators]
            plans = [self._plan(speaker.time_s, shown) for shown in self.shown(path)]
        drawn = zip(tokens, path, random, strict=True)
        return plans, [Memory(frames + 1, heard, *own) for own in drawn]

    def shown(self, path: Tensor) -> Tensor:
        """Path (..., 2 + H, C) -> what is seen of its future (..., H, C), both standardised: the head is smoothed."""
        if not self.settings.sampling.smoothing:
            return path[..., 2:, :]
        beyond = 2 * path[..., -1:, :] - path[..., -2:-1, :]
        before, own, after = path[..., 1:-1, :], path[..., 2:, :], torch.cat([path[..., 3:, :], beyond], dim=-2)
        return own + self._smoothing * ((before + after) / 2 - own)

    def _plan(self, made_at_s: float, path: Tensor) -> Plan:
        times_s = np.asarray(made_at_s + FRAME_S * np.arange(1, self.horizon + 1), dtype=np.float64)
        motion, jaw_rad = self.space.decode(self.model.restore(path).numpy())
        return Plan(made_at_s, times_s, motion, jaw_rad)

    def plan(self, seen: Context, path: Tensor, generators: Sequence[torch.Generator]) -> tuple[Tensor, Tensor]:
        """New plans of B streams: tokens (B, P + H, G), path (B, 2 + H, C). `path` is the old one, as played so far."""
        tokens = self.sampler.draw(seen, generators)
        decoded = (self._decode_one if len(tokens) == 1 else self._decode)(tokens)
        return tokens, join(path[:, :2], decoded, self.settings.sampling.seam_frames)

    def _hear(self, speaker: SpeakerFrame, before: SpeakerState) -> SpeakerState:
        """With the newest frame in place of the oldest."""
        present = len(speaker.audio) > 0
        if present and len(speaker.audio) != FRAME_SAMPLES:
            raise ValueError(f"a frame at {AUDIO_HZ} Hz has {FRAME_SAMPLES} samples or none, got {len(speaker.audio)}")
        sound, phase, audio = self.frontend.step(speaker.audio, before.audio)
        rows = self.model.standardise_sound(torch.from_numpy(sound)) * present
        face = torch.zeros(1, self.space.dim)
        known = speaker.face is not None and bool(np.isfinite(speaker.face.motion).all())
        if speaker.face is not None and known:
            face = self.model.standardise(torch.from_numpy(self.space.encode(speaker.face.motion[None])))
        voice = self.model.predictor.speaker.listen(torch.cat([before.rows, rows])[None])[0]
        return SpeakerState(
            audio,
            rows,
            voice=_push(before.voice, voice),
            heard=_push(before.heard, torch.tensor([present])),
            phase=_push(before.phase, torch.from_numpy(phase)[None]),
            face=_push(before.face, face),
            face_known=_push(before.face_known, torch.tensor([known])),
        )


def still_face(space: MotionSpace, frames: int) -> Tensor:
    """(frames, C) of a face at rest."""
    return torch.tensor(space.neutral, dtype=torch.float32).expand(frames, -1)


def passed(tokens: Tensor, path: Tensor, frames: int = 1) -> tuple[Tensor, Tensor]:
    """Tokens (..., P + H, G) and path (..., 2 + H, C) of `frames` later.

    What has passed without having been planned, before the first plan, was the neutral face: no keyframe.
    """
    horizon = path.shape[-2] - 2
    moved = torch.cat([tokens[..., frames:, :], torch.full_like(tokens[..., :frames, :], UNDECIDED)], dim=-2)
    moved[..., :-horizon, :].clamp_(min=0)
    return moved, torch.cat([path[..., frames:, :], path[..., -1:, :].expand(*path.shape[:-2], frames, -1)], dim=-2)


def _push(queue: Tensor, new: Tensor) -> Tensor:
    return torch.cat([queue[len(new) :], new])


def _context(speaker: SpeakerState, tokens: Tensor) -> Context:
    """A batch of one speaker."""
    s = speaker
    return Context(s.face[None], s.face_known[None], s.voice[None], s.heard[None], s.phase[None], tokens)


def join(tail: Tensor, decoded: Tensor, seam: int) -> Tensor:
    """Plan that goes on from where the motion was.

    Args:
        tail: (..., 2, C) the frame before and this frame as played.
        decoded: (..., 2 + H, C) the same two and the future, as the new tokens have them.
        seam: frames over which the difference fades.

    Returns:
        (..., 2 + H, C): `tail`, then `decoded` plus a cubic: the difference in place and speed, which ends flat.
    """
    gap = tail - decoded[..., :2, :]
    before, offset = gap[..., :1, :], gap[..., 1:, :]
    speed = offset - before
    u = (torch.arange(1, decoded.shape[-2] - 1) / seam).clamp(max=1.0)[:, None]
    fade = offset * (1 - u) ** 2 * (1 + 2 * u) + speed * seam * u * (1 - u) ** 2
    return torch.cat([tail, decoded[..., 2:, :] + fade], dim=-2)
