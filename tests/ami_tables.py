"""Annotations of made-up meetings, as the AMI tables have them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

UNTIL_S = 600.0
HEADERS = {
    "participants": "meeting,agent,participant,role,head_annotated_until_s,n,has_gaze_focus",
    "head_gestures": "meeting,agent,start_s,end_s,type,form",
    "gaze_focus": "meeting,agent,start_s,end_s,type,target",
    "words": "meeting,agent,start_s,end_s,kind,text",
    "dialogue_acts": "meeting,agent,start_s,end_s,type",
}


def words(seed: int, until_s: float = UNTIL_S, pause_s: float = 2.0) -> np.ndarray:
    """(K, 2) words of 0.2 to 0.5 s in phrases of 2 to 20 of them."""
    rng = np.random.default_rng(seed)
    spans, at = [], 1.0
    while at < until_s - 20:
        for _ in range(rng.integers(2, 20)):
            length = rng.uniform(0.2, 0.5)
            spans.append((at, at + length))
            at += length + 0.05
        at += rng.exponential(pause_s) + 0.3
    return np.round(spans, 2)


def write_tables(
    folder: Path, lacking: str | None = None, meetings: Sequence[str] = ("ES2002a",), until_s: float = UNTIL_S
) -> Path:
    """Tables of two people a meeting in which everything happens but for one kind (`gaze_shift`, `laugh`)."""
    rows: dict[str, list[str]] = {name: [] for name in HEADERS}
    for number, meeting in enumerate(meetings):
        for name, lines in _meeting(meeting, number, lacking, until_s).items():
            rows[name] += lines
    for name, header in HEADERS.items():
        (folder / f"{name}.csv").write_text("\n".join([header, *rows[name]]) + "\n")
    return folder


def _meeting(meeting: str, seed: int, lacking: str | None, until_s: float) -> dict[str, list[str]]:
    """A listens and does something of every kind; B speaks, laughs now and then, and asks."""
    last = round(until_s) - 20
    said = [f"{meeting},B,{a},{b},w,yes" for a, b in words(seed, until_s).tolist()]
    laughs = [f"{meeting},A,{at},{at + 1},vocalsound,laugh" for at in range(20, last, 40)]
    laughs += [f"{meeting},B,{at},{at + 1},vocalsound,laugh" for at in range(22, last, 40)]
    short = [f"{meeting},A,{at},{at + 0.3},w,mm-hm" for at in range(15, last, 25)]
    gaze = [f"{meeting},A,{at},{at + 4},person,B" for at in range(0, last + 10, 6)]
    gaze += [f"{meeting},A,{at + 4},{at + 6},place,table" for at in range(0, last + 10, 6)]
    return {
        "participants": [
            f"{meeting},{agent},{meeting}{agent},PM,{until_s:g},1,{int(lacking != 'gaze_shift')}" for agent in "AB"
        ],
        "head_gestures": [
            f"{meeting},A,{at + delay},{at + delay + 0.6},{type_},{form}"
            for at in range(10, last, 12)
            for delay, type_, form in ((0, "concord_signal", "nod"), (4, "negative_signal", "shake"),
                                       (8, "other_comm_head", ""))
        ],
        "gaze_focus": [] if lacking == "gaze_shift" else sorted(gaze),
        "words": said + short + ([] if lacking == "laugh" else laughs),
        "dialogue_acts": [f"{meeting},B,{at},{at + 1},el.inf" for at in range(30, last, 30)],
    }  # fmt: skip
