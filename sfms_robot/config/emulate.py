"""What a head's servos have stored and are fed with when it is emulated: `configs/heads/NAME/emulate.yaml`.

On a real head somebody has written homing offsets, limits and the like into the servos before; an emulated one gets
them from here. A head without this file has servos as they leave the factory.
"""

from __future__ import annotations

from pydantic import Field

from sfms_robot.config.base import Model, Name, Positive, load
from sfms_robot.data import find

_FILE = "emulate.yaml"


class Stored(Model):
    """`registers` holds for every servo of the head, `joints` for one; raw values by register name."""

    source: str = ""
    supply_v: Positive | None = None
    registers: dict[Name, int] = Field(default_factory=dict)
    joints: dict[Name, dict[Name, int]] = Field(default_factory=dict)

    def of(self, joint: str) -> dict[str, int]:
        """Everything stored in a joint's servo."""
        return {**self.registers, **self.joints.get(joint, {})}


def load_stored(head: str) -> Stored:
    """Of a head by shipped name or folder; empty where the head says nothing."""
    file = find("heads", head, "head.yaml") / _FILE
    return load(Stored, file) if file.is_file() else Stored()
