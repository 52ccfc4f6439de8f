"""Behind `train events`: meetings in, one readable file of hazards and shapes out, and what it is worth on others.

Taught on the people of training; ranked and rolled out on those of validation. Nobody of test is looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import EVENT_KINDS
from sfms_robot.lab.corpora.compose.ami import Person, read_people, split_series
from sfms_robot.lab.evaluation.meetings import tables
from sfms_robot.lab.learning.events import borrowed, event_rollout, event_shapes, event_trainer
from sfms_robot.lab.learning.events.event_trainer import GROUPS, NOD, RIDGE, STUDY_RIDGE, Groups, Student
from sfms_robot.lab.learning.events.labels import LEARNED
from sfms_robot.listeners.events.evidence import EVIDENCE
from sfms_robot.listeners.events.hazards import EventTables, Hazard, HazardBank
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.signals.motion_primitives import read_motions

KNOBS: Final = (1.0, 2.2, 4.0)  # nods a minute, rolled out
# AUC of the same kinds in a study of all 36 meetings by six-fold cross-validation, to stand beside.
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
how long and how large. Read by `sfms_robot.listeners.events.hazards`, which says what the numbers mean.
Learned from: The AMI Meeting Corpus, AMI project consortium (Carletta et al. 2005), manual annotations 1.7, CC BY 4.0,
http://groups.inf.ed.ac.uk/ami/corpus/; annotations taken from github Hasetomo2142/ami-corpus-preprocessing, commit
6d845bc07b21c8862afbf38f1b1f9ab3bf40c437; the people of the training split. Looks aside: Dembinsky, Watanabe, Dengel,
Ishimaru (ETRA 2024), github psyberlab/eye-gaze-during-conversation-dataset, commit
e15614560ba7b0c1121e3d82c8a6e29c57cff5bd, Apache-2.0. Blinks, brows and sizes: motions.npz (SOURCE.md). Made by
  sfms-robot train events --data DIR --out FILE"""


def train_events(data: Path, out: Path | None, all_series: bool, seed: int) -> dict[str, Any]:
    """Write `out` (if given) and return the figures. Raises ConfigError, also for tables in which people never do what
    is to be learned: without gaze, say, or without laughs. Without people of validation nothing is ranked.

    `all_series`: taught on everybody, those of validation and test too, so there is nothing to rank: for comparison
    with what a study learned from the same meetings, by its recipe (89 inputs of nods, ridge 10), never for use.
    """
    if out is not None and not out.parent.is_dir():
        raise ConfigError(f"--out {out}: {out.parent} is no folder")
    people = read_people(tables(data))
    split = split_series(people)
    parts = {"train": people if all_series else split["train"], "validation": [] if all_series else split["validation"]}
    with _progress(len(parts["train"]) + len(parts["validation"]) + len(LEARNED)) as step:
        taught, judged = ([_one(person, seed, step) for person in parts[name]] for name in ("train", "validation"))
        for kind in LEARNED:
            if not any(len(one.lessons[kind].onsets) for one in taught if kind in one.lessons):
                raise ConfigError(f"{data}: in {len(taught)} people to learn from there is no {kind}: {FROM[kind]}")
        recipe = ({**GROUPS, "nod": NOD}, STUDY_RIDGE) if all_series else (GROUPS, RIDGE)
        hazards = {kind: _taught(taught, kind, *recipe, seed, step) for kind in LEARNED}
        motions = read_motions(data_dir("sim") / "listeners" / "motions.npz")["train"]
        hazards["gaze_shift"] = borrowed.look_away_hazard(hazards["gaze_shift"], taught)
        hazards["blink"] = borrowed.blink_hazard(motions.gaps)
        found = EventTables(
            hazards={kind: hazards[kind] for kind in EVENT_KINDS},
            shapes=event_shapes.shapes(taught, motions),
        )
    if out is not None:
        save(out, found)
    figures: dict[str, Any] = {
        "out": None if out is None else str(out),
        "people": {name: len({person.participant for person in parts[name]}) for name in ("train", "validation")},
        "listening_minutes": round(sum(float(one.listening.sum()) for one in taught) / 25 / 60, 1),
        "kinds": {kind: _figures(found.hazards[kind], kind, taught, judged) for kind in LEARNED},
        "nod": found.hazards["nod"].model_dump(mode="json"),
    }
    if judged:
        figures["rollout"] = _rolled_out(EventModel(found), judged, seed)
    figures["rows"] = _rows(figures)
    return figures


def save(file: Path, found: EventTables) -> None:
    """Write the tables as YAML below where they come from. Raises ConfigError when that fails."""
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


def _one(person: Person, seed: int, step: Any) -> Student:
    made = event_trainer.student(person, np.random.default_rng([seed, *person.meeting.encode(), ord(person.agent)]))
    step()
    return made


def _taught(
    students: Sequence[Student], kind: str, groups: Mapping[str, Groups], ridge: float, seed: int, step: Any
) -> Hazard:
    learned = event_trainer.teach(students, kind, groups[kind], seed, ridge)
    step()
    rate = event_trainer.rate_per_minute(students, kind)
    return event_trainer.hazard(learned, groups[kind], FROM[kind], rate)


def _figures(given: Hazard, kind: str, taught: Sequence[Student], judged: Sequence[Student]) -> dict[str, Any]:
    found: dict[str, Any] = {
        "onsets": sum(len(one.lessons[kind].onsets) for one in taught if kind in one.lessons),
        "steps": sum(int(one.lessons[kind].may.sum()) for one in taught if kind in one.lessons),
        "per_minute": given.per_minute,
    }
    if not judged:
        return found
    ranked = event_trainer.ranked(judged, kind, _score(given, kind))
    found |= {"auc": _figure(ranked.mean), "interval": [_figure(end) for end in ranked.interval()],
              "people": len(ranked.auc), "study_auc": STUDY_AUC.get(kind)}  # fmt: skip
    if kind == "nod":
        for name, left_out in (
            ("own_voice", ("own_voice_s", "floor_mine")),
            ("own_nods", ("nod_end_s", "root_nods_30s", "log_rate")),
        ):
            less = event_trainer.ranked(judged, kind, _score(given, kind, left_out))
            found[f"auc_without_{name}"] = _figure(less.mean)
    return found


def _score(given: Hazard, kind: str, left_out: Sequence[str] = ()) -> Any:
    """Evidence (M, E) -> log-odds (M,), some evidence unknown."""
    bank = HazardBank({kind: given})
    columns = [EVIDENCE.index(name) for name in left_out]

    def score(evidence: np.ndarray) -> np.ndarray:
        rows = evidence.copy()
        rows[:, columns] = np.nan
        parts = np.array_split(rows, max(1, len(rows) // 4096))
        return np.concatenate([bank.log_odds(bank.contributions(part))[:, 0] for part in parts])

    return score


def _rolled_out(model: EventModel, judged: Sequence[Student], seed: int) -> dict[str, Any]:
    """By knob, and of the people themselves."""
    theirs = event_rollout.total([event_rollout.count(one, event_rollout.people_did(one)) for one in judged])
    found: dict[str, Any] = {"people": _rounded(event_rollout.figures(theirs))}
    for knob in KNOBS:
        ours = event_rollout.total(
            [
                event_rollout.count(
                    one,
                    np.array([nod.start_s for nod in event_rollout.roll_out(model, one, knob, number + 1000 * seed)]),
                )
                for number, one in enumerate(judged)
            ]
        )
        figures = {**event_rollout.figures(ours), "interval_ks": event_rollout.interval_distance(ours, theirs)}
        found[f"{knob:g}"] = _rounded(figures)
    return found


def _rounded(figures: Mapping[str, float]) -> dict[str, float | None]:
    return {key: _figure(value) for key, value in figures.items()}


def _figure(value: float) -> float | None:
    return round(float(value), 4) if np.isfinite(value) else None


def _rows(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for kind, found in figures["kinds"].items():
        auc = found.get("auc")
        low, high = found.get("interval") or (None, None)
        rows.append(
            {
                "kind": kind.replace("_", " "),
                "onsets": found["onsets"],
                "a minute": found["per_minute"],
                "AUC on validation": None if auc is None else f"{auc:.3f} [{low:.3f}, {high:.3f}]",
                "study": found.get("study_auc"),
            }
        )
    return rows


@contextmanager
def _progress(total: int) -> Iterator[Any]:
    """A bar on stderr; calling what it gives is one step."""
    columns = (*Progress.get_default_columns()[:2], MofNCompleteColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("people and kinds", total=total)
        yield lambda: bar.advance(task)
