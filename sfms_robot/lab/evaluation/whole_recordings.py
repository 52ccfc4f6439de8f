"""Evidence and hazards of whole recordings at once, which `EventModel.decide_each` computes and draws step by step.

`heard_in` and `done_at` return the rows that `evidence.hear` and `evidence.done` return frame by frame. With a given
history nothing has to be decided, so all steps are computed together (`hazards_in`). Without a history, `most_in`
returns the highest probability that each kind can have after any history. At a step whose draws are all above it no
event can begin, and only the other steps have to be decided, one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sfms_robot.config import Calmness
from sfms_robot.frames import (
    EVENT_KINDS,
    FRAME_S,
    MOTION_DIM,
    Bools,
    Doubles,
    FaceFrame,
    Floats,
    Ints,
    ListenerEvent,
    SpeakerFrame,
    changed,
)
from sfms_robot.listeners.events.evidence import (
    AT,
    BACK,
    BEAM,
    COUNTED_S,
    DONE,
    EPS_S,
    EVIDENCE,
    FLOOR_FRAMES,
    HEARD,
    HELD_FRAMES,
    JAW,
    MINE,
    NOBODY,
    NOD_RAD,
    NODS_APART,
    OPENING,
    OWN_VOICE_DB,
    PITCH,
    SMILES_APART,
    STANDS_OUT,
    SWAY,
    WINDOW,
    Addressed,
    Sensed,
    SenseMemory,
    jaw_opening,
    looks_at_head,
    smile_over,
    smoothed_pitch,
)
from sfms_robot.listeners.events.model import (
    ALWAYS,
    AT_PERSON,
    EXCLUDES,
    LEAD_FRAMES,
    LISTENING_S,
    STEP_FRAMES,
    STEP_S,
    EventMemory,
    EventModel,
)
from sfms_robot.listeners.stream_rng import Use, uniforms
from sfms_robot.signals import phase
from sfms_robot.signals.audio import energies_db
from sfms_robot.signals.event_sizes import SWING_S
from sfms_robot.signals.events import CORNERS

_TOGETHER: Final = 1000  # steps that are computed at once: as many as stay in a cache
_MOST_NODS: Final = 1 + COUNTED_S / SWING_S[0]  # most nods in the time in which they are counted
_MARGIN: Final = 1e-9  # margin of log-odds for sums in another order


# --- Evidence ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """N frames of a conversation of P people; the first person is the listener.

    Attributes:
        speaks: (N, P) each person speaks.
        looks: (N, P) each person looks at the listener (1) or not (0); NaN: unknown. The first column has no meaning.
        laughs: (N,) one of the others laughs.
        nods: (N,) one of the others begins to nod.
        smiles: (N,) size of the smile of one of the others; 0: none.
    """

    speaks: Bools
    looks: Doubles
    laughs: Bools
    nods: Bools
    smiles: Doubles


def heard_in(scene: Scene) -> Doubles:
    """Return the evidence (N, len(HEARD)) of a scene."""
    index = np.arange(len(scene.speaks))
    others = scene.speaks[:, 1:]
    phrase, silence, last = phase.times(np.asarray(others.any(axis=1))).T
    holder, held = _floor_in(scene.speaks)
    spoke = np.maximum.accumulate(np.where(scene.speaks, index[:, None], -np.inf), axis=0)  # (N, P)
    another = holder > MINE
    relevant = counts_in(scene)[:, 1:]
    looks = scene.looks[:, 1:]
    known = (relevant & ~np.isnan(looks)).any(axis=1)
    looked = (relevant & (looks == 1)).any(axis=1)
    began = np.maximum.accumulate(np.where(looked & ~np.r_[False, looked[:-1]], index, 0))
    speaking = others.sum(axis=1)
    columns = {
        "phrase_s": np.where(phrase > 0, phrase, np.nan),
        "silence_s": silence,
        "last_phrase_s": np.where(last > 0, last, np.nan),
        "one_speaks": speaking == 1,
        "several_speak": speaking > 1,
        "floor_mine": holder == MINE,
        "floor_s": np.where(another, (index - held) * FRAME_S, np.nan),
        "holder_silence_s": np.where(another, (index - spoke[index, np.maximum(holder, 0)]) * FRAME_S, np.nan),
        "own_voice_s": (index - spoke[:, MINE]) * FRAME_S,
        "own_voice_known": np.isfinite(spoke[:, MINE]),
        "gaze_known": known,
        "looked_at": looked,
        "looked_at_s": np.where(looked, (index - began) * FRAME_S, np.nan),
        "looked_at_silence_s": np.where(looked, silence, np.nan),
        "laugh_s": _since(scene.laughs),
        "others_nod_s": _since(scene.nods),
        **_smiles_in(scene.smiles),
    }
    return np.stack([np.asarray(columns[name], np.float64) for name in HEARD], axis=1)


def counts_in(scene: Scene) -> Bools:
    """Return (N, P) whose look counts: others who speak, else the holder of the floor; never the listener itself."""
    others = scene.speaks.copy()
    others[:, MINE] = False
    holder, _ = _floor_in(scene.speaks)
    waiting = ~others.any(axis=1, keepdims=True) & (holder[:, None] == np.arange(others.shape[1]))
    waiting[:, MINE] = False
    counts: Bools = others | waiting
    return counts


def unspoken(scene: Scene) -> Scene:
    """Return the scene without the listener's own voice."""
    speaks = scene.speaks.copy()
    speaks[:, MINE] = False
    return replace(scene, speaks=speaks)


def one_voice(scene: Scene) -> Scene:
    """Return the scene as one microphone and one camera record it.

    All others become one person, with the look of the person whose look counts, and with nods only while silent.
    """
    others = np.any(scene.speaks[:, 1:], axis=1)
    looks = np.fmax.reduce(np.where(counts_in(scene), scene.looks, np.nan), axis=1)
    return replace(
        scene,
        speaks=np.stack([scene.speaks[:, MINE], others], axis=1),
        looks=np.stack([looks, looks], axis=1),
        nods=scene.nods & (phase.times(others)[:, 0] == 0),
    )


def _since(happens: Bools) -> Doubles:
    """Return (N,) seconds since the newest True."""
    index = np.arange(len(happens))
    newest = np.maximum.accumulate(np.where(happens, index, -np.inf))
    return np.asarray((index - newest) * FRAME_S, np.float64)


def _smiles_in(smiles: Doubles) -> dict[str, Doubles]:
    """Return (N,) seconds since the newest smile began, and its size so far; breaks of a second do not end a smile."""
    index, at = np.arange(len(smiles)), np.flatnonzero(smiles > 0)
    first = at[np.diff(at, prepend=-np.inf) > SMILES_APART]
    newest = np.searchsorted(first, index, side="right") - 1
    begun, size = np.r_[first, -np.inf][newest], np.zeros(len(smiles))
    for start, end in pairwise([*first.tolist(), len(smiles)]):
        size[start:end] = np.maximum.accumulate(smiles[start:end])
    return {"others_smile_s": (index - begun) * FRAME_S, "others_smile": size}


def _floor_in(speaks: Bools) -> tuple[Ints, Ints]:
    """Return the holder of the floor (N,), -1 for none yet, and the frame (N,) since which it is the holder."""
    frames, people = speaks.shape
    index = np.arange(frames)
    lengths = np.stack([phase.times(speaks[:, who])[:, 0] for who in range(people)], axis=1)
    lengths[lengths < (FLOOR_FRAMES - 0.5) * FRAME_S] = np.inf
    newest = np.maximum.accumulate(np.where(np.isfinite(lengths).any(axis=1), index, -1))
    holder = np.where(newest >= 0, np.argmin(lengths, axis=1)[newest], NOBODY)
    passed = holder != np.r_[NOBODY, holder][:-1]
    return holder, np.maximum.accumulate(np.where(passed, index, 0))


def signs_in(faces: Sequence[FaceFrame | None]) -> Doubles:
    """Return nods, sizes of smiles, laughs, moving mouth (N, 4) of a recording: `read_signs` of all frames at once."""
    channels = np.full((len(faces), 4), np.nan)
    known = np.flatnonzero([face is not None for face in faces])
    motion = np.array([face.motion for face in faces if face is not None], np.float64).reshape(-1, MOTION_DIM)
    finite = np.isfinite(motion).all(axis=1)
    channels[known[finite]] = motion[finite][:, [PITCH, *CORNERS, JAW]]
    pitch_rad, found = np.full(len(faces), np.nan), np.zeros((len(faces), 4))
    smoothed, neutral, held, jaw, opening = None, None, 0, 0.0, 0.0
    for index, (pitch, left, right, open_) in enumerate(channels.tolist()):
        if pitch != pitch:  # NaN: no face
            smoothed, held, opening = None, 0, 0.0
            continue
        pitch_rad[index] = smoothed = smoothed_pitch(pitch, smoothed)
        over, neutral, held = smile_over((left + right) / 2, neutral, held)
        jaw, opening = jaw_opening(open_, jaw, opening)
        smiles, moves = held >= HELD_FRAMES, opening > OPENING
        found[index, 1:] = over if smiles else 0.0, smiles and over > BEAM and moves, moves
    nodded, sway = -NODS_APART, 0.0
    swings = np.maximum(_swings_in(pitch_rad), _swings_in(-pitch_rad)).tolist()
    for index in np.flatnonzero(~np.isnan(pitch_rad)).tolist():
        stands_out = swings[index] >= max(NOD_RAD, STANDS_OUT * sway)
        if stands_out and index - nodded >= NODS_APART:
            found[index, 0], nodded = True, index
        sway += SWAY * (swings[index] - sway)
    return found


def _swings_in(values: Doubles) -> Doubles:
    """Return `_swing` of the second before each frame (N,), as far as it has no NaN."""
    windows = sliding_window_view(np.r_[np.full(WINDOW - 1, np.nan), values], WINDOW)
    whole = np.logical_and.accumulate(~np.isnan(windows[:, ::-1]), axis=1)[:, ::-1]  # since the last NaN
    high = np.where(whole, windows, -np.inf)
    lowest = np.minimum.accumulate(np.where(whole, windows, np.inf), axis=1)
    top, rows = high.argmax(axis=1), np.arange(len(values))
    risen = high[rows, top] - lowest[rows, top]
    return np.where(high[rows, top] - values >= BACK * risen, risen, 0.0)


def scene_in(speaker: Sequence[SpeakerFrame], addressed: Addressed = "sense") -> Scene:
    """Return the scene that `sense` detects in a recording; `heard_in` makes the rows of evidence from it."""
    memory = SenseMemory(addressed=addressed)
    speaks, looks = np.zeros((len(speaker), 2), bool), np.full((len(speaker), 2), np.nan)
    nods, smiles, laughs, speaks[:, 1] = signs_in([frame.face for frame in speaker]).T
    nods, laughs = nods > 0, laughs > 0
    first = next((index for index, frame in enumerate(speaker) if len(frame.audio)), len(speaker))  # no sound before
    speaks[first:, 1] = phase.hear(_levels_db([frame.audio for frame in speaker[first:]]))
    speaks[:, 0] = (
        _levels_db([frame.audio[:0] if frame.agent_audio is None else frame.agent_audio for frame in speaker])
        > OWN_VOICE_DB
    )
    for index, frame in enumerate(speaker):
        looks[index, 1], memory = looks_at_head(frame, memory)
    silent = phase.times(speaks[:, 1])[:, 0] == 0
    return Scene(speaks, looks, laughs, nods & silent & np.r_[True, silent][:-1], smiles)


def _levels_db(pieces: Sequence[Floats]) -> Doubles:
    """Return `energy_db` of each piece, of many pieces of the same length at once."""
    levels_db = list[float]()
    for _, alike in groupby(pieces, len):
        rows = [*alike]
        for at in range(0, len(rows), _TOGETHER):
            levels_db += energies_db(np.stack(rows[at : at + _TOGETHER]))
    return np.array(levels_db)


def done_at(
    spans_s: Mapping[str, Doubles], now_s: Doubles, log_rate: Doubles | float, aside: Bools | None = None
) -> Doubles:
    """Return the rows (M, len(DONE)) at instants (M,) from spans (K, 2) by kind of `EVENT_KINDS`.

    Kinds that are missing have no events. `aside` (K,): The gaze shift goes away from the person.
    """
    columns: dict[str, Doubles | float] = {name: np.full(len(now_s), np.inf) for name in DONE}
    for kind in ("nod", "laugh", "smile", "shake", "tilt", "brow_raise"):
        columns[f"{kind}_end_s"] = _since_newest(spans_s.get(kind), now_s, ends=True)
    for kind in ("nod", "mm_hm", "blink"):
        columns[f"{kind}_s"] = _since_newest(spans_s.get(kind), now_s)
    nods = np.sort(spans_s.get("nod", np.zeros((0, 2)))[:, 0])
    begun, earlier = (np.searchsorted(nods, now_s - ago_s - EPS_S) for ago_s in (0.0, COUNTED_S))
    columns["root_nods_30s"] = np.sqrt(begun - earlier)
    columns["log_rate"] = log_rate
    shifts = spans_s.get("gaze_shift", np.zeros((0, 2)))
    columns["shift_s"] = _since_newest(shifts, now_s)
    newest = np.searchsorted(shifts[:, 0], now_s - EPS_S) - 1
    away = np.zeros(len(shifts), bool) if aside is None else aside
    at_person = (newest < 0) | ~np.r_[away, False][newest]
    columns["at_person_s"] = np.where(at_person, columns["shift_s"], np.nan)
    return np.stack([np.broadcast_to(np.asarray(columns[name], np.float64), now_s.shape) for name in DONE], axis=1)


def _since_newest(spans: Doubles | None, now_s: Doubles, ends: bool = False) -> Doubles:
    """Return (N,) seconds since the newest begun span began or, with `ends`, ended; inf before the first, 0 inside."""
    if spans is None or not len(spans):
        return np.full(len(now_s), np.inf)
    newest = np.searchsorted(spans[:, 0], now_s - EPS_S) - 1
    at = np.maximum.accumulate(spans[:, 1]) if ends else spans[:, 0]
    return np.where(newest < 0, np.inf, np.maximum(0.0, now_s - at[np.maximum(newest, 0)]))


# --- Hazards ----------------------------------------------------------------------------------------------------------


def steps_in(frames: int) -> Ints:
    """Return those of `frames` frames at whose end hazards are drawn."""
    return np.arange(STEP_FRAMES - 1, frames, STEP_FRAMES)


def hazards_in(
    model: EventModel, heard: Doubles, own: Sequence[ListenerEvent], calmness: Calmness
) -> dict[str, Doubles]:
    """Return `EventMemory.hazards_hz` of all frames, (N,) by kind, from evidence (N, len(HEARD)) and ordered events."""
    steps = steps_in(len(heard))
    now_s = np.asarray((steps + 1) * FRAME_S, np.float64)
    spans_s = {kind: event_spans(own, kind) for kind in EVENT_KINDS}
    away = np.array([event.target_rad != AT_PERSON for event in own if event.kind == "gaze_shift"], bool)
    done = done_at(spans_s, now_s, _log_rate(model, calmness), away)
    asked_hz = _chances(model, heard[steps], done, calmness) / STEP_S
    under_way = {}
    for kind, spans in spans_s.items():
        newest = np.searchsorted(spans[:, 0], now_s - EPS_S) - 1
        lasts_until_s = np.where(away, np.inf, 0.0) if kind == "gaze_shift" else np.maximum.accumulate(spans[:, 1])
        under_way[kind] = (newest >= 0) & (np.r_[lasts_until_s, 0.0][newest] > now_s)
    hazards_hz = {kind: np.zeros(len(heard)) for kind in EVENT_KINDS}
    for at, kind in enumerate(model.bank.kinds):
        if calmness.per_minute(kind) != 0:
            excluded = np.any([under_way[other] for other in EXCLUDES[kind]], axis=0)
            may = ~excluded & _answers(kind, heard[steps])
            held = np.repeat(np.where(may, asked_hz[:, at], 0.0), STEP_FRAMES)
            hazards_hz[kind][STEP_FRAMES - 1 :] = held[: len(heard) - STEP_FRAMES + 1]
    return hazards_hz


def most_in(model: EventModel, heard: Doubles, calmness: Calmness) -> Doubles:
    """Return the highest probability (M, kinds) of each kind after any history, from evidence (M, len(HEARD)) of steps.

    Each term that depends on the stream's earlier events has the value of its highest knot.
    """
    nothing = np.full((len(heard), len(DONE)), np.nan)
    most = _chances(model, heard, nothing, calmness, _most_by_doing(model, calmness), _MARGIN)
    for at, kind in enumerate(model.bank.kinds):
        most[:, at] *= calmness.per_minute(kind) != 0
        most[~_answers(kind, heard), at] = 0.0
    return most


def _chances(
    model: EventModel,
    heard: Doubles,
    done: Doubles,
    calmness: Calmness,
    terms: Doubles | float = 0.0,
    odds: float = 0.0,
) -> Doubles:
    """Return the probabilities (M, kinds) from evidence of the others and own events; `terms` and `odds` are added."""
    found = []
    for rows in np.array_split(np.concatenate([heard, done], axis=1), len(heard) // _TOGETHER + 1):
        log_odds = model.bank.log_odds(model.bank.contributions(rows) + terms)
        found.append(1 / (1 + np.exp(-log_odds - model.asked_odds(calmness) - odds)))
    return np.concatenate(found)


def _most_by_doing(model: EventModel, calmness: Calmness) -> Doubles:
    """Return (T,) the largest contribution of each term from the stream's earlier events; 0 for terms of the others."""
    curves = [weight for hazard in model.tables.hazards.values() for weight in hazard.weights.values()]
    knots_s = sorted({knot for curve in curves if isinstance(curve, dict) for knot in curve})
    rows = np.full((len(knots_s) + 1, len(EVIDENCE)), np.nan)
    rows[:-1, len(HEARD) :] = np.array(knots_s)[:, None]
    rows[:-1, AT["root_nods_30s"]] = math.sqrt(_MOST_NODS)
    rows[-1, AT["root_nods_30s"]] = 0.0
    rows[:, AT["log_rate"]] = _log_rate(model, calmness)
    return np.asarray(model.bank.contributions(rows).max(axis=0))


def _log_rate(model: EventModel, calmness: Calmness) -> float:
    return math.log(calmness.nod or model.tables.hazards["nod"].per_minute)


def event_spans(events: Sequence[ListenerEvent], kind: str) -> Doubles:
    """Return (K, 2) start, end of the events of a kind."""
    return np.array([(one.start_s, one.end_s) for one in events if one.kind == kind], np.float64).reshape(-1, 2)


def _answers(kind: str, heard: Doubles) -> Bools:
    """Return (M,): an event of the kind may begin, given the behaviour of the others."""
    if kind in ALWAYS:
        return np.ones(len(heard), bool)
    spoken = ~(np.isnan(heard[:, AT["phrase_s"]]) & np.isnan(heard[:, AT["last_phrase_s"]]))
    answered = spoken & (heard[:, AT["silence_s"]] <= LISTENING_S)  # another person has spoken just now
    if kind == "smile":
        answered |= heard[:, AT["others_smile_s"]] <= LISTENING_S
    return answered & (heard[:, AT["own_voice_s"]] > 0)


# --- Decisions -------------------------------------------------------------------------------------------------------


def decisions(
    model: EventModel, heard: Doubles, seeds: Sequence[int], calmness: Calmness
) -> list[tuple[ListenerEvent, ...]]:
    """Return the decisions for each seed without a given history, skipping steps at which no event can begin."""
    steps = steps_in(len(heard))
    most = most_in(model, heard[steps], calmness)
    streams = []
    for seed in seeds:
        draws = np.reshape(
            [uniforms(seed, at, Use.EVENT, len(EVENT_KINDS)) for at in steps.tolist()], (-1, len(EVENT_KINDS))
        )
        frames = [*steps[(draws[:, model.draws] < most).any(axis=1)].tolist(), len(heard)]
        streams.append(_Decider(model.start(seed, calmness), frames))
    while ahead := [stream for stream in streams if stream.frame < len(heard)]:  # each stream is at its own frame
        sensed = [Sensed(stream.frame, heard[stream.frame]) for stream in ahead]
        decided = model.decide_each(sensed, [stream.memory for stream in ahead])
        for stream, (events, memory) in zip(ahead, decided, strict=True):
            stream.take(events, memory)
    return [tuple(stream.events) for stream in streams]


class _Decider:
    """A stream that decides at the end of some frames, the last of which is beyond the end of the recording.

    Attributes:
        frame: The next frame at whose end it decides.
    """

    def __init__(self, memory: EventMemory, frames: Sequence[int]) -> None:
        self.memory, self.events = memory, list[ListenerEvent]()
        self._frames = iter(frames)
        self.frame = self._drawn = next(self._frames)

    def take(self, events: Sequence[ListenerEvent], memory: EventMemory) -> None:
        """Store the decisions, and find the next frame; a look away also ends at a step for which nothing is drawn."""
        self.events += events
        newest = {event.kind: event for event in memory.done}  # of kinds other than nods only these are needed
        self.memory = changed(memory, done=tuple(e for e in memory.done if e.kind == "nod" or newest[e.kind] is e))
        step, look = self.frame + STEP_FRAMES, newest.get("gaze_shift")
        if self.frame == self._drawn:
            self._drawn = next(self._frames)
        self.frame = self._drawn
        if look is not None and look.target_rad != AT_PERSON:
            over = math.ceil((look.end_s / FRAME_S - 1 - LEAD_FRAMES - 1e-6 - (STEP_FRAMES - 1)) / STEP_FRAMES)
            self.frame = min(self._drawn, max(step, over * STEP_FRAMES + STEP_FRAMES - 1))
