"""How well events are seen in motion: what a detector makes of events that are known to be there.

People's nods are annotated, a listener's are found in its motion: before the two are laid side by side the finder is
tried on motion composed from known nods. The same count tells whether a listener does what it has decided to do.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, YAW_PITCH, Doubles, Floats, ListenerEvent
from sfms_robot.lab.corpora.compose.render_events import Score, act
from sfms_robot.lab.evaluation.phrase_timing import find_gaze_shifts
from sfms_robot.signals.events import MOTION_EVENTS
from sfms_robot.signals.gaze_kinematics import EYE_CHANNELS, EYE_PAN_RAD, EYE_TILT_RAD, directions, head_part
from sfms_robot.signals.motion_primitives import Motions

IN_TIME_S: Final = 0.12
LOOSE_S: Final = 0.5  # further apart is no pair at all
SHOWS_AS: Final[Mapping[str, tuple[str, ...]]] = {"smile": ("laugh",)}  # what else is seen so, and is not counted
EDGE_S: Final = 1.0  # what begins this close to the end of a motion may not be over
SIZES: Final[Mapping[str, tuple[float, ...]]] = {
    "nod": tuple(np.deg2rad([0, 2, 3, 4, 6, 9, 180])),
    "blink": (0.0, 0.5, 0.75, 1.01),
    "smile": (0.0, 0.2, 0.3, 0.45, 0.6, 1.01),
}
EYES_RAD: Final = np.array([EYE_PAN_RAD, EYE_TILT_RAD])  # an eye's yaw and pitch for a channel of 1
_EYES: Final = list(EYE_CHANNELS)


@dataclass(frozen=True)
class Sightings:
    """Events of one kind that were asked for, beside what a detector saw; those of several motions may be added.

    Attributes:
        sizes: (K,) of those asked for; in_time: (K,) seen within 0.12 s of when they should be.
        seen: how many the detector saw; late_s: of those within 0.5 s of one asked for, by how much.
    """

    sizes: Doubles = field(default_factory=lambda: np.zeros(0))
    in_time: Doubles = field(default_factory=lambda: np.zeros(0))
    seen: int = 0
    late_s: Doubles = field(default_factory=lambda: np.zeros(0))

    def __add__(self, other: Sightings) -> Sightings:
        return Sightings(
            np.r_[self.sizes, other.sizes],
            np.r_[self.in_time, other.in_time],
            self.seen + other.seen,
            np.r_[self.late_s, other.late_s],
        )

    @property
    def recall(self) -> float:
        """Share of those asked for that is seen in time; NaN of none."""
        return float(self.in_time.mean()) if len(self.in_time) else float("nan")

    @property
    def precision(self) -> float:
        """Share of those seen that was asked for, in time; NaN of none."""
        return float(self.in_time.sum() / self.seen) if self.seen else float("nan")

    @property
    def offset_s(self) -> float:
        """How late they are seen, median; NaN of none."""
        return float(np.median(self.late_s)) if len(self.late_s) else float("nan")

    def recall_at(self, sizes: Doubles, edges: Sequence[float]) -> float:
        """Recall that events of these sizes would have, by the recall of each range of sizes between `edges`."""
        here, there = np.digitize(self.sizes, edges), np.digitize(sizes, edges)
        known = {place: self.in_time[here == place].mean() for place in np.unique(here)}
        found = [known[place] for place in there if place in known]
        return float(np.mean(found)) if found else float("nan")


def seen(motion: Floats, kind: str) -> list[tuple[float, float, float]]:
    """(start_s, end_s, size) of the events of a kind (`MOTION_EVENTS`) in motion (N, 58).

    The head goes along with a look aside and comes back: that is no nod, and what looking makes it do is left out
    (where eyes move at all; of those that were not tracked nobody knows).
    """
    how = MOTION_EVENTS[kind]
    if kind != "nod" or not motion[:, _EYES].any():
        return how.find(how.signal(motion), FRAME_HZ)
    rows = np.array(motion, np.float64)
    rows[:, :3] -= head_part(gaze_rad(motion))
    return how.find(how.signal(rows), FRAME_HZ)


def gaze_rad(motion: Floats) -> Doubles:
    """Motion (N, 58) -> where head and eyes together look (N, 2), yaw and pitch."""
    return np.asarray(motion[:, YAW_PITCH] + directions(motion, EYES_RAD).mean(axis=1), np.float64)


def gaze_shifts(motion: Floats) -> list[float]:
    """Seconds at which head and eyes together, of motion (N, 58), go elsewhere."""
    gaze = gaze_rad(motion)
    return find_gaze_shifts(gaze[:, 0], gaze[:, 1], FRAME_HZ)


def asked_and_seen(
    asked: Sequence[ListenerEvent], motion: Floats, lag_s: Mapping[str, float] | None = None
) -> dict[str, Sightings]:
    """By kind of `MOTION_EVENTS`: which of the events asked for are to be seen in motion (N, 58), and when.

    Times count from the first frame's beginning. `lag_s`: how late each kind is seen by its nature (a smile has to have
    risen); what is in time is in time apart from that. Of several candidates the nearest pairs go together.
    """
    last_s = len(motion) * FRAME_S - EDGE_S
    found = {}
    for kind in MOTION_EVENTS:
        wanted = [event for event in asked if event.kind == kind and 0 <= event.start_s < last_s]
        others = [event for event in asked if event.kind in SHOWS_AS.get(kind, ())]
        starts_s = np.array([
            start for start, _, _ in seen(motion, kind)
            if start < last_s + LOOSE_S and not any(_within(start, event) for event in others)
        ])  # fmt: skip
        lag = (lag_s or {}).get(kind, 0.0)
        pairs = paired(np.array([event.start_s for event in wanted]) + lag, starts_s, LOOSE_S)
        late_s = np.array([late for _, late in pairs]) + lag
        in_time = np.zeros(len(wanted))
        in_time[[place for place, late in pairs if abs(late) <= IN_TIME_S + 1e-9]] = 1.0
        sizes = np.array([abs(event.size) for event in wanted], np.float64)
        found[kind] = Sightings(sizes, in_time, int((starts_s < last_s).sum()), late_s)
    return found


def _within(time_s: float, event: ListenerEvent) -> bool:
    return event.start_s - LOOSE_S <= time_s <= event.end_s + LOOSE_S


def paired(asked_s: Doubles, seen_s: Doubles, within_s: float) -> list[tuple[int, float]]:
    """(index in `asked_s`, seconds late) of pairs no further apart than `within_s`, each in one pair, nearest first."""
    late = seen_s[None, :] - asked_s[:, None]
    rows, columns = np.nonzero(np.abs(late) <= within_s)
    pairs: list[tuple[int, float]] = []
    rows_left, columns_left = set(rows.tolist()), set(columns.tolist())
    for place in np.argsort(np.abs(late[rows, columns]), kind="stable"):
        row, column = int(rows[place]), int(columns[place])
        if row in rows_left and column in columns_left:
            rows_left.remove(row)
            columns_left.remove(column)
            pairs.append((row, float(late[row, column])))
    return sorted(pairs)


@dataclass(frozen=True)
class Calibration:
    """What the detectors make of known events, by kind."""

    known: Mapping[str, Sightings]

    @classmethod
    def of(cls, motions: Motions, listeners: int = 60, seed: int = 1) -> Calibration:
        """On a minute of each of so many composed listeners, whose nods are of many sizes. Some seconds."""
        drawn = [np.random.default_rng([seed, number]) for number in range(listeners)]
        acted = [act(busy_minute(rng), motions, rng) for rng in drawn]
        return cls.on([(one.events, one.motion) for one in acted])

    @classmethod
    def on(cls, listeners: Sequence[tuple[Sequence[ListenerEvent], Floats]]) -> Calibration:
        """On listeners (events, motion) whose events are known; each kind is in time apart from its median lateness."""
        loose = added_up(asked_and_seen(asked, motion) for asked, motion in listeners)
        lag_s = {kind: one.offset_s for kind, one in loose.items() if len(one.late_s)}
        return cls(added_up(asked_and_seen(asked, motion, lag_s) for asked, motion in listeners))

    @property
    def lag_s(self) -> dict[str, float]:
        """How late each kind is seen, median."""
        return {kind: one.offset_s for kind, one in self.known.items() if len(one.late_s)}

    @property
    def nods_per_seen_nod(self) -> float:
        """Nods there are for every one that is seen; 1 where nothing is known."""
        nods = self.known.get("nod", Sightings())
        return nods.precision / nods.recall if nods.in_time.any() else 1.0

    def report(self) -> dict[str, Any]:
        """Recall, precision and lateness by kind, and recall by size."""
        return {kind: figures(one, SIZES[kind]) for kind, one in self.known.items() if len(one.sizes)}


def busy_minute(rng: np.random.Generator) -> Score:
    """A minute in which a listener does a little of everything: what a detector may miss, or take for another."""

    def spans(every_s: float, shortest_s: float, longest_s: float) -> Doubles:
        starts = np.cumsum(rng.exponential(every_s, round(120 / every_s)) + longest_s)
        starts = starts[starts < 57]
        return np.stack([starts, starts + rng.uniform(shortest_s, longest_s, len(starts))], axis=1)

    looks = [(start, end, str(rng.choice(["down", "away", "side A", "screen"]))) for start, end in spans(5, 0.5, 3)]
    return Score(
        60 * FRAME_HZ,
        nods=spans(5, 0.3, 2),
        shakes=spans(60, 0.5, 1.5),
        tilts=spans(40, 0.5, 2),
        laughs=spans(30, 0.5, 2),
        shared_laughs=spans(15, 0.5, 2),
        gaze=tuple(looks),
    )


def added_up(parts: Iterable[Mapping[str, Sightings]]) -> dict[str, Sightings]:
    """The sum of each kind."""
    total: dict[str, Sightings] = {kind: Sightings() for kind in MOTION_EVENTS}
    for part in parts:
        for kind, one in part.items():
            total[kind] = total[kind] + one
    return total


def figures(one: Sightings, edges: Sequence[float]) -> dict[str, Any]:
    """As a report has them; None for what cannot be told."""
    place = np.digitize(one.sizes, edges)
    by_size = [
        {
            "size": [round(float(edges[at - 1]), 4), round(float(edges[at]), 4)],
            "asked": int((place == at).sum()),
            "recall": round(float(one.in_time[place == at].mean()), 4),
        }
        for at in range(1, len(edges))
        if (place == at).any()
    ]
    values = {"recall": one.recall, "precision": one.precision, "offset_s": one.offset_s}
    told = {name: round(value, 4) if np.isfinite(value) else None for name, value in values.items()}
    return {"asked": len(one.sizes), "seen": one.seen, **told, "by_size": by_size}
