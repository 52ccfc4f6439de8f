"""The AMI meeting annotations by listener: times of own nods, looks, laughs and speech, and of the others' speech.

Reads the tables head_gestures, gaze_focus, words, dialogue_acts and participants (CSV, gzipped or not) of one folder.
Times are seconds of the meeting; an interval table is (K, 2) start, end, sorted by start.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles
from sfms_robot.lab.corpora.clips import Split, by_split, split_of
from sfms_robot.lab.corpora.collection import columns

GAP_S: Final = 0.2  # shorter silences are part of a phrase
NODS: Final = ("concord_signal nod", "concord_signal ")  # form nod, and form left blank
_SHORT_S: Final = 0.6  # an isolated word is shorter
_ALONE_S: Final = 0.5  # silence before and after an isolated word
_COLUMNS: Final = {
    "participants": ("meeting", "agent", "participant", "head_annotated_until_s", "has_gaze_focus"),
    "head_gestures": ("meeting", "agent", "start_s", "end_s", "type", "form"),
    "gaze_focus": ("meeting", "agent", "start_s", "end_s", "target"),
    "words": ("meeting", "agent", "start_s", "end_s", "kind", "text"),
    "dialogue_acts": ("meeting", "agent", "start_s", "end_s", "type"),
}
LabelledSpan = tuple[float, float, str]  # start, end [s], and a label or an agent
LabelledSpans = tuple[LabelledSpan, ...]
_Spans = dict[tuple[str, str], list[LabelledSpan]]


@dataclass(frozen=True, kw_only=True)
class MeetingPerson:
    """One participant of one meeting, as a listener to all the others.

    Attributes:
        meeting, agent, participant: identity; `agent` is the letter used as a gaze target.
        until_s: end of the head's annotation, which begins at 0.
        nods, shakes, tilts: head gestures (concord signal; discord or negative; other communicative). Some annotators
            left the form of a nod blank; where they did not, 98 % of concord signals are nods.
        unseen: spans in which the head was off camera.
        gaze: (start, end, target): an agent's letter, a place, or "" (unspecified); None if gaze was not annotated.
        laughs, talk, backchannels: the participant's own voice.
        others: phrases of all the others together, joined across gaps under 0.2 s.
        floor: (start, end, agent) phrases of each of the others.
        others_laughs: laughs of the others.
        asked: ends of the others' dialogue acts that ask for something.
        others_backchannels: backchannels of the others.
        mm_hms: own isolated words under 0.6 s, with 0.5 s of silence before and after.
        others_nods: (start, end, agent) nods of each of the others.
        looked_at: (start, end, agent) of each of the others looking at the participant.
        gaze_known: the others whose gaze was annotated.
        words: each word, by agent, own words included.
    """

    meeting: str
    agent: str
    participant: str
    until_s: float
    nods: Doubles
    shakes: Doubles
    tilts: Doubles
    unseen: Doubles
    gaze: LabelledSpans | None
    laughs: Doubles
    talk: Doubles
    backchannels: Doubles
    others: Doubles
    floor: LabelledSpans
    others_laughs: Doubles
    asked: Doubles
    others_backchannels: Doubles
    mm_hms: Doubles
    others_nods: LabelledSpans
    looked_at: LabelledSpans
    gaze_known: frozenset[str]
    words: Mapping[str, Doubles]


def read_people(folder: Path) -> list[MeetingPerson]:
    """Return all persons with a minute or more of head annotations. Raises ConfigError naming table and column."""
    gestures, gaze, words, acts = (
        _spans(folder, name) for name in ("head_gestures", "gaze_focus", "words", "dialogue_acts")
    )
    listed = _table(folder, "participants")
    agents = defaultdict(list)
    for meeting, agent, *_ in listed:
        agents[meeting].append(agent)
    said = {key: interval_table(_spoken(found)) for key, found in words.items()}
    people = []
    for meeting, agent, participant, until, has_gaze in listed:
        if float(until or 0) < 60:
            continue
        key, others = (meeting, agent), [(meeting, other) for other in agents[meeting] if other != agent]
        people.append(
            MeetingPerson(
                meeting=meeting,
                agent=agent,
                participant=participant,
                until_s=float(until),
                nods=_pick(gestures[key], NODS),
                shakes=_pick(gestures[key], ("discord_signal shake", "negative_signal shake")),
                tilts=_pick(gestures[key], ("other_comm_head ",)),
                unseen=_pick(gestures[key], ("off_camera ",)),
                gaze=tuple(gaze[key]) if has_gaze == "1" and gaze[key] else None,
                laughs=_pick(words[key], ("vocalsound laugh",)),
                talk=phrases(_spoken(words[key])),
                backchannels=_pick(acts[key], ("bck",)),
                others=phrases(span for other in others for span in _spoken(words[other])),
                floor=tuple(
                    sorted(
                        (float(start), float(end), other[1])
                        for other in others
                        for start, end in phrases(_spoken(words[other]))
                    )
                ),
                others_laughs=phrases((a, b) for o in others for a, b, what in words[o] if what == "vocalsound laugh"),
                asked=np.sort([b for o in others for _, b, what in acts[o] if what.startswith("el.")]),
                others_backchannels=phrases((a, b) for o in others for a, b, what in acts[o] if what == "bck"),
                mm_hms=isolated(_spoken(words[key])),
                others_nods=_of_others(gestures, others, NODS),
                looked_at=_of_others(gaze, others, (agent,)),
                gaze_known=frozenset(other[1] for other in others if gaze[other]),
                words={one: said[meeting, one] for one in agents[meeting] if (meeting, one) in said},
            )
        )
    if not people:
        raise ConfigError(f"{folder}: participants: expected head annotations of a minute or more, found none")
    return people


def interval_table(spans: Iterable[Sequence[float]]) -> Doubles:
    """Return pairs (start, end) as an array (K, 2)."""
    return np.array(list(spans), np.float64).reshape(-1, 2)


def phrases(spans: Iterable[tuple[float, float]]) -> Doubles:
    """Return spans in any order as (K, 2), sorted by start, joined where they overlap or are less than 0.2 s apart."""
    joined: list[list[float]] = []
    for start, end in sorted(spans):
        if joined and start - joined[-1][1] < GAP_S:
            joined[-1][1] = max(joined[-1][1], end)
        elif end > start:
            joined.append([start, end])
    return interval_table(joined)


def isolated(words: Iterable[tuple[float, float]]) -> Doubles:
    """Return one person's words (K, 2) that are shorter than 0.6 s and have 0.5 s of silence on both sides."""
    spans = interval_table(sorted(words))
    before = spans[:, 0] - np.r_[-np.inf, spans[:-1, 1]]
    after = np.r_[spans[1:, 0], np.inf] - spans[:, 1]
    short = spans[:, 1] - spans[:, 0] < _SHORT_S
    return np.asarray(spans[short & (before >= _ALONE_S) & (after >= _ALONE_S)])


def split_series(people: Iterable[MeetingPerson]) -> dict[Split, list[MeetingPerson]]:
    """Return people by the split of their meeting (`clips.SERIES`).

    People of the training split are left out of the other splits.
    """
    parts = by_split((split_of(person.meeting), person) for person in people)
    seen = {person.participant for person in parts["train"]}
    for split in ("validation", "test"):
        parts[split] = [person for person in parts[split] if person.participant not in seen]
    return parts


def _of_others(spans: _Spans, others: Iterable[tuple[str, str]], wanted: tuple[str, ...]) -> LabelledSpans:
    """Return (start, end, agent) of the others' spans with a wanted label, sorted by start."""
    return tuple(
        sorted((start, end, other[1]) for other in others for start, end, what in spans[other] if what in wanted)
    )


def _spoken(spans: Iterable[LabelledSpan]) -> list[tuple[float, float]]:
    return [(start, end) for start, end, what in spans if what.startswith("w ")]


def _pick(spans: Iterable[LabelledSpan], wanted: tuple[str, ...]) -> Doubles:
    return interval_table((start, end) for start, end, what in spans if what in wanted)


def _spans(folder: Path, name: str) -> _Spans:
    spans: _Spans = defaultdict(list)
    try:
        for meeting, agent, start, end, *what in _table(folder, name):
            spans[meeting, agent].append((float(start), float(end), " ".join(what)))
    except ValueError as error:
        raise ConfigError(f"{folder}: {name}: {error}") from error
    for found in spans.values():
        found.sort()
    return spans


def _table(folder: Path, name: str) -> list[tuple[str, ...]]:
    """Return the rows of a table with only its `_COLUMNS`. Raises ConfigError."""
    for file in (folder / f"{name}.csv.gz", folder / f"{name}.csv"):
        if file.is_file():
            break
    else:
        raise ConfigError(f"{folder / name}.csv.gz: no such file; an AMI folder holds {', '.join(_COLUMNS)}")
    rows = columns(file)
    for column in _COLUMNS[name]:
        if column not in rows:
            raise ConfigError.at(file, "column", column, "is missing", rows)
    return list(zip(*(rows[column] for column in _COLUMNS[name]), strict=True))
