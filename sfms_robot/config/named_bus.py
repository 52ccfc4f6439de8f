"""One named bus of a head: what it speaks, how fast, and how often a second its wire can carry all goals."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, ValidationInfo, WithJsonSchema

from sfms_robot.config.base import Model, Positive
from sfms_robot.plugins import plugins

BUS_FAMILIES: Final = ("dynamixel2", "dynamixel1", "feetech", "maestro", "ssc32")
BUS_GROUP: Final = "sfms_robot.buses"  # entry points: families of other packages (`servo.families`)
HIGHEST_RATE_HZ: Final = 1000.0

# Bytes of one sync write of goal positions: around it, and per servo with its id. A board of hobby servos is not here:
# it sends what changed, when its wire is free.
_GOAL_BYTES: Final[Mapping[str, tuple[int, int]]] = {"dynamixel2": (14, 5), "dynamixel1": (8, 3), "feetech": (8, 3)}
# Bytes of the longest packet: the vendor's SDK of both Dynamixel protocols builds no longer one; a Feetech packet has a
# length of one byte.
_PACKET_BYTES: Final[Mapping[str, int]] = {"dynamixel2": 1024, "dynamixel1": 250, "feetech": 259}
_BITS: Final = 10  # of a byte on the wire: start, eight, stop


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
    """How often a second goals for `joints` servos fit on a wire of `baud`, answers left out; at most 1000, whole."""
    if family not in _GOAL_BYTES:
        return HIGHEST_RATE_HZ
    around, each = _GOAL_BYTES[family]
    return min(HIGHEST_RATE_HZ, max(1.0, float(baud // (_BITS * (around + each * joints)))))


def most_joints(family: str) -> int | None:
    """Return how many servos the goals of one packet can name; None for a board, or for a family of another package."""
    if family not in _GOAL_BYTES:
        return None
    around, each = _GOAL_BYTES[family]
    return (_PACKET_BYTES[family] - around) // each
