import threading

import numpy as np
import pytest
from chain_rig import plugged, rig_of

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import BusError
from sfms_robot.frames import Reading
from sfms_robot.ports import STOP_S
from sfms_robot.servo.bus import AbsentBus
from sfms_robot.servo.composite import CompositeBus
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Table


def test_two_buses_answer_as_one_in_the_order_of_the_head():
    one = plugged([EmulatedServo(1, start_ticks=2000), EmulatedServo(2, start_ticks=2010)])
    two = plugged([EmulatedServo(3, start_ticks=2020)])
    joints = ["joint2", "joint3", "joint1"]
    bus = CompositeBus({"one": one.bus, "two": two.bus}, joints)
    bus.connect()
    assert bus.enable(joints) == pytest.approx([(t - 2048) * 2 * np.pi / 4096 for t in (2010, 2020, 2000)])
    goals = np.array([0.1, 0.2, 0.3])
    for k in range(60):
        one.clock.t = two.clock.t = k * 0.01
        bus.write(goals, k * 0.01)
        readings = bus.poll(k * 0.01)
    assert [readings[joint].position_rad for joint in joints] == pytest.approx(goals, abs=0.002)
    total = bus.statistics()
    assert total["writes"] == 120 and total["buses"]["two"]["writes"] == 60 and total["silent"] == []
    bus.stop("release")
    bus.close()


def test_joints_must_be_those_of_the_buses_and_a_bus_that_fails_to_connect_closes_the_others():
    with pytest.raises(ValueError, match="the head has"):
        CompositeBus({"one": plugged([EmulatedServo(1)]).bus}, ["joint1", "joint2"])
    good, bad = plugged([EmulatedServo(1)]), plugged([EmulatedServo(2)], ids=[9])
    bus = CompositeBus({"good": good.bus, "bad": bad.bus}, ["joint1", "joint9"])
    with pytest.raises(BusError, match="no answer from id 9"):
        bus.connect()
    good.bus.connect()  # its port is free again


class Steady:
    """A bus in this process that works until it is told to fail."""

    def __init__(self, joint, failing_with=None):
        self.joints, self.capabilities = (joint,), {joint: frozenset({"torque"})}
        self.failing_with = failing_with
        self.written, self.calls = [], []

    def connect(self): ...

    def enable(self, joints):
        return np.zeros(len(joints))

    def write(self, goals_rad, now_s):
        self.written.append((float(goals_rad[0]), now_s))

    def poll(self, now_s):
        if self.failing_with is not None:
            raise self.failing_with
        return {self.joints[0]: Reading(0.1, 0.0)}

    def torque_off(self, policy):
        self.calls.append(("torque_off", policy))

    def stop(self, policy, within_s=STOP_S):
        self.calls.append(("stop", policy))

    def close(self): ...

    def statistics(self):
        return {"writes": len(self.written)}


class Gate(Steady):
    """A bus whose write waits until somebody opens it: a slow wire, without a stopwatch."""

    def __init__(self):
        super().__init__("slow")
        self.open = threading.Event()
        self.begun = threading.Event()
        self.refuse = False

    def write(self, goals_rad, now_s):
        if self.refuse:
            raise ValueError("goal of slow is not in range")
        self.begun.set()
        self.open.wait(30.0)
        super().write(goals_rad, now_s)

    def poll(self, now_s):
        return {"slow": Reading(0.5, 0.0, rejoined=len(self.written) == 1)}


def test_slow_bus_does_not_hold_up_the_others_and_gets_the_newest_goals():
    slow, fast = Gate(), Steady("fast")
    bus = CompositeBus({"slow": slow, "fast": fast}, ["slow", "fast"], {"slow": 1000.0, "fast": 1000.0})
    goals = np.array([0.0, 0.0])
    bus.write(goals, 0.0)
    assert slow.begun.wait(30.0)
    k = 0
    while len(fast.written) < 5:
        k += 1
        goals[0] = k / 1e6
        bus.write(goals, 0.001 * k)
        readings = bus.poll(0.001 * k)
    assert slow.written == [] and readings["slow"].position_rad is None
    slow.open.set()
    while len(slow.written) < 2:
        bus.write(goals, 0.001 * k)
    bus.stop("release")
    bus.close()
    assert slow.written[0] == (0.0, 0.0)
    assert slow.written[1][0] == goals[0]  # what came in between is forgotten


def test_joint_that_came_back_is_told_once_however_often_its_bus_ticks():
    slow = Gate()
    slow.open.set()
    bus, told = CompositeBus({"slow": slow}, ["slow"], {"slow": 1000.0}), 0
    while len(slow.written) < 5:
        bus.write(np.zeros(1), 0.0)
        told += bus.poll(0.0)["slow"].rejoined
    bus.stop("release")
    bus.close()
    assert told == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_goal_that_is_not_finite_reaches_no_thread(bad):
    slow = Gate()
    slow.open.set()
    bus = CompositeBus({"slow": slow}, ["slow"], {"slow": 1000.0})
    with pytest.raises(ValueError, match="goal of slow is not finite"):
        bus.write(np.array([bad]), 0.0)
    bus.close()
    assert slow.written == []


@pytest.mark.parametrize("rates_hz", [None, {"bad": 1000.0, "good": 1000.0}], ids=["in turn", "threads"])
def test_bus_that_fails_is_said_once_and_the_others_go_on(rates_hz):
    bad, good = Steady("antenna", BusError("nobody has answered for 30 s")), Steady("neck")
    bus = CompositeBus({"bad": bad, "good": good}, ["antenna", "neck"], rates_hz)
    bus.connect()
    bus.enable(["antenna", "neck"])
    said = 0
    for k in range(10_000):
        bus.write(np.zeros(2), 0.001 * k)
        try:
            readings = bus.poll(0.001 * k)
        except BusError:
            said += 1
        if said and k > 20 and readings["neck"].position_rad is not None:
            break
    for k in range(100):
        bus.write(np.zeros(2), 20.0 + 0.001 * k)
        readings = bus.poll(20.0 + 0.001 * k)
    assert said == 1 and readings["antenna"].fault == "bus failed" and readings["neck"].position_rad == 0.1
    bus.torque_off("release")
    bus.stop("release")
    assert bad.calls[0] == ("torque_off", "release") and bad.calls[-1] == ("stop", "release")
    bus.close()


def test_torque_off_reaches_every_bus_before_any_is_asked_to_confirm():
    order, buses = [], {name: Steady(name) for name in ("one", "two", "three")}
    for each in buses.values():
        each.calls = order
    CompositeBus(buses, list(buses)).stop("release")
    assert [call for call, _ in order] == ["torque_off"] * 3 + ["stop"] * 3


def test_stop_does_not_wait_for_a_bus_that_hangs_while_it_confirms():
    stuck, quick, opened, waited = Steady("stuck"), Steady("quick"), threading.Event(), []
    stuck.stop = lambda policy, within_s=STOP_S: waited.append(opened.wait(30.0))
    bus = CompositeBus({"stuck": stuck, "quick": quick}, ["stuck", "quick"], {"stuck": 1000.0, "quick": 1000.0})
    bus.write(np.zeros(2), 0.0)
    bus.stop("release", 0.0)
    assert waited == [] and ("torque_off", "release") in stuck.calls
    opened.set()
    bus.close()


def test_stop_does_not_wait_for_a_bus_that_hangs_in_the_middle_of_a_write():
    slow, quick = Gate(), Steady("quick")
    offs = []
    slow.torque_off = lambda policy: offs.append(slow.open.is_set())
    bus = CompositeBus({"slow": slow, "quick": quick}, ["slow", "quick"], {"slow": 1000.0, "quick": 1000.0})
    bus.write(np.zeros(2), 0.0)
    assert slow.begun.wait(30.0)
    bus.stop("release")
    assert offs == [False]  # sent from this thread, while the writer still hangs
    assert ("stop", "release") in quick.calls
    slow.open.set()
    bus.close()


def test_joints_that_were_left_out_take_goals_and_say_so():
    servo = BusServo(joint="jaw", id=4, table=Table.of(load_firmware_map("xl330-m288")), min_rad=0.2, max_rad=1.0)
    bus = CompositeBus({"out": AbsentBus([servo]), "rest": Steady("neck")}, ["jaw", "neck"])
    bus.connect()
    assert bus.enable(["jaw", "neck"]).tolist() == [0.2, 0.0]
    bus.write(np.array([0.5, 0.0]), 0.0)
    readings = bus.poll(0.0)
    assert readings["jaw"].fault == "left out" and readings["jaw"].position_rad is None
    assert readings["neck"].fault is None
    assert bus.statistics()["faults"] == ["jaw: left out"]
    bus.stop("release")
    bus.close()


def test_unconfirmed_joints_of_all_buses_are_listed_together():
    first, second = rig_of("xl330-m288", [2048, 2048]), Steady("antenna")
    bus = CompositeBus({"first": first.bus, "second": second}, ["joint1", "antenna", "joint2"])
    bus.connect()
    bus.enable(bus.joints)
    first.kill(2)
    bus.stop("release")
    assert bus.statistics()["torque_unconfirmed"] == ["joint2"]
