"""Functions behind `train events`: fit hazards and shapes on meetings, write one readable file, evaluate it on others.

It is fitted on the people of training; ranked and rolled out on those of validation. People of test are not used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import yaml
from scipy.optimize import brentq
from scipy.special import expit, ndtri
from scipy.stats import ks_2samp

from sfms_robot.app.progress import tracked
from sfms_robot.config import Calmness
from sfms_robot.errors import ConfigError
from sfms_robot.frames import EVENT_KINDS, FRAME_HZ, FRAME_S, Doubles, Floats
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.compose.ami import MeetingPerson, read_people, split_series
from sfms_robot.lab.corpora.compose.motions import held, pick
from sfms_robot.lab.evaluation.intervals import added, mean_interval, rounded
from sfms_robot.lab.evaluation.meetings import tables
from sfms_robot.lab.evaluation.robustness import motions_of
from sfms_robot.lab.evaluation.whole_recordings import decisions, event_spans, heard_in
from sfms_robot.lab.learning.events import event_trainer
from sfms_robot.lab.learning.events.event_trainer import (
    GROUPS,
    LEARNED,
    PHASE,
    RIDGE,
    STUDY,
    STUDY_RIDGE,
    EventStudent,
    Groups,
    hazard,
    inputs,
)
from sfms_robot.listeners.events.evidence import AT, EVIDENCE
from sfms_robot.listeners.events.model import STEP_S, EventModel, EventTables, Hazard, HazardBank, Shape
from sfms_robot.signals import event_sizes as sizes
from sfms_robot.signals.motion_primitives import Motions

Students = Sequence[EventStudent]

# Some of people's nods begin in the 0.2 s after a phrase in which a head cannot know yet that it is over: the fit has
# them within phrases, and a head's nods begin 0.12 s after they are decided. So fewer of a head's nods than of people's
# would follow a phrase. As a correction a head nods less in a phrase (`LESS`), and more at these knots of silence, when
# the end is known (`MORE`). Both were chosen on validation, by the phrase-end ratio of nods decided by a silent head.
END_KNOWN: Final = [len(PHASE["phrase_s"]) + PHASE["silence_s"].index(knot_s) for knot_s in (0.24, 0.4)]
LESS, MORE = 0.1, 0.15  # log-odds
KNOBS: Final = (1.0, 2.2, 4.0)  # nods a minute in the roll-outs
# AUC of the same kinds in a study of all 36 meetings by six-fold cross-validation, for comparison.
STUDY_AUC: Final[Mapping[str, float]] = {"nod": 0.674, "mm_hm": 0.747, "laugh": 0.822}
FROM: Final[Mapping[str, str]] = {
    "nod": "concord signals (form nod, or left blank), AMI",
    "shake": "discord and negative signals of form shake, AMI",
    "tilt": "other communicative head gestures, AMI",
    "laugh": "laughs, AMI",
    "smile": "derived: nobody annotated smiles; drawn after others' laughs, own mm-hm and nods, AMI",
    "mm_hm": "isolated words under 0.6 s, AMI",
    "brow_raise": "derived: nobody annotated brows; drawn after questions and with nods, AMI",
    "gaze_shift": "gaze shifts away from a speaker, AMI",
}
_HEADER: Final = """When a listener nods, shakes, tilts, laughs, smiles, says "mm-hm", raises brows, blinks, looks away;
how long and how large. Read by `sfms_robot.listeners.events.model`, which says what the numbers mean.
Learned from: The AMI Meeting Corpus, AMI project consortium (Carletta et al. 2005), manual annotations 1.7, CC BY 4.0,
http://groups.inf.ed.ac.uk/ami/corpus/; annotations taken from github Hasetomo2142/ami-corpus-preprocessing, commit
6d845bc07b21c8862afbf38f1b1f9ab3bf40c437; the people of the training split. Looks aside: Dembinsky, Watanabe, Dengel,
Ishimaru (ETRA 2024), github psyberlab/eye-gaze-during-conversation-dataset, commit
e15614560ba7b0c1121e3d82c8a6e29c57cff5bd, Apache-2.0. Blinks, brows and sizes: motions.npz (SOURCE.md). Made by
  sfms-robot train events --data DIR --out FILE"""


def train_events(data: Path, out: Path | None, all_series: bool, seed: int) -> Figures:
    """Fit all hazards, write `out` (if given) and return the figures.

    Raises ConfigError, also for tables without a kind of event that is to be learned, such as gaze or laughs. Without
    people of validation nothing is ranked.

    `all_series`: train on all people, validation and test included, without ranking: only for comparison with a study
    that used the same meetings, by its recipe (89 inputs of nods, ridge 10), never for use.
    """
    if out is not None and not out.parent.is_dir():
        raise ConfigError(f"--out {out}: {out.parent} expected a folder")
    people = read_people(tables(data))
    split = split_series(people)
    parts = {"train": people if all_series else split["train"], "validation": [] if all_series else split["validation"]}

    def student(person: MeetingPerson) -> EventStudent:
        return event_trainer.student(person, np.random.default_rng([seed, *person.meeting.encode(), ord(person.agent)]))

    taught, judged = ([student(person) for person in tracked(some, name)] for name, some in parts.items())
    for kind in LEARNED:
        if not any(len(one.lessons[kind].onsets) for one in taught if kind in one.lessons):
            raise ConfigError(f"{data}: in {len(taught)} people to learn from there is no {kind}: {FROM[kind]}")
    groups, ridge = ({**GROUPS, "nod": STUDY}, STUDY_RIDGE) if all_series else (GROUPS, RIDGE)
    hazards = {}
    judged_silent = [event_trainer.muted(one) for one in judged]
    # Every person with and without the own voice.
    examples = taught if all_series else [*taught, *(event_trainer.muted(one) for one in taught)]
    for kind in tracked(LEARNED, "kinds of events"):
        learned = event_trainer.teach(examples, kind, groups[kind], seed, ridge)
        if kind == "nod" and not all_series:
            learned.weights[: len(PHASE["phrase_s"])] -= LESS  # the first inputs are of phrase_s, the next of silence_s
            learned.weights[END_KNOWN] += MORE
        lessons = [one.lessons[kind] for one in taught if kind in one.lessons]
        per_minute = sum(len(one.onsets) for one in lessons) / sum(event_trainer.minutes(one.may) for one in lessons)
        hazards[kind] = hazard(learned, groups[kind], FROM[kind], per_minute)
    motions = motions_of("train")
    hazards["gaze_shift"] = look_away_hazard(hazards["gaze_shift"], taught)
    hazards["blink"] = blink_hazard(motions.gaps)
    found = EventTables(hazards={kind: hazards[kind] for kind in EVENT_KINDS}, shapes=shapes(taught, motions))
    if out is not None:
        save(out, found)
    figures: Figures = {
        "out": None if out is None else str(out),
        "people": {name: len({person.participant for person in parts[name]}) for name in ("train", "validation")},
        "listening_minutes": round(sum(float(one.listening.sum()) for one in taught) / 25 / 60, 1),
        "kinds": {kind: _judged(found.hazards[kind], kind, taught, judged, judged_silent) for kind in LEARNED},
        "nod": found.hazards["nod"].model_dump(mode="json"),
    }
    if judged:
        figures["rollout"] = _rolled_out(EventModel(found), judged, seed)
    figures["rows"] = _rows(figures)
    return figures


def save(file: Path, found: EventTables) -> None:
    """Write the tables as YAML, below a header with their sources. Raises ConfigError when that fails."""
    plain = found.model_dump(mode="python", exclude_defaults=True)
    for shape in plain["shapes"].values():
        for name, values in shape.items():
            shape[name] = list(values)
    text = yaml.safe_dump(plain, sort_keys=False, width=118, default_flow_style=None)
    head = "".join(f"# {line}\n" for line in _HEADER.splitlines())
    try:
        file.write_text(head + text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{file}: cannot be written: {error.strerror}") from error


def _judged(
    given: Hazard,
    kind: str,
    taught: Students,
    judged: Students,
    silent: Students,
) -> Figures:
    """Return counts of a hazard's training data, and its ranking of the onsets of other people: mean and interval.

    `silent`: those people without their own voice in the evidence, like a head that never speaks.
    """
    lessons = [one.lessons[kind] for one in taught if kind in one.lessons]
    found: Figures = {
        "onsets": sum(len(one.onsets) for one in lessons),
        "steps": sum(int(one.may.sum()) for one in lessons),
        "per_minute": given.per_minute,
    }
    if not judged:
        return found

    def ranked(people: Students, *left_out: str) -> Doubles:
        def score(evidence: Doubles) -> Doubles:
            rows = evidence.copy()
            rows[:, [AT[name] for name in left_out]] = np.nan
            return _log_odds(given, rows)

        return event_trainer.ranked(people, kind, score)

    auc = ranked(judged)
    found |= {
        "auc": _mean(auc),
        "interval": mean_interval(auc) if len(auc) > 1 else [None, None],
        "people": len(auc),
        "study_auc": STUDY_AUC.get(kind),
        "auc_without_own_voice": _mean(ranked(silent)),
        "expected_per_minute": _expected(given, kind, judged),
        "expected_per_minute_without_own_voice": _expected(given, kind, silent),
    }
    if kind == "nod":
        found["auc_without_own_nods"] = _mean(ranked(judged, "nod_end_s", "root_nods_30s", "log_rate"))
    return found


def _expected(given: Hazard, kind: str, people: Students) -> float | None:
    """Return the expected events a minute of a hazard, in the time of these people in which they may happen."""
    rows = [one.evidence[one.lessons[kind].may] for one in people if kind in one.lessons]
    return rounded(float(expit(_log_odds(given, np.concatenate(rows))).mean()) * 60 / STEP_S)


def _mean(auc: Doubles) -> float | None:
    return rounded(float(auc.mean())) if len(auc) else None


def _log_odds(given: Hazard, rows: Doubles) -> Doubles:
    """Return the log-odds (M,) of a hazard for evidence (M, E), in parts that fit a cache."""
    bank, parts = HazardBank({"": given}), np.array_split(rows, max(1, len(rows) // 4096))
    return np.concatenate([bank.log_odds(bank.contributions(part))[:, 0] for part in parts])


def _rolled_out(model: EventModel, judged: Students, seed: int) -> Figures:
    """Return figures of the people's nods, and of nods alone decided in their place at each rate of `KNOBS`."""

    def counted(onsets_s: Iterable[Doubles]) -> tuple[dict[str, float], Doubles]:
        counts = [event_trainer.count(one, at) for one, at in zip(judged, onsets_s, strict=True)]
        total = added(sums for sums, _ in counts)
        return event_trainer.figures(total), np.concatenate([intervals_s for _, intervals_s in counts])

    figures, theirs_s = counted(event_trainer.begun_in(one.person.nods, one.listening)[:, 0] for one in judged)
    found = {"people": figures}
    heard = [heard_in(one.scene) for one in judged]
    for knob in tracked(KNOBS, "nods decided at each rate"):
        asked = Calmness.model_validate(dict.fromkeys(EVENT_KINDS, 0.0) | {"nod": knob})
        decided = (decisions(model, rows, [at + 1000 * seed], asked)[0] for at, rows in enumerate(heard))
        figures, ours_s = counted(event_spans(each, "nod")[:, 0] for each in decided)
        found[f"{knob:g}"] = {**figures, "interval_ks": float(ks_2samp(ours_s, theirs_s).statistic)}
    return {key: {name: rounded(value) for name, value in figures.items()} for key, figures in found.items()}


def _rows(figures: Figures) -> list[Figures]:
    return [
        {
            "kind": kind.replace("_", " "),
            "onsets": found["onsets"],
            "a minute": found["per_minute"],
            "AUC on validation": found.get("auc")
            and ("{:.3f} [{:.3f}, {:.3f}]" if found["people"] > 1 else "{:.3f}").format(
                found["auc"], *found["interval"]
            ),
            "without own voice": found.get("auc_without_own_voice"),
            "expected a minute": found.get("expected_per_minute"),
            "silent head": found.get("expected_per_minute_without_own_voice"),
            "study": found.get("study_auc"),
        }
        for kind, found in figures["kinds"].items()
    ]


# --- Shapes: durations as people had them, the rest as in composed dyads --------------------
#
# A smile lasts as long as in composed dyads: from onset to offset of the recorded curve, held while it is seen.

STEPS: Final = 20  # intervals between quantiles
LONGEST_S: Final = 6.0  # of an annotated event
DRAWN: Final = 400  # number of smiles drawn
_SHARES: Final = np.linspace(0, 1, STEPS + 1)
_INNER: Final = np.clip(_SHARES, 0.01, 0.99)  # the tails are infinite


def shapes(students: Students, motions: Motions) -> dict[str, Shape]:
    """Return the shape of every kind, with durations from these people."""

    def lasts(spans: str, least_s: float = 0.0, longer_s: float = 0.0) -> tuple[float, ...]:
        return _quantiles(_lengths(getattr(one.person, spans) for one in students).clip(least_s, LONGEST_S) + longer_s)

    least, usual, most = sizes.NOD_DEG
    nod_deg = np.clip(usual * np.exp(sizes.NOD_SPREAD * ndtri(_INNER)), least, most)
    nod_deg[[0, -1]] = least, most
    habit = _thousandths(np.clip(1 + sizes.HABIT_SPREAD * ndtri(_INNER), 0.4, 1.6))
    laughs_s = _lengths(one.person.laughs for one in students).clip(0, LONGEST_S)
    rng = np.random.default_rng(0)
    laughs_s += rng.uniform(*sizes.LAUGH_LONGER_S, len(laughs_s))
    laugh, smile = (
        Shape(
            duration_s=_quantiles(
                _recorded([held(pick(motions.smiles, rng), int(seen * FRAME_HZ)) for seen in seen_s])
            ),
            size=size,
        )
        for seen_s, size in ((laughs_s, sizes.LAUGH), ((sizes.smile_s(rng) for _ in range(DRAWN)), sizes.SMILE))
    )
    slight, whole = sizes.BLINK
    return {
        "nod": Shape(duration_s=lasts("nods", 0.2), size=_thousandths(nod_deg), habit=habit, swings_hz=sizes.SWINGS_HZ),
        "shake": Shape(
            duration_s=lasts("shakes", 0.2),
            size=_thousandths(sizes.SHAKE * nod_deg),
            habit=habit,
            swings_hz=sizes.SWINGS_HZ,
        ),
        "tilt": Shape(duration_s=lasts("tilts", longer_s=12 * FRAME_S), size=sizes.TILT_DEG),
        "laugh": laugh,
        "smile": smile,
        "mm_hm": Shape(duration_s=lasts("mm_hms"), size=sizes.MM_HM),
        "brow_raise": Shape(
            duration_s=_quantiles(np.outer(_recorded(motions.brows), (*sizes.BROW_STRETCH, 1.0)).ravel()),
            size=sizes.BROW_RAISE,
        ),
        "blink": Shape(
            duration_s=_quantiles(_recorded(motions.blinks)),
            size=_thousandths(np.interp(_SHARES, (0, *[sizes.SLIGHT_BLINKS] * 2, 1), (*slight, *whole))),
        ),
        "gaze_shift": Shape(
            duration_s=_thousandths(np.array([sizes.aside_s(share) for share in _INNER])),
            size=_thousandths(np.interp(_SHARES, *sizes.ASIDE_DEG)),
        ),
    }


def _lengths(spans: Iterable[Doubles]) -> Doubles:
    every = np.concatenate(list(spans))
    return np.asarray(every[:, 1] - every[:, 0])


def _recorded(curves: Sequence[np.typing.NDArray[np.float32]]) -> Doubles:
    return np.array([len(curve) for curve in curves]) * FRAME_S


def _quantiles(values: Doubles) -> tuple[float, ...]:
    return _thousandths(np.quantile(values, _SHARES))


def _thousandths(values: Doubles) -> tuple[float, ...]:
    return tuple(round(float(value), 3) for value in values)


# --- Hazards that the meetings alone cannot teach: blinks, which were not annotated, and looks away without a table
#
# Blinks come at recorded intervals, more often at the cues that composed dyads use. The effect of speech on looking
# away is learned in the meetings, where slides and papers draw eyes for minutes. Rate and duration are those of 14
# people who listened to one another with no table between them (`signals.event_sizes`), and of these people speaking.

AT_PERSON_S: Final = 16.3  # mean seconds near the other's face, listening
AT_PERSON_SPEAKING_S: Final = 1.47
BLINKS: Final[Groups] = {"blink_s": (0.0, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8)}
BLINK_CUES: Final = {"silence_s": {0.0: 0.0, 0.12: 1.0, 0.4: 0.6, 0.8: 0.0}, "shift_s": {0.0: 1.5, 0.3: 1.0, 0.6: 0.0}}


def blink_hazard(gaps: Sequence[Floats]) -> Hazard:
    """Fit the hazard of blinks on recorded seconds between them."""
    every = np.concatenate([np.asarray(gap, np.float64) for gap in gaps])
    since = [np.arange(1, max(2, round(gap / STEP_S) + 1)) * STEP_S for gap in every.tolist()]
    rows = np.full((sum(map(len, since)), len(EVIDENCE)), np.nan)
    rows[:, AT["blink_s"]] = np.concatenate(since)
    happens = np.concatenate([np.r_[np.zeros(len(steps) - 1), 1.0] for steps in since])
    learned = event_trainer.fit(inputs(rows, BLINKS), happens, np.ones(len(happens)), ridge=1.0)
    told = "recorded intervals; cues as in composed dyads"
    found = hazard(learned, BLINKS, told, 60.0 / float(every.mean()))
    return found.model_copy(update={"weights": {**found.weights, **BLINK_CUES}})


def look_away_hazard(found: Hazard, students: Iterable[EventStudent]) -> Hazard:
    """Return the hazard `found` in the meetings, scaled to the rate at which people look away without a table."""
    weights = {name: weight for name, weight in found.weights.items() if name not in ("at_person_s", "own_voice_s")}
    more = round(float(np.log(AT_PERSON_S / AT_PERSON_SPEAKING_S)), 3)
    weights["own_voice_s"] = {0.0: more, 0.5: round(more / 2, 3), 1.0: 0.0}
    told = "gaze shifts away from a speaker, AMI; how often: 14 people listening, ETRA 2024"
    away = found.model_copy(update={"weights": weights, "learned_from": told})
    return at_rate(away, "gaze_shift", students, 60.0 / AT_PERSON_S)


def at_rate(given: Hazard, kind: str, students: Iterable[EventStudent], per_minute: float) -> Hazard:
    """Return the hazard with the intercept for `per_minute` in possible steps more than 1 s after the own voice."""
    rows = np.concatenate(
        [one.evidence[one.lessons[kind].may & (one.evidence[:, AT["own_voice_s"]] > 1.0)] for one in students
         if kind in one.lessons]
    )  # fmt: skip
    odds = _log_odds(given, rows)
    more = brentq(lambda by: expit(odds + by).mean() * 60 / STEP_S - per_minute, -20.0, 20.0)
    update = {"intercept": round(given.intercept + more, 3), "per_minute": round(per_minute, 3)}
    return given.model_copy(update=update)
