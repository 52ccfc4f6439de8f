"""Figures of the times of a listener's nods in meetings, compared with the annotated nods of the people.

Three sources are distinguished: the events of people (`people_`), the decisions of a listener (`decided_`), and the
events visible in its motion (no prefix). All are counted in the same way: onsets per minute of a kind of time
(`times_of`), intervals in listening time, and how well a score ranks the instants at which the person's events began
above the other instants at which they might have begun (`ranked`). Every count is a sum over one meeting; sums are
added per person (`per_person`) and made into figures.

The nod table is the simplest baseline of timing: a rate of nods by speech phase. A cell is the place in the talk of the
others: in a phrase or in a silence, by its duration so far and by the length of the phrase before. Its rate is nods
over minutes, pulled toward the mean where minutes are few.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, Bools, Doubles, Floats, Ints, ListenerEvent
from sfms_robot.lab.corpora import phrase_timing
from sfms_robot.lab.corpora.compose.ami import MeetingPerson
from sfms_robot.lab.corpora.compose.composed import Stretch, active
from sfms_robot.lab.corpora.phrase_timing import find_gaze_shifts, minutes_of
from sfms_robot.lab.evaluation.detection import Detected, DetectorCalibration, gaze_rad
from sfms_robot.lab.evaluation.intervals import Figure, Sums, added, distance, median, quotient, ratio
from sfms_robot.lab.evaluation.listener_meetings import SHIFT_S, ListenerMeeting, frames_before
from sfms_robot.lab.evaluation.whole_recordings import event_spans
from sfms_robot.lab.learning.events.event_trainer import listening_in
from sfms_robot.signals import phase
from sfms_robot.signals.events import MOTION_EVENTS

ANNOTATED: Final = ("mm_hm", "laugh", "gaze_shift")  # besides nods
_WITHIN_S: Final = 0.5  # a nod this close counts for an instant
_LEAST: Final = 3  # fewer events of a person in a meeting are not ranked
_INTERVALS_S: Final = np.geomspace(0.2, 1200, 400)  # edges of the histogram of intervals
_SIZES_DEG: Final = np.arange(0, 40.1, 0.1)  # edges of the histogram of nods by size
_LONG_SILENCE_S: Final = 2.0
_STRETCH_S: Final = 48.0  # listening time in which nods are counted for their variance over mean
_SPEECH_S: Final = (1.0, 2.0, 4.0, 8.0)  # edges of the cells of the nod table
_SILENCE_S: Final = (0.4, 0.8, 1.2)
_LAST_S: Final = (1.0, 3.0)
_PRIOR_NODS: Final = 5.0  # nods at the mean rate that are added to every cell
CELLS: Final = (len(_SILENCE_S) + 1 + len(_SPEECH_S) + 1) * (len(_LAST_S) + 1)

Runs = Sequence[Doubles]  # spans (K, 2) [s] of events, once for each seed


def _pooled(onsets: Sequence[Ints]) -> Ints:
    return np.concatenate([np.zeros(0, np.int64), *onsets])


# --- counts ---------------------------------------------------------------------------------------------------------


def times_of(one: ListenerMeeting) -> dict[str, Bools]:
    """Return masks (N,) of the times in which nods are counted; `after_phrase` over `later` is the phrase-end ratio."""
    frames, listening = one.frames, one.listening
    ends = phrase_timing.phrase_ends(one.others)
    silence_s = phase.times(one.others)[:, 1]
    return {
        "nods_per_minute": listening,
        "addressed_nods_per_minute": one.addressed,
        "bystander_nods_per_minute": one.bystander,
        "nods_after_phrase": phrase_timing.window_after(ends, phrase_timing.AFTER_S, frames) & listening,
        "nods_later": phrase_timing.window_after(ends, phrase_timing.LATER_S, frames) & listening,
        "nods_long_silence": (silence_s > _LONG_SILENCE_S) & ~one.own & ~one.unseen,
    }


def nod_sums(who: str, one: ListenerMeeting, runs: Runs, within: Bools | None = None, per_seen: float = 1.0) -> Sums:
    """Return nods and minutes of every kind of time, and the histogram of intervals, in the played part.

    `per_seen`: True nods for each counted nod (`detection.DetectorCalibration`).
    """
    played = np.ones(one.frames, bool) if within is None else within
    onsets = [np.round(nods[:, 0] * FRAME_HZ).astype(np.int64).clip(0, one.frames - 1) for nods in runs]
    every, heard = _pooled(onsets), one.listening & played
    sums = {
        who + name: np.array([per_seen * (mask & played)[every].sum(), len(runs) * minutes_of(mask & played)])
        for name, mask in times_of(one).items()
    }
    sums[who + "nods_variance_over_mean"] = np.sum([np.zeros(2), *(scatter(begun, heard) for begun in onsets)], axis=0)
    lengths_s = np.concatenate([np.zeros(0), *(intervals_s(begun, heard) for begun in onsets)])
    bins = np.digitize(lengths_s, _INTERVALS_S)  # also beyond both ends
    sums[who + "intervals"] = np.bincount(bins, minlength=len(_INTERVALS_S) + 1).astype(np.float64)
    return sums


def intervals_s(onsets: Ints, listening: Bools) -> Doubles:
    """Return the listening time [s] from onset to onset (frames); onsets outside of listening do not count."""
    clock_s = np.cumsum(listening) / FRAME_HZ
    return np.diff(clock_s[np.sort(onsets[listening[onsets]])])


def scatter(onsets: Ints, listening: Bools) -> Doubles:
    """Return [stretches times variance, sum] of the counts in stretches of 48 s of listening; zeros for one or none.

    Nods that trigger nods come in bouts and leave whole stretches empty, so their ratio exceeds 1, Poisson's value.
    """
    frames = round(_STRETCH_S * FRAME_HZ)
    stretch = (np.cumsum(listening) - 1) // frames
    whole = int(listening.sum()) // frames
    if whole < 2:
        return np.zeros(2)
    counts = np.bincount(stretch[onsets[listening[onsets]]], minlength=whole)[:whole]
    return np.array([whole * counts.var(ddof=1), counts.sum()], np.float64)


def _other_sums(who: str, one: ListenerMeeting, kind: str, runs: Runs) -> Sums:
    """Return [events of a kind other than nods, minutes of listening]; "mm-hm" begins where listening ends."""
    begun = _pooled([frames_before(spans[:, 0], one.frames) for spans in runs])
    counts = [one.listening[begun].sum(), len(runs) * minutes_of(one.listening)]
    return {f"{who}{kind}s_per_minute": np.array(counts, np.float64)}


def people_sums(one: ListenerMeeting, within: Bools) -> Sums:
    """Return the sums of the person; the intervals also for the played part only."""
    sums = nod_sums("people_", one, [one.spans_s["nod"]])
    sums["played_intervals"] = nod_sums("", one, [one.spans_s["nod"]], within)["intervals"]
    for kind in ANNOTATED:
        sums |= _other_sums("people_", one, kind, [one.spans_s[kind]] if kind in one.spans_s else [])
    return sums


def decided_sums(one: ListenerMeeting, streams: Sequence[Sequence[ListenerEvent]], own_voice: bool = False) -> Sums:
    """Return the sums of a listener's decisions, one stream per seed.

    `own_voice`: The listener spoke when the person did. Shifting its nods by a minute would shift them against that
    voice too, so their contingency on the others is left out.
    """
    nods = [event_spans(decided, "nod") for decided in streams]
    sums = nod_sums("decided_", one, nods)
    if not own_voice:
        sums |= nod_contingency("decided_", nods, one, np.ones(one.frames, bool))
    for kind in (*ANNOTATED, "smile", "blink"):
        sums |= _other_sums("decided_", one, kind, [event_spans(decided, kind) for decided in streams])
    return sums


def motion_sums(
    one: ListenerMeeting,
    motions: Floats,
    detected: Sequence[Detected],
    first: int,
    calibration: DetectorCalibration,
    own_voice: bool = False,
) -> Sums:
    """Return the sums of events detected in motion (S, N', 58), made from the meeting's frames from `first` on.

    Nods are corrected by the detector's calibration: its lateness, and the share of nods that it misses. `own_voice`:
    see `decided_sums`.
    """
    runs, frames = motions.shape[:2]
    played = np.zeros(one.frames, bool)
    played[first : first + frames] = True
    found = {kind: [each.events[kind] for each in detected] for kind in MOTION_EVENTS}
    begin_s = first * FRAME_S - calibration.lag_s.get("nod", 0.0)
    nods = [begin_s + np.array([nod[:2] for nod in each], np.float64).reshape(-1, 2) for each in found["nod"]]
    sizes = [np.degrees(size) for each in found["nod"] for _, _, size in each]
    minutes = runs * frames * FRAME_S / 60
    return {
        **nod_sums("", one, nods, played, calibration.nods_per_seen_nod),
        **({} if own_voice else nod_contingency("", nods, one, played)),
        "nod_deg_sizes": np.histogram(sizes, _SIZES_DEG)[0].astype(np.float64),
        "blinks_per_minute": np.array([sum(map(len, found["blink"])), minutes]),
        "smiles_per_minute": np.array([sum(map(len, found["smile"])), minutes]),
        "gaze_shifts_per_minute": np.array(
            [sum(len(find_gaze_shifts(gaze_rad(motion))) for motion in motions), minutes]
        ),
    }


# --- ranking --------------------------------------------------------------------------------------------------------


def ranked(scores: Doubles, one: ListenerMeeting, kind: str = "nod", within: Bools | None = None) -> Doubles:
    """Return [AUC * K, K]: how scores (N,) rank the instants before K events above the other instants of `begins`.

    Zeros for fewer than three events, or a kind without annotation.
    """
    if kind not in one.spans_s:
        return np.zeros(2)
    onsets, others = one.begins(kind)
    if within is not None:
        onsets, others = onsets[within[onsets]], others & within
    others[onsets] = False
    if len(onsets) < _LEAST or not others.any():
        return np.zeros(2)
    return np.array([phrase_timing.rank_auc(scores, onsets, others) * len(onsets), len(onsets)], np.float64)


def contingent(
    who: str, name: str, matched: Doubles, shifted: Sequence[Doubles], one: ListenerMeeting, within: Bools | None = None
) -> Sums:
    """Return how scores (N,) rank the nods, the mean ranking by scores of other minutes, and the difference."""
    own = ranked(matched, one, "nod", within)
    other = np.zeros(2)
    if shifted:
        other = np.mean([ranked(scores, one, "nod", within) for scores in shifted], axis=0)
    difference = np.array([own[0] - other[0], own[1]]) if other[1] else np.zeros(2)
    return {f"{who}{name}": own, f"{who}shifted_{name}": other, f"{who}{name}_matched_minus_shifted": difference}


def hazard_sums(who: str, one: ListenerMeeting, speaking: Doubles, silent: Doubles, other: Doubles) -> Sums:
    """Return how hazards (N,) rank the nods: with own speech, without it, without it and with the others shifted."""
    ranks = contingent(who, "nod_hazard_auc", silent, [other], one)
    return {
        f"{who}nod_hazard_auc_without_own_speech": ranks[f"{who}nod_hazard_auc"],
        **ranks,
        f"{who}nod_hazard_auc": ranked(speaking, one),
    }


def differences(sums: Sums) -> Sums:
    """Return how much better each source of evidence ranks the same nods than the source it is compared with.

    Hazards from annotations are compared with the reference; hazards with less evidence are compared with the former.
    """
    return {
        f"{who}{name}_minus_{other}": sums[who + name] - sums[f"{other}_{name}"] * [1, 0]
        for who, other in (("annotated_", "r2"), ("one_voice_", "annotated"), ("", "annotated"))
        for name in ("nod_hazard_auc", "nod_hazard_auc_without_own_speech")
        if {who + name, f"{other}_{name}"} <= sums.keys()
    }


def nod_contingency(who: str, runs: Runs, one: ListenerMeeting, within: Bools) -> Sums:
    """Return `contingent` for the nods of a listener with its own history.

    The score is the share of runs with a nod within 0.5 s. A run has its own history, so its response to another minute
    is its behaviour at that time. Its nods are therefore shifted, by every whole minute of the played part.
    """
    played = np.flatnonzero(within)
    share = np.mean([phrase_timing.near(nods, one.frames, _WITHIN_S) for nods in runs], axis=0)
    step = round(SHIFT_S * FRAME_HZ)
    moved = []
    for shift in range(step, len(played) - step + 1, step):
        other = share.copy()
        other[played] = np.roll(share[played], shift)
        moved.append(other)
    return contingent(who, "nod_auc", share, moved, one, within)


# --- the nod table --------------------------------------------------------------------------------------------------


def cells(times_s: Doubles) -> Ints:
    """Return the cell (N,), 0 to CELLS - 1, of speech phases (N, 3) (`signals.phase.times`): silence first."""
    speech, silence, last = times_s.T
    row = np.where(speech > 0, len(_SILENCE_S) + 1 + np.digitize(speech, _SPEECH_S), np.digitize(silence, _SILENCE_S))
    return np.asarray(row * (len(_LAST_S) + 1) + np.digitize(last, _LAST_S), np.int64)


def table_rates(people: Sequence[MeetingPerson]) -> Doubles:
    """Return nods per minute (CELLS,) over the annotated time of all people, with five nods at the mean rate added."""
    nods, minutes = np.zeros((2, CELLS))
    for person in people:
        whole = Stretch(person=person, start_s=0.0, end_s=person.until_s)
        others, listening = active(person.others, whole), listening_in(person, whole)
        cell, onsets = cells(phase.times(others)), frames_before(person.nods[:, 0], len(others))
        nods += np.bincount(cell[onsets[listening[onsets]]], minlength=CELLS)
        minutes += np.bincount(cell[listening], minlength=CELLS) / FRAME_HZ / 60
    if not nods.any():
        return np.zeros(CELLS)
    return np.asarray((nods + _PRIOR_NODS) / (minutes + _PRIOR_NODS * minutes.sum() / nods.sum()))


# --- people and figures ---------------------------------------------------------------------------------------------


def per_person(meetings: Iterable[tuple[str, Sums]]) -> list[Sums]:
    """Return the sums of each participant from (participant, sums of a meeting).

    An AUC becomes the mean over the person's events, with weight 1.
    """
    by_name: dict[str, list[Sums]] = {}
    for participant, sums in meetings:
        by_name.setdefault(participant, []).append(sums)

    def once(numbers: Doubles) -> Doubles:
        return np.array([numbers[0] / numbers[1], 1.0]) if numbers[1] else np.zeros(2)

    return [
        {name: once(numbers) if "_auc" in name else numbers for name, numbers in added(parts).items()}
        for _, parts in sorted(by_name.items())
    ]


def figures_of(sums: Sums) -> dict[str, Figure]:
    """Return every figure that these sums define."""
    pairs = [name for name in sums if not name.endswith(("intervals", "sizes"))]
    figures: dict[str, Figure] = {name: quotient(name) for name in pairs}
    for who in ("", "decided_", "people_"):
        if f"{who}nods_later" in sums:
            figures[f"{who}phrase_end_ratio"] = ratio(f"{who}nods_after_phrase", f"{who}nods_later")
            figures[f"{who}addressed_over_bystander"] = ratio(
                f"{who}addressed_nods_per_minute", f"{who}bystander_nods_per_minute"
            )
    if "intervals" in sums:
        figures["interval_ks"] = distance("intervals", "played_intervals")
        figures["nod_deg"] = median("nod_deg_sizes", (_SIZES_DEG[1:] + _SIZES_DEG[:-1]) / 2)
    if "decided_intervals" in sums:
        figures["decided_interval_ks"] = distance("decided_intervals", "people_intervals")
    gained = "nod_hazard_auc_matched_minus_shifted"
    for who in ("", "annotated_"):
        if {f"{who}{gained}", f"r2_{gained}"} <= sums.keys():
            figures[f"{who}{gained}_of_r2"] = ratio(f"{who}{gained}", f"r2_{gained}")
    return figures
