"""When a listener nods, against when people did: meetings are heard by it, its nods laid beside the annotated ones.

Three things are told apart: what people did (`people_`), what a listener decides (`decided_`), and what is to be seen
in its motion (no prefix). All are counted alike: onsets a minute of time of a kind (`times_of`), intervals in listening
time, and how well a score ranks the instants at which he began above the other instants at which he might have
(`ranked`). Every count is a sum over one meeting, to be added up to people (`per_person`) and made into figures.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from sfms_robot.frames import FRAME_HZ, FRAME_S, Doubles, Floats, ListenerEvent
from sfms_robot.lab.corpora.compose.ami import Person
from sfms_robot.lab.corpora.compose.composed import Stretch, active
from sfms_robot.lab.evaluation import phrase_timing
from sfms_robot.lab.evaluation.bootstrap import Figure, Sums, added, distance, median, quotient, ratio
from sfms_robot.lab.evaluation.deciding import spans_of
from sfms_robot.lab.evaluation.detection import Calibration, gaze_shifts, seen
from sfms_robot.lab.evaluation.listener_meetings import SHIFT_S, Ints, ListenerMeeting, frames_before
from sfms_robot.lab.evaluation.nod_table import Counts, cells
from sfms_robot.signals import phase
from sfms_robot.signals.events import MOTION_EVENTS, Bools

WITHIN_S: Final = 0.5  # a nod this close counts for an instant
LEAST: Final = 3  # events of a person in a meeting, to be ranked
INTERVALS_S: Final = np.geomspace(0.2, 1200, 400)  # edges of the histogram of intervals
SIZES_DEG: Final = np.arange(0, 40.1, 0.1)  # edges of the histogram of nods by size
LONG_SILENCE_S: Final = 2.0
STRETCH_S: Final = 48.0  # of listening, whose nods are counted for their variance over mean
WHO: Final = ("", "decided_", "people_")
ANNOTATED: Final = ("mm_hm", "laugh", "gaze_shift")  # beside nods
AUC: Final = "_auc"  # in the names of figures that are means over people

Runs = Sequence[Doubles]  # spans (K, 2) [s] of what was done, once for each seed


# --- how often --------------------------------------------------------------------------------------------------


def times_of(one: ListenerMeeting) -> dict[str, Bools]:
    """Masks (N,) of the times that nods are counted in; `after_phrase` and `later` make the phrase-end ratio."""
    frames, listening = one.frames, one.listening
    ends = phrase_timing.phrase_ends(one.others, FRAME_HZ)
    silence_s = phase.times(one.others.tolist())[:, 1]
    return {
        "nods_per_minute": listening,
        "addressed_nods_per_minute": one.addressed,
        "bystander_nods_per_minute": one.bystander,
        "nods_after_phrase": phrase_timing.window_after(ends, phrase_timing.AFTER_S, frames, FRAME_HZ) & listening,
        "nods_later": phrase_timing.window_after(ends, phrase_timing.LATER_S, frames, FRAME_HZ) & listening,
        "nods_long_silence": (silence_s > LONG_SILENCE_S) & ~one.own & ~one.unseen,
    }


def nod_sums(who: str, one: ListenerMeeting, runs: Runs, within: Bools | None = None, per_seen: float = 1.0) -> Sums:
    """Nods and minutes of every kind of time, and the histogram of intervals, in the part of it that is played.

    `per_seen`: how many nods there are for each that is told (`detection.Calibration`).
    """
    played = np.ones(one.frames, bool) if within is None else within
    onsets = [np.round(nods[:, 0] * FRAME_HZ).astype(np.int64).clip(0, one.frames - 1) for nods in runs]
    every = np.concatenate([np.zeros(0, np.int64), *onsets])
    sums = {}
    for name, mask in times_of(one).items():
        counted = mask & played
        sums[who + name] = np.array([per_seen * counted[every].sum(), len(runs) * _minutes(counted)])
    sums[who + "nods_variance_over_mean"] = np.sum(
        [np.zeros(2), *(scatter(begun, one.listening & played) for begun in onsets)], axis=0
    )
    found = [intervals_s(begun, one.listening & played) for begun in onsets]
    sums[who + "intervals"] = histogram(np.concatenate([np.zeros(0), *found]))
    return sums


def intervals_s(onsets: Ints, listening: Bools) -> Doubles:
    """From onset to onset (frames), as much of it as was listened in; onsets outside of it do not count."""
    clock_s = np.cumsum(listening) / FRAME_HZ
    return np.diff(clock_s[np.sort(onsets[listening[onsets]])])


def scatter(onsets: Ints, listening: Bools) -> Doubles:
    """[stretches times variance, sum] of the counts in stretches of 48 s of listening; nothing of fewer than two.

    Nods that call forth nods come in bouts, and leave whole stretches without: more than 1, which is Poisson's.
    """
    frames = round(STRETCH_S * FRAME_HZ)
    stretch = (np.cumsum(listening) - 1) // frames
    whole = int(listening.sum()) // frames
    if whole < 2:
        return np.zeros(2)
    counts = np.bincount(stretch[onsets[listening[onsets]]], minlength=whole)[:whole]
    return np.array([whole * counts.var(ddof=1), counts.sum()], np.float64)


def histogram(values: Doubles) -> Doubles:
    """Counts between the edges `INTERVALS_S`, and beyond both ends."""
    return np.bincount(np.digitize(values, INTERVALS_S), minlength=len(INTERVALS_S) + 1).astype(np.float64)


def other_sums(who: str, one: ListenerMeeting, kind: str, runs: Runs) -> Sums:
    """Events of another kind than nods, a minute of listening; an own voice begins where listening ends."""
    begun = np.concatenate([np.zeros(0, np.int64), *(frames_before(spans[:, 0], one.frames) for spans in runs)])
    listening = one.listening
    return {f"{who}{kind}s_per_minute": np.array([listening[begun].sum(), len(runs) * _minutes(listening)], np.float64)}


def people_sums(one: ListenerMeeting, within: Bools) -> Sums:
    """What he did himself; his intervals also of the part that is played alone."""
    sums = nod_sums("people_", one, [one.spans_s["nod"]])
    sums["played_intervals"] = nod_sums("", one, [one.spans_s["nod"]], within)["intervals"]
    for kind in ANNOTATED:
        known = [one.spans_s[kind]] if kind in one.spans_s else []
        sums |= other_sums("people_", one, kind, known)
    return sums


def decided_sums(one: ListenerMeeting, streams: Sequence[Sequence[ListenerEvent]], own_voice: bool = False) -> Sums:
    """What a listener decided, left to itself, once for each seed. `own_voice`: it spoke when he did, and a minute of
    its nods moved would be moved against that too, so how they hang on the others is not told.
    """
    nods = [spans_of(decided, "nod") for decided in streams]
    sums = nod_sums("decided_", one, nods)
    if not own_voice:
        sums |= nod_contingency("decided_", nods, one, np.ones(one.frames, bool))
    for kind in (*ANNOTATED, "smile", "blink"):
        sums |= other_sums("decided_", one, kind, [spans_of(decided, kind) for decided in streams])
    return sums


def motion_sums(
    one: ListenerMeeting, motions: Floats, first: int, calibration: Calibration, own_voice: bool = False
) -> Sums:
    """What is to be seen in motion (S, N', 58) that was made of the meeting's frames from `first` on.

    `own_voice`: see `decided_sums`.

    Nods are set right by what their finder makes of known ones: it is late or early by so much, and misses so many.
    """
    runs, frames = motions.shape[:2]
    played = np.zeros(one.frames, bool)
    played[first : first + frames] = True
    found = {kind: [seen(motion, kind) for motion in motions] for kind in MOTION_EVENTS}
    begin_s = first * FRAME_S - calibration.lag_s.get("nod", 0.0)
    nods = [begin_s + np.array([nod[:2] for nod in each], np.float64).reshape(-1, 2) for each in found["nod"]]
    sizes = [np.degrees(size) for each in found["nod"] for _, _, size in each]
    minutes = runs * frames * FRAME_S / 60
    return {
        **nod_sums("", one, nods, played, calibration.nods_per_seen_nod),
        **({} if own_voice else nod_contingency("", nods, one, played)),
        "nod_deg_sizes": np.histogram(sizes, SIZES_DEG)[0].astype(np.float64),
        "blinks_per_minute": np.array([sum(map(len, found["blink"])), minutes]),
        "smiles_per_minute": np.array([sum(map(len, found["smile"])), minutes]),
        "gaze_shifts_per_minute": np.array([sum(len(gaze_shifts(motion)) for motion in motions), minutes]),
    }


def _minutes(mask: Bools) -> float:
    return float(mask.sum()) / FRAME_HZ / 60


# --- ranking ----------------------------------------------------------------------------------------------------


def ranked(scores: Doubles, one: ListenerMeeting, kind: str = "nod", within: Bools | None = None) -> Doubles:
    """[AUC * K, K]: how scores (N,) rank the instants before his K events above the others at which he might begin.

    See `ListenerMeeting.begins`. Nothing of fewer than three events, or of a kind that was not annotated.
    """
    if kind not in one.spans_s:
        return np.zeros(2)
    onsets, others = one.begins(kind)
    if within is not None:
        onsets, others = onsets[within[onsets]], others & within
    others[onsets] = False
    if len(onsets) < LEAST or not others.any():
        return np.zeros(2)
    return np.array([phrase_timing.rank_auc(scores, onsets, others) * len(onsets), len(onsets)], np.float64)


def contingent(
    who: str, name: str, matched: Doubles, shifted: Sequence[Doubles], one: ListenerMeeting, within: Bools | None = None
) -> Sums:
    """How scores (N,) rank his nods; likewise those that belong to other minutes, in the mean; and by how much less."""
    own = ranked(matched, one, "nod", within)
    other = np.zeros(2)
    if shifted:
        other = np.mean([ranked(scores, one, "nod", within) for scores in shifted], axis=0)
    difference = np.array([own[0] - other[0], own[1]]) if other[1] else np.zeros(2)
    return {f"{who}{name}": own, f"{who}shifted_{name}": other, f"{who}{name}_matched_minus_shifted": difference}


def hazard_sums(who: str, one: ListenerMeeting, speaking: Doubles, silent: Doubles, other: Doubles) -> Sums:
    """How hazards (N,) rank his nods: given his own speech, without it, and without it while the others are shifted."""
    ranks = contingent(who, "nod_hazard_auc", silent, [other], one)
    return {
        f"{who}nod_hazard_auc_without_own_speech": ranks[f"{who}nod_hazard_auc"],
        **ranks,
        f"{who}nod_hazard_auc": ranked(speaking, one),
    }


def nod_share(runs: Runs, frames: int) -> Doubles:
    """(frames,) share of the runs with a nod within 0.5 s: the nod probability of every instant."""
    return np.asarray(
        np.mean([phrase_timing.near(nods, frames, FRAME_HZ, WITHIN_S) for nods in runs], axis=0), np.float64
    )


def nod_contingency(who: str, runs: Runs, one: ListenerMeeting, within: Bools) -> Sums:
    """`contingent` of nods that a listener made itself.

    Its history is its own, so what it did while it heard another minute is what it did then: its nods are moved, by
    every whole minute that the part played allows.
    """
    played = np.flatnonzero(within)
    share = nod_share(runs, one.frames)
    step = round(SHIFT_S * FRAME_HZ)
    moved = []
    for shift in range(step, len(played) - step + 1, step):
        other = share.copy()
        other[played] = np.roll(share[played], shift)
        moved.append(other)
    return contingent(who, "nod_auc", share, moved, one, within)


def table_rates(people: Sequence[Person]) -> Doubles:
    """Nods a minute by cell of the nod table, over everybody's whole annotated time."""
    parts = []
    for person in people:
        whole = Stretch(person, 0.0, person.until_s)
        others, own, unseen = (active(spans, whole) for spans in (person.others, person.talk, person.unseen))
        listening = phrase_timing.listening_mask(others, FRAME_HZ, own) & ~unseen
        onsets = frames_before(person.nods[:, 0], len(others))
        parts.append(Counts.of(cells(phase.times(others.tolist())), onsets, listening))
    return Counts.total(parts).rates()


def table_sums(one: ListenerMeeting, rates: Doubles) -> Sums:
    """How the nod table with these rates (`table_rates`) ranks his nods."""
    return {"table_nod_auc": ranked(rates[cells(phase.times(one.others.tolist()))], one)}


# --- people and figures -----------------------------------------------------------------------------------------


def per_person(meetings: Iterable[tuple[str, Sums]]) -> list[Sums]:
    """Sums of (participant, sums of a meeting) -> one of each participant; of an AUC the mean over his events, once."""
    by_name: dict[str, list[Sums]] = {}
    for participant, sums in meetings:
        by_name.setdefault(participant, []).append(sums)
    return [
        {name: _once(numbers) if AUC in name else numbers for name, numbers in added(parts).items()}
        for _, parts in sorted(by_name.items())
    ]


def _once(numbers: Doubles) -> Doubles:
    return np.array([numbers[0] / numbers[1], 1.0]) if numbers[1] else np.zeros(2)


def figures_of(sums: Sums) -> dict[str, Figure]:
    """Every figure that these sums can be made into."""
    pairs = [name for name in sums if not name.endswith(("intervals", "sizes"))]
    figures: dict[str, Figure] = {name: quotient(name) for name in pairs}
    for who in WHO:
        if f"{who}nods_later" in sums:
            figures[f"{who}phrase_end_ratio"] = ratio(f"{who}nods_after_phrase", f"{who}nods_later")
            figures[f"{who}addressed_over_bystander"] = ratio(
                f"{who}addressed_nods_per_minute", f"{who}bystander_nods_per_minute"
            )
    if "intervals" in sums:
        figures["interval_ks"] = distance("intervals", "played_intervals")
        figures["nod_deg"] = median("nod_deg_sizes", (SIZES_DEG[1:] + SIZES_DEG[:-1]) / 2)
    if "decided_intervals" in sums:
        figures["decided_interval_ks"] = distance("decided_intervals", "people_intervals")
    gained = "nod_hazard_auc_matched_minus_shifted"
    for who in ("", "annotated_"):
        if {f"{who}{gained}", f"r2_{gained}"} <= sums.keys():
            figures[f"{who}{gained}_of_r2"] = ratio(f"{who}{gained}", f"r2_{gained}")
    return figures
