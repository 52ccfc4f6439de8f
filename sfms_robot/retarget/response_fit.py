"""The response of a face's joints, learnt from a camera, and the drives that compensate for it.

A face tracker watches the robot's own face while its joints move. The head's own drives turn the tracked face into the
value that each joint *looks like*, in contrast to the value that it *has*. For a servo whose skin moves as its file
says they are the same. The relation between them is the joint's response,

    looks like = offset + r(has),    r(0) = 0, rising, no steeper or flatter than a bound, smooth.

It is found by bounded least squares. Its inverse is the curve to apply to the joint's drive. The offset is what the
tracker sees in the face at rest, and is not corrected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import lsq_linear

from sfms_robot.config import Expression, Head
from sfms_robot.config.head import drives
from sfms_robot.frames import MOTION_DIM, SHAPES, Doubles, Floats
from sfms_robot.retarget.channel_mapping import ChannelMapping, Units

FLATTEST, STEEPEST = 0.2, 8.0  # slope of a response: no curve multiplies a motion by more than 5
_KNOTS: Final = 9  # from rest to each end, closer together near rest
_NEAR_REST: Final = 2.0
_BINS: Final = 200
_LEAST_MOVED: Final = 0.2  # share of a side's range; with less motion there is no estimate
_LEAST_SAMPLES: Final = 50
_FULL_WEIGHT: Final = 20  # samples in a bin from which on its weight does not grow
_SMOOTH: Final = 0.002  # weight against a change of slope
_PLAIN: Final = 0.002  # weight against a slope other than 1: decides where there is no data


def looks_like(head: Head, shapes: Floats | Doubles) -> Doubles:
    """Return the joint values (N, J) that explain blendshapes (N, 52) of the robot's own face."""
    return asked(head.replaced(couplings=()), shapes)


def asked(head: Head, shapes: Floats | Doubles) -> Doubles:
    """Return the joint values (N, J) for blendshapes (N, 52), in joint units; the neck's joints stay 0."""
    motion = np.zeros((len(shapes), MOTION_DIM), dtype=np.float32)
    motion[:, SHAPES] = shapes
    mapping = ChannelMapping(head)
    rows = np.broadcast_to(motion[:, None], (len(motion), len(mapping.joints), MOTION_DIM))
    return Units.of(head).values(mapping.angles(rows))


@dataclass(frozen=True)
class Response:
    """The response of one joint: `has` (K,) and `looks` (K,), both rising through 0, to which `offset` is added.

    `moved`: (lowest, highest) value in the recording.
    """

    has: Doubles
    looks: Doubles
    offset: float
    moved: tuple[float, float]

    def __call__(self, has: Doubles) -> Doubles:
        """Return the visible value (N,), without the offset."""
        return np.asarray(np.interp(has, self.has, self.looks))

    @property
    def curve(self) -> tuple[tuple[float, float], ...]:
        """Curve from a requested value to the joint value that shows it, for an `Expression`."""
        return tuple((round(float(x), 5), round(float(y), 5)) for x, y in zip(self.looks, self.has, strict=True))


def fit(has: Doubles, looks: Doubles, low: Doubles, high: Doubles) -> list[Response | None]:
    """Fit responses to N pairs (N, J) in joint units, in the ranges low..high (J,); None for a joint that hardly moved.

    Raises ValueError if the pairs differ in shape. Rows that are not finite are left out.
    """
    if has.shape != looks.shape or has.ndim != 2:
        raise ValueError(f"has {has.shape} and looks {looks.shape} are not both (N, J)")
    there = np.isfinite(has).all(axis=1) & np.isfinite(looks).all(axis=1)
    return [_response(has[there, j], looks[there, j], float(low[j]), float(high[j])) for j in range(has.shape[1])]


def _response(has: Doubles, looks: Doubles, low: float, high: float) -> Response | None:
    if len(has) < _LEAST_SAMPLES:
        return None
    moved = float(has.min()), float(has.max())
    if moved[1] < _LEAST_MOVED * high and moved[0] > _LEAST_MOVED * low or high <= low:
        return None
    spread = np.linspace(0.0, 1.0, _KNOTS) ** _NEAR_REST
    below = low * spread[::-1] if low < 0 else np.zeros(1)
    above = high * spread[1:] if high > 0 else np.zeros(0)
    knots = np.concatenate([below, above])
    # One point per bin, so that long rest does not dominate: mean of `has`, median of `looks`, weight.
    bins = np.clip(((has - low) / (high - low) * _BINS).astype(int), 0, _BINS - 1)
    _, bins, count = np.unique(bins, return_inverse=True, return_counts=True)
    x = np.bincount(bins, has) / count
    y = np.array([np.median(looks[bins == each]) for each in range(len(count))])
    weight = np.sqrt(np.minimum(count, _FULL_WEIGHT) / _FULL_WEIGHT)
    weight /= np.sqrt((weight**2).mean() * len(weight))
    width = np.diff(knots)
    parts = np.clip((x[:, None] - knots[:-1]) / width, 0.0, 1.0) - (knots[:-1] < 0)  # 0 at rest, on either side
    # Unknowns are the slope of each piece, then the offset.
    data = np.concatenate([parts * width, np.ones((len(x), 1))], axis=1) * weight[:, None]
    slopes, bends = np.eye(len(width)), np.diff(np.eye(len(width)), axis=0)
    priors = np.concatenate([_PLAIN * slopes, _SMOOTH * bends])
    matrix = np.concatenate([data, np.pad(priors, ((0, 0), (0, 1)))])
    wanted = np.concatenate([y * weight, np.full(len(slopes), _PLAIN), np.zeros(len(bends))])
    bounds = np.append(np.full(len(width), FLATTEST), -np.inf), np.append(np.full(len(width), STEEPEST), np.inf)
    found = lsq_linear(matrix, wanted, bounds).x
    heights = np.concatenate([[0.0], np.cumsum(found[:-1] * width)])
    heights -= heights[len(below) - 1]  # 0 at rest
    return Response(knots, heights, float(found[-1]), moved)


def rms(errors: Doubles) -> float:
    """Return the root of the mean square; 0 for an empty array."""
    return float(np.sqrt(np.mean(errors**2))) if errors.size else 0.0


def fitted_drives(head: Head, responses: Sequence[Response | None]) -> dict[str, Expression]:
    """Return the drives that compensate for the responses, by joint; a twin of a fitted joint has its own drive."""
    plain = drives(head)
    found: dict[str, Expression] = {}
    for name, response in zip(head.joints, responses, strict=True):
        drive = plain[name]
        if drive is not None and response is not None:
            found[name] = _unfolded(head, name, Expression(sum=(drive,), curve=response.curve))
    for name, joint in head.joints.items():
        drive = plain[name]
        if joint.mirror_of in found and name not in found and drive is not None:
            found[name] = _unfolded(head, name, drive)
    return found


def _unfolded(head: Head, name: str, drive: Expression) -> Expression:
    """Return the drive without the head's folds, which are added to every drive and which it already contains."""
    folds = [Expression(channel=fold.channel, gain=-fold.gain) for fold in head.folds if fold.into == name]
    return Expression(sum=(drive, *folds)) if folds else drive
