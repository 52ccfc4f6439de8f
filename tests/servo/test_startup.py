"""Startup: who is absent stops nobody, and what a unit has stored against its head's file keeps its torque off."""

import pytest
from chain_rig import ServoRig, limits_of
from emulated_devices import device_of
from emulated_port import LossyPort, Straight, bus_servo, startups_on, switched_on
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import Faults, Safety, load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import BusError, ServoError
from sfms_robot.servo.chain.link import finish
from sfms_robot.servo.chain.startup import PATIENCE_S, needs_of
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import JointNeeds, contradictions, offset_ticks

LIMIT_RAD = 0.9
MODELS = ("xl330-m288", "mx-28-2.0", "xl-320", "ax-12a", "mx-28-1.0", "sts3215", "scs0009")
WITH_TURNS = ("xl330-m288", "mx-28-2.0")


class Rig(ServoRig):
    """A few servos of one model, and the startup of a bus that wants ids 1, 2, ..."""

    def __init__(self, model, *rows, limit_rad=LIMIT_RAD, ratio=1.0, wanted=None, stored=None, safety=None):
        firmware_map = load_firmware_map(model)
        self.table = Table.of(firmware_map)
        usual = {"model": model, "start_ticks": self.table.center_ticks}
        there = [EmulatedServo(**{"id": i, **usual, **row}) for i, row in enumerate(rows or ({},), 1)]
        self.port = LossyPort(device_of(*there))
        servos = [
            bus_servo(f"joint{i}", i, firmware_map, limit_rad, safety=safety or Safety(stored=stored or {}))
            for i in wanted or range(1, 1 + len(there))
        ]
        conversion = Straight(self.table, ratio=ratio)
        self.needs = needs_of(servos, conversion, Faults())
        self.startups, self.start_up = startups_on(self.port, servos, conversion)

    def held(self, name, servo=1):
        return self.register(servo, name)

    def values(self):
        """All registers, as doctor reads them."""
        return {name: self.held(name) for name in self.table.fields}

    def found(self):
        return {each.register: each for each in contradictions(self.values(), self.table, self.needs[0])}


@pytest.mark.parametrize("model", MODELS)
def test_absent_servos_do_not_stop_the_others(model):
    rig = Rig(model, {"id": 1}, {"id": 3}, wanted=[1, 2, 3, 4])
    assert rig.start_up() == {0: 0, 2: 0} and switched_on(rig.startups[2]) == rig.table.center_ticks
    assert [rig.held("torque_enable", i) for i in (1, 3)] == [0, 1]
    assert rig.clock.t < 2 * 3 * 2 * PATIENCE_S  # two absent, three pings each, with room for the others


@pytest.mark.parametrize("model", MODELS)
@given(fate=st.lists(st.sampled_from(["", "", "", "request", "answer"]), max_size=60))
def test_torque_is_on_only_where_the_servo_stands_whatever_is_lost(model, fate):
    rig = Rig(model, {"id": 1, "start_ticks": 500})
    rig.port.fate = iter(fate)
    try:
        rig.start_up()
        assert switched_on(rig.startups[0]) == 500
    except (BusError, ServoError):
        assert set(fate) - {""}
    if rig.held("torque_enable"):
        assert rig.held("goal_position") == 500
    assert rig.servo(1).state(rig.clock.t)["position"] == pytest.approx(500, abs=1)


@pytest.mark.parametrize("model", MODELS)
@given(data=st.data())
def test_a_unit_is_refused_exactly_when_a_goal_of_its_joint_lies_outside_its_limits(model, data):
    table = Table.of(load_firmware_map(model))
    names = limits_of(table)
    ends = sorted(data.draw(st.lists(st.integers(0, table[names[1]].high), min_size=2, max_size=2, unique=True)))
    rig = Rig(model, {"registers": dict(zip(names, ends, strict=True))})
    reached = ends[0] <= rig.needs[0].low_ticks and rig.needs[0].high_ticks <= ends[1]
    if reached:
        rig.start_up()
    else:
        with pytest.raises(ServoError, match="position_limit|angle_limit"):
            rig.start_up()
    for each in rig.found().values():  # what is proposed mends it
        rig = Rig(model, {"registers": rig.values() | {each.register: each.wanted}})
        assert each.register not in rig.found()


MOVES_WRONGLY = [  # model, register, stored, declared (None: nothing), what is wrong
    ("xl330-m288", "homing_offset", 100, 612, "every angle would be -45.0 deg off"),
    ("xl330-m288", "homing_offset", 512, None, "every angle would be +45.0 deg off"),
    ("sts3215", "homing_offset", 100, 612, "every angle would be +45.0 deg off"),
    ("sts3215", "homing_offset", -512, None, "every angle would be +45.0 deg off"),
    ("mx-28-1.0", "multi_turn_offset", 512, None, "every angle would be +45.0 deg off"),
    ("xl330-m288", "drive_mode", 1, 0, "the joint would move the other way"),
    ("xl330-m288", "drive_mode", 5, None, "the joint would move the other way"),
    ("mx-28-2.0", "drive_mode", 0, 1, "the joint would move the other way"),
    ("sts3215", "phase", 13, None, "the joint would move the other way"),
    ("scs0009", "phase", 128, None, "the joint would move the other way"),
]


@pytest.mark.parametrize(("model", "name", "now", "said", "why"), MOVES_WRONGLY)
def test_what_would_move_a_joint_wrongly_is_refused_until_the_file_declares_it(model, name, now, said, why):
    declared = {} if said is None else {name: said}
    rig = Rig(model, {"registers": {name: now}}, stored=declared)
    with pytest.raises(ServoError, match=rf"servo 1 \(joint1\): {name} is {now}, wanted .* doctor --port") as refused:
        rig.start_up()
    assert why in str(refused.value)
    assert rig.found()[name].in_file and rig.held("torque_enable") == 0 and rig.held(name) == now
    Rig(model, {"registers": {name: now}}, stored={name: now}).start_up()


def test_an_sts_offset_counts_with_its_own_sign():
    """Sign and magnitude, and subtracted from what the encoder reads: every second raw value, against the emulator."""
    rig = Rig("sts3215", {"registers": {"lock": 0}})
    field, turn = rig.table["homing_offset"], rig.table.ticks_per_revolution
    assert rig.held("present_position") == 2048
    for raw in range(0, 4096, 2):
        rig.servo(1).write(field.address, raw.to_bytes(2, "little"), 0.0)
        stored = rig.held("homing_offset")
        assert stored == (2048 - raw if raw > 2048 else raw % 2048)
        shown = rig.held("present_position") - 2048
        assert (shown - offset_ticks(rig.table, stored)) % turn == 0
        if stored:
            degrees = offset_ticks(rig.table, stored) * 360 / turn
            assert f"every angle would be {degrees:+.1f} deg off" in rig.found()["homing_offset"].why


@pytest.mark.parametrize(("shaft", "offset"), [(500, 1000), (3900, -1000)])
def test_the_one_turn_of_an_sts_that_counts_turns_is_shifted_by_its_offset_with_its_own_sign(shaft, offset):
    table = Table.of(load_firmware_map("sts3215"))
    values = {"present_position": shaft - offset, "homing_offset": offset, "phase": 28}
    assert contradictions(values, table, JointNeeds(1462, 2634, stored={"homing_offset": offset})) == []


def test_a_secondary_id_that_is_another_servo_of_the_head_is_refused():
    rig = Rig("xl330-m288", {"id": 1, "registers": {"secondary_id": 2}}, {"id": 2})
    with pytest.raises(ServoError, match="secondary_id is 2, wanted 255: it would follow the goals of id 2 too"):
        rig.start_up()
    rig = Rig("xl330-m288", {"id": 1, "registers": {"secondary_id": 77}})
    rig.start_up()
    assert rig.found()["secondary_id"].then == "told"


@pytest.mark.parametrize("model", MODELS)
def test_a_servo_as_it_leaves_the_factory_contradicts_nothing(model):
    rig = Rig(model)
    assert [each for each in rig.found().values() if each.then != "set"] == []
    rig.start_up()
    assert rig.found() == {}


@pytest.mark.parametrize("model", WITH_TURNS)
@pytest.mark.parametrize("found", [4150, -100, 9000])
def test_a_joint_turned_by_hand_past_one_turn_starts_where_it_stands(model, found):
    rig = Rig(model, {"start_ticks": found})
    rig.start_up()
    assert switched_on(rig.startups[0]) == found % 4096 and rig.held("torque_enable") == 1
    assert rig.servo(1).state(rig.clock.t + 1.0)["position"] == found % 4096


def test_turns_are_not_cleared_under_torque():
    rig = Rig("xl330-m288", {"start_ticks": 4150, "registers": {"operating_mode": 4}})
    servo = rig.servo(1)
    for name, value in (("goal_position", 4150), ("torque_enable", 1)):
        servo.write(rig.table[name].address, rig.table[name].to_bytes(value), 0.0)
    with pytest.raises(ServoError, match="present_position is 4150, wanted 54: it was turned past one turn"):
        rig.start_up()
    assert servo.state(rig.clock.t)["torque"]


def test_a_servo_that_cannot_forget_its_turns_is_refused_with_the_way_out():
    rig = Rig("sts3215")
    (found,) = contradictions({"present_position": 5000}, rig.table, rig.needs[0])
    assert (found.then, found.wanted, found.fixable) == ("refused", 904, False)
    assert "turn it back by hand, or switch its supply off and on" in str(found)


def test_an_offset_shifts_the_one_turn_that_there_is():
    """Of a servo with a homing offset of a quarter turn, readings up to 5119 are no turn too many."""
    rig = Rig("xl330-m288", {"start_ticks": 5000, "registers": {"homing_offset": 1024}}, stored={"homing_offset": 1024})
    rig.start_up()
    assert rig.servo(1).state(rig.clock.t)["position"] == 5000


GEARED = {"ratio": 4.0, "limit_rad": 1.2}  # 2048 +- 3129 ticks


@pytest.mark.parametrize("model", WITH_TURNS)
def test_a_geared_joint_works_in_extended_position_control(model):
    rig = Rig(model, **GEARED)
    rig.start_up()
    assert rig.held("operating_mode") == 4 and rig.startups[0].wanted()["operating_mode"] == 4
    switched_on(rig.startups[0])
    servo, goal = rig.servo(1), rig.table["goal_position"]
    assert servo.write(goal.address, goal.to_bytes(5000), rig.clock.t) == 0
    assert servo.state(rig.clock.t + 60.0)["position"] == pytest.approx(5000, abs=2)


@given(ticks=st.integers(-1081, 5177))
def test_torque_comes_on_only_where_the_lost_count_of_turns_leaves_one_place(ticks):
    """After power-up a servo reads its place within one turn: of all places it may be at, none other is in range."""
    read = ticks % 4096
    rig = Rig("xl330-m288", {"start_ticks": read}, **GEARED)
    places = [read + turn * 4096 for turn in (-2, -1, 0, 1, 2)]
    if [each for each in places if -1081 <= each <= 5177] == [read] == [ticks]:
        rig.start_up()
        assert switched_on(rig.startups[0]) == ticks
    else:
        with pytest.raises(ServoError, match="turns is lost.*by hand to where it will read 1082..3014"):
            rig.start_up()
        assert not rig.servo(1).state(rig.clock.t)["torque"]


def test_a_geared_joint_that_kept_its_torque_kept_its_count():
    rig = Rig("xl330-m288", **GEARED)
    rig.start_up()
    switched_on(rig.startups[0])
    servo, goal = rig.servo(1), rig.table["goal_position"]
    servo.write(goal.address, goal.to_bytes(5000), rig.clock.t)
    servo.advance(60.0)
    rig.clock.t = 60.0
    assert rig.start_up() == {0: 0}
    assert finish(rig.startups[0].bring_back(reboot=False)) == pytest.approx(5000, abs=2)


def test_a_trip_of_the_watchdog_that_was_left_over_is_cleared():
    rig = Rig("xl330-m288")
    rig.set(1, "torque_enable", 1)
    rig.set(1, "bus_watchdog", 5)
    rig.clock.t += 1.0
    assert rig.held("bus_watchdog") == -1
    rig.start_up()
    switched_on(rig.startups[0])
    assert rig.held("bus_watchdog") == 0 and rig.held("torque_enable") == 1


def test_a_register_above_those_that_are_polled_is_written_too():
    """XL-320: punch lies behind everything that tells the present."""
    rig = Rig("xl-320", safety=Safety(registers={"punch": 40}))
    rig.start_up()
    assert rig.held("punch") == 40


@pytest.mark.parametrize("model", MODELS)
def test_what_is_wanted_is_in_force_after_startup(model):
    rig = Rig(model, safety=Safety(torque_limit_percent=50))
    rig.start_up()
    switched_on(rig.startups[0])
    wanted = rig.startups[0].wanted()
    assert wanted and {name: rig.held(name) for name in wanted} == dict(wanted)
