"""Tables 1, 2 and 4 of the ARIG paper, as far as they need no rendered video: FD, RPCC, SID and Var, side by side.

The paper names its metrics and no definitions; these are DIM's, from whom it takes over its rows (Frechet distance per
clip, RPCC and Var flattened, SID in bits over 40 and 20 clusters of the truth). Its numbers are of 64 expression and 6
pose coefficients of Deep3DFaceRecon read off rendered video, ours of 52 blendshapes and 6 pose channels as they are
sent: shapes to compare with. Table 1 and 4 of the paper give RPCC, SID and Var of both parts together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from sfms_robot.frames import POSE, SHAPES, Doubles
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.paper.listener_tables import centres_of
from sfms_robot.lab.evaluation.paper.over_people import Chosen, intervals

CLIP_FRAMES: Final = 250
PARTS: Final[Mapping[str, slice]] = {"exp": SHAPES, "pose": POSE}
CLUSTERS: Final = {"exp": 40, "pose": 20}  # DIM's; the paper names none
COLUMNS: Final = ("FD", "RPCC", "SID", "Var")
_NAMES: Final = tuple(f"{column} {part}" for column in COLUMNS for part in PARTS)

PAPER_2: Final[Mapping[str, tuple[float | None, ...]]] = {  # table 2, on ViCo
    "RLHG": (39.02, 0.07, 0.08, 0.02, 3.62, 3.17, 1.52, 0.02),
    "L2L": (33.93, 0.06, 0.06, 0.08, 2.77, 2.66, 0.83, 0.02),
    "DIM": (23.88, 0.06, 0.06, 0.03, 3.71, 2.35, 1.53, 0.02),
    "INFP": (18.63, 0.07, None, None, 4.78, 3.92, 2.83, 0.18),
    "ARIG": (18.39, 0.06, 0.05, 0.01, 4.82, 3.94, 2.91, 0.17),
}
PAPER_1: Final[Mapping[str, tuple[float, ...]]] = {  # table 1, on RealTalk: RPCC, SID, Var
    "DIM": (0.186, 1.083, 1.206),
    "GT": (0.0, 2.902, 2.514),
    "ARIG": (0.125, 2.428, 2.397),
    "w/o long-range context": (0.140, 2.381, 2.326),
    "w/o conversational state guidance": (0.127, 2.263, 2.174),
    "w/o visual modality in IBU": (0.155, 2.115, 2.032),
}
PAPER_4: Final[Mapping[str, tuple[float, ...]]] = {  # table 4
    "w/o continuous AR modeling": (0.129, 2.261, 2.154),
    "w/o bidirectional-integrated learning": (0.173, 2.138, 2.016),
    "ARIG": (0.125, 2.428, 2.397),
}
# Changes to the listener's configuration behind the ablations' rows.
ABLATIONS: Final[Mapping[int, Mapping[str, Mapping[str, Any]]]] = {
    1: {
        "w/o long-range context": {"context_chunks": 4},
        "w/o conversational state guidance": {"state_guidance": False},
        "w/o visual modality in IBU": {"visual": False},
    },
    4: {
        "w/o continuous AR modeling": {"discrete": True, "draws": "motion"},
        "w/o bidirectional-integrated learning": {"interaction": "linear"},
    },
}


def scores(truth: Doubles, made: Doubles, speaker: Doubles, centres: Mapping[str, Doubles]) -> dict[str, float]:
    """FD, RPCC, SID and Var of expression and pose; clips (M, T, 58), a speaker's face NaN where it is not seen.

    RPCC is over the clips in which the speaker's face is seen throughout, NaN when there is none or one of the three
    never moves.
    """
    seen = np.isfinite(speaker).all(axis=(1, 2))
    found: dict[str, float] = {}
    for part, where in PARTS.items():
        real, ours, other = truth[..., where], made[..., where], speaker[..., where]
        moves = seen.any() and all(np.ptp(each[seen]) > 0 for each in (real, ours, other))
        found |= {
            f"FD {part}": metrics.frechet_distance(real, ours),
            f"RPCC {part}": metrics.rpcc_flat(real[seen], ours[seen], other[seen]) if moves else float("nan"),
            f"SID {part}": metrics.shannon_index(ours, real, CLUSTERS[part], unit="bits", centres=centres[part]),
            f"Var {part}": metrics.variance(ours),
        }
    return {name: found[name] for name in _NAMES}


def table_2(
    truth: Doubles, speaker: Doubles, answers: Mapping[str, Doubles], people: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Rows: truth, ours by name, the paper's. `people`: who listens in each clip, for intervals over them."""
    rows = _ours({"Ground truth": truth, **answers}, truth, speaker, people)
    rows += [_row(name, "paper", dict(zip(_NAMES, row, strict=True))) for name, row in PAPER_2.items()]
    return rows


def _ours(
    every: Mapping[str, Doubles], truth: Doubles, speaker: Doubles, people: Sequence[str]
) -> list[dict[str, Any]]:
    centres, rows = centres_of(truth, PARTS, CLUSTERS), []
    for name, made in every.items():

        def score(clips: Chosen, made: Doubles = made) -> dict[str, float]:
            return scores(truth[clips], made[clips], speaker[clips], centres)

        found = {key: [round(end, 5) for end in ends] for key, ends in intervals(score, people).items()}
        rows.append({**_row(name, "here", score(np.arange(len(truth)))), "interval": found})
    return rows


def ablation_table(
    number: int, truth: Doubles, speaker: Doubles, answers: Mapping[str, Doubles], people: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Table 1 or 4 without its image columns: rows as in `table_2`, with the paper's RPCC, SID and Var beside them."""
    paper = PAPER_1 if number == 1 else PAPER_4
    columns = ("paper RPCC", "paper SID", "paper Var")
    rows = [
        row | dict(zip(columns, paper.get(row["name"], (None,) * 3), strict=True))
        for row in _ours({"GT": truth, **answers}, truth, speaker, people)
    ]
    for name in paper.keys() - {row["name"] for row in rows}:
        empty: dict[str, float | None] = dict.fromkeys(_NAMES)
        rows.append({**_row(name, "paper", empty), **dict(zip(columns, paper[name], strict=True))})
    return rows


def _row(name: str, source: str, values: Mapping[str, float | None]) -> dict[str, Any]:
    return {"name": name, "source": source} | {
        key: None if value is None or not np.isfinite(value) else round(float(value), 5)
        for key, value in values.items()
    }
