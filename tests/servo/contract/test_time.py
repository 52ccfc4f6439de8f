"""What a bus may cost in time, and how late torque-off may be: on a port where silence costs time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from timed import CHAINS, READ_DEADLINE_S, timed
from virtual_time import Time

from sfms_robot.config import LoadRule, Safety
from sfms_robot.ports import STOP_S
from sfms_robot.servo.composite import CompositeBus

BYTE_S = 10 / 1_000_000
SLACK_S = 200 * BYTE_S  # the exchange that may be under way when the budget ends


def most(rig, n, held):
    rig.polls_s.clear()
    readings = rig.ticks(held, n)
    return max(rig.polls_s), readings


@pytest.mark.parametrize("family", CHAINS)
def test_any_number_of_silent_servos_costs_one_read_deadline_in_a_poll(family):
    rig = timed(family)
    held = rig.hold()
    healthy_s, _ = most(rig, 30, held)
    for dead in ({14}, {1}, {28}, {3, 9, 10, 20, 28}):
        rig.port.mute = dead
        worst_s, readings = most(rig, 120, held)
        assert worst_s <= healthy_s + READ_DEADLINE_S + 0.001 + SLACK_S
        assert worst_s <= rig.bus._poll.budget_s + SLACK_S and rig.bus.statistics()["silent"] == sorted(dead)
        assert all(readings[f"joint{i}"].age_s < 0.1 for i in rig.ids if i not in dead)


@pytest.mark.parametrize("family", CHAINS)
@settings(max_examples=6, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_no_pattern_of_loss_makes_a_poll_longer_than_its_budget(family, data):
    rig = timed(family)
    held = rig.hold()
    rig.ticks(held, 2)
    rig.polls_s.clear()
    for _ in range(6):
        rig.port.mute = data.draw(st.sets(st.integers(1, 28), max_size=28), label="mute")
        lost = data.draw(st.sets(st.integers(1, 28), max_size=28), label="answers lost")
        rig.port.lose = lost.__contains__
        rig.port.deaf = data.draw(st.integers(0, 5), label="deaf") == 0
        rig.ticks(held, 2)
    assert max(rig.polls_s) <= rig.bus._poll.budget_s + SLACK_S


@pytest.mark.parametrize("held_s", [0.0, pytest.param(0.002, marks=pytest.mark.slow), 0.016])
@pytest.mark.parametrize(("baud", "rate_hz"), [(1_000_000, 100), (57_600, 20)])
@pytest.mark.parametrize("away", [{2}, {1, 2, 3, 4}], ids=["one", "all"])
@pytest.mark.parametrize("family", CHAINS)
def test_who_was_away_is_back_however_slow_the_wire_and_its_adapter(family, away, baud, rate_hz, held_s):
    rig = timed(family, 4, held_s=held_s, baud=baud, rate_hz=rate_hz)
    held = rig.hold()
    rig.ticks(held, 5)
    rig.kill(*away)
    rig.ticks_for(3.0, held)
    assert rig.bus.statistics()["silent"] == sorted(away)
    for servo in away:
        rig.set(servo, "torque_enable", 0)  # their supply was away
    rig.revive(*away)
    readings = rig.ticks_for(2.0 * (1 + len(away)), held)
    assert rig.bus.statistics()["silent"] == [] and rig.torques() == [1] * 4
    assert all(reading.fault is None and reading.age_s < 0.5 for reading in readings.values())


@pytest.mark.parametrize("family", CHAINS)
def test_28_servos_that_return_cold_with_the_factory_return_delay_are_back_within_3_s(family):
    rig = timed(family)
    held = rig.hold()
    rig.ticks(held, 20)
    rig.kill(*rig.ids)
    rig.ticks_for(0.5, held)
    for servo in rig.port.device.servos:
        volts = servo.supply_v
        servo.set_supply(0.0, rig.clock.t)
        servo.set_supply(volts, rig.clock.t)
        rig.set(servo.id, "return_delay", 250)
    rig.revive(*rig.ids)
    rig.ticks_for(3.0, held)
    assert rig.torques() == [1] * 28 and all(member.gets_goals for member in rig.bus._members)
    assert {rig.register(i, "return_delay") for i in rig.ids} == {0}


@pytest.mark.parametrize("held_s", [0.0, 0.016])
@pytest.mark.parametrize("baud", [1_000_000, 57_600])
@pytest.mark.parametrize("family", CHAINS)
def test_lost_torque_and_changed_registers_are_heard_of_however_slow_the_wire_and_its_adapter(family, baud, held_s):
    rig = timed(family, 4, held_s=held_s, baud=baud)
    held = rig.hold()
    rig.ticks(held, 5)
    rig.set(2, "torque_enable", 0)
    fields = rig.servo(3).table.fields
    changed = next(name for name in ("profile_velocity", "moving_speed", "goal_velocity") if name in fields)
    rig.set(3, changed, 77)
    readings = rig.ticks_for(4.0, held)
    if rig.family.table.protocol == 2:  # of the others the next goal switches it on again
        assert "joint2: torque lost" in rig.bus.statistics()["faults"]
    assert readings["joint3"].fault == f"{changed} reads 77, set to 0"
    readings = rig.ticks_for(3.0, held)
    assert rig.torques() == [1] * 4 and readings["joint2"].fault is None


def test_28_servos_at_100_hz_and_1_mbit_keep_their_tick_with_two_bad_connections():
    rig = timed("dynamixel2")
    held = rig.hold()
    rig.ticks(held, 5)
    random = np.random.default_rng(1)
    rig.port.lose = lambda servo: servo in (5, 17) and random.random() < 0.3
    rig.polls_s.clear()
    rig.ticks(held, 300)
    goals_s = (14 + 28 * 5) * BYTE_S
    assert max(rig.polls_s) + goals_s <= rig.period_s


@pytest.mark.parametrize("family", CHAINS)
@settings(max_examples=4, suppress_health_check=[HealthCheck.too_slow])
@given(count=st.integers(2, 6), armed=st.booleans())
def test_any_number_of_mute_buses_have_torque_off_within_20_ms_and_stop_within_half_a_second(family, count, armed):
    clock = Time()
    rigs = [timed(family if k % 2 == 0 else "dynamixel2", 28, clock) for k in range(count)]
    for k, each in enumerate(rigs):
        each.bus.joints = tuple(f"bus{k}_joint{i}" for i in each.ids)
    bus = CompositeBus(
        {f"bus{k}": each.bus for k, each in enumerate(rigs)}, [joint for each in rigs for joint in each.bus.joints]
    )
    bus.connect()
    held = bus.enable(bus.joints)
    if armed:  # the watchdogs, which have to be off as well
        bus.write(held, clock.t)
        bus.poll(clock.t)
    for each in rigs:
        each.port.mute = set(each.ids)
    began_s, marks = clock.t, [len(each.port.sent) for each in rigs]
    bus.stop("release")
    assert clock.t - began_s <= STOP_S
    for each, mark in zip(rigs, marks, strict=True):
        assert each.port.sent_at_s[mark] - began_s <= 0.02
        packet = each.port.sent[mark]  # one for all of them, before any is asked
        named = packet[12:-2:2] if each.family.table.protocol == 2 else packet[7:-1:2]
        assert list(named) == each.ids and each.torques() == [0] * 28


@pytest.mark.parametrize("family", CHAINS)
def test_torque_off_waits_for_nobody_and_no_goal_follows_it(family):
    rig = timed(family, 8)
    held = rig.hold()
    rig.ticks(held, 2)
    rig.port.mute = set(rig.ids)
    began_s = rig.clock.t
    rig.bus.torque_off("hold")
    assert rig.clock.t == began_s
    rig.bus.torque_off("release")
    assert rig.clock.t - began_s < 0.001
    rig.port.mute = set()
    rig.ticks(held + 0.1, 100)
    assert rig.torques() == [0] * 8 and rig.bus.enable(rig.bus.joints) == pytest.approx(held, abs=0.02)
    rig.ticks(held, 5)
    assert rig.torques() == [1] * 8


@pytest.mark.parametrize("family", CHAINS)
def test_24_joints_come_back_in_many_ticks_and_the_watchdogs_of_4_that_hold_do_not_trip(family):
    clock = Time()
    face, neck = timed(family, 24, clock), timed(family, 4, clock, watchdog_ms=100)
    neck.bus.joints = tuple(f"neck{i}" for i in neck.ids)
    bus = CompositeBus({"face": face.bus, "neck": neck.bus}, [*face.bus.joints, *neck.bus.joints])
    bus.connect()
    held = bus.enable(bus.joints)
    back: dict[str, float] = {}

    def ticks(n):
        for _ in range(n):
            clock.wait_until((int(clock.t / 0.01 + 1e-6) + 1) * 0.01)
            bus.write(held, clock.t)
            readings = bus.poll(clock.t)
            back.update((joint, clock.t) for joint, reading in readings.items() if reading.rejoined)

    ticks(60)
    bus.release(face.bus.joints)
    ticks(50)
    assert face.torques() == [0] * 24
    began_s, mark = clock.t, len(neck.port.sent_at_s)
    bus.resume(bus.joints)
    assert clock.t == began_s
    ticks(250)
    assert set(back) == set(face.bus.joints) and len(set(back.values())) > 8 and max(back.values()) - began_s < 1.5
    assert face.torques() == [1] * 24 and neck.torques() == [1] * 4 and bus.statistics()["faults"] == []
    assert np.diff(neck.port.sent_at_s[mark - 1 :]).max() < 0.03


@pytest.mark.parametrize("family", CHAINS)
def test_watchdogs_are_switched_off_after_the_torque(family):
    rig = timed(family, 8)
    rig.ticks(rig.hold(), 60)
    watchdog = rig.family.table.role("bus_watchdog")
    if watchdog is None:
        return
    assert {rig.register(i, "bus_watchdog") for i in rig.ids} == {10}
    mark = len(rig.port.sent)
    rig.bus.stop("release")
    addresses = [int.from_bytes(packet[8:10], "little") for packet in rig.port.sent[mark:]]
    assert addresses.index(rig.family.table.role("torque_enable").address) < addresses.index(watchdog.address)
    assert {rig.register(i, "bus_watchdog") for i in rig.ids} == {0}


@pytest.mark.parametrize("family", CHAINS)
@pytest.mark.parametrize("origin_s", [0.0, 100.0, -3.0])
def test_age_is_never_negative_and_a_servo_dead_since_connect_is_not_fresh(family, origin_s):
    rig = timed(family, 4)
    held = rig.hold()
    rig.loop_origin_s = origin_s
    rig.port.mute = {4}
    began_s = rig.clock.t
    for _ in range(50):
        readings = rig.tick(held)
        assert all(reading.age_s >= 0.0 for reading in readings.values())
    assert readings["joint4"].age_s >= rig.clock.t - began_s - 0.02 and readings["joint1"].age_s < 0.05


GENTLE = Safety(pinch=LoadRule(current_mA=200, for_s=0.1, then="limp"))


def pinched(rig, held):
    """Ticks until joint 2 is pinched, by the bus's own rule."""
    rig.port.device.servo(2).plant.stuck = True
    goals = held.copy()
    goals[1] += 0.5
    for _ in range(200):
        rig.tick(goals)
        if any("pinched" in fault for fault in rig.bus.statistics()["faults"]):
            return goals
    raise AssertionError("nobody noticed")


TELLS_CURRENT = [name for name in CHAINS if name in ("dynamixel2", "sts")]


def loses_answers_about(rig, servo_id, role_or_name):
    """From now on no answer of a servo to a read of one register comes through."""
    table = rig.family.table
    here = table.role(role_or_name) or table[role_or_name]

    def lost(servo):
        packet = rig.port.sent[-1]
        address = int.from_bytes(packet[8:10], "little") if table.protocol == 2 else packet[5]
        return servo == servo_id and address == here.address

    rig.port.lose = lost


@pytest.mark.parametrize("family", TELLS_CURRENT)
def test_pinched_servo_is_limp_at_once_though_nothing_it_says_of_its_torque_arrives(family):
    rig = timed(family, 4, safety=GENTLE)
    held = rig.hold()
    rig.ticks(held, 3)
    loses_answers_about(rig, 2, "torque_enable")
    goals = pinched(rig, held)
    assert rig.torques() == [1, 0, 1, 1]  # in the very poll in which the rule was broken
    assert rig.ticks(goals, 50)["joint2"].fault is not None


@pytest.mark.parametrize("family", TELLS_CURRENT)
def test_torque_off_that_gets_lost_is_a_named_fault_and_is_repeated(family):
    rig = timed(family, 4, safety=GENTLE)
    held = rig.hold()
    rig.ticks(held, 3)
    servo = rig.port.device.servo(2)
    write, torque = servo.write, rig.family.table.role("torque_enable").address
    servo.write = lambda address, data, now_s: 0 if address == torque else write(address, data, now_s)  # it refuses
    goals = pinched(rig, held)
    readings = rig.ticks(goals, 10)
    assert rig.torques()[1] == 1
    assert readings["joint2"].fault == "torque is not off"
    assert "joint2: torque is not off" in rig.bus.statistics()["faults"]
    servo.write = write
    readings = rig.ticks(goals, 2)
    assert rig.torques() == [1, 0, 1, 1] and rig.ticks(goals, 3)["joint2"].fault != "torque is not off"


@pytest.mark.parametrize("family", TELLS_CURRENT)
def test_reduce_is_half_whatever_acknowledgements_are_lost(family):
    rule = LoadRule(current_mA=200, for_s=0.1, then="reduce")
    limits = Safety(pinch=rule, current_limit_mA=700) if family == "dynamixel2" else Safety(pinch=rule)
    rig = timed(family, 4, safety=limits)
    held = rig.hold()
    strength = "goal_current" if family == "dynamixel2" else "torque_limit"
    full = rig.register(2, strength)
    loses_answers_about(rig, 2, strength)
    goals = pinched(rig, held)
    for _ in range(100):
        rig.tick(goals)
        assert rig.register(2, strength) == full // 2
    rig.port.lose = lambda servo: False
    rig.ticks(goals, 5)
    assert rig.register(2, strength) == full // 2


def test_watchdog_whose_first_write_is_lost_is_armed_all_the_same():
    rig = timed("dynamixel2", 4)
    held, servo = rig.hold(), rig.port.device.servo(3)
    write, address = servo.write, rig.family.table["bus_watchdog"].address
    servo.write = lambda at, data, now_s: 0 if at == address else write(at, data, now_s)
    rig.ticks(held, 5)
    servo.write = write
    rig.ticks(held, 3)
    assert [rig.register(i, "bus_watchdog") for i in rig.ids] == [10] * 4
