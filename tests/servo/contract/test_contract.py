"""What every bus promises, whatever its family: the same tests for all of them.

On emulated servos in virtual time; with `--port FAMILY=DEVICE` those that need no helping hand run on real ones, too.
"""

import itertools
import math
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from chain_rig import BusRig
from emulated_devices import device_of
from emulated_port import EmulatedPort
from families import FAMILIES, LIMIT_RAD
from rig import emulated

from sfms_robot.config.wire_time import FRAMINGS
from sfms_robot.errors import BusError, ServoError

STATISTICS = {"writes", "reads", "errors", "retries", "reconnects", "silent", "faults"}
WIRE_FAULTS = ("drop=0.1", "corrupt=0.1", "truncate=0.1", "duplicate=0.3", "noise=0.3", "delay=0.03")
TOLD = {
    "current_mA": "current",
    "load_percent": "torque",
    "velocity_rad_s": "velocity",
    "voltage_V": "voltage",
    "temperature_C": "temperature",
}


def near(angles_rad, rig):
    """Equal but for rounding; a real servo also stops a little short of its goal."""
    slack_rad = 3 * rig.family.conversion.rad if rig.chain is not None else 0.03
    return pytest.approx(angles_rad, abs=slack_rad)


def test_joints_are_in_the_order_of_the_servos_nothing_goes_before_connect_and_no_goal_before_enable(rig):
    assert list(rig.bus.joints) == [f"joint{i}" for i in rig.ids]
    assert set(rig.bus.capabilities) == set(rig.bus.joints)
    with pytest.raises(BusError, match="not connected"):
        rig.bus.poll(rig.now_s)
    with pytest.raises((BusError, ValueError)):
        rig.bus.write(np.zeros(len(rig.ids)), rig.now_s)
    rig.bus.connect()
    rig.bus.poll(rig.now_s)
    mark = len(rig.sent)
    with pytest.raises(ValueError, match="no joint is enabled"):
        rig.bus.write(np.zeros(len(rig.ids)), rig.now_s)
    assert len(rig.sent) == mark


def test_bad_goal_is_refused_with_nothing_sent(rig):
    goals, mark = rig.hold(), len(rig.sent)
    for bad in (math.nan, math.inf, -math.inf, LIMIT_RAD + 0.01, -LIMIT_RAD - 0.01):
        goals[-1] = bad
        with pytest.raises(ValueError, match=rig.bus.joints[-1]):
            rig.bus.write(goals, rig.now_s)
    with pytest.raises(ValueError, match=f"{len(rig.ids)} joints"):
        rig.bus.write(goals[:-1], rig.now_s)
    assert len(rig.sent) == mark


def test_torque_comes_on_without_a_jump_where_the_position_is_known(rig):
    rig.bus.connect()
    before, held = rig.polls(2), rig.bus.enable(rig.bus.joints)
    assert np.isfinite(held).all()
    after = rig.polls(20, 0.05)
    if rig.tells("position"):
        assert [r.position_rad for r in before.values()] == near(held, rig)
        assert [r.position_rad for r in after.values()] == near(held, rig)


def test_goal_is_reached(rig):
    held = rig.hold()
    goals = held - np.copysign(0.1, held)
    moving, readings = rig.ticks(goals, 2), rig.ticks(goals, 60)
    if rig.tells("position"):
        assert [r.position_rad for r in readings.values()] == near(goals, rig)
        assert all(abs(r.extra["velocity_rad_s"]) > 0.1 for r in moving.values())
        assert all(20 < r.extra["temperature_C"] < 60 for r in readings.values())
    if rig.chain is not None:
        assert rig.shafts_rad() == near(goals, rig)


def test_nothing_is_reported_that_the_family_does_not_tell_and_statistics_have_the_keys_of_the_report(rig):
    held = rig.hold()
    readings = rig.ticks(held, 40)
    for joint, reading in readings.items():
        told = rig.bus.capabilities[joint]
        assert (reading.position_rad is None) == ("position" not in told)
        assert math.isinf(reading.age_s) == ("position" not in told)
        assert {TOLD[key] for key in reading.extra} <= told
    rig.ticks(held, 3)
    counts = rig.bus.statistics()
    assert set(counts) >= STATISTICS and counts["silent"] == [] and counts["writes"] >= 1


def test_stop_may_be_called_at_any_time_and_again(rig):
    rig.bus.stop("release")
    held = rig.hold()
    rig.bus.stop("release")
    rig.bus.stop("hold")
    rig.bus.stop("release")
    with pytest.raises(ValueError, match="no joint is enabled"):
        rig.bus.write(held, rig.now_s)


def test_close_may_be_called_at_any_time_and_again_and_connect_after_it(rig):
    rig.bus.close()
    first = rig.hold()
    rig.bus.close()
    rig.bus.close()
    rig.bus.stop("release")
    with pytest.raises(BusError, match="not connected"):
        rig.bus.poll(rig.now_s)
    assert rig.hold() == near(first, rig)
    rig.ticks(first, 3)


@pytest.mark.emulated
def test_goals_move_nothing_that_is_not_enabled(rig):
    rig.bus.connect()
    held, before = rig.bus.enable(rig.bus.joints[:2]), rig.shafts_rad()
    goals = np.zeros(4)
    goals[:2] = held
    rig.ticks(goals, 30)
    assert rig.torques() == [True, True, False, False] and rig.shafts_rad()[2:] == pytest.approx(before[2:])


@pytest.mark.emulated
def test_release_takes_the_torque_away_and_hold_leaves_it(rig):
    rig.hold()
    rig.bus.stop("hold")
    assert all(rig.torques())
    rig.bus.stop("release")
    assert not any(rig.torques())


@pytest.mark.emulated
def test_some_joints_are_released_while_the_others_go_on(rig):
    held = rig.hold()
    rig.ticks(held, 5)
    gone, mark = rig.bus.joints[0], len(rig.sent)
    rig.bus.release([gone])
    assert len(rig.sent) == mark + 1  # at once, in one packet
    goals = held.copy()
    goals[1:] = np.clip(held[1:] + 0.05, -LIMIT_RAD, LIMIT_RAD)
    for share in np.linspace(0, 1, 20):
        readings = rig.ticks(held + share * (goals - held), 1)
    rig.ticks(goals, 30)
    assert rig.torques() == [False] + [True] * (len(rig.ids) - 1) and rig.shafts_rad()[1:] == near(goals[1:], rig)
    assert all(readings[joint].fault is None for joint in rig.bus.joints)  # nobody calls it a fault
    again = rig.bus.enable([gone])
    assert not rig.tells("position") or again == near(rig.shafts_rad()[:1], rig)
    rig.ticks(np.concatenate([rig.shafts_rad()[:1], goals[1:]]), 5)
    assert all(rig.torques())


@pytest.mark.emulated
@pytest.mark.parametrize("how", ["release", "torque_off"])
def test_joints_are_called_back_while_the_others_go_on(rig, how):
    held = rig.hold()
    rig.ticks(held, 5)
    *gone, stays = rig.bus.joints
    if how == "release":
        rig.bus.release(gone)
    else:
        rig.bus.torque_off("release")
    rig.ticks(held, 60)
    assert rig.torques()[:-1] == [False] * len(gone)
    before = rig.now_s
    rig.bus.resume(rig.bus.joints)
    assert rig.now_s == before  # only asked for
    back: dict[str, int] = {}
    goals = held.copy()
    for k in range(300):
        goals[-1] += (how == "release") * 0.001 * (k < 50)
        readings = rig.ticks(goals, 1)
        back |= {joint: k for joint, reading in readings.items() if reading.rejoined}
    assert set(back) == set(gone if how == "release" else rig.bus.joints) and len(set(back.values())) > 1
    assert rig.torques() == [True] * len(rig.ids) and all(reading.fault is None for reading in readings.values())
    assert rig.shafts_rad() == near(goals, rig) and rig.bus.statistics()["reconnects"] == 0


@pytest.mark.emulated
def test_joints_that_come_back_may_be_released_again(rig):
    held = rig.hold()
    rig.ticks(held, 5)
    for n in (1, 3, 8):
        rig.bus.release(rig.bus.joints)
        rig.ticks(held, 20)
        rig.bus.resume(rig.bus.joints)
        rig.ticks(held, n)
    rig.bus.release(rig.bus.joints)
    rig.ticks(held, 100)
    assert not any(rig.torques())


@pytest.mark.emulated
def test_a_servo_that_does_not_hear_it_is_told_again_until_it_does(rig):
    """What is released is released, whatever the wire loses."""
    rig.ticks(rig.hold(), 3)
    rig.chain.inject("drop=0.6")
    rig.bus.release(rig.bus.joints)
    rig.ticks(np.zeros(len(rig.ids)), 40)
    rig.chain.clear_faults()
    rig.ticks(np.zeros(len(rig.ids)), 60)
    assert not any(rig.torques())


@pytest.mark.emulated
@pytest.mark.parametrize("place", [0, 2])
def test_dead_servo_leaves_the_others_fresh_and_its_own_reading_grows_old(rig, place):
    held = rig.hold()
    rig.ticks(held, 10)
    if not rig.tells("position"):
        rig.chain.kill(rig.ids[place])
        assert len(rig.ticks(held, 10)) == 4
        return
    rig.chain.kill(rig.ids[place])
    rig.ticks(held, 10)
    dead, ages = rig.bus.joints[place], []
    for _ in range(20):
        readings = rig.ticks(held, 1)
        ages.append(readings[dead].age_s)
        assert all(r.age_s <= 5 * 0.02 for joint, r in readings.items() if joint != dead)
    assert np.diff(ages) == pytest.approx(0.02)
    assert rig.bus.statistics()["silent"] == [rig.ids[place]]
    rig.chain.revive(rig.ids[place])
    assert rig.ticks(held, 150)[dead].age_s < 0.2 and rig.bus.statistics()["silent"] == []


@pytest.mark.emulated
def test_stop_completes_with_any_servos_dead(rig):
    for count in (1, 3, 4):
        for dead in itertools.combinations(range(4), count):
            rig.hold()
            for place in dead:
                rig.chain.kill(rig.ids[place])
            rig.bus.stop("release")
            rig.bus.stop("release")
            torques = rig.torques()
            reached = [torques[place] for place in range(4) if place not in dead]
            assert not any(reached), f"dead: {dead}"
            rig.bus.close()
            for servo in rig.ids:
                rig.chain.revive(servo)
            rig.clock.wait_until(rig.now_s + 0.5)


@pytest.mark.emulated
@pytest.mark.parametrize("family", [name for name, family in FAMILIES.items() if family.other])
def test_wrong_model_is_named_where_the_family_can_tell(family):
    other = FAMILIES[family].other
    with emulated(family, model=other) as rig:
        with pytest.raises(ServoError, match=rf"joint1 \(id 1\).*{FAMILIES[family].model}"):
            rig.bus.connect()


@pytest.mark.emulated
def test_nobody_there_is_an_error_that_names_the_baud_rate(rig):
    for servo in rig.ids:
        rig.chain.kill(servo)
    with pytest.raises(BusError, match=rf"bus 'face'.* at {rig.family.baud} baud: no"):
        rig.bus.connect()


@pytest.mark.emulated
def test_faults_on_the_wire_neither_raise_nor_make_old_readings_new(rig):
    held = rig.hold()
    rig.ticks(held, 5)
    goals = held - np.copysign(0.1, held)
    for k, fault in enumerate(WIRE_FAULTS):
        rig.chain.inject(fault)
        for part in range(5):
            reached = held + (goals - held) * (5 * k + part) / (5 * len(WIRE_FAULTS))
            readings = rig.ticks(reached, 4)
            for reading, shaft_rad in zip(readings.values(), rig.shafts_rad(), strict=True):
                if reading.age_s == 0.0:
                    assert reading.position_rad == pytest.approx(shaft_rad, abs=0.02)
        rig.chain.clear_faults()
    readings = rig.ticks(goals, 150)
    assert rig.bus.statistics()["silent"] == []
    for reading, shaft_rad, goal_rad in zip(readings.values(), rig.shafts_rad(), goals, strict=True):
        assert reading.fault == "left alone" or shaft_rad == near(goal_rad, rig)
        assert not rig.tells("position") or reading.age_s < 0.2


@pytest.mark.emulated
def test_adapter_may_be_unplugged_and_come_back(rig):
    held = rig.hold()
    rig.ticks(held, 5)
    rig.chain.hang_up()
    readings = rig.ticks(held, 50)
    if rig.tells("position"):
        assert all(r.age_s > 0.9 for r in readings.values())
    rig.chain.come_back()
    readings = rig.ticks(held, 100)
    if rig.tells("position"):
        assert all(r.age_s < 0.2 and r.fault is None for r in readings.values())
    goals = held - np.copysign(0.1, held)
    rig.ticks(goals, 100)
    assert rig.shafts_rad() == near(goals, rig) and all(rig.torques())


@pytest.mark.emulated
def test_no_goal_outside_the_limits_reaches_a_servo(rig):
    rig.hold()
    lowest, highest = rig.family.conversion.to_ticks(np.array([-LIMIT_RAD, LIMIT_RAD]))
    anywhere = np.random.default_rng(7).uniform(-LIMIT_RAD, LIMIT_RAD, (50, 4))
    for goals in (*anywhere, np.full(4, -LIMIT_RAD), np.full(4, LIMIT_RAD)):
        rig.ticks(goals, 1)
        told = [rig.chain.state(servo)["goal"] for servo in rig.ids]
        assert all(lowest <= goal <= highest for goal in told)


@pytest.mark.emulated
@pytest.mark.parametrize("already", [0, 2])
def test_supply_that_fails_while_torque_comes_on_is_an_error_and_no_lasting_one(rig, already):
    rig.bus.connect()
    if already:
        rig.bus.enable(rig.bus.joints[:already])
    rig.chain.inject("brownout")
    with pytest.raises((BusError, ServoError), match="answer"):
        rig.bus.enable(rig.bus.joints[already:])
    rig.bus.stop("release")
    assert rig.torques() == [False] * len(rig.ids)
    rig.clock.wait_until(rig.now_s + 2.0)
    rig.bus.enable(rig.bus.joints)
    assert rig.torques() == [True] * len(rig.ids)


@pytest.mark.emulated
@pytest.mark.parametrize("trouble", ["silent", "hangup"])
def test_bus_on_which_nobody_answers_any_more_has_failed(rig, trouble):
    goals = rig.hold()
    rig.ticks(goals, 2)
    rig.chain.inject(f"{trouble}@{rig.now_s}-{rig.now_s + 1000}")
    with pytest.raises(BusError, match="no answer from any servo for 30 s"):
        rig.ticks(goals, 330, period_s=0.1)
    assert rig.now_s < 1000
    rig.bus.stop("release")


GROUP_READS = {"dynamixel2", "dynamixel1-mx", "sts"}


@pytest.mark.emulated
@pytest.mark.parametrize("count", [1, 4])
def test_bytes_on_the_wire_are_those_that_are_counted(rig, request, count):
    framing, table = FRAMINGS[rig.family.bus], rig.family.table
    ids, name = rig.ids[:count], request.node.callspec.params["rig"]

    def spent(ask):
        before, mark = rig.chain.statistics()["bytes_out"], len(rig.sent)
        ask()
        return sum(map(len, rig.sent[mark:])) + rig.chain.statistics()["bytes_out"] - before

    goals = rig.hold()
    rig.ticks(goals, 3)
    rig.clock.wait_until(rig.now_s + 0.1)
    written = spent(lambda: rig.bus.write(goals + 0.01, rig.now_s))
    if table.protocol is None:  # channels side by side, and those below 10, take less
        assert 0.5 * framing.goals(4) <= written <= framing.goals(4)
        return
    assert written == framing.goals(4, table.role("goal_position").size)
    link, where = rig.bus._link, table.role("present_position")
    one_by_one = spent(lambda: [link.read(servo, where.address, where.size) for servo in ids])
    assert one_by_one == framing.reads(count, where.size, "one by one")
    for way, possible in (("together", name in GROUP_READS), ("fast", table.protocol == 2)):
        if possible:
            read = partial(link.read_many, where.address, where.size, ids, way == "fast")
            assert spent(read) == framing.reads(count, where.size, way)


REFUSED, WARNED, SET = "refused", "warned", "set"
STORED = [  # family, register, value, what a start makes of it
    ("dynamixel2", "drive_mode", 1, REFUSED),
    ("dynamixel2", "drive_mode", 8, SET),  # torque on by goal
    ("dynamixel2", "startup_configuration", 3, REFUSED),  # torque on at power-up
    ("dynamixel2", "homing_offset", 100, REFUSED),
    ("dynamixel2", "min_position_limit", 2000, REFUSED),
    ("dynamixel2", "operating_mode", 1, SET),
    ("dynamixel2", "shutdown", 0, WARNED),
    ("dynamixel1", "cw_angle_limit", 500, REFUSED),
    ("dynamixel1", "ccw_angle_limit", 0, SET),  # wheel mode
    ("dynamixel1", "shutdown", 0, WARNED),
    ("dynamixel1-mx", "multi_turn_offset", -100, REFUSED),
    ("dynamixel1-mx", "cw_angle_limit", 2000, REFUSED),
    ("dynamixel1-mx", "ccw_angle_limit", 0, SET),
    ("dynamixel1-mx", "shutdown", 0, WARNED),
    ("sts", "phase", 13, REFUSED),
    ("sts", "homing_offset", -100, REFUSED),
    ("sts", "max_position_limit", 2100, REFUSED),
    ("sts", "operating_mode", 1, SET),
    ("sts", "unloading_condition", 0, WARNED),
    ("scs", "phase", 1, REFUSED),
    ("scs", "max_position_limit", 520, REFUSED),
    ("scs", "unloading_condition", 0, WARNED),
]


def stored_rig(name, stored, joints=None):
    """The family's bus, with `stored` in the servos of all joints, or of those at `joints`."""
    family = FAMILIES[name]
    there = [
        replace(servo, start_ticks=family.table.center_ticks, registers=stored if joints is None or i in joints else {})
        for i, servo in enumerate(family.plugged())
    ]
    port = EmulatedPort(device_of(*there), family.baud, name="wire")
    return BusRig(port, family.build(lambda: port, 0.003))


@pytest.mark.parametrize(("name", "register", "value", "outcome"), STORED)
def test_what_servos_have_stored_is_refused_set_or_one_warning(name, register, value, outcome):
    rig = stored_rig(name, {register: value})
    if outcome is REFUSED:
        refusal = rf"^wire: servo 1 \(joint1\): {register} is {value}, wanted .* doctor --port"
        with pytest.raises(ServoError, match=refusal):
            rig.bus.connect()
        assert ServoError.exit_code == 4 and rig.torques() == [0] * 4
    else:
        rig.hold()
        (*warned,) = rig.bus.statistics()["stored_warnings"]
        assert [each.partition(" is ")[0] for each in warned] == (
            [f"joint1, joint2, joint3, joint4: {register}"] if outcome is WARNED else []
        )
    assert (rig.register(1, register) != value) == (outcome is SET)


def gone_and_back(name, register, value):
    """A rig in whose run servo 2 went away, got a value stored, and came back."""
    rig = stored_rig(name, {})
    held = rig.hold()
    rig.ticks(held, 3, 0.02)
    rig.kill(2)
    rig.ticks(held, 30, 0.02)
    rig.set(2, "torque_enable", 0)
    if "lock" in rig.servo(2).table.fields:
        rig.set(2, "lock", 0)
    rig.set(2, register, value)
    rig.revive(2)
    rig.ticks(held, 600, 0.02)
    assert rig.register(2, register) == value
    return rig


@pytest.mark.parametrize(("name", "register", "value"), [row[:3] for row in STORED if row[3] is REFUSED])
def test_a_servo_that_comes_back_with_what_would_be_refused_stays_off_and_is_named(name, register, value):
    rig = gone_and_back(name, register, value)
    assert rig.torques() == [1, 0, 1, 1] and "left alone" in rig.bus.poll(rig.clock.t)["joint2"].fault
    (named,) = (each for each in rig.bus.statistics()["faults"] if f"{register} is {value}" in each)
    assert named.startswith("joint2: wire: servo 2 (joint2): ")


@pytest.mark.parametrize(("name", "register", "value"), [row[:3] for row in STORED if row[3] is WARNED])
def test_a_servo_that_comes_back_with_less_protection_is_one_more_warning(name, register, value, caplog):
    rig = gone_and_back(name, register, value)
    (warned,) = rig.bus.statistics()["stored_warnings"]
    assert rig.torques() == [1] * 4 and warned.startswith(f"joint2: {register} is {value}")
    assert sum(f"comes back, and {register} is {value}" in each.getMessage() for each in caplog.records) == 1


def unconfirmed(rig):
    return rig.bus.statistics()["torque_unconfirmed"]


@pytest.mark.emulated
def test_joints_that_came_on_and_do_not_confirm_that_torque_is_off_are_listed(rig):
    rig.hold()
    rig.bus.stop("release")
    assert unconfirmed(rig) == []
    rig.bus.enable(rig.bus.joints[:2])
    for servo in rig.ids:
        rig.chain.kill(servo)
    rig.bus.stop("hold")
    assert unconfirmed(rig) == []
    for end in (rig.bus.torque_off, rig.bus.stop):  # of a bus that hangs, `stop` is never called
        end("release")
        assert unconfirmed(rig) == list(rig.bus.joints[:2])
    assert rig.torques() == [True, True, False, False]
    for servo in rig.ids:
        rig.chain.revive(servo)
    rig.bus.stop("release")
    assert unconfirmed(rig) == [] and not any(rig.torques())


@pytest.mark.emulated
def test_no_joint_is_confirmed_over_a_port_that_is_gone(rig):
    held = rig.hold()
    rig.chain.hang_up()
    rig.ticks(held, 5)
    rig.bus.stop("release")
    assert unconfirmed(rig) == list(rig.bus.joints)
    rig.chain.come_back()
    rig.bus.stop("release")  # opens the port that is back
    assert unconfirmed(rig) == [] and not any(rig.torques())


@pytest.mark.emulated
@pytest.mark.parametrize("family", [name for name, each in FAMILIES.items() if each.table.pulse_us is None])
def test_a_servo_that_never_came_on_is_not_listed_and_one_that_came_back_is(family):
    with emulated(family) as rig:
        *_, last = rig.ids
        rig.chain.kill(last)
        held = rig.hold()
        rig.ticks(held, 3)
        rig.bus.stop("release")
        assert unconfirmed(rig) == []
        held = rig.bus.enable(rig.bus.joints)
        rig.chain.revive(last)
        rig.ticks(held, 150)
        assert all(rig.torques())
        rig.chain.kill(last)
        rig.bus.stop("release")
        assert unconfirmed(rig) == [f"joint{last}"]
