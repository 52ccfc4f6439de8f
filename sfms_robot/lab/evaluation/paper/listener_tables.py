"""Tables I and II of the paper, on whatever data is at hand: listeners and heuristics beside the paper's own rows.

The paper leaves out how its numbers were computed; each choice is said where it is made. Table 1 is that of the
Learning2Listen line, expression and rotation apart; table 2 that of the REACT challenge, which scores 25 attributes
that no public code derives from coefficients: here it is computed on the coefficients, with ReactFace's FRDist. FRRea
needs rendered pictures and is out of scope. The paper's rows come from other data and spaces: shapes to compare with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles, Floats
from sfms_robot.lab.evaluation import metrics
from sfms_robot.lab.evaluation.baselines.heuristics import HEURISTICS, Heuristic
from sfms_robot.lab.evaluation.paper.over_people import Chosen, intervals

PARTS: Final[Mapping[str, Mapping[str, slice]]] = {
    "arkit58": {"expression": slice(6, 58), "rotation": slice(0, 3)},
    "faceverse58": {"expression": slice(0, 52), "rotation": slice(52, 55)},
    "deca56": {"expression": slice(0, 50), "rotation": slice(50, 53)},
}
CLUSTERS: Final = {"expression": 15, "rotation": 9}  # of the Shannon index (V-D1)
LEAST_SPREAD: Final = 1e-6  # channels whose clips all spread alike would be divided by next to nothing
FRAMES: Final = {1: 64, 2: 750}  # of a clip: Learning2Listen's and REACT's
TABLE_1: Final = ("L2", "FD", "Var", "SI", "P-FD", "RPCC")
TABLE_2: Final = ("FRCorr", "FRDist", "FRDiv", "FRVar", "FRDvs", "FRSyn")
NEEDED_FRAMES: Final = {1: 2, 2: 51}  # FRSyn looks 49 frames either way

# Tables I and II of the paper, in its units; None where it leaves a cell out.
_NONE: Final = (None,) * 6
PAPER_1: Final = {  # per part: L2, FD, Var, SI, P-FD, RPCC
    "Ground truth": ((None, 0.0, 2.90, 2.61, None, None), (None, None, 0.81, 1.96, None, None)),
    "Random": ((129.34, 524.69e3, 62.23, 1.17, 526.46e3, 0.08), (27.67, 257.06e2, 62.39, 1.06, 257.16e2, 0.002)),
    "Median": ((43.18, 97.86e3, 0.0, 0.0, None, None), _NONE),
    "LFI": ((50.07, 43.63e3, 1.15, 1.33, 54.34e3, 0.8), (9.00, 9.80e2, 0.17, 1.07, 12.36e2, 0.034)),
    "Learning2Listen": ((33.16, 3.55e3, 2.01, 2.48, 5.15e3, 0.02), (4.75, 0.81e2, 0.62, 1.82, 0.87e2, 0.0)),
    "ELP": ((None, 1.37e3, 2.70, 2.15, None, 0.014), (None, 0.36e2, 0.59, 1.60, None, 0.077)),
    "SFMS": ((26.65, 1.13e3, 2.17, 2.63, 1.35e3, 0.0023), (4.02, 0.68e2, 0.83, 2.03, 0.73e2, 0.006)),
}
PAPER_2: Final = {  # FRCorr, FRDist, FRDiv, FRVar, FRDvs, FRSyn
    "Ground truth": (0.85, 0.0, 0.0, 0.0724, 0.2483, 47.69),
    "Random": (0.05, 237.23, 0.1667, 0.0833, 0.1667, 44.10),
    "Mime": (0.38, 92.94, 0.0, 0.0724, 0.2483, 38.54),
    "MeanFr": (0.0, 97.86, 0.0, 0.0, 0.0, 49.0),
    "Trans-VAE": (0.07, 90.31, 0.0064, 0.0012, 0.0009, 44.65),
    "BeLFusion": (0.12, 94.09, 0.0379, 0.0248, 0.0397, 49.0),
    "Dense-FSQ": (0.31, 84.93, 0.1164, 0.0348, 0.1166, 47.42),
    "SFMS": (0.84, 66.89, 0.1207, 0.0871, 0.1212, 45.66),
}


Score = Callable[[Chosen], dict[str, Any]]  # figures of some of the clips


@dataclass(frozen=True)
class Clips:
    """Clips of one length in one motion space.

    Attributes:
        truth, speaker: (N, T, D); train: (M, T, D) listeners of the training set.
        people: (N,) who listens; none where nobody wants intervals over them.
    """

    space: str
    truth: Doubles
    speaker: Doubles
    train: Doubles
    people: Sequence[str] = ()


def cut(motions: Sequence[Doubles] | Sequence[Floats], frames: int) -> Doubles:
    """Motions (..., N_i, D) -> clips (M, ..., frames, D), one behind the other; what is left over is not used.

    Raises ConfigError when no motion is that long.
    """
    clips = [
        motion[..., at : at + frames, :] for motion in motions for at in range(0, motion.shape[-2] - frames + 1, frames)
    ]
    if not clips:
        raise ConfigError(f"no clip is as long as {frames} frames")
    return np.stack(clips).astype(np.float64)


def table(number: int, clips: Clips, answers: Mapping[str, Doubles], samples: int, seed: int = 0) -> dict[str, Any]:
    """Rows of table 1 or 2: truth, heuristics, `answers` (N, K, T, D) by name, and the paper's.

    A row of ours has `source` "here" and names the feature space of its numbers; one of the paper's has "paper".
    """
    score_of, paper = (_table_1(clips), _paper_1()) if number == 1 else (_table_2(clips), _paper_2())
    given = Heuristic(clips.train, clips.speaker, clips.space, samples, seed)
    every = np.arange(len(clips.truth))
    guesses = {"Ground truth": clips.truth[:, None], **{name: predict(given) for name, predict in HEURISTICS.items()}}
    rows = []
    for name, motion in {**guesses, **answers}.items():
        score = score_of(motion)
        over = intervals(score, clips.people) if name in answers else {}
        rows.append({"name": name, "source": "here", **score(every), "interval": over})
    return {
        "table": number,
        "space": clips.space,
        "features": _features(number, clips.space),
        "clips": len(clips.truth),
        "frames": clips.truth.shape[1],
        "samples": samples,
        "rows": [{key: _finite(value) for key, value in row.items()} for row in rows + paper],
    }


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def centres_of(truth: Doubles, parts: Mapping[str, slice], clusters: Mapping[str, int]) -> Mapping[str, Doubles]:
    """Of each part of a face the clusters of the truth (M, T, D), the same for every row of a table.

    Raises ConfigError for clips that are too alike.
    """
    try:
        return {part: metrics.cluster_centres(truth[..., where], clusters[part]) for part, where in parts.items()}
    except ValueError as error:
        raise ConfigError(f"the clips' own motion: {error}") from error


def _features(number: int, space: str) -> str:
    if number == 1 and space == "deca56":
        return "L2L-standardised: less the mean, over the deviation between clips of their deviations"
    if number == 1:
        return f"{space}, less the mean of training"
    return f"{space}, raw coefficients; appropriate is the own listener alone"


def _table_1(clips: Clips) -> Callable[[Doubles], Score]:
    """Every metric is the mean over the samples. FD, P-FD and SI pool all clips; Var and RPCC are DIM's."""
    scaled = _scale(clips)
    truth, speaker = scaled(clips.truth), scaled(clips.speaker)
    most = max(CLUSTERS.values())
    if (frames := truth.shape[0] * truth.shape[1]) < most:
        raise ConfigError(f"table 1 needs {most} frames for the clusters of SI, the clips have {frames} in all")
    centres = centres_of(truth, PARTS[clips.space], CLUSTERS)

    def score(pred: Doubles, chosen: Chosen) -> dict[str, Any]:
        row: dict[str, Any] = {}
        for part, where in PARTS[clips.space].items():
            own, person = truth[chosen][..., where], speaker[chosen][..., where]
            values = [
                (
                    metrics.l2(own, guess),
                    metrics.frechet_distance(own, guess),
                    metrics.variance(guess),
                    metrics.shannon_index(guess, own, CLUSTERS[part], centres=centres[part]),
                    metrics.paired_frechet_distance(own, guess, person),
                    _rpcc(own, guess, person),
                )
                for guess in (scaled(pred[chosen, k])[..., where] for k in range(pred.shape[1]))
            ]
            row |= {f"{part} {name}": value for name, value in zip(TABLE_1, _means(values), strict=True)}
        return row

    return lambda pred: partial(score, pred)


def _scale(clips: Clips) -> Callable[[Doubles], Doubles]:
    """The space that L2L's numbers are in, for its coefficients; others less the mean of training.

    Var and RPCC take all channels for one signal: a head that rests at pi about x would be all that they see.
    """
    if clips.space != "deca56":
        rest = clips.train.mean(axis=(0, 1))
        return lambda motion: motion - rest
    mean, spread = metrics.l2l_mean_std(clips.train)
    if (spread < LEAST_SPREAD).all():
        raise ConfigError(f"L2L's units need training clips that differ, there is {len(clips.train)}")
    spread = np.where(spread < LEAST_SPREAD, np.inf, spread)
    return lambda motion: (motion - mean) / spread


def _rpcc(truth: Doubles, guess: Doubles, person: Doubles) -> float:
    return float("nan") if np.ptp(guess) == 0 else metrics.rpcc_flat(truth, guess, person)


def _table_2(clips: Clips) -> Callable[[Doubles], Score]:
    """FRCorr is the challenge's sum over the samples, with the mean beside it; FRSyn skips constant channels.

    All but FRDvs are means over the clips; what each clip says is worked out once, whichever clips are chosen.
    """

    def score_of(pred: Doubles) -> Score:
        own = [
            (
                metrics.frc(made, true, np.eye(1)),
                metrics.reactface_frd(made, true, np.eye(1)),
                metrics.frdiv(made),
                metrics.frvar(made),
            )
            for made, true in zip(pred[:, None], clips.truth[:, None], strict=True)
        ]
        by_clip = np.array(own, np.float64)
        lags = metrics.synchrony_lags(pred, clips.speaker, nan_policy="skip", samples="all")

        def score(chosen: Chosen) -> dict[str, Any]:
            correlation, distance, diverse, varied = by_clip[chosen].mean(axis=0).tolist()
            known = lags[chosen][np.isfinite(lags[chosen])]
            synchrony = float(known.mean()) if len(known) else float("nan")
            values = (correlation, distance, diverse, varied, metrics.frdvs(pred[chosen]), synchrony)
            return dict(zip(TABLE_2, values, strict=True)) | {"FRCorr per sample": correlation / pred.shape[1]}

        return score

    return score_of


def _means(values: Sequence[Sequence[float]]) -> list[float]:
    return [float(np.mean(column)) for column in zip(*values, strict=True)]


def _paper_1() -> list[dict[str, Any]]:
    return [
        {"name": name, "source": "paper"}
        | {f"{part} {key}": value for part, row in zip(CLUSTERS, parts, strict=True)
           for key, value in zip(TABLE_1, row, strict=True)}
        for name, parts in PAPER_1.items()
    ]  # fmt: skip


def _paper_2() -> list[dict[str, Any]]:
    return [{"name": name, "source": "paper"} | dict(zip(TABLE_2, row, strict=True)) for name, row in PAPER_2.items()]
