"""`servo move`: move one servo gently, and restore its settings. `servo release`: torque off, in any state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import closing
from typing import Final

from sfms_robot.app.open_head import build_one, bus_servos
from sfms_robot.app.servo.serial_line import TRIES, FoundServo, Row, Wire
from sfms_robot.app.servo.single_servo import parse_number, scan
from sfms_robot.app.wiring import Opened, open_wires, port_of
from sfms_robot.config import Head, load_head
from sfms_robot.errors import BusError, ConfigError, PortError, RobotError, ServoError, TorqueError
from sfms_robot.ports import Clock
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.chain.link import finish
from sfms_robot.servo.chain.protocol1 import Protocol1Startup
from sfms_robot.servo.chain.protocol2 import Dynamixel2Startup
from sfms_robot.servo.chain.startup import Startup
from sfms_robot.servo.families import family_named
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Field, Table
from sfms_robot.servo.stored_settings import JointNeeds

SPEED_DEG_S: Final = 20.0
STEP_S: Final = 0.02
BEHIND_DEG: Final = 8.0  # lag behind the goal beyond which something is in the way
SETTLE_S: Final = 1.0
CLOSE_DEG: Final = 1.5  # a loaded servo without integral gain stops this far from its goal


def move(seen: FoundServo, to: str | None, by: str | None) -> Row:
    """Move a servo to a position or by a distance: raw ticks, or degrees of its shaft such as `-5deg`.

    The servo's own profile is limited, and its goal moves in steps of at most `SPEED_DEG_S`. Torque comes on as at
    startup, where the servo stands. Outside its own limits it cannot hold there, and its profile first moves it inside,
    equally slowly. Torque and profile are restored afterwards, also after Ctrl-C. Blocks until the motion is over, and
    up to `SETTLE_S` more. Where torque off is not confirmed the profile stays limited.

    Raises ConfigError for a goal outside its limits, ServoError for a servo that is not in position mode, refuses, or
    does not reach the goal; it then stops where it is.
    """
    table, clock = seen.registers(), seen.wire.port
    goal_field, present, torque = (seen.named(n) for n in ("goal_position", "present_position", "torque_enable"))
    _check_mode(seen)
    start = seen.read(present)
    startup = _startup(seen)
    limits = startup.own_limits() or (0, math.ceil(table.ticks_per_revolution) - 1)
    target = _target(seen, limits, start, to, by)
    step = max(1, math.floor(_ticks(table, SPEED_DEG_S) * STEP_S))
    speed = table.role("moving_speed")
    profile = {table[name]: seen.read(table[name]) for name in startup.unlimited if name in table.fields}
    was_on = bool(seen.read(torque))
    stays_on = was_on and limits[0] <= start <= limits[1]
    goal = start
    try:
        if not stays_on:
            goal = finish(startup.torque_on(), lambda pause_s: clock.wait_until(clock.now_s() + pause_s))
            stays_on = was_on
        if speed is not None:  # twice the speed of the steps, so that the servo keeps up with them
            raw = round(2.0 * _ticks(table, SPEED_DEG_S) / table.in_ticks(speed))
            seen.put(speed, min(speed.high, max(1, raw)))
        due_s = clock.now_s()
        while goal != target:
            goal += max(-step, min(step, target - goal))
            seen.put(goal_field, goal)
            due_s += STEP_S
            clock.wait_until(due_s)
            here = seen.read(present)
            if abs(goal - here) > _ticks(table, BEHIND_DEG):
                seen.put(goal_field, here)
                raise ServoError(f"id {seen.id} stays at {here} while its goal is {goal}: something is in the way")
        reached = _settled(seen, present, target)
    finally:
        if not stays_on:
            _torque_off(seen, torque)
        for field, usual in profile.items():  # last: with torque on, a servo away from its goal would jump
            seen.put(field, usual)
    return {"id": seen.id, "from": start, "to": target, "reached": reached}


def _startup(seen: FoundServo) -> Startup:
    """Return the startup of a servo that no head's file describes; it needs nothing beyond one turn."""
    table, wire = seen.registers(), seen.wire
    kind = Dynamixel2Startup if table.protocol == 2 else Protocol1Startup
    servo = BusServo(joint="servo", id=seen.id, table=table, min_rad=0.0, max_rad=0.0)
    startup = kind(servo, JointNeeds(0, 0), {})
    wire.link.tries = TRIES
    startup.link = wire.link
    return startup


def _target(seen: FoundServo, limits: tuple[int, int], start: int, to: str | None, by: str | None) -> int:
    if (to is None) == (by is None):
        raise ConfigError("servo move: expected either --to or --by, in ticks or degrees (--by -5deg)")
    text = to if to is not None else by or ""
    number, unit = parse_number(text)
    if not number or unit not in ("", "deg"):
        raise ConfigError.at("servo move", "goal", text, "is not a place", ["ticks: 2048", "degrees: 12.5deg"])
    ticks = round(_ticks(seen.registers(), float(number))) if unit else int(number)
    target = ticks if to is not None else start + ticks
    if not limits[0] <= target <= limits[1]:
        raise ConfigError.at(f"id {seen.id}", "goal", target, "is outside its limits", [f"{limits[0]}..{limits[1]}"])
    return target


def _check_mode(seen: FoundServo) -> None:
    """Raise ServoError for a servo that is not in position mode."""
    mode, wanted = seen.registers().role("operating_mode"), seen.registers().position_mode
    if mode is not None and wanted is not None and (now := seen.read(mode)) != wanted:
        raise ServoError(
            f"id {seen.id} is in operating mode {now}, not in position control: "
            f"{seen.wire.command(f'write {seen.id} {mode.name} {wanted}')}"
        )


def _torque_off(seen: FoundServo, torque: Field) -> None:
    """Switch torque off, even if Ctrl-C comes meanwhile. Raises TorqueError if the servo does not confirm it."""
    try:
        seen.put(torque, 0)
    except KeyboardInterrupt:
        _torque_off(seen, torque)
        raise
    except RobotError as error:
        raise TorqueError([f"id {seen.id}"]) from error


def _settled(seen: FoundServo, present: Field, target: int) -> int:
    """Return the position once the servo is close to `target`. Raises ServoError."""
    clock = seen.wire.port
    end_s = clock.now_s() + SETTLE_S
    while abs((now := seen.read(present)) - target) > _ticks(seen.registers(), CLOSE_DEG):
        if clock.now_s() >= end_s:
            raise ServoError(f"id {seen.id} stopped at {now}, its goal is {target}")
        clock.wait_until(clock.now_s() + STEP_S)
    return now


def _ticks(table: Table, degrees: float) -> float:
    return degrees * table.ticks_per_revolution / 360.0


# --- release ----------------------------------------------------------------------------------------------------

Unconfirmed = dict[int, str]  # by id: reason why torque is not confirmed off; empty if it is off

SILENT: Final = "does not answer; torque off was sent"


def release_head(name: str, port: str, everything: bool) -> list[Row]:
    """Switch torque off on the servos of a head on `port`, as `release` does."""
    head = load_head(name)
    with open_wires(head, port) as opened:
        return release(head, opened, RealClock(), everything)


def release(head: Head, opened: Opened, clock: Clock, everything: bool = False) -> list[Row]:
    """Switch torque off on the servos of a head, and write nothing else; return a row per joint.

    The servos may differ from those in the head's file. `everything`: also servos and channels with other ids.
    Joints on a bus whose port fails are unconfirmed. Raises PortError and BusError if no bus could be used.
    """
    rows, failures = [], []
    for name, where in opened.items():
        joints = head.on_bus(name)
        bus, servos = head.buses[name], bus_servos(head, joints)
        names, tables = {each.id: each.joint for each in servos}, {each.id: each.table for each in servos}
        try:
            if family_named(bus.family).board:
                most = max((table.channels or 0 for table in tables.values()), default=0)
                channels = range(most) if everything else list(tables)
                board = build_one(head, name, joints, where, clock, confirmed=True, kept={}) if joints else None
                off = dict.fromkeys(channels, "" if board is None or board.end_pulses(channels) else SILENT)
            else:
                with closing(port_of(where, bus, clock)()) as port:
                    off = release_chain(Wire(port, bus.family, bus.baud, fixed=True), tables, everything)
        except (PortError, BusError) as error:
            failures.append(error)
            off = dict.fromkeys(names, str(error))
        for servo, why in off.items():
            torque = "unconfirmed" if why else "off"
            rows.append({"bus": name, "joint": names.get(servo), "id": servo, "torque": torque, "note": why})
    if len(failures) == len(opened):
        raise failures[0]
    return rows


def release_chain(wire: Wire, tables: Mapping[int, Table], everything: bool) -> Unconfirmed:
    """Write torque off to the servos of `tables`, by id, until they confirm it. Raises BusError when the port fails.

    A servo that answers a ping is written at the torque register of the model that it reports; a silent servo, which
    may still obey, at that of the head's file. All models of Protocol 1.0 have this register at the same address.
    """
    seen = {each.id: each for each in (scan(wire) if everything else ())}
    why = dict.fromkeys((*tables, *seen), SILENT)
    for _ in range(TRIES):
        packets: dict[Field, dict[int, bytes]] = {}
        for servo in [servo for servo in why if why[servo]]:
            if (found := seen.get(servo) or wire.ping(servo, tries=1)) is not None:
                seen[servo] = found
            table = found.table if found and (found.table or wire.kind.protocol == 2) else tables.get(servo)
            if table is None:
                why[servo] = "its model has no firmware map; nothing was written"
            else:
                field = table["torque_enable"]
                packets.setdefault(field, {})[servo] = field.to_bytes(0)
        for field, off in packets.items():
            wire.link.sync_write(field.address, off)
        for field, off in packets.items():
            for servo in off.keys() & seen.keys():
                answer = wire.link.read(servo, field.address, field.size)
                confirmed = answer is not None and answer.data == off[servo]
                why[servo] = "" if confirmed else "answers, but does not report torque off (status return level?)"
    return why
