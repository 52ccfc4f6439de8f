"""SFMS as it runs: one speaker frame in, and on every `hop`-th a plan of the next 8 frames out.

Tokens once drawn stay drawn while what they were drawn for holds: a new plan keeps what is left of the one before and
draws only the `hop` frames at its far end. So a keyframe is decided (future - hop) to future frames ahead, 0.16 to
0.32 s with hop 4, and re-planning cannot jitter. A listener that is told of events compares what it is told now with
what the tokens were drawn under: from the first future frame on for which that differs they are drawn anew, but never
the next frame's, which servos are already under way to. What is behind the last keyframe drawn is an extrapolation,
which the next plan may correct: it starts where the motion was, at the speed it had, and the difference fades over
`seam_frames`.
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
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, Floats, Plan, SpeakerFrame
from sfms_robot.listeners.graphs import graph
from sfms_robot.listeners.sfms.audio_frontend import AudioFrontend, AudioState
from sfms_robot.listeners.sfms.draw import Sampler
from sfms_robot.listeners.sfms.model import HEAD, SfmsModel
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context, last_keyframes
from sfms_robot.listeners.sfms.sway import draw_sway, sway_at
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS

NEUTRAL_STRIDE = 8  # frames between the keyframes of the neutral face a stream begins with
KEPT_FRAMES = 1  # of the future, whatever is told
SAME = 1e-5  # what is told of a frame differs by more, or does not


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
        control: (P + H, K) what was told of each of those frames when they were drawn.
        path: (2 + H, C) standardised: the frame before, this frame, then the plan in force.
        sway: what `sway.draw_sway` made for this stream; empty without.
        random: state of the stream's own generator.
    """

    frames: int
    speaker: SpeakerState
    tokens: Tensor
    control: Tensor
    path: Tensor
    sway: Tensor
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
        self._columns = len(COLUMNS) if settings.events else 0
        # Behind the last keyframe is what it was: then one that leaves the window has to be held on to.
        self.holds = settings.placement == "penalised"
        self._decode = Decode(self.model, settings.future_frames + 2).eval()
        self._decode_one: Callable[..., Any] = self._decode

    def build_graphs(self) -> SfmsListener:
        """The weights stay as they are from now on: what a single stream computes of a plan becomes graphs. Itself."""
        memory = self.start(0)
        self.sampler.build_graphs(_context(memory.speaker, memory.tokens[None], memory.control[None]))
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

    @property
    def control_frames(self) -> tuple[int, int]:
        """How many frames up to the newest heard, and how many after it, `step` wants to be told of; none without."""
        return (self.settings.past_frames, self.horizon) if self._columns else (0, 0)

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
        generator = torch.Generator().manual_seed(seed)
        sway = self.draw_sway(generator)
        control = torch.zeros(len(tokens), self._columns)
        return Memory(0, speaker, tokens, control, path, sway, generator.get_state())

    def draw_sway(self, generator: torch.Generator) -> Tensor:
        """A stream's own sway, as `sway_at` takes it; empty, and nothing drawn, for a listener whose tokens hold it."""
        if not self.model.head:
            return torch.zeros(3, 0, 0)
        return draw_sway(self.model.sway_amplitude, self.model.sway_spread, generator)

    def at_rest(self) -> tuple[Tensor, Tensor]:
        """Tokens (P + H, G) and path (2 + H, C) of a neutral face that has no plan yet."""
        undecided = torch.full((self.horizon, self._neutral.shape[1]), UNDECIDED)
        return torch.cat([self._neutral, undecided]), self.model.standardise(still_face(self.space, 2 + self.horizon))

    def step(self, speaker: SpeakerFrame, memory: Memory, control: Floats | None = None) -> tuple[Plan | None, Memory]:
        """Take one frame; a Plan on every `hop`-th, None between. Never changes `memory` in place.

        `control`: rows of `signals.control` for the `control_frames` up to this frame and after it, (P + H, K); None
        for a listener that is not told of events.

        Raises ValueError when the frame holds another number of samples than 640 or none, or control another shape.
        """
        plans, (now,) = self.step_many(speaker, [memory], None if control is None else [control])
        return plans[0] if plans else None, now

    @torch.inference_mode()
    def step_many(
        self, speaker: SpeakerFrame, memories: Sequence[Memory], controls: Sequence[Floats] | None = None
    ) -> tuple[list[Plan], list[Memory]]:
        """`step` of streams that began together and heard the same speaker ever since; no plans between hops.

        Each is told of its own events, and draws from its own randomness, as it would alone, at a fraction of the time.
        """
        told = self._told(controls, len(memories))
        heard = self._hear(speaker, memories[0].speaker)
        frames = memories[0].frames
        tokens, path = (torch.stack([getattr(m, name) for m in memories]) for name in ("tokens", "path"))
        tokens, path = passed(tokens, path, holds=self.holds)
        control = later(torch.stack([m.control for m in memories]))
        random = [memory.random for memory in memories]
        plans: list[Plan] = []
        if frames % self.hop == 0:
            generators = [torch.Generator().set_state(state) for state in random]
            tokens = revoked(tokens, control, told, self.horizon)
            tokens, path = self.plan(_context(heard, tokens, told), path, generators)
            control = told
            random = [generator.get_state() for generator in generators]
            shown = self.with_sway(self.shown(path), torch.stack([m.sway for m in memories]), frames + 1)
            plans = [self._plan(speaker.time_s, one) for one in shown]
        drawn = zip(tokens, control, path, (m.sway for m in memories), random, strict=True)
        return plans, [Memory(frames + 1, heard, *own) for own in drawn]

    def _told(self, controls: Sequence[Floats] | None, streams: int) -> Tensor:
        """(B, P + H, K). Raises ValueError for another shape, and where nothing is told to one that must be."""
        rows = sum(self.control_frames)
        if controls is None and not self._columns:
            return torch.zeros(streams, self.settings.window_frames, 0)
        if controls is None:
            raise ValueError(f"this listener is told of events: control ({rows}, {self._columns}) is missing")
        if len(controls) != streams or any(one.shape != (rows, self._columns) for one in controls):
            shapes = ", ".join(str(one.shape) for one in controls)
            raise ValueError(f"control has shape {shapes}, not {streams} times ({rows}, {self._columns})")
        return torch.from_numpy(np.stack(controls).astype(np.float32))

    def with_sway(self, shown: Tensor, sway: Tensor, first: int) -> Tensor:
        """Motion (B, N, C), standardised, of frames `first`, `first` + 1, ... -> in the model's space, with the slow
        motion (B, 3, L, S) of each stream.
        """
        motion = self.model.restore(shown)
        if self.model.head:
            times_s = FRAME_S * (first + 1 + torch.arange(shown.shape[-2], dtype=torch.float64))
            motion[..., self.model.head] += sway_at(sway, times_s)
        return motion

    def shown(self, path: Tensor) -> Tensor:
        """Path (..., 2 + H, C) -> what is seen of its future (..., H, C), both standardised: the head is smoothed."""
        if not self.settings.sampling.smoothing:
            return path[..., 2:, :]
        beyond = 2 * path[..., -1:, :] - path[..., -2:-1, :]
        before, own, after = path[..., 1:-1, :], path[..., 2:, :], torch.cat([path[..., 3:, :], beyond], dim=-2)
        return own + self._smoothing * ((before + after) / 2 - own)

    def _plan(self, made_at_s: float, shown: Tensor) -> Plan:
        times_s = np.asarray(made_at_s + FRAME_S * np.arange(1, self.horizon + 1), dtype=np.float64)
        motion, jaw_rad = self.space.decode(shown.numpy())
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


def passed(tokens: Tensor, path: Tensor, frames: int = 1, holds: bool = False) -> tuple[Tensor, Tensor]:
    """Tokens (..., P + H, G) and path (..., 2 + H, C) of `frames` later.

    What has passed without having been planned, before the first plan, was the neutral face: no keyframe. `holds`: the
    last keyframe that has left the window stands at its first frame.
    """
    horizon = path.shape[-2] - 2
    moved = torch.cat([tokens[..., frames:, :], torch.full_like(tokens[..., :frames, :], UNDECIDED)], dim=-2)
    moved[..., :-horizon, :].clamp_(min=0)
    if holds:
        moved[..., 0, :] = last_keyframes(tokens[:, : frames + 1]).tokens[:, -1, :, 0]
    return moved, torch.cat([path[..., frames:, :], path[..., -1:, :].expand(*path.shape[:-2], frames, -1)], dim=-2)


def later(control: Tensor, frames: int = 1) -> Tensor:
    """Control (..., P + H, K) of `frames` later; of frames that nothing was told of yet it is 0."""
    return torch.cat([control[..., frames:, :], torch.zeros_like(control[..., :frames, :])], dim=-2)


def revoked(tokens: Tensor, drawn_under: Tensor, told: Tensor, horizon: int) -> Tensor:
    """Tokens (B, P + H, G) without those of the future that what is told now, (B, P + H, K), has overtaken."""
    changed = ((told - drawn_under)[:, -horizon:].abs() > SAME).any(-1)
    stale = changed.cumsum(1) > 0
    stale[:, :KEPT_FRAMES] = False
    future = torch.where(stale[..., None], UNDECIDED, tokens[:, -horizon:])
    return torch.cat([tokens[:, :-horizon], future], dim=1)


def _push(queue: Tensor, new: Tensor) -> Tensor:
    return torch.cat([queue[len(new) :], new])


def _context(speaker: SpeakerState, tokens: Tensor, control: Tensor) -> Context:
    """A batch of one speaker."""
    s = speaker
    return Context(s.face[None], s.face_known[None], s.voice[None], s.heard[None], s.phase[None], tokens, control)


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
