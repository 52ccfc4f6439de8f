"""One emulated servo, read and written directly: what its registers do."""

import math

import pytest
from emulated_devices import ServoBench
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_firmware_map, map_files
from sfms_robot.servo.codecs import dxl2

MODELS = sorted(file.stem for file in map_files() if load_firmware_map(file.stem).registers)
FAMILIES = ["xl330-m288", "xl-320", "ax-12a", "mx-28-1.0", "sts3215", "scs0009"]


@pytest.mark.parametrize("model", MODELS)
def test_every_model_jumps_to_the_middle_under_torque_and_then_goes_where_it_is_told(model):
    center = load_firmware_map(model).center_ticks
    bench = ServoBench(model, start=center - 150)
    assert bench.after(0.5) == center - 150 and bench.get("model_number") == (bench.table.model_number or 0)
    assert bench.put(torque_enable=1) == 0 and bench.after(3.0) == center
    assert bench.put(goal_position=center + 100) == 0
    assert center < bench.after(0.02) < center + 100 == bench.after(3.0) and bench.servo.fault_status == 0


@pytest.mark.parametrize("model", FAMILIES)
def test_a_loss_of_supply_is_silence_and_then_a_start_without_torque_and_turns(model):
    bench = ServoBench(model)
    turn, center, baud = bench.table.ticks_per_revolution, bench.table.center_ticks, bench.servo.baud
    bench.put(torque_enable=1, goal_position=center + 50)
    supply_v = bench.servo.supply_v
    bench.servo.set_supply(1.0, 0.1)
    assert not bench.servo.hears(baud, 0.2) and not bench.servo.state(0.2)["torque"]
    bench.servo.turn(2 * turn + 700, 0.2)
    bench.servo.set_supply(supply_v, 0.3)
    assert bench.servo.hears(baud, 0.35) is (bench.table.protocol == 1) and bench.servo.hears(baud, 0.7)
    bench.t = 1.0
    assert (bench.get("torque_enable"), bench.get("goal_position")) == (0, center)
    assert bench.get("present_position") == 700 and bench.servo.state(1.0)["position"] == pytest.approx(700)


STORED = {
    "xl330-m288": {"homing_offset": 500},
    "ax-12a": {"return_delay_time": 7},
    "mx-28-1.0": {"ccw_angle_limit": 3000},
    "sts3215": {"homing_offset": -30},
    "scs0009": {"max_position_limit": 900},
}


@pytest.mark.parametrize("model", STORED)
def test_stored_values_and_the_supply_are_there_at_the_start(model):
    bench = ServoBench(model, supply_v=20.0, **STORED[model])
    assert {name: bench.get(name) for name in STORED[model]} == STORED[model] and bench.get("voltage") == 200
    assert bench.get("present_position") == bench.table.center_ticks  # a homing offset counted in
    assert "voltage" in bench.servo.state(0.0)["faults"]


@given(st.sampled_from(FAMILIES), st.integers(0, 255), st.binary(min_size=1, max_size=12))
def test_any_write_is_survived(model, address, data):
    servo = ServoBench(model).servo
    servo.write(address, data, 0.0)
    servo.advance(0.2)
    servo.read(0, 60, 0.3)


@pytest.mark.parametrize(("firmware", "first_data"), [(52, 208), (53, 224)])
def test_indirect_data_show_what_their_addresses_say(firmware, first_data):
    bench = ServoBench(firmware=firmware, start=2100)
    assert bench.table["indirect_data_1"].address == first_data
    # Present position, whose four bytes start at 132, then the temperature at 146.
    bench.put(**{f"indirect_address_{k + 1}": address for k, address in enumerate([132, 133, 134, 135, 146])})
    error, data = bench.servo.read(first_data, 5, bench.t)
    assert (error, data) == (0, (2100).to_bytes(4, "little") + bytes([31]))


def test_a_homing_offset_shifts_and_reverse_mode_mirrors_the_position():
    bench = ServoBench(start=2048, homing_offset=1024)
    assert bench.servo.plant.position == 1024 and bench.get("present_position") == 2048
    bench.put(torque_enable=1, goal_position=2500)
    assert bench.after(2.0) == 2500 and bench.servo.plant.position == 2500 - 1024
    bench = ServoBench(start=2500, drive_mode=1)
    assert bench.servo.plant.position == 4096 - 2500
    bench.put(torque_enable=1, goal_position=2600)
    assert bench.after(0.05, "present_velocity") > 0
    assert bench.after(2.0) == 2600 and bench.servo.plant.position == 4096 - 2600


def test_velocity_mode_turns_at_the_goal_velocity_and_keeps_the_profile_acceleration():
    bench = ServoBench(operating_mode=1)
    bench.put(torque_enable=1, goal_velocity=100)
    start = bench.after(1.0)
    turned = bench.after(1.0) - start
    assert turned == pytest.approx(100 * 0.229 * 4096 / 60, rel=0.01)
    assert bench.after(0.0, "present_velocity") == 100
    bench.put(goal_velocity=0)
    assert bench.after(1.0, "present_velocity") == 0
    bench = ServoBench(operating_mode=1)
    bench.put(torque_enable=1, profile_acceleration=10, goal_velocity=200)
    rev_per_min2 = 10 * 214.577
    assert bench.after(1.0, "present_velocity") * 0.229 == pytest.approx(rev_per_min2 / 60, rel=0.1)


@pytest.mark.parametrize(("mode", "goal"), [(16, {"goal_pwm": 442}), (0, {"goal_current": 875})])
def test_pwm_and_current_modes_turn_the_motor_with_about_half_its_strength(mode, goal):
    bench = ServoBench(operating_mode=mode)
    bench.put(torque_enable=1, **goal)
    speed_rpm = bench.after(2.0, "present_velocity") * 0.229
    assert speed_rpm == pytest.approx(103 / 2, rel=0.05)


def test_extended_mode_goes_past_a_turn_and_position_mode_does_not():
    bench = ServoBench(operating_mode=4)
    bench.put(torque_enable=1)
    assert bench.put(goal_position=9000) == 0 and bench.after(5.0) == 9000
    assert ServoBench().put(goal_position=9000) == dxl2.DATA_LIMIT_ERROR


def test_current_based_position_mode_gives_way_where_position_mode_overloads():
    weak, strong = ServoBench(operating_mode=5), ServoBench()
    weak.put(goal_current=200)
    for bench in (weak, strong):
        bench.servo.plant.stuck = True
        bench.put(torque_enable=1, goal_position=3000)
        bench.t = 3.0
    assert weak.get("present_current") == pytest.approx(1200 * 200 / 1750, rel=0.1)
    assert weak.get("hardware_error_status") == 0 and weak.get("torque_enable") == 1
    assert strong.get("hardware_error_status") == 1 << 5 and strong.get("torque_enable") == 0


def test_a_goal_brings_torque_where_the_drive_mode_says_so_and_a_new_mode_resets_goals():
    bench = ServoBench(drive_mode=8)
    bench.put(goal_position=2100)
    assert bench.get("torque_enable") == 1 and bench.after(1.0) == 2100
    bench = ServoBench(start=2300)
    bench.put(goal_position=3000, profile_velocity=50, operating_mode=4)
    assert (bench.get("goal_position"), bench.get("profile_velocity")) == (2300, 0)


@pytest.mark.parametrize(
    ("limit", "value", "goal"),
    [("velocity_limit", 100, "goal_velocity"), ("pwm_limit", 400, "goal_pwm"), ("current_limit", 500, "goal_current")],
)
def test_goals_stay_below_their_limit_registers(limit, value, goal):
    bench = ServoBench()
    bench.put(**{limit: value})
    assert bench.put(**{goal: value}) == 0 and bench.put(**{goal: value + 1}) == dxl2.DATA_LIMIT_ERROR


def test_supply_outside_the_limits_raises_the_alert_for_good():
    bench = ServoBench(supply_v=7.2, shutdown=52)
    assert bench.get("present_input_voltage") == 72 and bench.get("hardware_error_status") == 1
    bench.servo.power_cycle(0.0)
    bench.t = 1.0
    assert bench.get("hardware_error_status") == 1
    assert bench.put(torque_enable=1) == 0  # 52 leaves the voltage out, 53 does not
    assert ServoBench(supply_v=7.2).put(torque_enable=1) == dxl2.ACCESS_ERROR


@pytest.mark.parametrize(("firmware", "moves_on"), [(51, True), (53, False)])
def test_watchdog_of_old_firmware_only_raises_its_flag(firmware, moves_on):
    bench = ServoBench(firmware=firmware, start=2000)
    bench.put(profile_velocity=20, goal_position=2000, torque_enable=1, bus_watchdog=5)
    bench.put(goal_position=3000)
    assert (bench.after(20.0) == 3000) == moves_on
    assert bench.get("bus_watchdog") == -1 and bench.put(goal_position=2500) == dxl2.DATA_RANGE_ERROR


def test_load_hangs_a_little_below_the_goal_and_takes_current():
    bench = ServoBench()
    bench.put(goal_position=2048, torque_enable=1)
    bench.servo.plant.load = 0.2
    assert 1 <= 2048 - bench.after(2.0) <= 40 and bench.get("present_current") == pytest.approx(240, abs=10)


def test_held_load_makes_it_warm_and_too_much_overheats_it():
    bench = ServoBench(shutdown=4)
    bench.put(goal_position=2048, torque_enable=1)
    bench.servo.plant.load = 0.8
    warm = bench.after(5.0, "present_temperature")
    assert 33 < warm < 70
    bench.t = 120.0
    assert bench.get("hardware_error_status") & 1 << 2 and bench.get("torque_enable") == 0


def test_indirect_data_write_through():
    bench = ServoBench()
    bench.put(indirect_address_1=65, indirect_address_2=84, indirect_address_3=85)
    assert bench.servo.write(bench.table["indirect_data_1"].address, bytes([1, 0xBC, 2]), 0.0) == 0
    assert (bench.get("led"), bench.get("position_p_gain")) == (1, 0x2BC)
    # Half a register is refused, and then nothing at all is changed.
    bench.put(indirect_address_3=86)
    assert bench.servo.write(bench.table["indirect_data_1"].address, bytes([0, 1, 1]), 0.0) != 0
    assert bench.get("led") == 1


def test_position_stays_finite_at_the_ends_of_every_range():
    bench = ServoBench(operating_mode=4)
    bench.put(torque_enable=1, profile_velocity=32767, profile_acceleration=32767, goal_position=-1048575)
    for _ in range(20):
        assert math.isfinite(bench.after(1.0))
