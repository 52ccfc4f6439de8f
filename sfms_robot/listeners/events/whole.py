"""Whole recordings at once: the hazards that `EventModel.decide` asks step by step, where all that was done is known.

Where a history is given nothing has to be decided, so every step is asked together (`hazards_in`). Where none is,
`most_in` says how likely each kind can be at all, whatever was done: at a step whose draws all lie above that nothing
can happen, and only the others have to be decided one after the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from sfms_robot.config import Calmness
from sfms_robot.frames import EVENT_KINDS, FRAME_S, Doubles, ListenerEvent
from sfms_robot.listeners.events.evidence import AT, COUNTED_S, DONE, EVIDENCE, HEARD, Bools, Ints, done_at
from sfms_robot.listeners.events.hazards import STEP_FRAMES, STEP_S
from sfms_robot.listeners.events.model import ALWAYS, AT_PERSON, EXCLUDES, LISTENING_S, EventModel
from sfms_robot.signals.event_sizes import SWING_S

_TOGETHER: Final = 1000  # steps: as much as stays in a cache
_MOST_NODS: Final = 1 + COUNTED_S / SWING_S[0]  # in the time in which they are counted
_EPS_S: Final = 1e-6
_MARGIN: Final = 1e-9  # of log-odds, for sums in another order


def steps_in(frames: int) -> Ints:
    """The frames, of so many, at whose end hazards are asked."""
    return np.arange(STEP_FRAMES - 1, frames, STEP_FRAMES)


def hazards_in(
    model: EventModel, heard: Doubles, own: Sequence[ListenerEvent], calmness: Calmness
) -> dict[str, Doubles]:
    """`Decision.hazards_hz` of every frame: evidence (N, len(HEARD)), somebody's events in order -> (N,) by kind."""
    steps = steps_in(len(heard))
    now_s = np.asarray((steps + 1) * FRAME_S, np.float64)
    spans_s = {kind: _spans(own, kind) for kind in EVENT_KINDS}
    away = np.array([event.target_rad != AT_PERSON for event in own if event.kind == "gaze_shift"], bool)
    log_rate = _log_rate(model, calmness)
    odds = [
        model.bank.log_odds(model.bank.contributions(np.concatenate([rows, done_at(spans_s, at_s, log_rate, away)], 1)))
        for rows, at_s in zip(_blocks(heard[steps]), _blocks(now_s), strict=True)
    ]
    asked_hz = 1 / (1 + np.exp(-np.concatenate(odds) - model.asked_odds(calmness))) / STEP_S
    may = _may_happen(heard[steps], spans_s, away, now_s)
    hazards_hz = {kind: np.zeros(len(heard)) for kind in EVENT_KINDS}
    for at, kind in enumerate(model.bank.kinds):
        if calmness.per_minute(kind) != 0:
            held = np.repeat(np.where(may[kind], asked_hz[:, at], 0.0), STEP_FRAMES)
            hazards_hz[kind][STEP_FRAMES - 1 :] = held[: len(heard) - STEP_FRAMES + 1]
    return hazards_hz


def most_in(model: EventModel, heard: Doubles, calmness: Calmness) -> Doubles:
    """Evidence (M, len(HEARD)) of steps -> (M, len(model.bank.kinds)) the greatest probability of each kind.

    Greatest over everything that the stream itself may have done: each term at that one of its knots which says most.
    """
    nothing = np.full((len(heard), len(DONE)), np.nan)
    odds = [
        model.bank.log_odds(model.bank.contributions(np.concatenate([rows, done], 1)) + _most_by_doing(model, calmness))
        for rows, done in zip(_blocks(heard), _blocks(nothing), strict=True)
    ]
    most = 1 / (1 + np.exp(-np.concatenate(odds) - model.asked_odds(calmness) - _MARGIN))
    listening = _listening(heard)
    for at, kind in enumerate(model.bank.kinds):
        most[:, at] *= calmness.per_minute(kind) != 0
        if kind not in ALWAYS:
            most[~listening, at] = 0.0
    return np.asarray(most)


def _most_by_doing(model: EventModel, calmness: Calmness) -> Doubles:
    """(T,) the most that each term can add by what was done; 0 of terms of what is heard."""
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


def _blocks(rows: Doubles) -> list[Doubles]:
    return np.array_split(rows, len(rows) // _TOGETHER + 1)


def _spans(events: Sequence[ListenerEvent], kind: str) -> Doubles:
    return np.array([(one.start_s, one.end_s) for one in events if one.kind == kind], np.float64).reshape(-1, 2)


def _listening(heard: Doubles) -> Bools:
    """(M,) somebody has spoken just now, and it was not oneself."""
    spoken = ~(np.isnan(heard[:, AT["phrase_s"]]) & np.isnan(heard[:, AT["last_phrase_s"]]))
    return np.asarray(spoken & (heard[:, AT["silence_s"]] <= LISTENING_S) & (heard[:, AT["own_voice_s"]] > 0))


def _may_happen(heard: Doubles, spans_s: Mapping[str, Doubles], away: Bools, now_s: Doubles) -> dict[str, Bools]:
    """(M,) by kind: the moment allows it, of listening and of what is under way."""
    under_way = {}
    for kind, spans in spans_s.items():
        newest = np.searchsorted(spans[:, 0], now_s - _EPS_S) - 1
        lasts_until_s = np.where(away, np.inf, 0.0) if kind == "gaze_shift" else np.maximum.accumulate(spans[:, 1])
        under_way[kind] = (newest >= 0) & (np.r_[lasts_until_s, 0.0][newest] > now_s)
    listening = _listening(heard)
    return {
        kind: ~np.any([under_way[other] for other in EXCLUDES[kind]], axis=0) & (listening | (kind in ALWAYS))
        for kind in EVENT_KINDS
    }
