"""`servo move`: one servo, gently, and left as it was found. `servo release`: torque off, whatever they do."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

from sfms_robot.app.open_head import build_one
from sfms_robot.app.servo.serial_line import TRIES, FoundServo, Wire
from sfms_robot.app.servo.single_servo import field_named, put, read, scan
from sfms_robot.app.wiring import Opened, port_of
from sfms_robot.config import Head, Joint, load_firmware_map
from sfms_robot.emulator.launch import Chain
from sfms_robot.errors import BusError, ConfigError, PortError, RobotError, ServoError, TorqueError
from sfms_robot.ports import Clock
from sfms_robot.servo.chain.startup import WayInside, slow_profile, way_inside
from sfms_robot.servo.families import family_named
from sfms_robot.servo.registers import Field, Table
from sfms_robot.servo.stored_settings import limit_names

log = logging.getLogger(__name__)

SPEED_DEG_S: Final = 20.0
STEP_S: Final = 0.02
BEHIND_DEG: Final = 8.0  # farther behind its goal than this, something is in the way
SETTLE_S: Final = 1.0
LOOK_S: Final = 0.05  # between two looks at a servo that comes inside its limits
STILL_TICKS: Final = 1  # between two looks: it stands
CLOSE_DEG: Final = 1.5  # a loaded servo without integral gain stops that short


def move(wire: Wire, seen: FoundServo, to: str | None, by: str | None) -> dict[str, Any]:
    """Move a servo to a place or by a way: raw ticks, or degrees of its shaft as `-5deg`.

    Its own profile is limited and its goal goes in steps of at most `SPEED_DEG_S`; torque comes on where it stands.
    One that stands outside its own limits cannot hold there: its own profile moves it inside first, as slowly, which
    the log says. Torque and profile are put back afterwards, also after Ctrl-C. Blocks for as long as the way takes,
    and `SETTLE_S`.

    Raises ConfigError for a goal outside its limits, ServoError for one that is not in position mode, refuses, or does
    not get there; it then stops where it is.
    """
    table = seen.registers()
    goal_field, present_field = field_named(table, "goal_position"), field_named(table, "present_position")
    _in_position_mode(wire, seen)
    start = read(wire, seen, present_field)
    limits = _limits(wire, seen, table)
    target = _target(seen, table, limits, start, to, by)
    step = max(1, math.floor(_ticks(table, SPEED_DEG_S) * STEP_S))
    with _torque_as_found(wire, seen):
        goal = start if limits[0] <= start <= limits[1] else _brought_in(wire, seen, start, limits)
        with _gently(wire, seen, goal):
            due_s = wire.clock.now_s()
            while goal != target:
                goal += max(-step, min(step, target - goal))
                put(wire, seen, goal_field, goal)
                due_s += STEP_S
                wire.clock.wait_until(due_s)
                _in_the_way(wire, seen, goal, read(wire, seen, present_field))
            reached = _settled(wire, seen, present_field, target)
    return {"id": seen.id, "from": start, "to": target, "reached": reached}


def _limits(wire: Wire, seen: FoundServo, table: Table) -> tuple[int, int]:
    """Those that it has stored, or a turn where it has none or they are the same."""
    turn = 0, math.ceil(table.ticks_per_revolution) - 1
    names = limit_names(table)
    if names is None:
        return turn
    low, high = (read(wire, seen, table[name]) for name in names)
    return (low, high) if low < high else turn


def _target(seen: FoundServo, table: Table, limits: tuple[int, int], start: int, to: str | None, by: str | None) -> int:
    if (to is None) == (by is None):
        raise ConfigError("servo move: say --to TICKS or --by TICKS, one of them (or degrees: --by -5deg)")
    target = _parsed(table, to) if to is not None else start + _parsed(table, by or "")
    low, high = limits
    if not low <= target <= high:
        raise ConfigError.at(f"id {seen.id}", "goal", target, "is outside its limits", [f"{low}..{high}"])
    return target


def _parsed(table: Table, text: str) -> int:
    match = re.fullmatch(r"\s*([-+]?\d{1,20}(?:\.\d+)?)\s*(deg)?\s*", text)
    if match is None or (match[2] is None and "." in match[1]):
        raise ConfigError.at("servo move", "goal", text, "is no place", ["ticks: 2048", "degrees: 12.5deg"])
    return round(_ticks(table, float(match[1]))) if match[2] else int(match[1])


def _in_position_mode(wire: Wire, seen: FoundServo) -> None:
    table = seen.registers()
    mode = table.role("operating_mode")
    if mode is None or table.position_mode is None:
        return
    if (now := read(wire, seen, mode)) != table.position_mode:
        raise ServoError(
            f"id {seen.id} is in operating mode {now}, not in position control: "
            f"sfms-robot servo write {seen.id} {mode.name} {table.position_mode}"
        )


@contextmanager
def _torque_as_found(wire: Wire, seen: FoundServo) -> Iterator[None]:
    """Torque goes off again afterwards where it was off."""
    torque = field_named(seen.registers(), "torque_enable")
    was_on = read(wire, seen, torque)
    try:
        yield
    finally:
        if not was_on:
            _limp(wire, seen, torque)


def _limp(wire: Wire, seen: FoundServo, torque: Field) -> None:
    """Switch torque off, also when Ctrl-C comes meanwhile. Raises TorqueError where the servo does not confirm it."""
    try:
        put(wire, seen, torque, 0)
    except KeyboardInterrupt:
        _limp(wire, seen, torque)
        raise
    except RobotError as error:
        raise TorqueError([f"id {seen.id}"]) from error


@contextmanager
def _gently(wire: Wire, seen: FoundServo, start: int) -> Iterator[None]:
    """Torque on at `start` with a slow profile, which is as before afterwards."""
    table = seen.registers()
    torque, goal = field_named(table, "torque_enable"), field_named(table, "goal_position")
    speed = table.role("moving_speed")
    was_fast = None if speed is None else read(wire, seen, speed)
    try:
        if speed is not None:
            put(wire, seen, speed, _slow(speed))
        if not read(wire, seen, torque):
            put(wire, seen, goal, start)
            put(wire, seen, torque, 1)
        yield
    finally:
        if speed is not None and was_fast is not None:
            put(wire, seen, speed, was_fast)


def _brought_in(wire: Wire, seen: FoundServo, start: int, limits: tuple[int, int]) -> int:
    """Move a servo inside its limits by its own slow profile; where it stands then, with torque.

    Raises ServoError, torque off, where it does not come in twice the time that the way should take.
    """
    table = seen.registers()
    way = way_inside(start, limits, table.ticks_per_revolution)
    mode = read(wire, seen, table["drive_mode"]) if "drive_mode" in table.fields else 0
    profile = {} if way is None else slow_profile(table, mode, way.distance_deg)
    where = f"id {seen.id} stands at {start}, outside its limits {limits[0]}..{limits[1]}"
    if way is None or not profile:
        raise ServoError(f"{where}: turn it in by hand")
    log.warning("%s: moving it inside at %g deg/s", where, SPEED_DEG_S)
    torque, goal = field_named(table, "torque_enable"), field_named(table, "goal_position")
    usual = {name: read(wire, seen, table[name]) for name in profile}
    try:
        for name, value in profile.items():
            put(wire, seen, table[name], value)
        put(wire, seen, goal, way.goal_ticks)
        put(wire, seen, torque, 1)
        here = _arrived_inside(wire, seen, way, limits)
        if here is None:
            raise ServoError(f"{where}, and does not come inside in {way.bound_s:.1f} s: torque is off")
        put(wire, seen, goal, here)
    except BaseException:  # before its usual profile is back, with which it would jump
        _limp(wire, seen, torque)
        raise
    finally:
        for name, value in usual.items():
            put(wire, seen, table[name], value)
    return here


def _arrived_inside(wire: Wire, seen: FoundServo, way: WayInside, limits: tuple[int, int]) -> int | None:
    """Where it stands still inside `limits`; None where it does not in time."""
    present, end_s = field_named(seen.registers(), "present_position"), wire.clock.now_s() + way.bound_s
    before = None
    while wire.clock.now_s() < end_s:
        wire.clock.wait_until(wire.clock.now_s() + LOOK_S)
        now = read(wire, seen, present)
        if before is not None and abs(now - before) <= STILL_TICKS and limits[0] <= now <= limits[1]:
            return now
        before = now
    return None


def _slow(speed: Field) -> int:
    """Twice the speed of the steps, so that the servo keeps up with them and does no more."""
    per_unit = 6.0 if speed.unit == "rpm" else 1.0  # deg/s
    return min(speed.high, max(1, round(2.0 * SPEED_DEG_S / per_unit / speed.scale)))


def _in_the_way(wire: Wire, seen: FoundServo, goal: int, present: int) -> None:
    table = seen.registers()
    if abs(goal - present) > _ticks(table, BEHIND_DEG):
        put(wire, seen, field_named(table, "goal_position"), present)
        raise ServoError(f"id {seen.id} stays at {present} while its goal is {goal}: something is in the way")


def _settled(wire: Wire, seen: FoundServo, present: Field, target: int) -> int:
    """Where it stands once it is close. Raises ServoError."""
    end_s = wire.clock.now_s() + SETTLE_S
    while True:
        now = read(wire, seen, present)
        if abs(now - target) <= _ticks(seen.registers(), CLOSE_DEG):
            return now
        if wire.clock.now_s() >= end_s:
            raise ServoError(f"id {seen.id} stopped at {now}, its goal is {target}")
        wire.clock.wait_until(wire.clock.now_s() + STEP_S)


def _ticks(table: Table, degrees: float) -> float:
    return degrees * table.ticks_per_revolution / 360.0


# --- release ----------------------------------------------------------------------------------------------------

Unconfirmed = dict[int, str]  # by id: why it is not known that its torque is off; empty if it is off

SILENT: Final = "does not answer; torque off was sent"


def release(head: Head, opened: Opened, clock: Clock, everything: bool = False) -> list[dict[str, Any]]:
    """Take torque off the servos of a head, and write nothing else; return a row per joint.

    The servos need not be those that the head's file names. `everything`: also servos and channels of other ids.
    Joints on a bus whose port fails are unconfirmed. Raises PortError and BusError if no bus could be used.
    """
    rows: list[dict[str, Any]] = []
    failures: list[PortError | BusError] = []
    for name, where in opened.items():
        joints = {key: joint for key, joint in head.joints.items() if joint.bus == name}
        names = {joint.id: key for key, joint in joints.items()}
        try:
            off = _release_bus(head, name, joints, where, clock, everything)
        except (PortError, BusError) as error:
            failures.append(error)
            off = dict.fromkeys(names, str(error))
        for servo, why in off.items():
            torque = "unconfirmed" if why else "off"
            rows.append({"bus": name, "joint": names.get(servo), "id": servo, "torque": torque, "note": why})
    if len(failures) == len(opened):
        raise failures[0]
    return rows


def _release_bus(
    head: Head, name: str, joints: dict[str, Joint], where: Chain | str, clock: Clock, everything: bool
) -> Unconfirmed:
    bus, tables = head.buses[name], {j.id: Table.of(load_firmware_map(j.model)) for j in joints.values()}
    if family_named(bus.family).board:
        most = max((table.channels or 0 for table in tables.values()), default=0)
        channels = range(most) if everything else list(tables)
        confirmed = not joints or build_one(head, name, joints, where, clock, confirmed=True, kept={}).end_pulses(
            channels
        )
        return dict.fromkeys(channels, "" if confirmed else SILENT)
    port = port_of(where, bus, clock)()
    try:
        return release_chain(Wire(port, bus.family, clock, bus.baud, fixed=True), tables, everything)
    finally:
        port.close()


def release_chain(wire: Wire, tables: Mapping[int, Table], everything: bool = False) -> Unconfirmed:
    """Write torque off to the servos of `tables`, by id, until they confirm it. Raises BusError when the port fails.

    A servo that answers a ping is written where the model that it names keeps its torque, a silent one where the head
    says: it may still obey. Models of Protocol 1.0 all keep it in one place.
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
