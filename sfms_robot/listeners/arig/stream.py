"""ARIG as a stream: one speaker frame in, our face of the next frame out, and a memory of fixed size. numpy only.

Nothing is computed twice: behaviours of old frames, keys and values of old sounds, motions and whole chunks are kept.
Only the chunk in progress is processed again, since the newest sounds modulate all of it.

Ours: a listener with events (`config.ListenerSettings.events`) accepts two control rows per frame: of the frame that
came and of the frame to be made. Its conversational state is drawn (`draw_sojourn`); a stream of the paper continues
from its most probable state.

The robot's own voice belongs to the frame that is made, so `SpeakerFrame.agent_audio` should come one frame early: its
samples are the robot's voice in the 40 ms after `time_s`. If it comes on time, lips follow one frame late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.config.listener import EVENT_STATES, STATES
from sfms_robot.errors import ModelError
from sfms_robot.frames import Bools, Doubles, Floats, Plan, SpeakerFrame, changed
from sfms_robot.listeners.audio_frontend import TRACKS, AudioState, fit_frame, hear_each
from sfms_robot.listeners.engine import Engine, RunsOnEngine, stacked
from sfms_robot.listeners.idle import HeadSway
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.listeners.stream_rng import Use, normals, uniforms
from sfms_robot.signals.control import COLUMNS

BEYOND = 1e3  # rad, m or value of a blendshape: no face has such values
CONTROL_ROWS: Final = 2  # control rows per frame: of the frame before and of the frame
ROTARY_BASE: Final = 10_000.0

# --- Conversational states (3.3) --------------------------------------------------------------------------------------
#
# `modules` has the table of states. Ours, with events: a semi-Markov process in place of the most probable state, which
# flickers. The duration of a state is drawn from durations of the data, the next state from the model's answer.
# Visible feedback, a nod or a smile in the other's turn, is not drawn: events decide it.

FIRST: Final = STATES.index("waiting")  # state of a stream before its first frame
LISTENING: Final = STATES.index("listening")
FEEDBACK: Final = STATES.index("giving_feedback")
NODDING: Final = EVENT_STATES.index("giving_feedback_nod")
SMILING: Final = EVENT_STATES.index("giving_feedback_smile")
QUANTILES: Final = 33  # number of quantiles of a state's durations
_ACTIVE: Final = {kind: COLUMNS.index(f"{kind}.active") for kind in ("nod", "smile", "laugh")}


@dataclass(frozen=True)
class Sojourn:
    """One of `STATES`, and the number of further frames that it lasts."""

    state: int
    left: int


def with_feedback(states: NDArray[Any], rows: Floats) -> NDArray[Any]:
    """Return the `EVENT_STATES` (...) of states (...) among `STATES` and the control rows (..., K) of their frames.

    A nod, laugh or smile while listening is feedback; other states, and unknown ones, stay unchanged.
    """
    nods = rows[..., _ACTIVE["nod"]] > 0
    smiles = (rows[..., _ACTIVE["smile"]] > 0) | (rows[..., _ACTIVE["laugh"]] > 0)
    seen = np.where(nods, NODDING, np.where(smiles, SMILING, states))
    return np.where((states == LISTENING) | (states == FEEDBACK), seen, states)


def draw_sojourn(
    durations: Floats, possible: Floats, logits: Floats, voiced: Bools, before: Sojourn, uniforms: Doubles
) -> Sojourn:
    """Draw the state of a frame.

    A state lasts as long as was drawn when it began, but ends at once if the voices rule it out. Then another state
    follows, drawn by the model's logits from those that the voices allow; the same again if they allow no other.

    Args:
        durations, possible: buffers of `modules.StateUnderstanding`.
        logits: (S,) of the frame.
        voiced: (2,) speech of agent and user, as for the model.
        before: sojourn of the frame before.
        uniforms: (2,) in 0..1, for the state and for its duration.
    """
    # The voices of both allow some of the seven states (figure 3).
    may = possible[int(voiced[0]), int(voiced[1])] > 0  # (7,), a new array
    if before.left > 0 and may[before.state]:
        return Sojourn(before.state, before.left - 1)
    may[before.state] &= not may.sum() > 1  # another one, if there is any
    scores = np.where(may, logits[: len(STATES)].astype(np.float64), -np.inf)
    chances = np.exp(scores - scores.max()).cumsum()  # inverse transform of the softmax
    state = min(int((chances <= uniforms[0] * chances[-1]).sum()), len(STATES) - 1)
    place = float(uniforms[1]) * (QUANTILES - 1)  # inverse transform of the durations, linear between quantiles
    low, high = durations[state, int(place)], durations[state, min(int(place) + 1, QUANTILES - 1)]
    return Sojourn(state, max(0, round(float(low + (place % 1) * (high - low))) - 1))


# --- Rotary places (Su et al. 2021) -----------------------------------------------------------------------------------


def rotary(chunks: NDArray[np.integer], size: int) -> Floats:
    """Return cosines and sines (N, 2, size) of chunk numbers (N,); sines of the first half are negative.

    They rotate keys and queries of the long range; the halves of `size` are the two coordinates of each plane. Angles
    are in double precision, so that after days of running those of two chunks still differ.
    """
    half = size // 2
    turns = np.tile(ROTARY_BASE ** (-np.arange(half) / half), 2)  # radians per chunk
    angles = chunks[:, None] * turns  # place of a chunk: attention depends on the distance of two, not on their time
    signs = np.where(np.arange(size) < half, -1.0, 1.0)
    return np.stack([np.cos(angles), np.sin(angles) * signs], axis=1).astype(np.float32)


# --- Stream -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ArigMemory:
    """Memory of one stream. Values only, all of fixed size: a step makes a new one.

    Attributes:
        seed: seed of all its random numbers (`stream_rng`).
        frames: number of frames so far.
        user_voice, agent_voice: samples and phrase of both tracks.
        agent_sound: (D,) embedded sound of the agent's last frame.
        agent_behaviour, user_behaviour: (c, D) behaviours of the last c frames, the newest last.
        sound_keys: (3, 2D) keys of the agent's last sounds; motion_keys: (5, 2D) keys of its last motions.
        context: (2L, h, w - 1, D/h) keys and values of whole chunks, layer by layer, the newest last.
        motion: (D,) embedded motion of the agent's last frame; standard: (C,) the same, standardised; sample: (C,) the
            draw that led to it; all without sway.
        state: conversational state of the last frame, of `settings.states`; sojourn: with events, the drawn state that
            it comes from.
        sway: sway of this stream (`HeadSway.start`).
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


# Fields that are inputs of the network `frame`; it returns the first four.
REMEMBERED: Final = (
    "agent_sound",
    "agent_behaviour",
    "user_behaviour",
    "sound_keys",
    "motion",
    "motion_keys",
    "sample",
)
_MADE: Final = (*REMEMBERED[:4], "standard", "sample", "motion", "motion_keys")  # outputs of the networks per frame


class ArigListener(RunsOnEngine):
    """ARIG as a stream; its engine runs `networks`.

    Attributes:
        noise_shape: shape of the standard normal numbers of one frame: (steps, channels), (1, 1) with codes.
    """

    def __init__(self, settings: config.Arig, engine: Engine, folder: Path | None = None) -> None:
        """Create the listener; the matrix that the settings may name is in `folder`.

        Raises ConfigError, and ModelError for a model of features that are not computed here (sound: wav2vec2).
        """
        if settings.sound != "mel":
            raise ModelError(f"sound = {settings.sound!r}: such a model can be trained and evaluated, not run (mel)")
        self.settings = settings
        self.engine = engine
        self.space = MotionSpace.of(settings, folder)
        self.sway = HeadSway(settings, engine.tensors)
        if settings.events:
            self.control_frames, self.control_columns = (1, CONTROL_ROWS - 1), len(COLUMNS)
        self.noise_shape = (1, 1) if settings.discrete else (settings.diffusion.steps, len(settings.channels))

    def start(self, seed: int) -> ArigMemory:
        """Return the memory of a stream without sound so far and with a neutral face (A.2)."""
        settings = self.settings
        d, c, heads = settings.width, settings.chunk_frames, settings.heads
        still = self.standardise(self.space.neutral.astype(np.float32))
        motion, silence, motion_key, sound_key = (part[0] for part in self.engine.run("rest", still[None]))
        room = settings.context_chunks - 1
        # A.2: caches begin with the reference motion and the first sound repeated; ours: silence, and a neutral face.
        # Chunks begin with the first behaviour repeated, which the network `frame` does where `first`.
        return ArigMemory(
            seed=seed,
            frames=0,
            user_voice=TRACKS.start(),
            agent_voice=TRACKS.start(),
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

    def step_each(
        self,
        speakers: Sequence[SpeakerFrame],
        memories: Sequence[ArigMemory],
        controls: Sequence[Floats | None] | None = None,
    ) -> list[tuple[Plan | None, ArigMemory]]:
        """Advance every stream by one frame; each plans its next frame."""
        settings = self.settings
        rows = self.told(controls or [None] * len(memories)).reshape(len(memories), -1)
        sounds, present, face, seen, now = self._hear(speakers, memories)
        voiced = np.array([(memory.agent_voice.voiced, memory.user_voice.voiced) for memory in now])
        newest = np.array([memory.frames for memory in now])
        # 1. Everything before the sampler (3.2). Chunk i holds frames c i to c (i + 1) - 1; of the w chunks in view,
        # w - 1 are whole.
        chunks, room = (newest - 1) // settings.chunk_frames, settings.context_chunks - 1
        z, logits, summaries, *kept = self.engine.run(
            "frame",
            sounds,
            present,
            voiced,
            face,
            seen,
            newest == 1,
            np.array([memory.state for memory in now]),
            rotary(chunks, settings.width // settings.heads),
            np.arange(room) >= room - np.minimum(chunks, room)[:, None],  # the newest chunks are last
            *(_stacked(now, name) for name in REMEMBERED),
            rows,
            *(stacked([memory.context[part] for memory in now]) for part in range(2 * settings.context_layers)),
        )
        # 2. Noise, a function of seed and frame, 3. the sampler, 4. sway and states.
        noise = np.stack([normals(memory.seed, memory.frames, Use.NOISE, *self.noise_shape) for memory in now])
        inputs = [z, noise, _stacked(now, "standard"), _stacked(now, "motion_keys")]
        made, *drawn = self.engine.run("draw", *inputs, *([rows, voiced[:, 0]] if settings.events else []))
        shown = self.sway.added(made[:, None].copy(), _stacked(now, "sway"), newest)
        sojourns, states = self._states(logits, now, rows, voiced)
        out: list[tuple[Plan | None, ArigMemory]] = []
        for index, (speaker, memory) in enumerate(zip(speakers, now, strict=True)):
            own: dict[str, Any] = dict(zip(_MADE, (part[index] for part in (*kept, *drawn)), strict=True))
            if memory.frames % settings.chunk_frames == 0:  # the chunk is whole: its keys and values stay (3.2)
                own["context"] = np.concatenate([memory.context[:, :, 1:], summaries[index][:, :, None]], axis=2)
            after = changed(memory, **own, state=states[index], sojourn=sojourns[index])
            out.append((self.space.plan(speaker.time_s, shown[index]), after))
        return out

    def _states(
        self, logits: Floats, now: Sequence[ArigMemory], rows: Floats, voiced: Bools
    ) -> tuple[list[Sojourn], list[int]]:
        """Return states of the frame that is made: the most probable, or drawn if the model has events."""
        before = [memory.sojourn for memory in now]
        if not self.settings.state_guidance:
            return before, [memory.state for memory in now]
        if not self.settings.events:
            return before, logits.argmax(-1).tolist()
        durations, possible = (self.engine.tensors[f"states.{name}"] for name in ("durations", "possible"))
        # Ours: a state lasts as long as in the data, and visible feedback comes from the events.
        sojourns = [
            draw_sojourn(durations, possible, scores, both, last, uniforms(own.seed, own.frames, Use.STATE, 2))
            for scores, both, last, own in zip(logits, voiced, before, now, strict=True)
        ]
        # A nod or a smile in progress turns listening into a separate state.
        drawn = np.array([sojourn.state for sojourn in sojourns])
        return sojourns, with_feedback(drawn, rows[:, -len(COLUMNS) :]).tolist()

    def _hear(
        self, speakers: Sequence[SpeakerFrame], memories: Sequence[ArigMemory]
    ) -> tuple[Floats, Bools, Floats, Bools, list[ArigMemory]]:
        """Return both people in the newest frame of each of N streams, and memories that include their voices.

        The people are features (N, 2, A) of user and agent, which of them there are (N, 2), the user's standardised
        face (N, C), and whether there is a face (N,).
        """
        # Equation (2): A^u_(T-1) of the user, and A^a_T of the agent, which is one frame ahead.
        samples = [track for one in speakers for track in (one.audio, fit_frame(one.agent_audio))]
        before = [voice for memory in memories for voice in (memory.user_voice, memory.agent_voice)]
        sounds, present, after = hear_each(samples, before)
        now = [
            changed(memory, frames=memory.frames + 1, user_voice=user, agent_voice=agent)
            for memory, user, agent in zip(memories, after[::2], after[1::2], strict=True)
        ]
        face = np.zeros((len(speakers), len(self.settings.channels)), np.float32)
        seen = np.zeros(len(speakers), np.bool_)
        for row, speaker in enumerate(speakers):
            # A face that is not finite or beyond all faces counts as not seen: the memory would keep it.
            motion = None if speaker.face is None else speaker.face.motion
            if motion is not None and np.abs(motion).max() < BEYOND:  # false for NaN too
                face[row], seen[row] = self.standardise(self.space.encode(motion[None]))[0], True
        return sounds.reshape(len(now), 2, -1), np.reshape(present, (-1, 2)), face, seen, now


def _stacked(parts: Sequence[Any], name: str) -> NDArray[Any]:
    return stacked([getattr(part, name) for part in parts])
