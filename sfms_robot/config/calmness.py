"""How often a head does things, and whether it takes itself for the one who is spoken to."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sfms_robot.config.base import Model

PerMinute = Annotated[float, Field(ge=0, le=60)]


class Calmness(Model):
    """Events a minute by kind: more is livelier, 0 is never, None is as people do.

    A rate is what would be seen of somebody in a meeting, who is looked at some of the time. Whoever is spoken to and
    looked at nods more than that, and whoever is not nods less.

    Attributes:
        nod, shake, tilt: of the head. With its own nods behind it a head nods a tenth more than it is asked to: 2.0 are
            people's 2.2. Nods, shakes, smiles, laughs, brows and "mm-hm" only come while listening.
        gaze_shift: looks away from the person; each is followed by a look back.
        addressed: sense: the person's attention says whether the head is spoken to, and without any face it is;
            assume: it always is; never: it never is.
    """

    nod: PerMinute | None = 2.0
    shake: PerMinute | None = None
    tilt: PerMinute | None = None
    laugh: PerMinute | None = None
    smile: PerMinute | None = None
    mm_hm: PerMinute | None = None
    brow_raise: PerMinute | None = None
    blink: PerMinute | None = None
    gaze_shift: PerMinute | None = None
    addressed: Literal["sense", "assume", "never"] = "sense"

    def per_minute(self, kind: str) -> float | None:
        """The rate asked for of one of `frames.EVENT_KINDS`; None: as people do."""
        asked: float | None = getattr(self, kind)
        return asked
