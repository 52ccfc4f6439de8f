"""SFMS as it runs: one speaker frame in, and on every `hop`-th a plan of the next 8 frames out.

Tokens once drawn stay drawn while what they were drawn for holds: a new plan keeps what is left of the one before and
draws only the `hop` frames at its far end. So a keyframe is decided (future - hop) to future frames ahead, 0.16 to
0.32 s with hop 4, and re-planning cannot jitter. A listener that is told of events compares what it is told now with
what the tokens were drawn under: from the first future frame on for which that differs they are drawn anew, but never
the next frame's, which servos are already under way to. Frames that are kept show what they showed: the way to a
keyframe behind them begins at the last of them. What is behind the last keyframe drawn is an extrapolation,
which the next plan may correct: it starts where the motion was, at the speed it had, and the difference fades over
`seam_frames`.

Between plans nothing is computed: frames are kept, and become features with the next plan, all of them at once.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.frames import (
    AUDIO_HZ,
    CHANNEL_INDEX,
    FRAME_S,
    FRAME_SAMPLES,
    MOTION_DIM,
    SMILE_CORNERS,
    Doubles,
    Floats,
    Plan,
    SpeakerFrame,
    changed,
)
from sfms_robot.listeners.engine import Engine, RunsOnEngine, stacked
from sfms_robot.listeners.idle import HEAD, HeadSway
from sfms_robot.listeners.sfms.audio_frontend import AudioFrontend, AudioState
from sfms_robot.listeners.sfms.draw import Reach, Sampler, Seen, ToldCourse
from sfms_robot.listeners.sfms.keyframes import UNDECIDED, Tokens, around, later, neutral_mask, passed, revoked
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS

_NO_FACE: Final = np.full(MOTION_DIM, np.nan, np.float32)


@dataclass(frozen=True)
class SpeakerState:
    """The speaker's last P frames up to the newest plan, the newest last, as `draw.Seen` wants them (no batch); and
    what was heard since then, which becomes features with the next plan, all of it at once.

    Attributes:
        sounds, faces: of every frame since: its samples, and its motion (58,), NaN where no face is known.
        audio: what unfinished features still need.
        rows: (R, bins) sound of the newest of the P frames, standardised.
    """

    sounds: tuple[Floats, ...]
    faces: tuple[Floats, ...]
    audio: AudioState
    rows: Floats
    voice: Floats
    heard: NDArray[np.bool_]
    phase: Floats
    face: Floats
    face_known: NDArray[np.bool_]


@dataclass(frozen=True)
class Memory:
    """What one stream remembers; values only: a step makes a new one. All but `frames` is as of the newest plan.

    Attributes:
        seed: what it draws hangs on it (`lots`).
        frames: how many have been heard.
        speaker: of the last P frames.
        tokens: (P + H, G) own tokens up to then, those drawn for the future, UNDECIDED.
        control: (P + H, K) what was told of each of those frames when they were drawn.
        path: (2 + H, C) standardised: the frame before, the frame itself, then the plan in force.
        sway: this stream's own (`HeadSway.start`).
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
        self.sway = HeadSway(settings, engine.tensors)
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
        self.sampler = Sampler(settings, engine, reach, self._courses(codes[0]))

    def _courses(self, codes: Floats) -> list[ToldCourse]:
        """That this listener keeps to, of the standardised motion (V, C) of every code."""
        sampling, found = self.settings.sampling, []
        for how, name, shown in (
            (sampling.nod, self.settings.nodding_group, ("pitch",)),
            (sampling.smile, self.settings.smiling_group, SMILE_CORNERS),
        ):
            if how is not None and name is not None:
                found.append(
                    ToldCourse(how, list(self.settings.groups).index(name), self._shown_by(codes, name, shown))
                )
        return found

    def _shown_by(self, codes: Floats, group: str, shown: Sequence[str]) -> Doubles:
        """What every code (V, C) of a group makes of these channels of our motion, in the mean, on a face at rest."""
        own = [self.settings.channels.index(name) for name in self.settings.groups[group].channels]
        rows = self._still(self.settings.groups[group].codes)
        rows[:, own] = codes[: len(rows), own]
        motion, _ = self.space.decode(rows * self._scales["motion_std"] + self._scales["motion_mean"])
        return np.asarray(motion[:, [CHANNEL_INDEX[name] for name in shown]].mean(axis=1), np.float64)

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
            sounds=(),
            faces=(),
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
        return Memory(seed, 0, speaker, tokens, control, path, self.sway.start(seed))

    def at_rest(self) -> tuple[Tokens, Floats]:
        """Tokens (P + H, G) and path (2 + H, C) of a neutral face that has no plan yet."""
        undecided = np.full((self.horizon, self._neutral.shape[1]), UNDECIDED)
        return np.concatenate([self._neutral, undecided]), self._still(2 + self.horizon)

    def is_due(self, memory: Memory) -> bool:
        """Whether the next frame brings a plan."""
        return memory.frames % self.hop == 0

    def step(self, speaker: SpeakerFrame, memory: Memory, control: Floats | None = None) -> tuple[Plan | None, Memory]:
        """Take one frame; a Plan on every `hop`-th, None between. Never changes `memory` in place.

        `control`: rows of `signals.control` for the `control_frames` up to this frame and after it, (P + H, K); None
        for a listener that is not told of events, and for a frame that brings no plan.

        Raises ValueError when the frame holds another number of samples than 640 or none, or control another shape.
        """
        return self.step_each([speaker], [memory], [control])[0]

    def step_each(
        self,
        speakers: Sequence[SpeakerFrame],
        memories: Sequence[Memory],
        controls: Sequence[Floats | None] | None = None,
    ) -> list[tuple[Plan | None, Memory]]:
        """See `ports.BatchListener`; controls as of `step`. Those that are due are planned together."""
        heard = [_listened(*each) for each in zip(speakers, [memory.speaker for memory in memories], strict=True)]
        return self._stepped([frame.time_s for frame in speakers], heard, memories, controls)

    def step_many(
        self, speaker: SpeakerFrame, memories: Sequence[Memory], controls: Sequence[Floats | None] | None = None
    ) -> tuple[list[Plan], list[Memory]]:
        """`step` of streams that began together and heard the same speaker ever since; no plans between hops.

        As `step_each`, and the speaker is listened to once.
        """
        heard = [_listened(speaker, memories[0].speaker)] * len(memories)
        found = self._stepped([speaker.time_s] * len(memories), heard, memories, controls)
        return [plan for plan, _ in found if plan is not None], [memory for _, memory in found]

    def _stepped(
        self,
        times_s: Sequence[float],
        heard: Sequence[SpeakerState],
        memories: Sequence[Memory],
        controls: Sequence[Floats | None] | None,
    ) -> list[tuple[Plan | None, Memory]]:
        """Every stream one frame on, what its speaker did in it heard already."""
        found: list[tuple[Plan | None, Memory]] = [
            (None, changed(memory, frames=memory.frames + 1, speaker=speaker))
            for memory, speaker in zip(memories, heard, strict=True)
        ]
        due = [row for row, memory in enumerate(memories) if self.is_due(memory)]
        if due:
            told = self.told([None if controls is None else controls[row] for row in due])
            planned = self._planned([times_s[row] for row in due], [found[row][1] for row in due], told)
            for row, each in zip(due, planned, strict=True):
                found[row] = each
        return found

    def _planned(self, times_s: Sequence[float], memories: Sequence[Memory], told: Floats) -> list[tuple[Plan, Memory]]:
        """Plans of streams that have heard all up to now, told (B, P + H, K), and their memories with them."""
        tokens, path, control = self._moved_on(memories)
        speakers, seen = self._taken_in([memory.speaker for memory in memories])
        tokens, settled = revoked(tokens, control, told, self.horizon)
        newest = [memory.frames - 1 for memory in memories]
        window = Seen(**seen, tokens=tokens, control=told, settled=settled)
        tokens, path = self.plan(window, path, [memory.seed for memory in memories], newest)
        sway = stacked([memory.sway for memory in memories])
        plans = self._plans(times_s, self.with_sway(self.shown(path), sway, np.array(newest) + 1))
        after = [
            changed(memory, speaker=speaker, tokens=own, control=rows, path=way)
            for memory, speaker, own, rows, way in zip(memories, speakers, tokens, told, path, strict=True)
        ]
        return list(zip(plans, after, strict=True))

    def _moved_on(self, memories: Sequence[Memory]) -> tuple[Tokens, Floats, Floats]:
        """Tokens, path and control (B, ...) of now, the frames heard since the last plan further on."""
        tokens, path, control = (
            stacked([getattr(memory, name) for memory in memories]) for name in ("tokens", "path", "control")
        )
        since = [len(memory.speaker.sounds) for memory in memories]
        if len(set(since)) == 1:
            return *passed(tokens, path, since[0], self.holds), later(control, since[0])
        for frames in set(since):
            rows = [row for row, own in enumerate(since) if own == frames]
            tokens[rows], path[rows] = passed(tokens[rows], path[rows], frames, self.holds)
            control[rows] = later(control[rows], frames)
        return tokens, path, control

    def told(self, controls: Sequence[Floats | None]) -> Floats:
        """What the predictor is told of controls as of `step`, (B, P + H, K).

        Raises ValueError for another shape, and where nothing is told to one that must be.
        """
        rows = sum(self.control_frames)
        if not self._columns and all(one is None for one in controls):
            return np.zeros((len(controls), self.settings.window_frames, 0), np.float32)
        told = [one for one in controls if one is not None]
        if len(told) < len(controls):
            raise ValueError(f"this listener is told of events: control ({rows}, {self._columns}) is missing")
        if any(one.shape != (rows, self._columns) for one in told):
            shapes = ", ".join(str(one.shape) for one in told)
            raise ValueError(f"control has shape {shapes}, not {len(told)} times ({rows}, {self._columns})")
        return stacked(told).astype(np.float32)

    def with_sway(self, shown: Floats, sway: Doubles, first: int | NDArray[np.int64]) -> Floats:
        """Motion (..., N, C), standardised, of frames `first`, `first` + 1, ... -> in the model's space, with the slow
        motion (..., 3, L, S) of each stream; `first` is of all streams, or (...) of each.
        """
        motion = shown * self._scales["motion_std"] + self._scales["motion_mean"]
        return self.sway.added(motion, sway, first)

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
        (decoded,) = self.engine.run("decode", tokens, *around(tokens))
        return tokens, join(path[:, :2], decoded, self.settings.sampling.seam_frames)

    def voices(self, rows: Floats) -> Floats:
        """Standardised sound (N, 2R, bins) of N frames, each behind the one before it -> (N, W)."""
        return self.engine.run("hear", rows)[0]

    def standardise_sound(self, rows: Floats) -> Floats:
        """Rows (..., bins) of sound features, likewise."""
        return np.asarray((rows - self._scales["sound_mean"]) / self._scales["sound_std"], np.float32)

    def _still(self, frames: int) -> Floats:
        """(frames, C) of a face at rest, standardised."""
        return np.repeat(self.standardise(self.space.neutral.astype(np.float32)[None]), frames, axis=0)

    def _taken_in(self, states: Sequence[SpeakerState]) -> tuple[Sequence[SpeakerState], dict[str, NDArray[Any]]]:
        """States whose frames since the last plan are among their P; and those of all, the speaker's part of a `Seen`:
        one speaker alone where all streams have the same.
        """
        if len(states) > 1 and all(state is states[0] for state in states):
            (state,), seen = self._taken_in(states[:1])
            return [state] * len(states), seen
        counts = [len(state.sounds) for state in states]
        ends: NDArray[np.int64] = np.cumsum(counts, dtype=np.int64)
        rows, phase, audio = self.frontend.step_each(
            [state.sounds for state in states], [state.audio for state in states]
        )
        heard = np.array([len(sound) > 0 for state in states for sound in state.sounds])
        rows = self.standardise_sound(rows.reshape(-1, *self.frontend.shape)) * heard[:, None, None].astype(np.float32)
        face, known = self._faces([face for state in states for face in state.faces])
        new = {
            "face": face,
            "face_known": known,
            "voice": self.voices(_behind(rows, [state.rows for state in states], ends - counts)),
            "heard": heard,
            "phase": phase,
        }
        seen = {name: _pushed([getattr(state, name) for state in states], part, counts) for name, part in new.items()}
        after = [
            SpeakerState((), (), sound, rows[end - 1], **{name: part[row] for name, part in seen.items()})
            for row, (sound, end) in enumerate(zip(audio, ends.tolist(), strict=True))
        ]
        return after, seen

    def _faces(self, motion: Sequence[Floats]) -> tuple[Floats, NDArray[np.bool_]]:
        """Motion (58,) of N frames, not finite where no face is known -> (N, C) standardised, and which are known."""
        rows = stacked(motion)
        known: NDArray[np.bool_] = np.asarray(np.isfinite(rows).all(axis=1))
        faces = np.zeros((len(rows), self.space.dim), np.float32)
        if known.any():
            faces[known] = self.standardise(self.space.encode(rows[known]))
        return faces, known


def _listened(speaker: SpeakerFrame, before: SpeakerState) -> SpeakerState:
    """With the newest frame. Raises ValueError for another number of samples than those of a frame, or none."""
    if len(speaker.audio) not in (0, FRAME_SAMPLES):
        raise ValueError(f"a frame at {AUDIO_HZ} Hz has {FRAME_SAMPLES} samples or none, got {len(speaker.audio)}")
    face = _NO_FACE if speaker.face is None else speaker.face.motion
    sound = np.array(speaker.audio, np.float32)  # whoever gave it may use it again
    return changed(before, sounds=(*before.sounds, sound), faces=(*before.faces, face))


def _behind(rows: Floats, before: Sequence[Floats], begins: NDArray[np.int64]) -> Floats:
    """Rows (N, R, bins) of N frames, each behind those of the frame before it: (N, 2R, bins). Streams begin at
    `begins`, and theirs are `before`.
    """
    size = rows.shape[1]
    out = np.empty((len(rows), 2 * size, rows.shape[2]), np.float32)
    out[:, size:] = rows
    out[1:, :size] = rows[:-1]
    out[begins, :size] = before
    return out


def _pushed(queues: Sequence[NDArray[Any]], new: NDArray[Any], counts: Sequence[int]) -> NDArray[Any]:
    """Queues (P, ...) -> (N, P, ...), each with its share of `new`, as many as `counts` says, for its oldest."""
    longest = len(queues[0])
    out = np.empty((len(queues), *queues[0].shape), queues[0].dtype)
    end = 0
    for row, (queue, count) in enumerate(zip(queues, counts, strict=True)):
        end += count
        kept = max(longest - count, 0)
        out[row, :kept] = queue[longest - kept :]
        out[row, kept:] = new[end - (longest - kept) : end]
    return out


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
