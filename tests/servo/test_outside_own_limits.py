"""Servos found outside their own stored limits, as those of a sagged head, come in gently or stay without torque."""

import math

import pytest
from chain_rig import ServoRig, limits_of, plugged
from emulated_devices import device_of, servos_of
from emulated_port import LossyPort, Straight, bus_servo, startups_on, switched_on
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import NOTE, BusError, ServoError
from sfms_robot.servo.chain.link import Silent, finish
from sfms_robot.servo.chain.startup import SPEED_DEG_S, way_inside
from sfms_robot.servo.registers import Table

MODELS = ("xl330-m288", "mx-28-2.0", "xl-320", "ax-12a", "mx-28-1.0", "sts3215", "scs0009")
LIMIT_DEG, LOW_DEG = 40.0, 45.0  # of the joint; stored in the servo
BY_TIME = 0x04  # drive mode


class Rig(ServoRig):
    """One servo that stands `outside_deg` beyond an end of what it has stored (below 0: the lower one)."""

    def __init__(self, model, outside_deg, registers=None):
        firmware_map = load_firmware_map(model)
        self.table = table = Table.of(firmware_map)
        self.deg = 360.0 / table.ticks_per_revolution
        self.limits = tuple(round(table.center_ticks + end / self.deg) for end in (-LOW_DEG, LOW_DEG))
        end, sign = (self.limits[0], -1) if outside_deg < 0 else (self.limits[1], 1)
        self.start = end + sign * max(1, round(abs(outside_deg) / self.deg))
        stored = dict(zip(limits_of(table), self.limits, strict=True)) | (registers or {})
        (there,) = servos_of(model, 1, start_ticks=self.start, registers=stored)
        self.port = LossyPort(device_of(there))
        self.leg = self.servo(1)
        self.fastest_deg_s, self.goals = 0.0, []
        self.port.write = self._watched(self.port.write)
        servos = [bus_servo("leg", 1, firmware_map, LIMIT_DEG * 6.283185307179586 / 360.0)]
        self.startups, self.start_up = startups_on(self.port, servos, Straight(table))

    def _watched(self, write):
        def watched(data):
            write(data)
            state = self.leg.state(self.clock.t)
            self.fastest_deg_s = max(self.fastest_deg_s, abs(state["speed"]) * self.deg)
            if state["torque"]:
                self.goals.append(state["goal"])

        return watched

    def held(self, name):
        return self.register(1, name)

    def on_the_way(self):
        """The steps of a startup that has its servo moving by now."""
        self.start_up()
        steps = self.startups[0].torque_on()
        while not (self.state(1)["torque"] and self.state(1)["speed"]):
            self.clock.t += next(steps)
        return steps

    def inside(self, ticks):
        return self.limits[0] <= round(ticks) <= self.limits[1]

    def usual_profile(self):
        wanted = self.startups[0].wanted()
        return {name: self.held(name) for name in wanted} == dict(wanted)


PROFILES = [(model, {}) for model in MODELS] + [
    (model, {"drive_mode": BY_TIME}) for model in ("xl330-m288", "mx-28-2.0")
]


@pytest.mark.parametrize("outside_deg", [-12.0, -0.3, 0.3, 12.0])
@pytest.mark.parametrize(("model", "registers"), PROFILES)
def test_it_comes_inside_slowly_and_is_held_there_with_its_usual_profile(model, registers, outside_deg):
    rig = Rig(model, outside_deg, registers)
    rig.start_up()
    held = switched_on(rig.startups[0])
    assert rig.inside(held) and rig.held("torque_enable") == 1 and rig.held("goal_position") == held
    assert rig.usual_profile() and all(rig.inside(goal) for goal in rig.goals)
    assert 0.0 < rig.fastest_deg_s < 1.15 * SPEED_DEG_S and rig.state(1)["position"] == pytest.approx(held, abs=2)
    rig.clock.t += 1.0
    assert rig.state(1)["position"] == pytest.approx(held, abs=2)


@pytest.mark.parametrize("model", MODELS)
@given(fate=st.lists(st.sampled_from(["", "", "", "", "request", "answer"]), max_size=120))
def test_whatever_is_lost_it_never_goes_faster_or_further_out(model, fate):
    rig = Rig(model, -5.0)
    rig.port.fate = iter(fate)
    try:
        rig.start_up()
        held = switched_on(rig.startups[0])
        assert rig.inside(held) and rig.usual_profile()
    except (BusError, ServoError):
        assert set(fate) - {""}
    assert all(rig.inside(goal) for goal in rig.goals) and rig.fastest_deg_s < 1.15 * SPEED_DEG_S
    rig.port.fate, rig.clock.t = iter(()), rig.clock.t + 0.3
    rig.start_up()  # by now perhaps inside, perhaps lost half way
    assert rig.inside(switched_on(rig.startups[0])) and rig.usual_profile()
    assert rig.fastest_deg_s < 1.15 * SPEED_DEG_S


@pytest.mark.parametrize("model", MODELS)
def test_one_that_does_not_come_is_let_go_and_named(model):
    rig = Rig(model, 12.0)
    rig.start_up()
    rig.leg.plant.stuck = True
    low, high = rig.limits
    expected = rf"leg \(id 1\) stands at {rig.start}, outside its own limits {low}\.\.{high}.*torque is off"
    with pytest.raises(ServoError, match=expected):
        switched_on(rig.startups[0])
    assert not rig.state(1)["torque"] and rig.clock.t < 5.0 and rig.usual_profile()


@pytest.mark.parametrize("model", MODELS)
def test_whoever_takes_the_torque_meanwhile_ends_it(model):
    rig = Rig(model, -12.0)
    steps, torque = rig.on_the_way(), rig.table.role("torque_enable")
    rig.leg.write(torque.address, torque.to_bytes(0), rig.clock.t)
    with pytest.raises(ServoError, match="leg"):
        finish(steps, lambda duration_s: rig.port.wait_until(rig.clock.t + duration_s))
    assert not rig.state(1)["torque"] and not rig.inside(rig.state(1)["position"])


@pytest.mark.parametrize("model", MODELS)
def test_a_job_that_is_dropped_half_way_leaves_torque_off(model):
    rig = Rig(model, -12.0)
    rig.on_the_way().close()
    assert not rig.state(1)["torque"]


@pytest.mark.parametrize("model", MODELS)
def test_one_that_was_lost_sight_of_half_way_is_let_go_before_its_profile_is_made_usual(model):
    rig = Rig(model, -30.0)
    steps = rig.on_the_way()
    rig.port.fate = iter(["request"] * 40)
    with pytest.raises(Silent):
        finish(steps)
    rig.port.fate = iter(())
    assert rig.state(1)["torque"]  # nobody could tell it
    rig.start_up()
    assert not rig.state(1)["torque"] and rig.fastest_deg_s < 1.15 * SPEED_DEG_S
    assert rig.inside(switched_on(rig.startups[0])) and rig.fastest_deg_s < 1.15 * SPEED_DEG_S


@given(low=st.integers(0, 4000), width=st.integers(1, 4095), present=st.integers(0, 4095))
def test_the_way_inside_is_the_short_one_or_none(low, width, present):
    high = min(4095, low + width)
    if low <= present <= high:
        return
    way = way_inside(present, (low, high), 4096.0)
    to_low, to_high = (low - present) % 4096, (present - high) % 4096  # round the circle
    if way is None:
        assert (min(to_low, to_high), present < low) in ((to_low, False), (to_high, True)) or to_low == to_high
    else:
        assert low <= way.goal_ticks <= high
        assert (to_low <= to_high) if present < low else (to_high <= to_low)


def test_one_that_would_go_round_the_other_side_is_refused():
    """It hangs 5 degrees below its lower limit, past the end of the turn, and so reads high up."""
    table = Table.of(load_firmware_map("sts3215"))
    rig = Rig("sts3215", 45.0, {"min_position_limit": 20, "max_position_limit": 3000})
    rig.leg.turn(4060, 0.0)
    rig.limits = (20, 3000)
    assert table.center_ticks == 2048
    with pytest.raises(ServoError, match=r"stands at 4060, outside its own limits 20\.\.3000.*turn it in by hand"):
        rig.start_up()
        switched_on(rig.startups[0])
    assert not rig.state(1)["torque"]


STORED = {"min_position_limit": 1300, "max_position_limit": 2800}
SAGGED = 1200


def sagged():
    return plugged([EmulatedServo(1, start_ticks=2048), EmulatedServo(2, start_ticks=SAGGED, registers=STORED)])


def test_torque_off_from_outside_ends_enable_with_torque_off():
    rig = sagged()
    rig.bus.connect()
    plain = rig.clock.wait_until

    def wait_until(time_s):
        plain(time_s)
        if rig.clock.t > 0.3:
            rig.bus.torque_off("release")

    rig.clock.wait_until = wait_until
    with pytest.raises(BusError, match="torque off was requested while joint2 was being enabled"):
        rig.bus.enable(rig.bus.joints)
    rig.bus.stop("release")
    assert not any(rig.state(i)["torque"] for i in (1, 2))
    assert rig.state(2)["position"] < STORED["min_position_limit"]


def test_one_that_comes_back_outside_is_brought_in_beside_the_running_bus():
    rig = sagged()
    held = rig.hold()
    rig.supply(0.0)
    rig.ticks(held, 60)
    rig.servo(2).turn(SAGGED, rig.clock.t)
    rig.supply(5.0)
    _, readings = rig.until(held, lambda each: each["joint2"].rejoined, 8.0)
    assert rig.state(2)["position"] >= STORED["min_position_limit"]


def test_a_joint_outside_the_limits_of_the_head_is_told_with_its_angle_and_what_to_do(caplog):
    caplog.set_level(NOTE)
    held = plugged([EmulatedServo(1, start_ticks=4000)]).hold()
    (line,) = caplog.messages
    assert f"joint1 (id 1) stands at {math.degrees(held[0]):.1f} deg, outside its limits " in line
    assert "is moved back slowly" in line and "head calibrate" in line and "\n" not in line
