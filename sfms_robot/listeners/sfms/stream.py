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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, Doubles, Floats, Plan, SpeakerFrame
from sfms_robot.listeners.engine import Engine, RunsOnEngine
from sfms_robot.listeners.sfms.audio_frontend import AudioFrontend, AudioState
from sfms_robot.listeners.sfms.channels import HEAD, head_channels
from sfms_robot.listeners.sfms.draw import Sampler, Seen
from sfms_robot.listeners.sfms.keyframes import UNDECIDED, Tokens, later, neutral_mask, passed, revoked
from sfms_robot.listeners.sfms.reachable import Reach
from sfms_robot.listeners.sfms.sway import draw_sway, sway_at
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS


@dataclass(frozen=True)
class SpeakerState:
    """The speaker's last P frames, the newest last, as `draw.Seen` wants them (no batch).

    Attributes:
        audio: what unfinished features still need.
        rows: (R, bins) sound of the newest frame, standardised.
    """

    audio: AudioState
    rows: Floats
    voice: Floats
    heard: NDArray[np.bool_]
    phase: Floats
    face: Floats
    face_known: NDArray[np.bool_]


@dataclass(frozen=True)
class Memory:
    """What one stream remembers; values only: a step makes a new one.

    Attributes:
        seed: what it draws hangs on it (`lots`).
        frames: how many have been heard.
        speaker: of the last P frames.
        tokens: (P + H, G) own tokens up to now, those drawn for the future, UNDECIDED.
        control: (P + H, K) what was told of each of those frames when they were drawn.
        path: (2 + H, C) standardised: the frame before, this frame, then the plan in force.
        sway: what `sway.draw_sway` made for this stream; empty without.
    """

    seed: int
    frames: int
    speaker: SpeakerState
    tokens: Tokens
    control: Floats
    path: Floats
    sway: Doubles


class SfmsListener(RunsOnEngine):
    """`ports.BatchListener`. Holds weights only: its engine does, which runs `networks`."""

    def __init__(
        self,
        settings: config.Sfms,
        engine: Engine,
        space: MotionSpace | None = None,
        frontend: AudioFrontend | None = None,
    ) -> None:
        self.settings = settings
        self.engine = engine
        self.space = space or MotionSpace.of(settings)
        self.frontend = frontend or AudioFrontend.of(settings)
        self._scales = engine.tensors
        self._head = head_channels(settings.channels) if settings.sway else []
        self._smoothing = np.array([channel in HEAD for channel in settings.channels], np.float32)
        self._smoothing *= np.float32(settings.sampling.smoothing)
        self._columns = len(COLUMNS) if settings.events else 0
        # Behind the last keyframe is what it was: then one that leaves the window has to be held on to.
        self.holds = settings.placement == "penalised"
        mask = neutral_mask(settings.past_frames, len(settings.groups))
        neutral, codes = engine.run("rest", self._still(settings.past_frames)[None], mask[None])
        self._neutral = neutral[0]
        groups = settings.groups.values()
        own = [[settings.channels.index(name) for name in group.channels] for group in groups]
        sizes, bounded = [group.codes for group in groups], settings.sampling.reach
        reach = Reach(codes[0], own, sizes, self._scales["motion_speed"], bounded)
        self.sampler = Sampler(settings, engine, reach)

    @property
    def hop(self) -> int:
        return self.settings.hop_frames

    @property
    def hops(self) -> Sequence[int]:
        """Those that `at_hop` may be asked for."""
        return range(1, self.horizon + 1) if self.settings.hop == "auto" else (self.hop,)

    def at_hop(self, hop: int) -> SfmsListener:
        """The same weights, planning every `hop` frames."""
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

    def start(self, seed: int) -> Memory:
        """Memory of a stream that has heard nothing and looked neutral so far."""
        p = self.settings.past_frames
        speaker = SpeakerState(
            audio=self.frontend.start(),
            rows=np.zeros(self.frontend.shape, np.float32),
            voice=np.zeros((p, self.settings.predictor_width), np.float32),
            heard=np.zeros(p, np.bool_),
            phase=np.zeros((p, self.frontend.phase_features), np.float32),
            face=np.zeros((p, self.space.dim), np.float32),
            face_known=np.zeros(p, np.bool_),
        )
        tokens, path = self.at_rest()
        control = np.zeros((len(tokens), self._columns), np.float32)
        return Memory(seed, 0, speaker, tokens, control, path, self.draw_sway(seed))

    def draw_sway(self, seed: int) -> Doubles:
        """A stream's own sway, as `sway_at` takes it; empty for a listener whose tokens hold it."""
        if not self._head:
            return np.zeros((3, 0, 0))
        return draw_sway(self._scales["sway_amplitude"], float(self._scales["sway_spread"]), seed)

    def at_rest(self) -> tuple[Tokens, Floats]:
        """Tokens (P + H, G) and path (2 + H, C) of a neutral face that has no plan yet."""
        undecided = np.full((self.horizon, self._neutral.shape[1]), UNDECIDED)
        return np.concatenate([self._neutral, undecided]), self._still(2 + self.horizon)

    def step(self, speaker: SpeakerFrame, memory: Memory, control: Floats | None = None) -> tuple[Plan | None, Memory]:
        """Take one frame; a Plan on every `hop`-th, None between. Never changes `memory` in place.

        `control`: rows of `signals.control` for the `control_frames` up to this frame and after it, (P + H, K); None
        for a listener that is not told of events.

        Raises ValueError when the frame holds another number of samples than 640 or none, or control another shape.
        """
        return self.step_each([speaker], [memory], None if control is None else [control])[0]

    def step_each(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[Memory], controls: Sequence[Floats] | None = None
    ) -> list[tuple[Plan | None, Memory]]:
        """See `ports.BatchListener`; controls as of `step`. Those that are due are planned together."""
        heard = self._hear([*speakers], [memory.speaker for memory in memories])
        return self._stepped([frame.time_s for frame in speakers], heard, memories, controls)

    def step_many(
        self, speaker: SpeakerFrame, memories: Sequence[Memory], controls: Sequence[Floats] | None = None
    ) -> tuple[list[Plan], list[Memory]]:
        """`step` of streams that began together and heard the same speaker ever since; no plans between hops.

        As `step_each`, and the speaker is listened to once.
        """
        heard = self._hear([speaker], [memories[0].speaker]) * len(memories)
        found = self._stepped([speaker.time_s] * len(memories), heard, memories, controls)
        return [plan for plan, _ in found if plan is not None], [memory for _, memory in found]

    def _stepped(
        self,
        times_s: Sequence[float],
        heard: Sequence[SpeakerState],
        memories: Sequence[Memory],
        controls: Sequence[Floats] | None,
    ) -> list[tuple[Plan | None, Memory]]:
        """Every stream one frame on, what its speaker did in it heard already."""
        told = self._told(controls, len(memories))
        tokens, path = passed(_stacked(memories, "tokens"), _stacked(memories, "path"), holds=self.holds)
        control = later(_stacked(memories, "control"))
        plans: list[Plan | None] = [None] * len(memories)
        due = [row for row, memory in enumerate(memories) if memory.frames % self.hop == 0]
        if due:
            speaking = [heard[row] for row in due]
            planned = [memories[row] for row in due]
            tokens[due] = revoked(tokens[due], control[due], told[due], self.horizon)
            seen = _seen(speaking, tokens[due], told[due])
            newest = [memory.frames for memory in planned]
            tokens[due], path[due] = self.plan(seen, path[due], [memory.seed for memory in planned], newest)
            control[due] = told[due]
            shown = self.shown(path[due])
            moved = [
                self.with_sway(one, memory.sway, memory.frames + 1) for one, memory in zip(shown, planned, strict=True)
            ]
            for row, plan in zip(due, self._plans([times_s[row] for row in due], np.stack(moved)), strict=True):
                plans[row] = plan
        after = [
            Memory(memory.seed, memory.frames + 1, heard[row], tokens[row], control[row], path[row], memory.sway)
            for row, memory in enumerate(memories)
        ]
        return list(zip(plans, after, strict=True))

    def _told(self, controls: Sequence[Floats] | None, streams: int) -> Floats:
        """(B, P + H, K). Raises ValueError for another shape, and where nothing is told to one that must be."""
        rows = sum(self.control_frames)
        if controls is None and not self._columns:
            return np.zeros((streams, self.settings.window_frames, 0), np.float32)
        if controls is None:
            raise ValueError(f"this listener is told of events: control ({rows}, {self._columns}) is missing")
        if len(controls) != streams or any(one.shape != (rows, self._columns) for one in controls):
            shapes = ", ".join(str(one.shape) for one in controls)
            raise ValueError(f"control has shape {shapes}, not {streams} times ({rows}, {self._columns})")
        return np.stack(controls).astype(np.float32)

    def with_sway(self, shown: Floats, sway: Doubles, first: int) -> Floats:
        """Motion (..., N, C), standardised, of frames `first`, `first` + 1, ... -> in the model's space, with the slow
        motion (..., 3, L, S) of each stream.
        """
        motion = shown * self._scales["motion_std"] + self._scales["motion_mean"]
        if self._head:
            motion[..., self._head] += sway_at(sway, FRAME_S * (first + 1.0 + np.arange(shown.shape[-2])))
        return motion

    def shown(self, path: Floats) -> Floats:
        """Path (..., 2 + H, C) -> what is seen of its future (..., H, C), both standardised: the head is smoothed."""
        if not self.settings.sampling.smoothing:
            return path[..., 2:, :]
        beyond = 2 * path[..., -1:, :] - path[..., -2:-1, :]
        before, own = path[..., 1:-1, :], path[..., 2:, :]
        after = np.concatenate([path[..., 3:, :], beyond], axis=-2)
        return np.asarray(own + self._smoothing * ((before + after) / 2 - own))

    def _plans(self, made_at_s: Sequence[float], shown: Floats) -> list[Plan]:
        """Motion (B, H, C) in the model's space, of plans made at those times."""
        motion, jaw_rad = self.space.decode(shown.reshape(-1, shown.shape[-1]))
        motion = motion.reshape(*shown.shape[:2], -1)
        jaws = [None] * len(shown) if jaw_rad is None else [*jaw_rad.reshape(*shown.shape[:2], -1)]
        ahead_s: Doubles = FRAME_S * np.arange(1, self.horizon + 1, dtype=np.float64)
        return [
            Plan(at_s, np.add(at_s, ahead_s), frames, jaw)
            for at_s, frames, jaw in zip(made_at_s, motion, jaws, strict=True)
        ]

    def plan(self, seen: Seen, path: Floats, seeds: Sequence[int], newest: Sequence[int]) -> tuple[Tokens, Floats]:
        """New plans of B streams: tokens (B, P + H, G), path (B, 2 + H, C). `path` is the old one, as played so far.

        `newest`: the frame that each has heard last, from 0 at its beginning.
        """
        tokens = self.sampler.draw(seen, seeds, [frame + self.horizon for frame in newest])
        (decoded,) = self.engine.run("decode", tokens)
        return tokens, join(path[:, :2], decoded, self.settings.sampling.seam_frames)

    def voices(self, rows: Floats) -> Floats:
        """Standardised sound (N, 2R, bins) of N frames, each behind the one before it -> (N, W)."""
        return self.engine.run("hear", rows)[0]

    def standardise(self, motion: Floats) -> Floats:
        """Motion (..., C) of the model's motion space -> the units it works in."""
        return np.asarray((motion - self._scales["motion_mean"]) / self._scales["motion_std"], np.float32)

    def standardise_sound(self, rows: Floats) -> Floats:
        """Rows (..., bins) of sound features, likewise."""
        return np.asarray((rows - self._scales["sound_mean"]) / self._scales["sound_std"], np.float32)

    def _still(self, frames: int) -> Floats:
        """(frames, C) of a face at rest, standardised."""
        return np.repeat(self.standardise(self.space.neutral.astype(np.float32)[None]), frames, axis=0)

    def _hear(self, speakers: Sequence[SpeakerFrame], before: Sequence[SpeakerState]) -> list[SpeakerState]:
        """Of every stream, with the newest frame in place of the oldest."""
        for speaker in speakers:
            if len(speaker.audio) not in (0, FRAME_SAMPLES):
                raise ValueError(
                    f"a frame at {AUDIO_HZ} Hz has {FRAME_SAMPLES} samples or none, got {len(speaker.audio)}"
                )
        found = [self.frontend.step(one.audio, state.audio) for one, state in zip(speakers, before, strict=True)]
        rows = [
            self.standardise_sound(sound) * np.float32(len(speaker.audio) > 0)
            for speaker, (sound, _, _) in zip(speakers, found, strict=True)
        ]
        voices = self.voices(
            np.stack([np.concatenate(two) for two in zip((s.rows for s in before), rows, strict=True)])
        )
        out = []
        for speaker, state, (_, phase, audio), row, voice in zip(speakers, before, found, rows, voices, strict=True):
            face, known = self._face(speaker)
            out.append(
                SpeakerState(
                    audio,
                    row,
                    voice=_push(state.voice, voice),
                    heard=_push(state.heard, np.bool_(len(speaker.audio) > 0)),
                    phase=_push(state.phase, phase),
                    face=_push(state.face, face),
                    face_known=_push(state.face_known, np.bool_(known)),
                )
            )
        return out

    def _face(self, speaker: SpeakerFrame) -> tuple[Floats, bool]:
        """(C,) standardised, and whether it is known."""
        if speaker.face is None or not np.isfinite(speaker.face.motion).all():
            return np.zeros(self.space.dim, np.float32), False
        return self.standardise(self.space.encode(speaker.face.motion[None]))[0], True


def _push(queue: NDArray[Any], new: NDArray[Any] | np.bool_) -> NDArray[Any]:
    """(P, ...) without its oldest row and with `new` (...) as its newest."""
    out = np.empty_like(queue)
    out[:-1] = queue[1:]
    out[-1] = new
    return out


def _stacked(parts: Sequence[Any], name: str) -> NDArray[Any]:
    return np.stack([getattr(part, name) for part in parts])


def _seen(speakers: Sequence[SpeakerState], tokens: Tokens, control: Floats) -> Seen:
    """One batch; one speaker alone where all streams have the same."""
    if all(speaker is speakers[0] for speaker in speakers):
        speakers = speakers[:1]
    face, known, voice, heard, phase = (
        _stacked(speakers, name) for name in ("face", "face_known", "voice", "heard", "phase")
    )
    return Seen(face, known, voice, heard, phase, tokens, control)


def join(tail: Floats, decoded: Floats, seam: int) -> Floats:
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
    u = np.minimum(np.arange(1, decoded.shape[-2] - 1, dtype=np.float32) / np.float32(seam), 1)[:, None]
    fade = offset * (1 - u) ** 2 * (1 + 2 * u) + speed * seam * u * (1 - u) ** 2
    return np.concatenate([tail, decoded[..., 2:, :] + fade], axis=-2)
