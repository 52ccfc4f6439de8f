"""The motion of a listener in a free run, with the speaker of a dyad as its input.

`rollout` steps any listener frame by frame, as `run` does. `offline_rollout` does the same from arrays, for SFMS: the
features of a dyad are computed once for all streams, and speaker and plans stay in the model's motion space, so that
data in DECA or FaceVerse coefficients, with mel in place of a waveform, are answered in the same space. A test checks
that both return the same motion.

A listener that follows events receives the given events, each `LEAD_FRAMES` before it begins, as in a run.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sfms_robot.app.progress import tracked
from sfms_robot.config.listener import paper_state
from sfms_robot.errors import ConfigError
from sfms_robot.frames import (
    FRAME_S,
    FRAME_SAMPLES,
    MOTION_DIM,
    NO_SOUND,
    FaceFrame,
    Floats,
    ListenerEvent,
    SpeakerFrame,
)
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Order, usable
from sfms_robot.lab.corpora.conversational_states import UNKNOWN
from sfms_robot.lab.corpora.conversion import at_frame_rate
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.learning.sfms.features import frames_of, keyframe_tokens, place_all
from sfms_robot.listeners.arig.stream import ArigMemory
from sfms_robot.listeners.capacity import step_each
from sfms_robot.listeners.engine import EngineName
from sfms_robot.listeners.events.model import LEAD_FRAMES
from sfms_robot.listeners.registry import at_hop, hops_of, load_listener, one_thread
from sfms_robot.listeners.sfms.draw import UNDECIDED, Context, later, passed, revoked
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.ports import Listener
from sfms_robot.processes import process_pool
from sfms_robot.signals.control import control_track

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")


def load_at_hop(name: str, hop: int | None = None, engine: EngineName = "torch") -> Listener:
    """Load a listener by name or folder, planning every `hop` frames; None: as its config.yaml says.

    Raises ConfigError for a hop that it does not support, ModelError.
    """
    listener = load_listener(name, engine=engine)
    if hop is None:
        return listener
    if hop not in (choices := hops_of(listener)):
        raise ConfigError(f"--hop {hop}: not a hop of listener {name} (valid: {', '.join(map(str, choices))})")
    return at_hop(listener, hop)


def run_in_processes(
    work: Callable[[_Task], _Result], tasks: Sequence[_Task], jobs: int | None, title: str
) -> list[_Result]:
    """Return `work` of every task in their order, computed in at most `jobs` processes; None: as many as cores.

    Shows a progress bar. An exception of a task is raised here, and tasks that have not begun are dropped. `work` is a
    module's function.
    """
    workers = min(jobs or os.cpu_count() or 1, len(tasks))
    if workers <= 1:
        one_thread()
        return [work(task) for task in tracked(tasks, title)]
    with process_pool(workers) as pool:
        waiting = [pool.submit(work, task) for task in tasks]
        for done in tracked(as_completed(waiting), title, len(tasks)):
            done.result()
        return [one.result() for one in waiting]


def spread(items: Sequence[_Task], most: int | None) -> list[_Task]:
    """Return at most `most` items, spread evenly from the first to the last."""
    if most is None or most >= len(items):
        return list(items)
    return [items[int(index)] for index in np.linspace(0, len(items) - 1, most).round()]


# --- input of a listener --------------------------------------------------------------------------------------------


def streamable(data: Path, split: str, order: Order | None = None, most: int | None = None) -> Iterator[Dyad]:
    """Open a split, and yield its dyads as they are streamed to a listener: in arkit58, at 25 fps.

    At most `most` of them, spread over the set; those that cannot be read are left out (`usable`). `order`: see
    `open_dataset`. Raises ConfigError.
    """
    every = open_for("arkit58", data, split, order)
    return map(at_frame_rate, usable(replace(every, clips=tuple(spread(every.clips, most)))))


def speaker_frames(
    audio: Floats | None, face: Floats, agent_audio: Floats | None = None, attention: Floats | None = None
) -> list[SpeakerFrame]:
    """Return sound (N * 640,) and face (N, 58) as a source does, with the agent's voice (N * 640,) one frame early.

    A face of NaN becomes None, and so does the attention (N,) of a frame without a face; an attention of NaN (unknown)
    stays. If all sound is zero, the frames have no microphone.
    """
    heard = audio if audio is not None and audio.any() else NO_SOUND
    said = None if agent_audio is None else np.pad(agent_audio, (0, FRAME_SAMPLES))[FRAME_SAMPLES:]
    shown = np.asarray(np.isfinite(face).all(axis=1))
    frames = []
    for index, row in enumerate(face):
        time_s, now = (index + 1) * FRAME_S, slice(index * FRAME_SAMPLES, (index + 1) * FRAME_SAMPLES)
        looks = None if attention is None else float(attention[index])
        if looks is not None and not shown[index] and not math.isnan(looks):
            looks = None
        seen = FaceFrame.of(time_s, row) if shown[index] else None
        frames.append(SpeakerFrame(time_s, heard[now], seen, None if said is None else said[now], looks))
    return frames


def frames_of_dyad(dyad: Dyad) -> list[SpeakerFrame]:
    """Return both tracks of a dyad as a source does."""
    return speaker_frames(dyad.audio, dyad.speaker, dyad.agent_audio, dyad.attention)


# --- frame by frame -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Rollout:
    """S streams with the same N input frames; each plan counts until the next one.

    Attributes:
        motion: (S, N, 58) faces.
        states: (S, N) int8 of the paper's seven conversational states; -1 before the first, and if there are none.
        events: The decisions of each stream; empty for listeners that decide none.
    """

    motion: Floats
    states: NDArray[np.int8]
    events: tuple[tuple[ListenerEvent, ...], ...]


def control_at(listener: Listener, events: Sequence[ListenerEvent], index: int) -> Floats | None:
    """Return the control that `listener` receives with frame `index` of its stream; None if it follows no events."""
    past, ahead = getattr(listener, "control_frames", (0, 0))
    if not past + ahead:
        return None
    decided_s = (index + 1 + LEAD_FRAMES) * FRAME_S + 1e-9
    known = [event for event in events if event.start_s <= decided_s]
    return control_track(known, index + 1 - past, past + ahead)


def rollout(
    listener: Listener,
    speaker: Sequence[SpeakerFrame],
    seeds: Sequence[int],
    events: Sequence[ListenerEvent] = (),
    title: str = "",
) -> Rollout:
    """Play the listener to `speaker` once for every seed, all streams together if it can.

    `events`: Events for a listener that follows events. `title`: Title of a progress bar; "": no bar.
    """
    return _together(listener, [speaker] * len(seeds), seeds, [events] * len(seeds), title)


def rollouts(listener: Listener, dyads: Sequence[Dyad], seed: int, title: str) -> list[tuple[Floats, NDArray[np.int8]]]:
    """Play one stream through every dyad from its beginning, with seeds from `seed` on, all together if it can.

    Returns motion (N, 58) and states (N,) of each, as in `Rollout`. A listener that follows events receives those of
    the dyad's listener. `title`: Title of a progress bar.
    """
    speakers, seeds = [*map(frames_of_dyad, dyads)], range(seed, seed + len(dyads))
    played = _together(listener, speakers, seeds, [dyad.events or () for dyad in dyads], title)
    streams = zip(played.motion, played.states, map(len, speakers), strict=True)
    return [(motion[:frames], states[:frames]) for motion, states, frames in streams]


def _together(
    listener: Listener,
    speakers: Sequence[Sequence[SpeakerFrame]],
    seeds: Sequence[int],
    events: Sequence[Sequence[ListenerEvent]],
    title: str,
) -> Rollout:
    """Play one stream for each speaker, as long as the longest; a stream ends with its speaker."""
    memories: list[Any] = [listener.start(seed) for seed in seeds]
    longest = max(map(len, speakers))
    motion = np.zeros((len(seeds), longest + listener.horizon, MOTION_DIM), np.float32)
    states = np.full((len(seeds), longest + 1), UNKNOWN, np.int8)
    decided: list[list[ListenerEvent]] = [[] for _ in seeds]
    for index in tracked(range(longest), title) if title else range(longest):
        rows = [row for row, speaker in enumerate(speakers) if index < len(speaker)]
        controls = [control_at(listener, events[row], index) for row in rows]
        frames, before = [speakers[row][index] for row in rows], [memories[row] for row in rows]
        stepped = step_each(listener, frames, before, *[controls] * (controls[0] is not None))
        for row, (plan, memory) in zip(rows, stepped, strict=True):
            memories[row] = memory
            if plan is not None:
                motion[row, index + 1 :][: listener.horizon] = plan.frames
                decided[row] += plan.events
            how = getattr(memory, "how", memory)
            if isinstance(how, ArigMemory):
                states[row, index + 1] = paper_state(how.state)
    return Rollout(motion[:, :longest], states[:, :longest], tuple(map(tuple, decided)))


# --- from arrays ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OfflineRollout:
    """S streams with a dyad of N frames as input: motion (S, N, C) in the model's space, and its tokens (S, N, G)."""

    motion: Tensor
    tokens: Tensor


def offline_rollout(
    listener: SfmsListener, dyad: Dyad, seeds: Sequence[int], *, true_past: bool = False
) -> OfflineRollout:
    """Compute `rollout` from arrays, with the dyad's events for a listener that follows events.

    `true_past`: Each plan continues from the motion of the dyad's listener, not from earlier plans; this needs engine
    torch.

    Raises ConfigError if the dyad's space cannot become the listener's, or the dyad has no events.
    """
    past, ahead, streams = listener.settings.past_frames, listener.horizon, len(seeds)
    heard = frames_of(dyad, listener.space, listener.frontend, listener.settings)
    frames = len(heard.motion)
    sound = listener.standardise_sound(heard.sound.float().numpy())
    sound = _led(np.where(heard.heard.numpy()[:, None, None], sound, np.float32(0)), 1)
    voice = listener.voices(np.concatenate([sound[:-1], sound[1:]], axis=1))
    person = {  # frame t at index past + t
        "face": _led(listener.standardise(heard.face.numpy()), past),
        "face_known": _led(heard.face_known.numpy(), past),
        "voice": _led(voice, past),
        "heard": _led(heard.heard.numpy(), past),
        "phase": _led(heard.phase.numpy(), past),
    }
    at_rest, still = listener.at_rest()
    tokens, path = np.repeat(at_rest[None], streams, axis=0), np.repeat(still[None], streams, axis=0)
    control = np.zeros((1, past + ahead, heard.control.shape[1]), np.float32)
    drawn = np.repeat(np.maximum(tokens[:, -1:], 0), frames + ahead + 1, axis=1)
    shown = np.repeat(path[:, :1], frames + ahead + 1, axis=1)
    settled = np.array([past - 1])
    truth = _true_past(listener, heard.motion) if true_past else None
    for now in range(0, frames, listener.hop):  # the newest input frame
        frames_passed = listener.hop if now else 1
        tokens, path = passed(tokens, path, frames_passed, listener.holds)
        asked = control_at(listener, dyad.events or (), now)
        if asked is not None:
            control, before = listener.told([asked]), later(control, frames_passed)
            tokens, settled = revoked(tokens, before, control, ahead)
        window = slice(now + 1, now + 1 + past)
        if truth is not None:
            tokens[:, :past], tokens[:, past:] = truth[0][window], UNDECIDED
            path[:, :2] = truth[1][now : now + 2]
        seen = Context(
            **{name: rows[None, window] for name, rows in person.items()},
            tokens=tokens,
            control=np.repeat(control, streams, axis=0),
        )
        tokens, path = listener.plan(seen, np.broadcast_to(settled, streams), path, seeds, [now] * streams)
        shown[:, now + 1 : now + 1 + ahead] = listener.shown(path)
        drawn[:, now + 1 : now + 1 + ahead] = tokens[:, -ahead:]
    sway = np.stack([listener.sway.start(seed) for seed in seeds])
    motion = listener.with_sway(shown[:, :frames], sway, 0)
    return OfflineRollout(torch.from_numpy(motion), torch.from_numpy(drawn[:, :frames]))


@torch.no_grad()
def _true_past(listener: SfmsListener, motion: Tensor) -> tuple[NDArray[Any], Floats]:
    """Return tokens (P + N, G) and standardised motion (1 + N, C) of a motion (N, C), led by a face at rest."""
    model, rest = listener.model, listener.at_rest()
    standard = model.standardise(motion)
    mask = place_all(model.tokenizer, standard, [len(standard)])
    tokens = torch.where(mask > 0.5, keyframe_tokens(model, standard), 0).numpy()
    return np.concatenate([rest[0][: -listener.horizon], tokens]), np.concatenate([rest[1][:1], standard.numpy()])


def _led(rows: NDArray[Any], frames: int) -> NDArray[Any]:
    """Return rows (N, ...) with `frames` rows of zeros before them."""
    return np.concatenate([np.zeros((frames, *rows.shape[1:]), rows.dtype), rows])
