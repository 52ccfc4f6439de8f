"""One named bus of a head: what it speaks, how fast, and how often a second its wire can carry all goals."""

from __future__ import annotations

from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, ValidationInfo, WithJsonSchema

from sfms_robot.config.base import Model, Positive
from sfms_robot.config.wire_time import BITS, FRAMINGS
from sfms_robot.plugins import plugins

BUS_FAMILIES: Final = ("dynamixel2", "dynamixel1", "feetech", "maestro", "ssc32")
BUS_GROUP: Final = "sfms_robot.buses"  # entry points: families of other packages (`servo.families`)
HIGHEST_RATE_HZ: Final = 1000.0


def _family(name: str) -> str:
    if name in BUS_FAMILIES:
        return name
    known = [*BUS_FAMILIES, *plugins(BUS_GROUP)]
    if name not in known:
        raise ValueError(f"is not a family of buses ({', '.join(known)})")
    return name


def _crc(crc: bool, info: ValidationInfo) -> bool:
    if crc and info.data.get("family") != "maestro":
        raise ValueError("expected false, as only a Maestro has this setting")
    return crc


class Bus(Model):
    """One named bus of a head.

    `read_deadline_ms` is the silence that makes a servo silent. `fast_read`: all servos answer in one packet; "auto"
    tries it at start. `watchdog_ms` 0 leaves the servos' own watchdog off. `stagger_ms` lies between two servos whose
    torque comes on. A bus on which nobody answers for `reconnect_s` has failed. `rs485`: who switches the direction of
    a half-duplex RS-485 driver, the program by the RTS line (rts) or the driver (kernel); none for adapters that do.
    `crc`: a Maestro has "Enable CRC" on, and gets one with every command.
    """

    family: Annotated[str, AfterValidator(_family), WithJsonSchema({"enum": list(BUS_FAMILIES)})]
    baud: Annotated[int, Field(gt=0)]
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 100.0
    read_deadline_ms: Annotated[float, Field(gt=0, le=100)] = 3.0
    fast_read: Literal["auto", "on", "off"] = "auto"
    watchdog_ms: Annotated[int, Field(ge=0, le=2540)] = 200
    stagger_ms: Annotated[float, Field(ge=0, le=1000)] = 5.0
    reconnect_s: Positive = 30.0
    rs485: Literal["rts", "kernel"] | None = None
    crc: Annotated[bool, AfterValidator(_crc)] = False


def highest_rate_hz(family: str, baud: int, joints: int) -> float:
    """Return how often a second goals for `joints` servos fit on a wire of `baud`, answers left out.

    At most 1000, and whole. A board sends what changed when its wire is free, so its wire sets no limit.
    """
    framing = FRAMINGS.get(family)
    if framing is None or not framing.answer:
        return HIGHEST_RATE_HZ
    return min(HIGHEST_RATE_HZ, max(1.0, float(baud // (BITS * framing.goals(joints)))))


def most_joints(family: str) -> int | None:
    """Return how many servos the goals of one packet can name; None for a board, or for a family of another package."""
    framing = FRAMINGS.get(family)
    if framing is None or not framing.longest:
        return None
    return (framing.longest - framing.write) // (framing.write_each + framing.goal)
