"""ARIG as it runs: one speaker frame in, our face of the next frame out, and a memory of fixed size.

What has not changed is not computed again: behaviours of old frames, keys and values of old sounds, motions and whole
chunks are kept. Only the chunk in progress is read anew, since
the newest sounds modulate all of it.

A listener with events (`config.Listener.events`) takes two control rows a frame, of the frame heard and of the frame to
be made. Its conversational state is drawn (`sojourns`); a stream of the paper's goes on from its most probable one.

The robot's own voice belongs to the frame that is made, so `SpeakerFrame.agent_audio` is best given one frame early:
its samples are those the robot says in the 40 ms after `time_s`. Given on time, lips follow one frame late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.errors import ModelError
from sfms_robot.frames import FRAME_S, Doubles, Floats, Plan, SpeakerFrame, changed
from sfms_robot.listeners.arig import audio_frontend
from sfms_robot.listeners.arig.audio_frontend import AudioState
from sfms_robot.listeners.arig.rotary import rotary
from sfms_robot.listeners.arig.sojourns import CONTROL_ROWS, FIRST, Sojourn, draw_sojourn, with_feedback
from sfms_robot.listeners.engine import Engine, RunsOnEngine, stacked
from sfms_robot.listeners.idle import HeadSway
from sfms_robot.listeners.lots import Use, normals, uniforms
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS

BEYOND = 1e3  # rad, m or of a blendshape: no face


@dataclass(frozen=True)
class Memory:
    """What one stream remembers. Values only, all of fixed size: a step makes a new one.

    Attributes:
        seed: what it draws hangs on it (`lots`).
        frames: how many have been heard.
        user_voice, agent_voice: samples and phrase of both tracks.
        agent_sound: (D,) embedded, of the agent's last frame.
        agent_behaviour, user_behaviour: (c, D) of the last c frames, the newest last.
        sound_keys: (3, 2D) of the agent's last sounds; motion_keys: (5, 2D) of its last motions.
        context: (2L, h, w - 1, D/h) keys and values of whole chunks, layer by layer, the newest last.
        motion: (D,) embedded motion of the agent's last frame; standard: (C,) the same, standardised; sample: (C,) the
            step to it, as the sampler draws steps; all without sway.
        state: conversational state of the last frame, of `settings.states`; sojourn: that which it is drawn from, of a
            listener with events.
        sway: this stream's own (`HeadSway.start`).
    """

    seed: int
    frames: int
    user_voice: AudioState
    agent_voice: AudioState
    agent_sound: Floats
    agent_behaviour: Floats
    user_behaviour: Floats
    sound_keys: Floats
    motion_keys: Floats
    context: Floats
    motion: Floats
    standard: Floats
    sample: Floats
    state: int
    sojourn: Sojourn
    sway: Doubles


@dataclass(frozen=True)
class Heard:
    """One frame of both people: features of user and agent (2, A), which of them are there (2,), the user's face (C,)
    standardised, whether it is seen, and the audio of the next frame.
    """

    sounds: Floats
    present: NDArray[np.bool_]
    face: Floats
    seen: bool
    user_voice: AudioState
    agent_voice: AudioState

    @property
    def voiced(self) -> tuple[bool, bool]:
        """Speech of agent, user."""
        return self.agent_voice.voiced, self.user_voice.voiced


class ArigListener(RunsOnEngine):
    """`ports.BatchListener`. Holds weights only: its engine does, which runs the networks of `frame`."""

    hop = horizon = 1

    def __init__(self, settings: config.Arig, engine: Engine, space: MotionSpace | None = None) -> None:
        """Raises ModelError for a model that hears with features nothing here computes (sound: wav2vec2)."""
        if settings.sound != "mel":
            raise ModelError(f"sound = {settings.sound!r}: such a model can be trained and evaluated, not run (mel)")
        self.settings = settings
        self.engine = engine
        self.space = space or MotionSpace.of(settings)
        self.sway = HeadSway(settings, engine.tensors)
        self._noise_shape = (1, 1) if settings.discrete else (settings.diffusion.steps, len(settings.channels))

    @property
    def control_frames(self) -> tuple[int, int]:
        """Control rows that a step takes: up to the newest frame heard, and after it."""
        return (1, CONTROL_ROWS - 1) if self.settings.events else (0, 0)

    def start(self, seed: int) -> Memory:
        """Memory of a stream that has heard nothing and looked neutral so far (A.2)."""
        settings = self.settings
        d, c, heads = settings.width, settings.chunk_frames, settings.heads
        still = self.standardise(self.space.neutral.astype(np.float32))
        motion, silence, motion_key, sound_key = (part[0] for part in self.engine.run("rest", still[None]))
        room = settings.context_chunks - 1
        return Memory(
            seed=seed,
            frames=0,
            user_voice=audio_frontend.start(),
            agent_voice=audio_frontend.start(),
            agent_sound=silence,
            agent_behaviour=np.zeros((c, d), np.float32),
            user_behaviour=np.zeros((c, d), np.float32),
            sound_keys=np.tile(sound_key, (settings.sound_frames, 1)),
            motion_keys=np.tile(motion_key, (settings.motion_frames, 1)),
            context=np.zeros((2 * settings.context_layers, heads, room, d // heads), np.float32),
            motion=motion,
            standard=still,
            sample=np.zeros_like(still),
            state=FIRST,
            sojourn=Sojourn(FIRST, 0),
            sway=self.sway.start(seed),
        )

    def step(self, speaker: SpeakerFrame, memory: Memory, control: Floats | None = None) -> tuple[Plan, Memory]:
        """Take one frame, plan the next. Never changes `memory` in place.

        `control` (2, K): rows of `signals.control` of the frame heard and of the next; None: nothing happens. Raises
        ValueError when the frame holds another number of samples than 640 or none, for control of another shape, and
        for any where the listener has no events.
        """
        return self._stepped([speaker], [memory], None if control is None else [control])[0]

    def step_each(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[Memory], controls: Sequence[Floats] | None = None
    ) -> list[tuple[Plan | None, Memory]]:
        """See `ports.BatchListener`; controls as of `step`."""
        return [*self._stepped(speakers, memories, controls)]

    def step_many(
        self, speaker: SpeakerFrame, memories: Sequence[Memory], controls: Sequence[Floats] | None = None
    ) -> tuple[list[Plan], list[Memory]]:
        """`step` of streams that began together and heard the same speaker ever since, each with its own control.

        As `step_each`, and the speaker is listened to once.
        """
        found = self._stepped([speaker] * len(memories), memories, controls, self._hear([speaker], memories[:1]))
        return [plan for plan, _ in found], [memory for _, memory in found]

    def condition(self, speaker: SpeakerFrame, memory: Memory, control: Floats | None = None) -> tuple[Floats, Memory]:
        """What the sampler is told of the next frame, (1, its width), and the memory but for what is to be drawn."""
        rows = self._rows(None if control is None else [control], 1)
        z, _, (now,) = self._conditions(self._hear([speaker], [memory]), [memory], rows)
        return z, now

    def _stepped(
        self,
        speakers: Sequence[SpeakerFrame],
        memories: Sequence[Memory],
        controls: Sequence[Floats] | None,
        heard: Sequence[Heard] | None = None,
    ) -> list[tuple[Plan, Memory]]:
        """Every stream one frame on. `heard`: what all of them heard, if that was worked out already."""
        rows = self._rows(controls, len(memories))
        if heard is None:
            heard = self._hear(speakers, memories)
        elif len(heard) < len(memories):
            heard = [*heard] * len(memories)
        z, logits, now = self._conditions(heard, memories, rows)
        noise = np.stack([normals(memory.seed, memory.frames, Use.NOISE, *self._noise_shape) for memory in now])
        inputs = [z, noise, _stacked(now, "standard"), _stacked(now, "motion_keys")]
        told = [rows, np.array([one.voiced[0] for one in heard])] if self.settings.events else []
        made, standard, sample, motion, keys = self.engine.run("draw", *inputs, *told)
        newest = np.array([memory.frames for memory in now])
        shown = self.sway.added(made[:, None].copy(), _stacked(now, "sway"), newest)
        sojourns, states = self._states(logits, now, rows, heard)
        out = []
        for index, (speaker, memory) in enumerate(zip(speakers, now, strict=True)):
            frames, jaw_rad = self.space.decode(shown[index])
            plan = Plan(speaker.time_s, np.array([speaker.time_s + FRAME_S]), frames, jaw_rad)
            after = changed(
                memory,
                motion=motion[index],
                standard=standard[index],
                sample=sample[index],
                motion_keys=keys[index],
                state=states[index],
                sojourn=sojourns[index],
            )
            out.append((plan, after))
        return out

    def _conditions(
        self, heard: Sequence[Heard], memories: Sequence[Memory], rows: Floats
    ) -> tuple[Floats, Floats, list[Memory]]:
        """What the sampler is told (N, its width), logits of the states (N, S), and memories but for what is drawn."""
        z, logits, made, *rest = self.engine.run("frame", *self._frame_inputs(heard, memories, rows))
        agent_sound, agent_behaviour, user_behaviour, sound_keys = rest
        after = []
        for index, (one, memory) in enumerate(zip(heard, memories, strict=True)):
            frames, context = memory.frames + 1, memory.context
            if frames % self.settings.chunk_frames == 0:
                context = np.concatenate([context[:, :, 1:], made[index][:, :, None]], axis=2)
            after.append(
                changed(
                    memory,
                    frames=frames,
                    user_voice=one.user_voice,
                    agent_voice=one.agent_voice,
                    agent_sound=agent_sound[index],
                    agent_behaviour=agent_behaviour[index],
                    user_behaviour=user_behaviour[index],
                    sound_keys=sound_keys[index],
                    context=context,
                )
            )
        return z, logits, after

    def _states(
        self, logits: Floats, now: Sequence[Memory], rows: Floats, heard: Sequence[Heard]
    ) -> tuple[list[Sojourn], list[int]]:
        """States of the frame that is made: the most probable, or drawn where the model has events."""
        before = [memory.sojourn for memory in now]
        if not self.settings.state_guidance:
            return before, [memory.state for memory in now]
        if not self.settings.events:
            return before, logits.argmax(-1).tolist()
        durations, possible = (self.engine.tensors[f"states.{name}"] for name in ("durations", "possible"))
        sojourns = [
            draw_sojourn(durations, possible, scores, one.voiced, last, uniforms(own.seed, own.frames, Use.STATE, 2))
            for scores, one, last, own in zip(logits, heard, before, now, strict=True)
        ]
        drawn = np.array([sojourn.state for sojourn in sojourns])
        return sojourns, with_feedback(drawn, rows[:, -len(COLUMNS) :]).tolist()

    def _rows(self, controls: Sequence[Floats] | None, streams: int) -> Floats:
        """(streams, 2K); of a listener without events (streams, 0)."""
        if not self.settings.events:
            if controls is not None:
                raise ValueError("control is for a listener with events: true")
            return np.zeros((streams, 0), np.float32)
        if controls is None:
            return np.zeros((streams, CONTROL_ROWS * len(COLUMNS)), np.float32)
        rows = np.stack([np.asarray(control, np.float32) for control in controls])
        if rows.shape != (streams, CONTROL_ROWS, len(COLUMNS)):
            raise ValueError(
                f"control is {rows.shape[1:]} of {len(rows)}, not {(CONTROL_ROWS, len(COLUMNS))} of {streams}"
            )
        return rows.reshape(streams, -1)

    def _hear(self, speakers: Sequence[SpeakerFrame], memories: Sequence[Memory]) -> list[Heard]:
        """Both people in the newest frame of each stream."""
        samples, voices = [], []
        for speaker, memory in zip(speakers, memories, strict=True):
            samples += [speaker.audio, audio_frontend.fit_frame(speaker.agent_audio)]
            voices += [memory.user_voice, memory.agent_voice]
        sounds, present, voices = audio_frontend.hear_each(samples, voices)
        here = np.array(present)
        return [
            Heard(sounds[at : at + 2], here[at : at + 2], *self._face(speaker), voices[at], voices[at + 1])
            for at, speaker in zip(range(0, len(samples), 2), speakers, strict=True)
        ]

    def _frame_inputs(self, heard: Sequence[Heard], memories: Sequence[Memory], rows: Floats) -> list[NDArray[Any]]:
        """What the network `frame` takes."""
        settings = self.settings
        frames = np.array([memory.frames for memory in memories])
        chunks, room = frames // settings.chunk_frames, settings.context_chunks - 1
        remembered = (
            "agent_sound",
            "agent_behaviour",
            "user_behaviour",
            "sound_keys",
            "motion",
            "motion_keys",
            "sample",
        )
        return [
            _stacked(heard, "sounds"),
            _stacked(heard, "present"),
            np.array([one.voiced for one in heard]),
            _stacked(heard, "face"),
            np.array([one.seen for one in heard]),
            frames == 0,
            np.array([memory.state for memory in memories]),
            rotary(chunks, settings.width // settings.heads),
            np.arange(room) >= room - np.minimum(chunks, room)[:, None],
            *(_stacked(memories, name) for name in remembered),
            rows,
            *(stacked([memory.context[part] for memory in memories]) for part in range(2 * settings.context_layers)),
        ]

    def _face(self, speaker: SpeakerFrame) -> tuple[Floats, bool]:
        """(C,) standardised, and whether it is seen; what is not finite or beyond all faces is not: memory would keep
        it.
        """
        motion = None if speaker.face is None else speaker.face.motion
        if motion is None or not np.abs(motion).max() < BEYOND:  # false for NaN too
            return np.zeros(len(self.settings.channels), np.float32), False
        return self.standardise(self.space.encode(motion[None]))[0], True


def _stacked(parts: Sequence[Any], name: str) -> NDArray[Any]:
    return stacked([getattr(part, name) for part in parts])
