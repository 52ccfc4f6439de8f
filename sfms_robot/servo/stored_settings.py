"""Comparison of the stored settings of a servo with the head's file: values in, contradictions out, no I/O.

Startup compares before torque comes on, `sfms-robot doctor` whenever it is run; both use these rules. Registers that a
model does not have, or that were not read, are skipped.

Sources: ROBOTIS e-manual, control tables of the X and MX series (operating mode 11, homing offset 20, position limits
48 and 52, startup configuration 60, shutdown 63) and of Protocol 1.0 (angle limits 6 and 8, shutdown 18); Feetech STS
memory table V3.6 (angle limits 9 and 11, phase 18, unloading condition 19, offset 31).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Final, Literal

from sfms_robot.servo.registers import Table, Values

Then = Literal["refused", "set", "told"]

REVERSE: Final = 0x01  # drive mode bit 0: ticks count in the opposite direction
_SLAVE: Final = 0x02  # drive mode bit 1: follows another motor over a separate cable (X540, MX-106)
_TORQUE_AT_POWER_UP: Final = 0x01  # startup configuration bit 0
_EXTENDED_MODE: Final = 4  # Protocol 2.0: extended position
_CURRENT_POSITION_MODE: Final = 5  # Protocol 2.0: position with bounded current, also over many turns
_PROTECTIONS: Final = ("overheating", "overload", "electrical shock")
_LIMITS: Final = (("min_position_limit", "max_position_limit"), ("cw_angle_limit", "ccw_angle_limit"))
_OFFSETS: Final = ("homing_offset", "multi_turn_offset")
_DIRECTION: Final = {"drive_mode": REVERSE | _SLAVE, "phase": 0x81}  # Feetech: motor (bit 0), encoder (bit 7)
_SCALES: Final = ("angular_resolution", "resolution_divider")  # above 1: one tick of the servo stands for several


@dataclass(frozen=True)
class JointNeeds:
    """The requirements of a joint on the servo that moves it.

    Attributes:
        low_ticks, high_ticks: lowest and highest goal of the joint.
        stored: EEPROM values with which zero and direction in the head's file were measured.
        other_ids: ids of the other servos on its bus.
        bounded_current: True to limit its current, if the servo supports it.
        allowed_faults: faults that the head's file ignores.
    """

    low_ticks: int
    high_ticks: int
    _: KW_ONLY
    stored: Values = field(default_factory=dict)
    other_ids: frozenset[int] = frozenset()
    bounded_current: bool = False
    allowed_faults: Sequence[str] = ()


@dataclass(frozen=True)
class Contradiction:
    """A stored value that contradicts the head's file.

    Attributes:
        wanted: the value that fits, as close to the stored one as possible.
        then: `refused` at startup, `set` by startup, or `told`: only a warning.
        fixable: True if it can be corrected without harm; otherwise a person has to check it.
        in_file: True if the head's file has to change, since zero and direction depend on the value; else the servo.
    """

    register: str
    value: int
    wanted: int
    why: str
    _: KW_ONLY
    then: Then
    fixable: bool = True
    in_file: bool = False

    def __str__(self) -> str:
        return f"{self.register} is {self.value}, wanted {self.wanted}: {self.why}"


def multi_turn(table: Table, needs: JointNeeds) -> bool:
    """Return whether the goals of a joint exceed the single turn of position mode, and the model can reach them."""
    goal = table.role("goal_position")
    if goal is None or goal.low <= needs.low_ticks and goal.high < table.ticks_per_revolution:
        return False
    return needs.low_ticks < 0 or needs.high_ticks >= table.ticks_per_revolution


def operating_mode(table: Table, needs: JointNeeds) -> int | None:
    """Return the value of role `operating_mode` for a joint; None if limits set it (Protocol 1.0), or nothing does.

    Several turns need mode 4 with Protocol 2.0; a Feetech STS stays in mode 0, and its limits allow them.
    """
    if table.protocol == 2 and needs.bounded_current and "goal_current" in table.fields:
        return _CURRENT_POSITION_MODE
    if table.protocol == 2 and multi_turn(table, needs):
        return _EXTENDED_MODE
    return table.position_mode


def limit_names(table: Table) -> tuple[str, str] | None:
    """Return the names of the lower and the upper position limit; None for a model without limits."""
    return next((names for names in _LIMITS if names[0] in table.fields), None)


def limits_count(table: Table, needs: JointNeeds) -> bool:
    """Return whether a servo compares goals with its position limits: not in modes 4 and 5, nor with several turns."""
    if table.protocol == 2:
        return operating_mode(table, needs) in (None, table.position_mode)
    return not multi_turn(table, needs)


def contradictions(values: Values, table: Table, needs: JointNeeds) -> list[Contradiction]:
    """Return every stored value of one servo that contradicts the needs of its joint, most important first.

    Args:
        values: registers by name, as read.
    """
    found = [
        *_mode_and_limits(values, table, needs),
        *_zero_and_direction(values, table, needs),
        *_acts_unasked(values, needs),
        *_shutdown(values, table, needs),
        *_turns(values, table, needs),
    ]
    return sorted(found, key=lambda each: ("refused", "set", "told").index(each.then))


def _mode_and_limits(values: Values, table: Table, needs: JointNeeds) -> Iterator[Contradiction]:
    """Yield the operating mode if it is not the one that the joint needs, then each limit inside the joint's range.

    Servos of Protocol 2.0 refuse goals beyond a limit, all others clip them silently. Several turns need both limits at
    4095 (MX 1.0), or both at 0 (STS).
    """
    mode, wanted = table.role("operating_mode"), operating_mode(table, needs)
    if mode is not None and wanted is not None and (now := values.get(mode.name, wanted)) != wanted:
        kinds = {_EXTENDED_MODE: "extended position", _CURRENT_POSITION_MODE: "current-based position"}
        kind = kinds.get(wanted, "position") if table.protocol == 2 else "position"
        yield Contradiction(mode.name, now, wanted, f"the joint is moved in {kind} control", then="set")
    names = limit_names(table)
    if names is None or not values.keys() >= set(names):
        return
    low, high = (values[name] for name in names)
    if multi_turn(table, needs) and table.protocol == 1:
        both = 0 if table.family == "feetech" else table[names[1]].high
        for name, now in zip(names, (low, high), strict=True):
            if now != both:
                yield Contradiction(name, now, both, "the joint's range is more than one turn", then="set")
    elif not limits_count(table, needs):
        return
    elif low >= high:
        if table.family == "dynamixel" and names[0] == "cw_angle_limit":  # both 0: wheel mode, both 4095: multi-turn
            why = "equal angle limits are not a position mode"
            yield Contradiction(names[0], low, 0, why, then="set")
            yield Contradiction(names[1], high, table[names[1]].high, why, then="set")
    else:
        goals = f"the joint's range is {needs.low_ticks}..{needs.high_ticks} ticks"
        if low > needs.low_ticks:
            yield Contradiction(names[0], low, needs.low_ticks, goals, then="refused")
        if high < needs.high_ticks:
            yield Contradiction(names[1], high, needs.high_ticks, goals, then="refused")


def _zero_and_direction(values: Values, table: Table, needs: JointNeeds) -> Iterator[Contradiction]:
    """Yield each offset, reverse bit and scale that would move the joint by a wrong angle or in the wrong direction.

    Then yield each other register whose value differs from the head's file.
    """
    for name in _OFFSETS:
        now, wanted = values.get(name, 0), needs.stored.get(name, 0)
        if name in values and now != wanted:
            degrees = offset_ticks(table, now - wanted) * 360.0 / table.ticks_per_revolution
            why = f"every angle would be {degrees:+.1f} deg off"
            yield Contradiction(name, now, wanted, why, then="refused", in_file=True)
    for name, bits in _DIRECTION.items():
        now, declared = values.get(name, 0), needs.stored.get(name, 0)
        wanted = now & ~bits | declared & bits
        if name not in values or now == wanted:
            continue
        slave = name == "drive_mode" and (now ^ wanted) & _SLAVE
        why = "it follows another motor, not its goals" if slave else "the joint would move the other way"
        yield Contradiction(name, now, wanted, why, then="refused", in_file=not slave)
    for name in _SCALES:
        if values.get(name, 1) > 1:
            yield Contradiction(name, values[name], 1, "one of its ticks is several", then="refused")
    for name, wanted in needs.stored.items():
        if name not in (*_OFFSETS, *_DIRECTION) and values.get(name, wanted) != wanted:
            why = "the head's file was measured with it"
            yield Contradiction(name, values[name], wanted, why, then="refused", in_file=True)


def offset_ticks(table: Table, stored: int) -> int:
    """Return the ticks that a stored offset adds to each position the servo reports.

    Dynamixel: present position = shaft + offset. Feetech STS: present position = shaft - offset.
    """
    return -stored if table.family == "feetech" else stored


def _acts_unasked(values: Values, needs: JointNeeds) -> Iterator[Contradiction]:
    """Yield settings that make a servo act without a goal sent to it.

    These are an active secondary id (0..252), whose writes it also obeys but never answers, and actions at power-up.
    """
    now = values.get("secondary_id", 255)
    if now in needs.other_ids:
        yield Contradiction("secondary_id", now, 255, f"it would follow the goals of id {now} too", then="refused")
    elif now <= 252:
        yield Contradiction("secondary_id", now, 255, f"it obeys id {now} too", then="told", fixable=False)
    now = values.get("startup_configuration", 0)
    if now & _TORQUE_AT_POWER_UP:
        why = "its torque comes on at power-up, wherever it stands"
        yield Contradiction("startup_configuration", now, now & ~_TORQUE_AT_POWER_UP, why, then="refused")
    elif now:
        yield Contradiction("startup_configuration", now, 0, "it restores RAM values of an earlier time", then="told")


def _shutdown(values: Values, table: Table, needs: JointNeeds) -> Iterator[Contradiction]:
    """Yield the shutdown register if a protective fault does not switch torque off, or an ignored fault does."""
    name = "unloading_condition" if table.family == "feetech" else "shutdown"
    if name not in values:
        return
    faults, now, factory = table.servo_faults, values[name], table[name].initial

    def factory_bits(names: Sequence[str]) -> int:
        return sum(1 << bit for bit, text in faults.items() if text in names and factory >> bit & 1)

    protecting = factory_bits(_PROTECTIONS)
    wanted = (now | protecting) & ~(factory_bits(needs.allowed_faults) & ~protecting)
    if missing := table.faults_in(wanted & ~now):
        yield Contradiction(name, now, wanted, f"it does not switch torque off on {', '.join(missing)}", then="told")
    elif extra := table.faults_in(now & ~wanted):
        why = f"it switches torque off on {', '.join(extra)}, which the head's file ignores"
        yield Contradiction(name, now, wanted, why, then="told")


def _turns(values: Values, table: Table, needs: JointNeeds) -> Iterator[Contradiction]:
    """Yield a position beyond the single turn of position mode, or one that occurs in several turns of the joint."""
    present, turn = table.role("present_position"), table.ticks_per_revolution
    if present is None or present.name not in values:
        return
    now, offset = values[present.name], offset_ticks(table, values.get("homing_offset", 0))
    torque = table.role("torque_enable")
    if multi_turn(table, needs):
        if torque is not None and values.get(torque.name):
            return  # torque is on: the servo has had power since its position was known
        low, high = unique_ticks(turn, needs)
        if not low <= now <= high:
            low, high = home_ticks(turn, needs)
            why = (
                "the count of turns is lost at power-off, and this may be one of several places; switch its supply "
                f"off, turn it by hand to where it will read {low}..{high}, and switch it on"
            )
            yield Contradiction(present.name, now, (low + high) // 2, why, then="refused", fixable=False)
    elif not min(0, offset) <= now < turn + max(0, offset):  # a homing offset shifts the single turn
        inside = (now - offset) % math.ceil(turn) + offset
        clears = table.protocol == 2 and "homing_offset" in table.fields  # has instruction CLEAR; the XL-320 has not
        cure = ": turn it back by hand, or switch its supply off and on" * (not clears)
        yield Contradiction(
            present.name, now, inside, f"it was turned past one turn{cure}", then="refused", fixable=clears
        )


def unique_ticks(turn: float, needs: JointNeeds) -> tuple[int, int]:
    """Return the first and last tick that belong to only one position of the joint; first > last if there are none.

    A servo that may have lost its count of turns still reports its true position if that lies between them.
    """
    whole = round(turn)
    return max(needs.low_ticks, needs.high_ticks - whole + 1), min(needs.high_ticks, needs.low_ticks + whole - 1)


def home_ticks(turn: float, needs: JointNeeds) -> tuple[int, int]:
    """Return the part of `unique_ticks` inside the turn that a servo reports at power-up."""
    low, high = unique_ticks(turn, needs)
    return max(low, 0), min(high, round(turn) - 1)
