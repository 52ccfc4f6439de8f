"""The head at hand: a head's file, the overlay of this build, and the servos that answer.

A joint moves freely on real servos when its measurement holds for the servo that answers, or when its head needs none.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from contextlib import suppress
from typing import Final

from sfms_robot.app.servo.serial_line import FoundServo, Wire
from sfms_robot.app.wiring import SIM, devices, port_of
from sfms_robot.config import Head, Joint, load_firmware_map, load_head
from sfms_robot.config.head import held_back
from sfms_robot.config.overlay import Identity, head_hash, layered, load_overlay
from sfms_robot.emulator.launch import Chain
from sfms_robot.errors import ServoError
from sfms_robot.ports import Clock
from sfms_robot.servo.families import family_named
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table

log = logging.getLogger(__name__)

_REVERSED: Final = 1  # bit of the drive mode: which way ticks run


def calibrated_head(name: str, port: str, clock: Clock, kept: dict[str, Port]) -> Head:
    """Return the head as it may move on this port.

    On emulated servos every head counts as calibrated. On real ones each measured servo is identified first; a joint
    whose measurement does not hold, and an unmeasured one of a head to be calibrated first, holds back. The ports that
    are opened for this stay open, by bus, in `kept`: some adapters reset their servos at every opening.

    Raises ConfigError, PortError.
    """
    head = load_head(name)
    overlay, sha256 = load_overlay(head), head_hash(name)
    if port == SIM:
        layers = layered(head, overlay.model_copy(update={"calibrate": None, "stored": None}), sha256)
        _tell(head.name, layers.refused, layers.notes)
        return layers.head
    where = devices(head, port)
    measured = overlay.calibrate.joints if overlay.calibrate is not None else {}
    servos = identify(head, measured, where, clock, kept)
    layers = layered(head, overlay, sha256, servos)
    _tell(head.name, layers.refused, layers.notes)
    return ready(layers.head, real=True, calibrated=layers.calibrated, refused=layers.refused)


def ready(head: Head, *, real: bool, calibrated: Collection[str] = (), refused: Collection[str] = ()) -> Head:
    """The head with joints that nobody has measured, or whose measurement is `refused`, moving little and slowly."""
    if not real:
        return head
    held = [j for j in head.joints if j in refused or (head.calibrate_first and j not in calibrated)]
    if not held:
        return head
    which = "" if len(held) == len(head.joints) else f" in {', '.join(held)}"
    log.warning("head %s is not calibrated%s: 20 %% of its travel, 0.3 of its speed", head.name, which)
    return held_back(head, held)


def identify(
    head: Head,
    joints: Collection[str],
    where: Mapping[str, Chain | str],
    clock: Clock,
    kept: dict[str, Port] | None = None,
) -> dict[str, Identity | None]:
    """Return which servo answers for each of `joints`, None if none does. Writes nothing. Raises PortError.

    Ports are closed again, or stay open in `kept`, by bus.
    """
    servos: dict[str, Identity | None] = {}
    for name, bus in head.buses.items():
        mine = [joint for joint in joints if head.joints[joint].bus == name]
        if family_named(bus.family).board:
            servos |= {j: Identity(id=head.joints[j].id, model=head.joints[j].model) for j in mine}
        elif mine:
            port = port_of(where[name], bus, clock)()
            try:
                for joint in mine:
                    servos[joint] = _identity(port, bus.family, bus.baud, head.joints[joint], clock)
            finally:
                if kept is None:
                    port.close()
                else:
                    kept[name] = port
    return servos


def _identity(port: Port, family: str, baud: int, joint: Joint, clock: Clock) -> Identity | None:
    wire = Wire(port, family, clock, baud, fixed=True)
    seen = wire.ping(joint.id)
    if seen is None:
        return None
    expected = load_firmware_map(joint.model)
    model = joint.model if seen.model_number in (None, expected.model_number) else seen.model
    table = Table.of(expected) if seen.table is None or seen.model_number == expected.model_number else seen.table
    drive_mode = _register(seen, table, "drive_mode")
    return Identity(
        id=joint.id,
        model=model,
        firmware=seen.firmware,
        homing_offset=_register(seen, table, "homing_offset"),
        drive_mode=None if drive_mode is None else drive_mode & _REVERSED,
    )


def _register(seen: FoundServo, table: Table, name: str) -> int | None:
    with suppress(ServoError):
        return seen.read(table.fields[name]) if name in table.fields else None
    return None


def _tell(head: str, refused: Mapping[str, str], notes: Collection[str]) -> None:
    for joint, problem in refused.items():
        log.warning("head %s: the calibration of %s does not hold: %s", head, joint, problem)
    for note in notes:
        log.warning("head %s: %s", head, note)
