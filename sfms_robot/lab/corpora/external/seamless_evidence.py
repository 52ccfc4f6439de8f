"""Which way Seamless Interaction's numbers point, told by the key points of the same frames.

Nobody has published the axes of `alignment_head_rotation`, nor the order of `FAUValue`. But the files also hold where
eyes, nose and lips were seen in the picture (`boxes_and_keypoints:keypoints`, COCO-WholeBody: Jin et al., ECCV 2020),
and these must go along: the nose goes down when the head does, to the picture's right when it turns to its own left,
the right eye falls below the left one when the right ear does, lips part when the jaw drops, lids meet when eyes close.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles
from sfms_robot.lab.corpora.action_units import FAU_VALUE

SIGNS: Final = ("pitch", "yaw", "roll", "jaw drop", "eyes closed")
CLEAR: Final = 0.3  # correlations nearer to 0 prove nothing
LEAST_FRAMES: Final = 60
_SURE: Final = 0.3  # confidence of a key point
_NOSE, _LEFT_EYE, _RIGHT_EYE = 0, 1, 2
_FACE: Final = 23  # the first of 68 landmarks of the face
_LIPS: Final = (_FACE + 62, _FACE + 66)  # inner lip, upper and lower
_LIDS: Final = tuple((_FACE + above, _FACE + below) for above, below in ((37, 41), (38, 40), (43, 47), (44, 46)))
_USED: Final = sorted({_NOSE, _LEFT_EYE, _RIGHT_EYE, *_LIPS, *(point for pair in _LIDS for point in pair)})


@dataclass(frozen=True)
class Evidence:
    """Correlations of what was tracked with what was seen, by name of `SIGNS`: the median over `files`; {}: none."""

    correlations: dict[str, float]
    files: int

    @property
    def mirrored(self) -> bool:
        """Yaw and roll both go against the picture: a frame with y down and z away from the viewer."""
        return all(self.correlations.get(name, 0.0) < -CLEAR for name in ("yaw", "roll"))

    def told(self) -> str:
        """One line for a person."""
        if not self.correlations:
            return "no key points beside the motion: signs of yaw and roll, and the order of action units, unverified"
        found = ", ".join(f"{name} {value:+.2f}" for name, value in self.correlations.items())
        turned = {"yaw", "roll"} if self.mirrored else set()
        against = [name for name, value in self.correlations.items() if value < -CLEAR and name not in turned]
        unclear = [name for name, value in self.correlations.items() if abs(value) <= CLEAR]
        said = f"key points of {self.files} files beside the motion: {found}"
        said += "; yaw and roll are turned" if turned else ""
        said += f"; against the picture: {', '.join(against)}" if against else ""
        return said + (f"; not proved by these: {', '.join(unclear)}" if unclear else "")


def correlations(rotation_rad: Doubles, units: Doubles, keypoints: NDArray[Any]) -> dict[str, float] | None:
    """Of valid frames: rotation (N, 3), units (N, 24), keypoints (N, 133, 3) = x, y [pixel], confidence.

    None where too few frames show the face. A track that does not move has no correlation and is left out.
    """
    sure = (keypoints[:, _USED, 2] > _SURE).all(axis=1)
    seen = np.asarray(keypoints[sure, :, :2], np.float64)
    left, right = seen[:, _LEFT_EYE], seen[:, _RIGHT_EYE]
    apart = np.linalg.norm(left - right, axis=1)
    usable = apart > 1.0
    if usable.sum() < LEAST_FRAMES:
        return None
    nose = seen[:, _NOSE] - (left + right) / 2
    lids = np.mean([seen[:, below, 1] - seen[:, above, 1] for above, below in _LIDS], axis=0)
    picture = (nose[:, 1], nose[:, 0], right[:, 1] - left[:, 1], seen[:, _LIPS[1], 1] - seen[:, _LIPS[0], 1], -lids)
    tracked = (*rotation_rad[sure].T, units[sure, FAU_VALUE.index(26)], units[sure, FAU_VALUE.index(43)])
    found = {}
    for name, ours, theirs in zip(SIGNS, tracked, picture, strict=True):
        pair = np.stack([ours[usable], theirs[usable] / apart[usable]])
        if (pair.std(axis=1) > 1e-6).all():
            found[name] = float(np.corrcoef(pair)[0, 1])
    return found


def weigh(files: Sequence[dict[str, float]]) -> Evidence:
    """The median over files of each correlation."""
    names = [name for name in SIGNS if any(name in one for one in files)]
    return Evidence({name: float(np.median([one[name] for one in files if name in one])) for name in names}, len(files))
