"""Nobody answers: does somebody answer to another protocol?

One broadcast ping per rate and frame, and a short listen: Dynamixel 2.0 and Feetech answer it. Dynamixel 1.0 does not,
so there the first twenty ids are asked.
"""

from __future__ import annotations

from typing import Final

from sfms_robot.app.servo.serial_line import Wire, table_of
from sfms_robot.errors import PortError
from sfms_robot.servo.codecs import dxl2, protocol1
from sfms_robot.servo.families import servo_families
from sfms_robot.servo.port import Port

LISTEN_S: Final = 0.08  # answers come by id, 3 ms apart: those of the first two dozen ids
_FIRST_IDS: Final = 20
_ID_S: Final = 0.02  # an adapter may hold an answer back for 16 ms
_RATES: Final = 3  # of each family, those met most often
_DXL2_HEADER: Final = b"\xff\xff\xfd\x00"


def protocol_hint(wire: Wire) -> str:
    """What to type instead, or nothing. Takes at most 3 s on a silent wire, and leaves it at its rate."""
    before = wire.baud
    try:
        for baud in dict.fromkeys(baud for family in servo_families().values() for baud in family.bauds[:_RATES]):
            try:
                wire.at(baud)
            except PortError:
                continue
            family = _speaks(wire.port, wire, baud)
            if family == wire.family:
                return ""
            if family is not None:
                return f"these servos answer {servo_families()[family].title} at {baud} baud: --family {family}"
    finally:
        wire.at(before)
    return ""


def _speaks(port: Port, wire: Wire, baud: int) -> str | None:
    """The family that answers at the port's rate."""
    if _DXL2_HEADER in _reply(port, dxl2.encode_instruction(dxl2.BROADCAST, dxl2.PING)):
        return "dynamixel2"
    frames = protocol1.salvage(bytearray(_reply(port, protocol1.encode(protocol1.BROADCAST, protocol1.PING))))
    if not frames and baud in servo_families()["dynamixel1"].bauds[:2]:  # these answer only to their own id
        link = Wire(port, "dynamixel1", wire.clock, baud, fixed=True).link
        link.silence_s = _ID_S
        if any(link.ping(servo) is not None for servo in range(1, _FIRST_IDS + 1)):
            return "dynamixel1"
    for servo in {frame.servo for frame in frames}:
        for family in ("feetech", "dynamixel1"):
            found = Wire(port, family, wire.clock, baud, fixed=True).link.ping(servo)
            if found is not None and table_of(family, found.model_number, found.firmware) is not None:
                return family
    return None


def _reply(port: Port, request: bytes) -> bytes:
    """What comes back within `LISTEN_S`, without the echo of an adapter that hears itself."""
    port.discard_input()
    port.write(request)
    data, end_s = bytearray(), port.now_s() + LISTEN_S
    while part := port.read(4096, end_s):
        data += part
        if port.now_s() >= end_s:
            break
    return bytes(data).removeprefix(request)
