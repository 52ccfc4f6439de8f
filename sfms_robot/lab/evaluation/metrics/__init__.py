"""Metrics under the names their papers use, as their reference code computes them; `timing` is this project's own.

FRRea, a distance between rendered images, is out of scope: nothing here renders faces for judging.
"""

from sfms_robot.lab.corpora.learning2listen import l2l_bilateral, l2l_mean_std
from sfms_robot.lab.evaluation.metrics.dim_metrics import (
    cluster_centres,
    frechet_distance,
    l2,
    paired_frechet_distance,
    rpcc_channels,
    rpcc_flat,
    shannon_index,
    sts,
    variance,
)
from sfms_robot.lab.evaluation.metrics.react_metrics import (
    ccc,
    dtw,
    frc,
    frd,
    frdiv,
    frdvs,
    frsyn,
    frvar,
    reactface_frc,
    reactface_frd,
    synchrony_lags,
)

__all__ = [
    "ccc",
    "cluster_centres",
    "dtw",
    "frc",
    "frd",
    "frdiv",
    "frdvs",
    "frechet_distance",
    "frsyn",
    "frvar",
    "l2",
    "l2l_bilateral",
    "l2l_mean_std",
    "paired_frechet_distance",
    "reactface_frc",
    "reactface_frd",
    "rpcc_channels",
    "rpcc_flat",
    "shannon_index",
    "sts",
    "synchrony_lags",
    "variance",
]
