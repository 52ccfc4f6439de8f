"""A listener left to itself: what it does while the speaker of a dyad is heard.

`rollout` goes frame by frame as `run` does, with any listener. `offline_rollout` is the same from arrays, for SFMS: the
features of a dyad are worked out once and serve all streams, and speaker and plans stay in the model's motion space, so
that data in DECA or FaceVerse coefficients, with mel in place of a waveform, are answered in their own terms. That both
give the same motion is a law of the tests.

A listener that is told of events is told those that are given, each `LEAD_FRAMES` before it begins, as when it runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sfms_robot.config.listener import paper_state
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, MOTION_DIM, FaceFrame, Floats, ListenerEvent, Plan, SpeakerFrame
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.conversational_states import UNKNOWN
from sfms_robot.lab.learning.sfms.features import frames_of
from sfms_robot.listeners.arig.stream import ArigMemory
from sfms_robot.listeners.eventful import EventfulMemory
from sfms_robot.listeners.events.model import LEAD_FRAMES
from sfms_robot.listeners.sfms.draw import PlanInputs, later, passed, revoked
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.ports import Listener
from sfms_robot.signals.control import control_track


@dataclass(frozen=True)
class Rollout:
    """S streams that heard the same N frames; what a plan shows counts until the next one.

    Attributes:
        motion: (S, N, 58) faces.
        states: (S, N) int8 of the paper's seven conversational states, -1 before the first and of listeners without.
        events: of each stream, what it decided; nothing of listeners that decide none.
    """

    motion: Floats
    states: NDArray[np.int8]
    events: tuple[tuple[ListenerEvent, ...], ...]


@dataclass(frozen=True)
class OfflineRollout:
    """S streams that heard one dyad of N frames: motion (S, N, C) in the model's space, tokens (S, N, G) behind it."""

    motion: Tensor
    tokens: Tensor


def speaker_frames(
    audio: Floats | None, face: Floats, agent_audio: Floats | None = None, attention: Floats | None = None
) -> list[SpeakerFrame]:
    """Sound (N * 640,) and face (N, 58) as a source gives them, and the agent's own voice (N * 640,) one frame early.

    A face of NaN is None, and so is the attention (N,) of a face that is not seen; an attention of NaN stays: nobody
    knows. No sound at all is no microphone.
    """
    heard = audio if audio is not None and audio.any() else np.zeros(0, np.float32)
    shown = np.asarray(np.isfinite(face).all(axis=1))
    frames = []
    for index, row in enumerate(face):
        time_s = (index + 1) * FRAME_S
        now, following = (slice(at * FRAME_SAMPLES, (at + 1) * FRAME_SAMPLES) for at in (index, index + 1))
        said = None if agent_audio is None else agent_audio[following]
        if said is not None and len(said) < FRAME_SAMPLES:
            said = np.pad(said, (0, FRAME_SAMPLES - len(said)))
        seen = FaceFrame.of(time_s, row) if shown[index] else None
        looks = None if attention is None else float(attention[index])
        if looks is not None and seen is None and not np.isnan(looks):
            looks = None
        frames.append(SpeakerFrame(time_s, heard[now], seen, said, looks))
    return frames


def frames_of_dyad(dyad: Dyad) -> list[SpeakerFrame]:
    """Both tracks of a dyad as a source gives them."""
    return speaker_frames(dyad.audio, dyad.speaker, dyad.agent_audio, dyad.attention)


def whole_clips(speaker: Sequence[SpeakerFrame], frames: int) -> Sequence[SpeakerFrame]:
    """As much as is whole clips of so many frames."""
    return speaker[: len(speaker) // frames * frames]


@runtime_checkable
class ManyStreams(Protocol):
    """A listener that steps several streams of one speaker at once."""

    def step_many(
        self, speaker: SpeakerFrame, memories: Sequence[Any], controls: Sequence[Floats] | None = None
    ) -> tuple[Sequence[Plan | None], Sequence[Any]]:
        """`Listener.step` of streams that have heard the same from the start; no plans between hops."""


def control_at(listener: Listener, events: Sequence[ListenerEvent], index: int) -> Floats | None:
    """What `listener` is told with frame `index` of all the `events` of its life; None for one that is told nothing."""
    past, ahead = getattr(listener, "control_frames", (0, 0))
    if not past + ahead:
        return None
    decided_s = (index + 1 + LEAD_FRAMES) * FRAME_S + 1e-9
    known = [event for event in events if event.start_s <= decided_s]
    return control_track(known, index + 1 - past, past + ahead)


def rollout(
    listener: Listener, speaker: Sequence[SpeakerFrame], seeds: Sequence[int], events: Sequence[ListenerEvent] = ()
) -> Rollout:
    """What the listener does while `speaker` is heard, once for every seed; side by side where the listener can.

    `events`: what a listener that is told of them shall do.
    """
    memories: Sequence[Any] = [listener.start(seed) for seed in seeds]
    motion = np.zeros((len(seeds), len(speaker) + listener.horizon, MOTION_DIM), np.float32)
    states = np.full((len(seeds), len(speaker) + 1), UNKNOWN, np.int8)
    decided: list[list[ListenerEvent]] = [[] for _ in seeds]
    for index, frame in enumerate(speaker):
        plans, memories = _step(listener, frame, memories, control_at(listener, events, index))
        for row, plan in enumerate(plans):
            if plan is not None:
                motion[row, index + 1 : index + 1 + listener.horizon] = plan.frames
                decided[row] += plan.events
        for row, memory in enumerate(memories):
            how = memory.how if isinstance(memory, EventfulMemory) else memory
            if isinstance(how, ArigMemory):
                states[row, index + 1] = paper_state(how.state)
    return Rollout(motion[:, : len(speaker)], states[:, : len(speaker)], tuple(map(tuple, decided)))


def _step(
    listener: Any, frame: SpeakerFrame, memories: Sequence[Any], control: Floats | None
) -> tuple[Sequence[Plan | None], Sequence[Any]]:
    told = () if control is None else (control,)
    if isinstance(listener, ManyStreams):
        return listener.step_many(frame, memories, *([one] * len(memories) for one in told))
    stepped = [listener.step(frame, memory, *told) for memory in memories]
    return [plan for plan, _ in stepped], [memory for _, memory in stepped]


def rollouts(
    listener: Listener,
    dyads: Sequence[Dyad],
    seed: int,
    each: Callable[[], object] = lambda: None,
    clip_frames: int = 1,
) -> list[Rollout]:
    """One stream through every dyad from its beginning, each with a seed of its own; `each()` after every one.

    A listener that is told of events is told those of the dyad's own listener. `clip_frames`: see `whole_clips`.
    """
    found = []
    for number, dyad in enumerate(dyads):
        heard = whole_clips(frames_of_dyad(dyad), clip_frames)
        found.append(rollout(listener, heard, [seed + number], dyad.events or ()))
        each()
    return found


def offline_rollout(listener: SfmsListener, dyad: Dyad, seeds: Sequence[int]) -> OfflineRollout:
    """`rollout` from arrays, told of the dyad's own events where the listener is told of any.

    Raises ConfigError when the dyad is in a space that cannot become the listener's, or has no events.
    """
    past, ahead, streams = listener.settings.past_frames, listener.horizon, len(seeds)
    heard = frames_of(dyad, listener.space, listener.frontend, listener.settings)
    frames = len(heard.motion)
    sound = listener.standardise_sound(heard.sound.float().numpy())
    sound = _led(np.where(heard.heard.numpy()[:, None, None], sound, np.float32(0)), 1)
    voice = listener.voices(np.concatenate([sound[:-1], sound[1:]], axis=1))
    face, voice, phase = (
        _led(part, past) for part in (listener.standardise(heard.face.numpy()), voice, heard.phase.numpy())
    )
    known, audible = (_led(part.numpy(), past) for part in (heard.face_known, heard.heard))  # frame t at index past + t
    rest = listener.at_rest()
    tokens, path = np.repeat(rest[0][None], streams, axis=0), np.repeat(rest[1][None], streams, axis=0)
    control = np.zeros((1, past + ahead, heard.control.shape[1]), np.float32)
    drawn = np.repeat(np.maximum(tokens[:, -1:], 0), frames + ahead + 1, axis=1)
    shown = np.repeat(path[:, :1], frames + ahead + 1, axis=1)
    settled = np.array([past - 1])
    for now in range(0, frames, listener.hop):  # the newest frame heard
        frames_passed = listener.hop if now else 1
        tokens, path = passed(tokens, path, frames_passed, listener.holds)
        asked = control_at(listener, dyad.events or (), now)
        if asked is not None:
            control, before = listener.told([asked]), later(control, frames_passed)
            tokens, settled = revoked(tokens, before, control, ahead)
        window = slice(now + 1, now + 1 + past)
        seen = PlanInputs(
            face=face[None, window],
            face_known=known[None, window],
            voice=voice[None, window],
            heard=audible[None, window],
            phase=phase[None, window],
            tokens=tokens,
            control=np.repeat(control, streams, axis=0),
            settled=np.broadcast_to(settled, streams),
        )
        tokens, path = listener.plan(seen, path, seeds, [now] * streams)
        shown[:, now + 1 : now + 1 + ahead] = listener.shown(path)
        drawn[:, now + 1 : now + 1 + ahead] = tokens[:, -ahead:]
    sway = np.stack([listener.sway.start(seed) for seed in seeds])
    motion = listener.with_sway(shown[:, :frames], sway, 0)
    return OfflineRollout(torch.from_numpy(motion), torch.from_numpy(drawn[:, :frames]))


def _led(rows: NDArray[Any], frames: int) -> NDArray[Any]:
    """(N, ...) behind so many rows of nothing."""
    return np.concatenate([np.zeros((frames, *rows.shape[1:]), rows.dtype), rows])
