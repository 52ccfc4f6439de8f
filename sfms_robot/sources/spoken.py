"""What the robot says and who plays it, as they see one another."""

from __future__ import annotations

from typing import Protocol

from sfms_robot.frames import Floats
from sfms_robot.ports import Voice


class Player(Protocol):
    """Who plays what is said. All from any thread; none waits for a device.

    Attributes:
        delay_s: from the time of a sample of what is said until it leaves the loudspeaker.
    """

    delay_s: float

    def said(self) -> None:
        """There is something new to say."""

    def hushed(self) -> None:
        """Nothing more is said from now on."""


class Spoken(Voice, Protocol):
    """A voice that can be played."""

    def upcoming(self, index: int) -> Floats | None:
        """What is known by now of frame `index`, (640,), which was not taken yet: it may change until it is."""

    def played_by(self, player: Player) -> None:
        """From now on `player` wants to know at once of what changes."""
