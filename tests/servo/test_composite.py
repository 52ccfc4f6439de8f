import numpy as np
import pytest

from sfms_robot.errors import BusError
from sfms_robot.servo.composite import CompositeBus
from sfms_robot.simulator.launch import EmulatedServo


def test_two_buses_answer_as_one_in_the_order_of_the_head(make_rig):
    with (
        make_rig([EmulatedServo(1, start_ticks=2000), EmulatedServo(2, start_ticks=2010)]) as one,
        make_rig([EmulatedServo(3, start_ticks=2020)]) as two,
    ):
        joints = ["joint2", "joint3", "joint1"]
        bus = CompositeBus({"one": one.bus, "two": two.bus}, joints)
        bus.connect()
        held = bus.enable(joints)
        assert held == pytest.approx([(t - 2048) * 2 * np.pi / 4096 for t in (2010, 2020, 2000)])
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


def test_joints_must_be_those_of_the_buses(make_rig):
    with make_rig([EmulatedServo(1)]) as rig, pytest.raises(ValueError, match="the head has"):
        CompositeBus({"one": rig.bus}, ["joint1", "joint2"])


def test_bus_that_fails_to_connect_closes_the_others(make_rig):
    with make_rig([EmulatedServo(1)]) as good, make_rig([EmulatedServo(2)], expected=[9]) as bad:
        bus = CompositeBus({"good": good.bus, "bad": bad.bus}, ["joint1", "joint9"])
        with pytest.raises(BusError, match="no answer from id 9"):
            bus.connect()
        good.bus.connect()  # its port is free again
