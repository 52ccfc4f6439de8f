"""Quality of the detectors of events in motion, measured on known events.

People's nods are annotated, while a listener's nods are detected in its motion. Before the two are compared, the
detector is tested on motion composed from known nods. The same count shows whether a listener performs its decisions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import starmap
from typing import Final

import numpy as np
from scipy.signal import welch

from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, FRAME_S, YAW_PITCH, Bools, Doubles, Floats, ListenerEvent
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora import phrase_timing
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.compose.render_events import Score, act
from sfms_robot.lab.corpora.phrase_timing import find_gaze_shifts
from sfms_robot.lab.evaluation.intervals import rounded
from sfms_robot.signals import events
from sfms_robot.signals.events import MOTION_EVENTS
from sfms_robot.signals.gaze_kinematics import EYE_CHANNELS, EYES_RAD, directions, head_part
from sfms_robot.signals.motion_primitives import Motions

_IN_TIME_S: Final = 0.12
_LOOSE_S: Final = 0.5  # largest distance of the events of a pair
_EDGE_S: Final = 1.0  # an event that begins this close to the end of a motion may not be over
_SIZES: Final[Mapping[str, tuple[float, ...]]] = {  # edges of the ranges of sizes
    "nod": tuple(np.deg2rad([0, 2, 3, 4, 6, 9, 180])),
    "blink": (0.0, 0.5, 0.75, 1.01),
    "smile": (0.0, 0.2, 0.3, 0.45, 0.6, 1.01),
}


@dataclass(frozen=True)
class Sightings:
    """Requested events of one kind and the events that a detector saw; sightings of several motions can be added.

    Attributes:
        sizes: (K,) sizes of the requested events.
        in_time: (K,) 1 if the requested event was seen within 0.12 s of the due time.
        seen: Number of events that the detector saw.
        late_s: Lateness of the seen events within 0.5 s of a requested one.
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
        """Return the share of requested events seen in time; NaN without any."""
        return float(self.in_time.mean()) if len(self.in_time) else np.nan

    @property
    def precision(self) -> float:
        """Return the share of seen events that were requested, in time; NaN without any."""
        return float(self.in_time.sum() / self.seen) if self.seen else np.nan

    @property
    def offset_s(self) -> float:
        """Return the median lateness; NaN without any."""
        return middle(self.late_s)

    def recall_at(self, sizes: Doubles, edges: Sequence[float]) -> float:
        """Return the expected recall of events of these sizes, from the recall of each range between `edges`."""
        here, there = np.digitize(self.sizes, edges), np.digitize(sizes, edges)
        known = {place: self.in_time[here == place].mean() for place in np.unique(here)}
        found = [known[place] for place in there if place in known]
        return float(np.mean(found)) if found else np.nan

    def report(self, kind: str) -> Figures:
        """Return counts, recall, precision and lateness, and the recall by size; None where undefined."""
        edges = _SIZES[kind]
        place = np.digitize(self.sizes, edges)
        return {
            "asked": len(self.sizes),
            "seen": self.seen,
            **self.figures(self.recall),
            "by_size": [
                {
                    "size": np.round(edges[at - 1 : at + 1], 4).tolist(),
                    "asked": int((place == at).sum()),
                    "recall": round(float(self.in_time[place == at].mean()), 4),
                }
                for at in np.unique(place).tolist()
            ],
        }

    def figures(self, recall: float) -> dict[str, float | None]:
        """Return a recall with the precision and lateness; None where undefined."""
        return {"recall": rounded(recall), "precision": rounded(self.precision), "offset_s": rounded(self.offset_s)}


def seen(motion: Floats, kind: str) -> list[tuple[float, float, float]]:
    """Return (start_s, end_s, size) of the events of a kind (`MOTION_EVENTS`) in motion (N, 58)."""
    how = MOTION_EVENTS[kind]
    return how.find(_pitch(motion) if kind == "nod" else how.signal(motion), FRAME_HZ)


def _pitch(motion: Floats) -> Doubles:
    """Return the pitch (N,) of motion (N, 58) without the head's part in gaze shifts.

    The head moves with a look aside and comes back, which is not a nod. Eyes that do not move at all are not tracked,
    and then nothing is removed.
    """
    pitch = motion[:, CHANNEL_INDEX["pitch"]].astype(float)
    return pitch - head_part(gaze_rad(motion))[:, 1] if motion[:, list(EYE_CHANNELS)].any() else pitch


def gaze_rad(motion: Floats) -> Doubles:
    """Return the direction (N, 2), yaw and pitch, in which head and eyes of motion (N, 58) look together."""
    return np.asarray(motion[:, YAW_PITCH] + directions(motion, EYES_RAD).mean(axis=1), float)


@dataclass(frozen=True)
class Detected:
    """Events detected in motion of some frames, by kind of `MOTION_EVENTS`: (start_s, end_s, size)."""

    frames: int
    events: Mapping[str, Sequence[tuple[float, float, float]]]

    @classmethod
    def of(cls, motion: Floats) -> Detected:
        return cls(len(motion), {kind: seen(motion, kind) for kind in MOTION_EVENTS})


def asked_and_seen(
    asked: Sequence[ListenerEvent], detected: Detected, lag_s: Mapping[str, float] | None = None
) -> dict[str, Sightings]:
    """Return by kind which requested events were detected, and how late.

    Times count from the beginning of the first frame. `lag_s`: The usual lateness of each kind (a smile has to rise),
    which does not count against being in time. Of several candidates the nearest are paired first.
    """
    last_s = detected.frames * FRAME_S - _EDGE_S
    found = {}
    for kind, shown in detected.events.items():
        wanted = [event for event in asked if event.kind == kind and 0 <= event.start_s < last_s]
        # A laugh looks like a smile, and is not counted as one.
        laughs = [event for event in asked if kind == "smile" and event.kind == "laugh"]
        starts_s = np.array([
            start for start, _, _ in shown
            if start < last_s + _LOOSE_S
            and not any(event.start_s - _LOOSE_S <= start <= event.end_s + _LOOSE_S for event in laughs)
        ])  # fmt: skip
        lag = (lag_s or {}).get(kind, 0.0)
        pairs = paired(np.array([event.start_s for event in wanted]) + lag, starts_s, _LOOSE_S)
        in_time = np.zeros(len(wanted))
        in_time[[place for place, late in pairs if abs(late) <= _IN_TIME_S + 1e-9]] = 1.0
        sizes = np.array([abs(event.size) for event in wanted], float)
        late_s = np.array([late for _, late in pairs]) + lag
        found[kind] = Sightings(sizes, in_time, int((starts_s < last_s).sum()), late_s)
    return found


def paired(asked_s: Doubles, seen_s: Doubles, within_s: float) -> list[tuple[int, float]]:
    """Return (index in `asked_s`, lateness) of pairs at most `within_s` apart, each time in one pair, nearest first."""
    late = seen_s[None, :] - asked_s[:, None]
    rows, columns = np.nonzero(np.abs(late) <= within_s)
    pairs: dict[int, float] = {}
    taken: set[int] = set()
    for place in np.argsort(np.abs(late[rows, columns]), kind="stable"):
        row, column = int(rows[place]), int(columns[place])
        if row not in pairs and column not in taken:
            pairs[row] = float(late[row, column])
            taken.add(column)
    return sorted(pairs.items())


def added_up(parts: Iterable[Mapping[str, Sightings]]) -> dict[str, Sightings]:
    """Return the sum of each kind."""
    every = list(parts)
    return {kind: sum((part[kind] for part in every if kind in part), Sightings()) for kind in MOTION_EVENTS}


@dataclass(frozen=True)
class DetectorCalibration:
    """Sightings of known events by the detectors, by kind."""

    known: Mapping[str, Sightings]

    @classmethod
    def of(cls, motions: Motions, listeners: int = 60, seed: int = 1) -> DetectorCalibration:
        """Measure on a minute of each of `listeners` composed listeners, with nods of many sizes. Takes seconds."""
        drawn = [np.random.default_rng([seed, number]) for number in range(listeners)]
        acted = [act(busy_minute(rng), motions, rng) for rng in drawn]
        return cls.on([(one.events, one.motion) for one in acted])

    @classmethod
    def on(cls, listeners: Sequence[tuple[Sequence[ListenerEvent], Floats]]) -> DetectorCalibration:
        """Measure on listeners (events, motion); "in time" is relative to the median lateness of each kind."""
        known = [(asked, Detected.of(motion)) for asked, motion in listeners]
        lag_s = cls(added_up(starmap(asked_and_seen, known))).lag_s
        return cls(added_up(asked_and_seen(asked, detected, lag_s) for asked, detected in known))

    @property
    def lag_s(self) -> dict[str, float]:
        """Return the median lateness of each kind."""
        return {kind: one.offset_s for kind, one in self.known.items() if len(one.late_s)}

    @property
    def nods_per_seen_nod(self) -> float:
        """Return the number of true nods per seen nod; 1 without data."""
        nods = self.known.get("nod", Sightings())
        return nods.precision / nods.recall if nods.in_time.any() else 1.0

    def report(self) -> Figures:
        return {kind: one.report(kind) for kind, one in self.known.items() if len(one.sizes)}

    def report_of(self, sightings: Mapping[str, Sightings]) -> Figures:
        """Return reports of sightings, with the recall of known events of the same sizes as "recorded"."""
        return {
            kind: {
                **one.report(kind),
                "recorded": self.known[kind].figures(self.known[kind].recall_at(one.sizes, _SIZES[kind])),
            }
            for kind, one in sightings.items()
            if len(one.sizes)
        }


def busy_minute(rng: np.random.Generator) -> Score:
    """Draw a minute in which a listener does everything that a detector may miss or confuse."""

    def spans(every_s: float, shortest_s: float, longest_s: float) -> Doubles:
        starts = np.cumsum(rng.exponential(every_s, round(120 / every_s)) + longest_s)
        starts = starts[starts < 57]
        return np.stack([starts, starts + rng.uniform(shortest_s, longest_s, len(starts))], axis=1)

    looks = [(start, end, str(rng.choice(["down", "away", "side A", "screen"]))) for start, end in spans(5, 0.5, 3)]
    return Score(
        frames=60 * FRAME_HZ,
        nods=spans(5, 0.3, 2),
        shakes=spans(60, 0.5, 1.5),
        tilts=spans(40, 0.5, 2),
        laughs=spans(30, 0.5, 2),
        shared_laughs=spans(15, 0.5, 2),
        gaze=tuple(looks),
    )


# --- Statistics of behaviour -----------------------------------------------------------------------------------------
#
# `behaviour` returns figures of listeners with their dyads: nods, blinks, smiles, stillness, smoothness. `movement`
# describes each kind of motion: nods, blinks, smiles, gaze, and slow sway.

SWAY_BANDS_HZ: Final = ((0.05, 0.1), (0.1, 0.2), (0.2, 0.4))
_ROTATIONS: Final = slice(0, 3)
_STILL_DEG: Final = 0.1
_ON_PERSON_RAD: Final = np.deg2rad(5.0)
_FIXATION_RAD: Final = np.deg2rad(2.0)  # a look ends when gaze is that far from where it began
_SHIFT_RAD: Final = np.deg2rad(5.0)
_SWAY_WINDOW: Final = 20 * FRAME_HZ
_CYCLE: Final = 0.25  # share of a nod's depth; two peaks with a shallower dip between them are one cycle
_SLOW: Final = 10 * FRAME_HZ  # frames whose median is a slow pose
_LEFT: Final = {"blink": "eyeBlinkLeft", "smile": "mouthSmileLeft"}


def behaviour(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> dict[str, float]:
    """Return figures of the motions of listeners (N, 58), each with its dyad; NaN where there is no data.

    Rates are per minute, nods per minute of listening. nod_deg: median peak to peak. phrase_end_ratio: nod onsets just
    after phrase ends over those later on. still_share: share of seconds in which the head turns less than 0.1 degree.
    speed, acceleration and jerk: 99.9th percentiles of the head's rotation.
    """
    onsets, listened, sizes, counts = 0, 0.0, [], np.zeros(4)
    for motion, dyad in zip(motions, dyads, strict=True):
        nods = events.find_nods(motion[:, CHANNEL_INDEX["pitch"]], FRAME_HZ)
        starts = [start for start, _, _ in nods]
        listened += phrase_timing.minutes_of(dyad.listening)
        onsets += sum(bool(dyad.listening[int(start * FRAME_HZ)]) for start in starts)
        sizes += [size for _, _, size in nods]
        spoke = np.zeros(len(motion), bool) if dyad.audio is None else phrase_timing.voice_activity(dyad.audio)
        counts += phrase_timing.phrase_end_counts(starts, phrase_timing.phrase_ends(spoke), dyad.listening)
    minutes = sum(map(len, motions)) / FRAME_HZ / 60
    still = []
    for motion in motions:
        if seconds := len(motion) // FRAME_HZ:
            turns = np.degrees(motion[: seconds * FRAME_HZ, _ROTATIONS]).reshape(seconds, FRAME_HZ, 3)
            still.append((np.ptp(turns, axis=1).max(axis=1) < _STILL_DEG).mean())
    return {
        "nods": onsets / listened if listened else np.nan,
        "nod_deg": middle(np.degrees(sizes)),
        "phrase_end_ratio": phrase_timing.ratio_of(counts.tolist()),
        "blinks": len(_lasted_s(motions, "blink")) / minutes,
        "smiles": len(_lasted_s(motions, "smile")) / minutes,
        "still_share": float(np.mean(still)) if still else np.nan,
        "speed_deg_s": _fastest(motions, 1),
        "acceleration_deg_s2": _fastest(motions, 2),
        "jerk_deg_s3": _fastest(motions, 3),
    }


def middle(values: Sequence[float] | Doubles) -> float:
    """Return the median; NaN without values."""
    return float(np.median(values)) if len(values) else np.nan


def _lasted_s(motions: Sequence[Floats], kind: str) -> list[float]:
    """Return the length [s] of each event of a kind, measured on the left side of the face."""
    find, channel = MOTION_EVENTS[kind].find, CHANNEL_INDEX[_LEFT[kind]]
    return [end - start for motion in motions for start, end, _ in find(motion[:, channel], FRAME_HZ)]


def _fastest(motions: Sequence[Floats], order: int) -> float:
    moved = [np.diff(motion[:, _ROTATIONS].astype(float), order, axis=0) for motion in motions]
    pooled = np.linalg.norm(np.concatenate(moved), axis=1)
    return float(np.degrees(np.percentile(pooled, 99.9)) * FRAME_HZ**order) if len(pooled) else np.nan


# --- how a face moves -----------------------------------------------------------------------------------------------


def movement(motions: Sequence[Floats], addressed: Sequence[Bools]) -> dict[str, float]:
    """Return figures of motions (N, 58), each with the frames (N,) in which gaze at the person is expected.

    Medians of nods (as in `nods_of`), of the lengths of blinks, smiles and looks, gaze within 5 degrees of the person
    (share of the expected time), gaze shifts of 5 degrees and more per minute, and power of the head's turns by band of
    `SWAY_BANDS_HZ`. NaN where nothing was found.
    """
    sizes, lengths, cycles, swings = nods_of(motions).T
    gazes = [gaze_rad(motion) for motion in motions]
    minutes = sum(map(len, motions)) / FRAME_HZ / 60
    on_person = np.concatenate(
        [np.hypot(*gaze[asked].T) <= _ON_PERSON_RAD for gaze, asked in zip(gazes, addressed, strict=True)] or [[]]
    )
    return {
        "nod_deg": middle(np.degrees(sizes)),
        "nod_s": middle(lengths),
        "nod_cycle_s": middle(cycles),
        "nod_swings": middle(swings),
        "blink_s": middle(_lasted_s(motions, "blink")),
        "smile_s": middle(_lasted_s(motions, "smile")),
        "look_s": middle([length_s for gaze in gazes for length_s in looks_s(gaze)]),
        "gaze_on_person": float(on_person.mean()) if len(on_person) else np.nan,
        "gaze_shifts_per_minute": sum(map(shifts, gazes)) / minutes if minutes else np.nan,
        **{
            f"sway_db_{low:g}_{high:g}_hz": power
            for (low, high), power in zip(SWAY_BANDS_HZ, sway_db(motions).tolist(), strict=True)
        },
    }


def nods_of(motions: Sequence[Floats]) -> Doubles:
    """Return (K, 4): size peak to peak [rad], length [s], length of a cycle [s], and number of cycles of each nod.

    The length of a nod is its full width at half depth, for recorded and for drawn motion: from where the pitch passes
    half the depth of the first cycle to where it comes back to half the depth of the last. Depths are measured from the
    line between the pitch before and after the nod. The length of a cycle is its own full width at half depth, the
    median of all. Two lowest points with less than a quarter of the depth between them are one cycle.

    The length does not include the margins that a filter adds around a nod, nor the time of an annotator's key press.
    """
    nods = []
    for motion in motions:
        pitch = _pitch(motion)
        for start, end, size in events.find_nods(pitch, FRAME_HZ):
            swing = pitch[round(start * FRAME_HZ) : round(end * FRAME_HZ) + 1]
            swing = swing - np.linspace(swing[0], swing[-1], len(swing))
            swing *= np.copysign(1, swing.max() + swing.min())  # the larger swing becomes positive
            peaks, depths = events.find_peaks(swing, _CYCLE * swing.max())
            before, after = np.array(events.half_widths(swing, peaks, depths)) / FRAME_HZ
            nods.append((size, after[-1] - before[0], np.median(after - before), len(peaks)))
    return np.array(nods, float).reshape(-1, 4)


def looks_s(gaze: Doubles) -> list[float]:
    """Return the time [s] for which gaze (N, 2) stays within 2 degrees of where it settled, per look but the last."""
    found, first = [], 0
    for frame in range(1, len(gaze)):
        if np.hypot(*(gaze[frame] - gaze[first])) > _FIXATION_RAD:
            found.append((frame - first) / FRAME_HZ)
            first = frame
    return [length for length in found if length > 1.5 / FRAME_HZ]  # shorter ones are part of a shift


def shifts(gaze: Doubles) -> int:
    """Return how often gaze (N, 2) moves by 5 degrees or more within 0.2 s."""
    return len(find_gaze_shifts(gaze, _SHIFT_RAD))


def sway_db(motions: Sequence[Floats]) -> Doubles:
    """Return the mean power (B,) of roll, pitch and yaw in `SWAY_BANDS_HZ`, dB of a square degree per Hz.

    NaN if no motion lasts twenty seconds.
    """
    long = [motion[:, _ROTATIONS] for motion in motions if len(motion) >= _SWAY_WINDOW]
    if not long:
        return np.full(len(SWAY_BANDS_HZ), np.nan)
    powers = [welch(np.degrees(turns.astype(float)), FRAME_HZ, nperseg=_SWAY_WINDOW, axis=0) for turns in long]
    hz, mean = powers[0][0], np.mean([power.mean(axis=1) for _, power in powers], axis=0)
    return np.array([10 * np.log10(mean[(hz >= low) & (hz < high)].mean() + 1e-12) for low, high in SWAY_BANDS_HZ])


def slow_poses_deg(motions: Sequence[Floats]) -> Doubles:
    """Return roll, pitch, yaw (K, 3): the median of every ten seconds."""
    found = [
        np.median(motion[at : at + _SLOW, _ROTATIONS], axis=0)
        for motion in motions
        for at in range(0, len(motion), _SLOW)
    ]
    return np.degrees(np.array(found, np.float64).reshape(-1, 3))
