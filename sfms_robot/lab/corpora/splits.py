"""Training, validation and test splits: one table for composing, fitting and scoring.

Meetings of a series share their people, so whole series are kept apart; so are whole recordings of voices and faces.
The series are laid out by hand so that every part has people whose gaze was annotated, and meetings in which nods were
left without a form. Voices of one person, or of people who talk with one another in several recordings, are in one
part. Nothing is fitted, chosen or calibrated on test.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final, Literal, TypeVar

Split = Literal["train", "validation", "test"]
SPLITS: Final[tuple[Split, ...]] = ("train", "validation", "test")

SERIES: Final[Mapping[Split, tuple[str, ...]]] = {
    "train": ("ES2008", "IS1002", "IS1004", "IS1008", "IS1009", "TS3003"),
    "validation": ("IS1000", "IS1005", "TS3011"),
    "test": ("ES2003", "IS1001", "IS1006"),
}
# Recordings of voices, by how their names begin; others are for training.
VOICES: Final[Mapping[Split, tuple[str, ...]]] = {
    "train": (
        "1114_2_01", "jfk", "audio_EN2001", "audio_EN2003", "audio_EN2004", "hvb_01cefd", "hvb_02e416", "hvb_03a17c",
        "lca_49",
    ),
    "validation": ("1114_3_15", "katie", "audio_EN2006", "hvb_a7ccc3", "hvb_eb82ec"),
    "test": ("1114_3_16", "steve", "audio_EN2005", "audio_EN2009", "audio_ES2003", "hvb_01f7ec"),
}  # fmt: skip
_Item = TypeVar("_Item")


def series(meeting: str) -> str:
    """Return the series of a meeting, whose meetings share their people: "IS1008c" -> "IS1008"."""
    return meeting.rstrip("abcdefgh")


def split_of(meeting: str) -> Split:
    """Return the split of a meeting; meetings of other series are for training."""
    return next((split for split in SPLITS if series(meeting) in SERIES[split]), "train")


def split_of_voice(name: str) -> Split:
    """Return the split of a recorded voice."""
    return next((split for split in SPLITS if name.startswith(VOICES[split])), "train")


def by_split(items: Iterable[tuple[Split, _Item]]) -> dict[Split, list[_Item]]:
    """Return items in their order, by split; every split is there."""
    parts: dict[Split, list[_Item]] = {split: [] for split in SPLITS}
    for split, item in items:
        parts[split].append(item)
    return parts
