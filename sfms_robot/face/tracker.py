"""A face tracker that looks at the robot's own face, for want of a camera: joint values in, blendshapes out.

Skin and linkages answer each joint by a curve of their own that nobody has written down. What a tracker reports is the
face that explains what the joints show: of all blendshapes 0..1 that would ask this of the joints, those that move
the virtual head's skin least. Then comes the tracker's noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.face.human import HumanHead, load_human
from sfms_robot.frames import BLENDSHAPES, Doubles, Floats
from sfms_robot.signals.spaces import bounded_least_squares

_LEAST_MOTION_PRICE: Final = 0.002  # of skin motion, against a joint's value that is not explained
_SIZE_PRICE: Final = 0.01  # for shapes that hardly move the skin


@dataclass(frozen=True)
class Skin:
    """What each joint's value becomes: gain x (|value| beyond a dead band)^power, on its own side of rest.

    Each is (2, J): below rest, above rest.
    """

    gain: Doubles
    power: Doubles
    dead_band: Doubles

    @classmethod
    def plain(cls, joints: int) -> Skin:
        """As the head's file says."""
        ones = np.ones((2, joints))
        return cls(ones, ones, 0 * ones)

    @classmethod
    def hidden(cls, joints: int, seed: int) -> Skin:
        """One that nobody knows."""
        rng = np.random.default_rng(seed)
        shape = (2, joints)
        return cls(rng.uniform(0.85, 1.3, shape), rng.uniform(0.5, 2.0, shape), rng.uniform(0.0, 0.06, shape))

    def __call__(self, values: Doubles) -> Doubles:
        """(N, J) joint units -> (N, J) what they look like."""
        gain, power, dead = (np.where(values > 0, each[1], each[0]) for each in (self.gain, self.power, self.dead_band))
        beyond = np.maximum(np.abs(values) - dead, 0.0) / (1.0 - dead)
        out: Doubles = np.sign(values) * gain * beyond**power
        return out


class Tracker:
    """Sees a face that joints move.

    showing: (J, 52) the value that each blendshape at 1 asks of each joint. noise: of a blendshape, 1 sigma.
    """

    def __init__(self, showing: Doubles, skin: Skin, noise: float = 0.0, human: HumanHead | None = None) -> None:
        self._skin, self._noise = skin, noise
        motion = skin_motion(human)
        prices = [
            np.sqrt(_LEAST_MOTION_PRICE) * np.linalg.cholesky(motion + 1e-9 * np.eye(len(motion))).T,
            _SIZE_PRICE * np.eye(len(motion)),
        ]
        self._matrix = np.concatenate([showing, *prices])

    def face(self, values: Doubles) -> Doubles:
        """Joint values (N, J) -> blendshapes (N, 52) 0..1, without noise."""
        shown = self._skin(values)
        none, all_ = np.zeros(len(BLENDSHAPES)), np.ones(len(BLENDSHAPES))
        wanted = np.pad(shown, ((0, 0), (0, len(self._matrix) - shown.shape[1])))
        return bounded_least_squares(self._matrix, wanted, none, all_)

    def seen(self, values: Doubles, rng: np.random.Generator) -> Floats:
        """As `face`, as a tracker tells it."""
        face = self.face(values)
        return np.clip(face + rng.normal(0.0, self._noise, face.shape), 0.0, 1.0).astype(np.float32)


def skin_motion(human: HumanHead | None = None) -> Doubles:
    """(52, 52) how much two blendshapes move the skin alike; the mean of its diagonal is 1.

    For blendshapes b, b skin_motion b is the mean square way of the vertices, in units of that of one shape.
    """
    deltas = (human or load_human()).deltas.reshape(len(BLENDSHAPES), -1).astype(np.float64)
    gram = deltas @ deltas.T
    out: Doubles = gram * (len(BLENDSHAPES) / np.trace(gram))
    return out
