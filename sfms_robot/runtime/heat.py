"""A servo that gets warm moves less, and so slower; one that is hot goes to rest and stays there until it has cooled.

Every joint has a share: 1 shows what is asked, 0 is its rest angle. It is `WARM_SHARE` while the servo is warm and 0
while it is hot, moves there over seconds, and comes back `COOLER_C` below where it left. Joints that show one pose
together (a neck) share the smallest. A servo that does not tell its temperature counts as cool; what it does at its own
limit is its protection's, and `on_fault` of the joint's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from sfms_robot.frames import Doubles, Reading

WARM_SHARE: Final = 0.5
COOLER_C: Final = 3.0
PER_S: Final = 0.5  # of the share: from moving to rest in two seconds


@dataclass(frozen=True)
class Heat:
    """All (J,).

    Attributes:
        share: of what is asked that a joint shows.
        wanted: where the share is going.
    """

    share: Doubles
    wanted: Doubles

    @classmethod
    def cool(cls, joints: int) -> Heat:
        return cls(np.ones(joints), np.ones(joints))

    @property
    def none(self) -> bool:
        """Whether every joint shows all that is asked."""
        return bool((self.share == 1.0).all())


class HeatGuard:
    """warm_C, hot_C: (J,). together: columns of joints that show one pose."""

    def __init__(self, warm_C: Doubles, hot_C: Doubles, together: Sequence[int] = ()) -> None:
        self._warm_C, self._hot_C, self._together = warm_C, hot_C, list(together)

    def judge(self, temperatures_C: Doubles, heat: Heat) -> Heat:
        """Temperatures (J,), NaN where not known -> where the shares are to go."""
        left_hot = np.where(heat.wanted < WARM_SHARE, COOLER_C, 0.0)
        left_warm = np.where(heat.wanted < 1.0, COOLER_C, 0.0)
        with np.errstate(invalid="ignore"):  # NaN is not hot
            hot = temperatures_C >= self._hot_C - left_hot
            warm = temperatures_C >= self._warm_C - left_warm
        wanted = np.where(hot, 0.0, np.where(warm, WARM_SHARE, 1.0))
        if self._together:
            wanted[self._together] = wanted[self._together].min()
        return replace(heat, wanted=wanted)

    def after(self, heat: Heat, dt_s: float) -> Heat:
        """`dt_s` later."""
        if (heat.share == heat.wanted).all():
            return heat
        step = np.clip(heat.wanted - heat.share, -PER_S * dt_s, PER_S * dt_s)
        return replace(heat, share=heat.share + step)


def temperatures_C(joints: Sequence[str], readings: Mapping[str, Reading]) -> Doubles:
    """(J,) of the freshest readings, NaN where a servo does not tell."""
    told = (readings[joint].extra.get("temperature_C") if joint in readings else None for joint in joints)
    return np.array([np.nan if each is None else each for each in told])
