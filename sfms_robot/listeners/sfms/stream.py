"""SFMS as a stream: one speaker frame in, and on every `hop`-th a plan of the next 8 frames out. numpy only.

A new plan keeps the remaining tokens of the plan before and draws only its last `hop` frames. So a keyframe is decided
(future - hop) to future frames ahead, 0.16 to 0.32 s with hop 4, and planning again cannot jitter. Only an event that
is decided meanwhile revokes tokens: `draw` shows the window as a timeline. Motion after the last drawn keyframe is an
extrapolation, which the next plan may correct: the new plan starts at the place and speed of the motion so far, and the
difference fades over `seam_frames` (`join`).

Between plans nothing is computed: frames are kept, and all become features at once with the next plan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot import config
from sfms_robot.frames import (
    CHANNEL_INDEX,
    MOTION_DIM,
    SMILE_CORNERS,
    Bools,
    Doubles,
    Floats,
    Ints,
    Plan,
    SpeakerFrame,
    changed,
)
from sfms_robot.listeners.audio_frontend import AudioFrontend, AudioState, check_length
from sfms_robot.listeners.engine import Engine, RunsOnEngine, stacked
from sfms_robot.listeners.idle import HEAD, HeadSway
from sfms_robot.listeners.sfms.draw import (
    UNDECIDED,
    Context,
    EventCourse,
    Sampler,
    Tokens,
    around,
    later,
    neutral_mask,
    passed,
    revoked,
)
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS

_NO_FACE: Final = np.full(MOTION_DIM, np.nan, np.float32)


@dataclass(frozen=True, kw_only=True)
class SpeakerState:
    """The speaker's last P frames up to the newest plan, the newest last, and the frames since then.

    Attributes:
        sounds, faces: samples and motion (58,) of every frame since then; motion is NaN where no face is known.
        audio: state of unfinished features.
        rows: (R, bins) sound of the newest of the P frames, standardised.
        voice, heard, phase, face, face_known: (P, ...) of the P frames, as in `draw.Context`.
    """

    sounds: tuple[Floats, ...] = ()
    faces: tuple[Floats, ...] = ()
    audio: AudioState
    rows: Floats
    voice: Floats
    heard: Bools
    phase: Floats
    face: Floats
    face_known: Bools


@dataclass(frozen=True, kw_only=True)
class SfmsMemory:
    """Memory of one stream; values only: a step makes a new one. `tokens`, `control`, `path` are of the newest plan.

    Attributes:
        seed: seed of all its random numbers (`stream_rng`).
        frames: number of frames so far.
        speaker: the last P frames up to the newest plan, and the frames since then.
        tokens: (P + H, G) own tokens: past, drawn for the future, UNDECIDED.
        control: (P + H, K) control rows with which the tokens were drawn.
        path: (2 + H, C) standardised: the frame before, the frame itself, then the plan in force.
        sway: sway of this stream (`HeadSway.start`).
    """

    seed: int
    frames: int
    speaker: SpeakerState
    tokens: Tokens
    control: Floats
    path: Floats
    sway: Doubles


class SfmsListener(RunsOnEngine):
    """SFMS as a stream; its engine runs `model.networks`."""

    def __init__(self, settings: config.Sfms, engine: Engine, folder: Path | None = None) -> None:
        """Create the listener; files that the settings name (a matrix, a model of sound) are in its `folder`.

        Raises ConfigError or ModelError.
        """
        self.settings = settings
        self.engine = engine
        self.space = MotionSpace.of(settings, folder)
        self.frontend = AudioFrontend.of(settings, folder)
        self._scales = engine.tensors
        self.sway = HeadSway(settings, engine.tensors)
        # Only the head is smoothed: its codes are coarse, and corners of its path make servos audible.
        self._smoothing = np.array([channel in HEAD for channel in settings.channels], np.float32)
        self._smoothing *= np.float32(settings.sampling.smoothing)
        self.hop, self.horizon = settings.hop_frames, settings.future_frames
        self.hops = range(1, self.horizon + 1) if settings.hop == "auto" else (self.hop,)
        if settings.events:
            self.control_frames, self.control_columns = (settings.past_frames, self.horizon), len(COLUMNS)
        # Penalised keyframes hold until the next one: a keyframe that leaves the window has to be kept.
        self.holds = settings.placement == "penalised"
        # A stream begins with a still, neutral face: the paper trains with a neutral sequence before each clip (IV-C).
        mask = neutral_mask(settings.past_frames, len(settings.groups))
        neutral, (codes,) = engine.run("rest", self._still(settings.past_frames)[None], mask[None])
        self._neutral = neutral[0]
        p = settings.past_frames
        self._unheard = SpeakerState(
            audio=self.frontend.start(),
            rows=np.zeros(self.frontend.shape, np.float32),
            voice=np.zeros((p, settings.predictor_width), np.float32),
            heard=np.zeros(p, np.bool_),
            phase=np.zeros((p, self.frontend.phase_features), np.float32),
            face=np.zeros((p, self.space.dim), np.float32),
            face_known=np.zeros(p, np.bool_),
        )
        self.sampler = Sampler(settings, engine, codes, self._courses(codes))

    def _courses(self, codes: Floats) -> list[EventCourse]:
        """Return the courses that this listener follows; `codes` (V, C): standardised motion of every code."""
        sampling = self.settings.sampling
        courses = []
        for how, group, shown in (
            (sampling.nod, self.settings.nodding_group, ("pitch",)),
            (sampling.smile, self.settings.smiling_group, SMILE_CORNERS),
        ):
            if how is None or group is None:
                continue
            # The mean of the channels shown for each code of the group, on a face at rest.
            own = [self.settings.channels.index(name) for name in self.settings.groups[group].channels]
            rows = self._still(self.settings.groups[group].codes)
            rows[:, own] = codes[: len(rows), own]
            motion, _ = self.space.decode(rows * self._scales["motion_std"] + self._scales["motion_mean"])
            values = np.asarray(motion[:, [CHANNEL_INDEX[name] for name in shown]].mean(axis=1), np.float64)
            courses.append(EventCourse(how, list(self.settings.groups).index(group), values))
        return courses

    def start(self, seed: int) -> SfmsMemory:
        """Return the memory of a stream without sound so far and with a neutral face."""
        tokens, path = self.at_rest()
        control = np.zeros((len(tokens), self.control_columns), np.float32)
        return SfmsMemory(
            seed=seed,
            frames=0,
            speaker=self._unheard,
            tokens=tokens,
            control=control,
            path=path,
            sway=self.sway.start(seed),
        )

    def at_rest(self) -> tuple[Tokens, Floats]:
        """Return tokens (P + H, G) and path (2 + H, C) of a neutral face that has no plan yet."""
        undecided = np.full((self.horizon, self._neutral.shape[1]), UNDECIDED)
        return np.concatenate([self._neutral, undecided]), self._still(2 + self.horizon)

    def is_due(self, memory: SfmsMemory) -> bool:
        """Return whether the next frame brings a plan."""
        return memory.frames % self.hop == 0

    def step_each(
        self,
        speakers: Sequence[SpeakerFrame],
        memories: Sequence[SfmsMemory],
        controls: Sequence[Floats | None] | None = None,
    ) -> list[tuple[Plan | None, SfmsMemory]]:
        """Advance every stream by one frame: a Plan on every `hop`-th, None between. Due plans are made together.

        Streams that began together with the same speaker share its state, so its features are computed once.
        """
        heard: dict[tuple[int, int], SpeakerState] = {}
        found: list[tuple[Plan | None, SfmsMemory]] = []
        for speaker, memory in zip(speakers, memories, strict=True):
            same = id(speaker), id(memory.speaker)
            if same not in heard:
                check_length(speaker.audio)
                face = _NO_FACE if speaker.face is None else speaker.face.motion
                # Nothing is computed until the next plan (see the module).
                sound = np.array(speaker.audio, np.float32)  # a copy: the caller may use the array again
                before = memory.speaker
                heard[same] = changed(before, sounds=(*before.sounds, sound), faces=(*before.faces, face))
            found.append((None, changed(memory, frames=memory.frames + 1, speaker=heard[same])))
        due = [row for row, memory in enumerate(memories) if self.is_due(memory)]  # memories before this frame
        if due:
            told = self.told([None if controls is None else controls[row] for row in due])
            control = told.reshape(len(due), self.settings.window_frames, self.control_columns)
            planned = self._planned([speakers[row].time_s for row in due], [found[row][1] for row in due], control)
            for row, each in zip(due, planned, strict=True):
                found[row] = each
        return found

    def _planned(
        self, times_s: Sequence[float], memories: Sequence[SfmsMemory], control: Floats
    ) -> list[tuple[Plan, SfmsMemory]]:
        """Return plans made at these times by B streams with control (B, P + H, K), and their memories."""
        tokens, path, drawn_under = (
            stacked([getattr(memory, name) for memory in memories]) for name in ("tokens", "path", "control")
        )
        # 1. The window moves on by the frames since the last plan, which differ from stream to stream.
        since = np.array([len(memory.speaker.sounds) for memory in memories])
        moved, way, under = np.empty_like(tokens), np.empty_like(path), np.empty_like(drawn_under)
        for frames in set(since.tolist()):
            rows = since == frames
            moved[rows], way[rows] = passed(tokens[rows], path[rows], frames, self.holds)
            under[rows] = later(drawn_under[rows], frames)
        # 2. Events that were decided since then revoke tokens (`draw.revoked`).
        tokens, settled = revoked(moved, under, control, self.horizon)
        # 3. Sound and faces since then become features.
        speakers, seen = self._taken_in([memory.speaker for memory in memories])
        newest = [memory.frames - 1 for memory in memories]
        # 4. Undecided tokens are drawn and decoded.
        inputs = Context(**seen, tokens=tokens, control=control)
        tokens, path = self.plan(inputs, settled, way, [memory.seed for memory in memories], newest)
        # 5. The path becomes motion: the head smoothed, its slow sway added, in our motion space.
        motion = self.with_sway(self.shown(path), stacked([memory.sway for memory in memories]), np.array(newest) + 1)
        found = []
        for row, (at_s, memory) in enumerate(zip(times_s, memories, strict=True)):
            after = changed(memory, speaker=speakers[row], tokens=tokens[row], control=control[row], path=path[row])
            found.append((self.space.plan(at_s, motion[row]), after))
        return found

    def with_sway(self, shown: Floats, sway: Doubles, first: int | Ints) -> Floats:
        """Return motion in the model's space of standardised motion (..., N, C), with the slow motion of the head.

        Args:
            shown: motion of frames `first`, `first` + 1, ...
            sway: (..., 3, 1 + L, S) sway of each stream.
            first: one number for all streams, or (...) for each.
        """
        return self.sway.added(shown * self._scales["motion_std"] + self._scales["motion_mean"], sway, first)

    def shown(self, path: Floats) -> Floats:
        """Return the future (..., H, C) of a path (..., 2 + H, C), standardised, with the head smoothed."""
        if not self.settings.sampling.smoothing:
            return path[..., 2:, :]
        # x_t + s ((x_(t-1) + x_(t+1)) / 2 - x_t); after the last frame the motion continues straight.
        beyond = 2 * path[..., -1:, :] - path[..., -2:-1, :]
        before, own = path[..., 1:-1, :], path[..., 2:, :]
        after = np.concatenate([path[..., 3:, :], beyond], axis=-2)
        return np.asarray(own + self._smoothing * ((before + after) / 2 - own))

    def plan(
        self, seen: Context[Any], settled: Tokens, path: Floats, seeds: Sequence[int], newest: Sequence[int]
    ) -> tuple[Tokens, Floats]:
        """Return the tokens (B, P + H, G) and path (B, 2 + H, C) of a new plan of B streams.

        Args:
            seen, settled: as for `Sampler.draw`.
            path: (B, 2 + H, C) the old plan, as played so far.
            seeds: seed of each stream.
            newest: number of the newest frame of each stream, from 0 at its beginning.
        """
        # Equation (11): the tokens of the undecided frames; then equations (9) and (10): tokens become motion.
        tokens = self.sampler.draw(seen, settled, seeds, [frame + self.horizon for frame in newest])
        (decoded,) = self.engine.run("decode", tokens, *around(tokens))
        return tokens, join(path[:, :2], decoded, self.settings.sampling.seam_frames)

    def voices(self, rows: Floats) -> Floats:
        """Return vectors (N, W) of standardised sound (N, 2R, bins) of N frames, each after the frame before it."""
        return self.engine.run("hear", rows)[0]

    def standardise_sound(self, rows: Floats) -> Floats:
        """Return rows (..., bins) of sound features in the units of the model."""
        return np.asarray((rows - self._scales["sound_mean"]) / self._scales["sound_std"], np.float32)

    def _still(self, frames: int) -> Floats:
        """Return standardised motion (frames, C) of a face at rest."""
        return np.repeat(self.standardise(self.space.neutral.astype(np.float32)[None]), frames, axis=0)

    def _taken_in(self, states: Sequence[SpeakerState]) -> tuple[Sequence[SpeakerState], dict[str, Any]]:
        """Return states with the frames since the last plan among their P, and the speaker's part of `Context`.

        If all streams have the same speaker, that part has one stream.
        """
        if len(states) > 1 and all(state is states[0] for state in states):
            one, seen = self._taken_in(states[:1])
            return [*one] * len(states), seen
        counts = [len(state.sounds) for state in states]
        ends: Ints = np.cumsum(counts, dtype=np.int64)
        rows, phase, audio = self.frontend.step_each(
            [state.sounds for state in states], [state.audio for state in states]
        )
        # Features of all new frames of all streams, one stream after the other.
        heard = np.array([len(sound) > 0 for state in states for sound in state.sounds])
        # A frame without sound is 0, the mean of the data, not silence.
        rows = self.standardise_sound(rows.reshape(-1, *self.frontend.shape)) * heard[:, None, None].astype(np.float32)
        # Each frame after the one before it, the first of a stream after the newest of its last plan: (N, 2R, bins).
        last = np.concatenate([rows[:1], rows[:-1]])
        last[ends - counts] = [state.rows for state in states]
        face, known = self._faces([face for state in states for face in state.faces])
        new = {
            "face": face,
            "face_known": known,
            "voice": self.voices(np.concatenate([last, rows], axis=1)),
            "heard": heard,
            "phase": phase,
        }
        # Each queue of P frames loses its oldest and gains the new ones.
        found: dict[str, Any] = {}
        for name, part in new.items():
            each = zip(states, np.split(part, ends[:-1]), strict=True)
            queues = [np.concatenate([getattr(state, name), own]) for state, own in each]
            found[name] = np.stack([queue[-self.settings.past_frames :] for queue in queues])
        after = [
            SpeakerState(audio=sound, rows=rows[end - 1], **{name: part[row] for name, part in found.items()})
            for row, (sound, end) in enumerate(zip(audio, ends.tolist(), strict=True))
        ]
        return after, found

    def _faces(self, motion: Sequence[Floats]) -> tuple[Floats, Bools]:
        """Return standardised motion (N, C) and known faces (N,), of motion (58,) of N frames, NaN if not known."""
        rows = stacked(motion)
        known: Bools = np.asarray(np.isfinite(rows).all(axis=1))
        # A face that is not known is 0, the mean of the data; `face_known` marks it for the encoder.
        faces = np.zeros((len(rows), self.space.dim), np.float32)
        if known.any():
            faces[known] = self.standardise(self.space.encode(rows[known]))
        return faces, known


def join(tail: Floats, decoded: Floats, seam: int) -> Floats:
    """Return a plan that continues from where the motion was.

    Args:
        tail: (..., 2, C) the frame before and this frame as played.
        decoded: (..., 2 + H, C) the same two and the future, as the new tokens have them.
        seam: frames over which the difference fades.

    Returns:
        (..., 2 + H, C): `tail`, then `decoded` plus a cubic that begins with the difference in place and speed and
        ends flat: with u = frame / seam, offset (1 - u)^2 (1 + 2u) + speed seam u (1 - u)^2.
    """
    # Ours: the paper's windows end where the next begin; here each plan corrects the one before.
    gap = tail - decoded[..., :2, :]
    before, offset = gap[..., :1, :], gap[..., 1:, :]
    speed = offset - before
    u = np.minimum(np.arange(1, decoded.shape[-2] - 1, dtype=np.float32) / np.float32(seam), 1)[:, None]
    fade = offset * (1 - u) ** 2 * (1 + 2 * u) + speed * seam * u * (1 - u) ** 2
    return np.concatenate([tail, decoded[..., 2:, :] + fade], axis=-2)
