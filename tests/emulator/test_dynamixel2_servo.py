"""One emulated servo, asked directly: what its registers do."""

import math

import pytest

from sfms_robot.config import load_firmware_map, map_files, variant
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.emulator.servo_chains import Dynamixel2Servo
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.registers import Table


class Bench:
    """A servo and the time."""

    def __init__(self, model="xl330-m288", firmware=53, start=2048, supply_v=None, **registers):
        self.table = Table.of(variant(model, firmware))
        self.servo = Dynamixel2Servo(
            EmulatedServo(1, model, 1_000_000, start, firmware=firmware, registers=registers, supply_v=supply_v),
            self.table,
        )
        self.t = 0.0

    def put(self, **values):
        """Write registers; the last error."""
        for name, value in values.items():
            field = self.table[name]
            error = self.servo.write(field.address, field.to_bytes(value), self.t)
            self.servo.feed_watchdog(self.t)
        return error

    def get(self, name):
        field = self.table[name]
        error, data = self.servo.read(field.address, field.size, self.t)
        assert error == 0
        return field.from_bytes(data)

    def after(self, seconds, name="present_position"):
        self.t += seconds
        return self.get(name)


PROTOCOL_2 = sorted(file.stem for file in map_files() if load_firmware_map(file.stem).protocol == 2)


@pytest.mark.parametrize("model", PROTOCOL_2)
def test_every_shipped_model_stands_still_and_moves_when_told(model):
    table = Table.of(load_firmware_map(model))
    baud = max(table.baud_codes.values())
    servo = Dynamixel2Servo(EmulatedServo(1, model, baud, table.center_ticks, firmware=table.firmware[1]), table)
    present, goal, torque = (table.role(r) for r in ("present_position", "goal_position", "torque_enable"))
    assert servo.read(0, table.size, 0.5) == (0, servo.read(0, table.size, 0.5)[1])
    assert present.from_bytes(servo.read(present.address, present.size, 1.0)[1]) == table.center_ticks
    assert servo.write(torque.address, torque.to_bytes(1), 1.0) == 0
    assert servo.write(goal.address, goal.to_bytes(table.center_ticks + 100), 1.0) == 0
    assert present.from_bytes(servo.read(present.address, present.size, 3.0)[1]) == table.center_ticks + 100
    assert servo.fault_status == 0


@pytest.mark.parametrize(("firmware", "first_data"), [(52, 208), (53, 224)])
def test_indirect_data_show_what_their_addresses_say(firmware, first_data):
    bench = Bench(firmware=firmware, start=2100)
    assert bench.table["indirect_data_1"].address == first_data
    # Present position, whose four bytes start at 132, then the temperature at 146.
    bench.put(**{f"indirect_address_{k + 1}": address for k, address in enumerate([132, 133, 134, 135, 146])})
    error, data = bench.servo.read(first_data, 5, bench.t)
    assert (error, data) == (0, (2100).to_bytes(4, "little") + bytes([31]))


def test_indirect_data_write_through():
    bench = Bench()
    bench.put(indirect_address_1=65, indirect_address_2=84, indirect_address_3=85)
    assert bench.servo.write(bench.table["indirect_data_1"].address, bytes([1, 0xBC, 2]), 0.0) == 0
    assert (bench.get("led"), bench.get("position_p_gain")) == (1, 0x2BC)
    # Half a register is refused, and then nothing at all is changed.
    bench.put(indirect_address_3=86)
    assert bench.servo.write(bench.table["indirect_data_1"].address, bytes([0, 1, 1]), 0.0) != 0
    assert bench.get("led") == 1


def test_homing_offset_shifts_what_the_servo_tells_and_is_told():
    bench = Bench(start=2048, homing_offset=1024)
    assert bench.servo.plant.position == 1024 and bench.get("present_position") == 2048
    bench.put(torque_enable=1, goal_position=2500)
    assert bench.after(2.0) == 2500 and bench.servo.plant.position == 2500 - 1024


def test_reverse_mode_mirrors_the_position_but_not_the_offset():
    bench = Bench(start=2500, drive_mode=1)
    assert bench.servo.plant.position == 4096 - 2500
    bench.put(torque_enable=1, goal_position=2600)
    assert bench.after(0.05, "present_velocity") > 0
    assert bench.after(2.0) == 2600 and bench.servo.plant.position == 4096 - 2600


def test_velocity_mode_turns_at_the_goal_velocity():
    bench = Bench(operating_mode=1)
    bench.put(torque_enable=1, goal_velocity=100)
    start = bench.after(1.0)
    turned = bench.after(1.0) - start
    assert turned == pytest.approx(100 * 0.229 * 4096 / 60, rel=0.01)
    assert bench.after(0.0, "present_velocity") == 100
    bench.put(goal_velocity=0)
    assert bench.after(1.0, "present_velocity") == 0


def test_velocity_mode_keeps_the_profile_acceleration():
    bench = Bench(operating_mode=1)
    bench.put(torque_enable=1, profile_acceleration=10, goal_velocity=200)
    rev_per_min2 = 10 * 214.577
    assert bench.after(1.0, "present_velocity") * 0.229 == pytest.approx(rev_per_min2 / 60, rel=0.1)


@pytest.mark.parametrize(("mode", "goal"), [(16, {"goal_pwm": 442}), (0, {"goal_current": 875})])
def test_pwm_and_current_modes_turn_the_motor_with_about_half_its_strength(mode, goal):
    bench = Bench(operating_mode=mode)
    bench.put(torque_enable=1, **goal)
    speed_rpm = bench.after(2.0, "present_velocity") * 0.229
    assert speed_rpm == pytest.approx(103 / 2, rel=0.05)


def test_extended_mode_goes_past_a_turn_and_position_mode_does_not():
    bench = Bench(operating_mode=4)
    bench.put(torque_enable=1)
    assert bench.put(goal_position=9000) == 0
    assert bench.after(5.0) == 9000
    assert Bench().put(goal_position=9000) == dxl2.DATA_LIMIT_ERROR


def test_turns_are_forgotten_by_clear_and_by_reboot():
    bench = Bench(operating_mode=4, start=9000)
    assert bench.servo.clear(b"\x01\x44\x58\x4c\x22", 0.0) == 0
    assert bench.get("present_position") == 9000 - 2 * 4096
    assert bench.servo.clear(b"\x01\x00\x00\x00\x00", 0.0) == dxl2.DATA_RANGE_ERROR
    bench = Bench(operating_mode=4, start=9000)
    bench.servo.power_cycle(0.0)
    assert bench.after(1.0) == 9000 - 2 * 4096


def test_current_based_position_mode_gives_way_where_position_mode_overloads():
    weak, strong = Bench(operating_mode=5), Bench()
    weak.put(goal_current=200)
    for bench in (weak, strong):
        bench.servo.plant.stuck = True
        bench.put(torque_enable=1, goal_position=3000)
        bench.t = 3.0
    assert weak.get("present_current") == pytest.approx(1200 * 200 / 1750, rel=0.1)
    assert weak.get("hardware_error_status") == 0 and weak.get("torque_enable") == 1
    assert strong.get("hardware_error_status") == 1 << 5 and strong.get("torque_enable") == 0


def test_profile_by_time_arrives_in_that_time():
    bench = Bench(drive_mode=4, start=2000)
    bench.put(profile_velocity=1000, profile_acceleration=200, torque_enable=1, goal_position=3000)
    assert bench.after(0.5) == pytest.approx(2500, abs=60)
    assert bench.after(0.65) == pytest.approx(3000, abs=3)


def test_torque_comes_on_with_a_goal_where_the_drive_mode_says_so():
    bench = Bench(drive_mode=8)
    bench.put(goal_position=2100)
    assert bench.get("torque_enable") == 1 and bench.after(1.0) == 2100


def test_changing_the_mode_resets_the_goals():
    bench = Bench(start=2300)
    bench.put(goal_position=3000, profile_velocity=50, operating_mode=4)
    assert (bench.get("goal_position"), bench.get("profile_velocity")) == (2300, 0)


@pytest.mark.parametrize(
    ("limit", "value", "goal"),
    [("velocity_limit", 100, "goal_velocity"), ("pwm_limit", 400, "goal_pwm"), ("current_limit", 500, "goal_current")],
)
def test_goals_stay_below_their_limit_registers(limit, value, goal):
    bench = Bench()
    bench.put(**{limit: value})
    assert bench.put(**{goal: value}) == 0
    assert bench.put(**{goal: value + 1}) == dxl2.DATA_LIMIT_ERROR


def test_supply_outside_the_limits_raises_the_alert_for_good():
    bench = Bench(supply_v=7.2, shutdown=52)
    assert bench.get("present_input_voltage") == 72 and bench.get("hardware_error_status") == 1
    bench.servo.power_cycle(0.0)
    bench.t = 1.0
    assert bench.get("hardware_error_status") == 1
    assert bench.put(torque_enable=1) == 0  # 52 leaves the voltage out, 53 does not
    assert Bench(supply_v=7.2).put(torque_enable=1) == dxl2.ACCESS_ERROR


def test_brown_out_restarts_the_servo():
    bench = Bench()
    bench.put(torque_enable=1, led=1)
    bench.servo.set_supply(1.0, 0.1)
    assert not bench.servo.hears(1_000_000, 0.2)
    bench.servo.set_supply(5.0, 0.3)
    assert not bench.servo.hears(1_000_000, 0.4) and bench.servo.hears(1_000_000, 0.7)
    bench.t = 1.0
    assert (bench.get("torque_enable"), bench.get("led")) == (0, 0)


@pytest.mark.parametrize(("firmware", "moves_on"), [(51, True), (53, False)])
def test_watchdog_of_old_firmware_only_raises_its_flag(firmware, moves_on):
    bench = Bench(firmware=firmware, start=2000)
    bench.put(profile_velocity=20, goal_position=2000, torque_enable=1, bus_watchdog=5)
    bench.put(goal_position=3000)
    assert (bench.after(20.0) == 3000) == moves_on
    assert bench.get("bus_watchdog") == -1 and bench.put(goal_position=2500) == dxl2.DATA_RANGE_ERROR


def test_load_hangs_a_little_below_the_goal_and_takes_current():
    bench = Bench()
    bench.put(goal_position=2048, torque_enable=1)
    bench.servo.plant.load = 0.2
    assert 1 <= 2048 - bench.after(2.0) <= 40
    assert bench.get("present_current") == pytest.approx(240, abs=10)


def test_held_load_makes_it_warm_and_too_much_overheats_it():
    bench = Bench(shutdown=4)
    bench.put(goal_position=2048, torque_enable=1)
    bench.servo.plant.load = 0.8
    warm = bench.after(5.0, "present_temperature")
    assert 33 < warm < 70
    bench.t = 120.0
    assert bench.get("hardware_error_status") & 1 << 2 and bench.get("torque_enable") == 0


def test_position_stays_finite_at_the_ends_of_every_range():
    bench = Bench(operating_mode=4)
    bench.put(torque_enable=1, profile_velocity=32767, profile_acceleration=32767, goal_position=-1048575)
    for _ in range(20):
        assert math.isfinite(bench.after(1.0))


def test_xl320_torque_limit_starts_at_max_torque_and_holds_the_motor_back():
    table = Table.of(load_firmware_map("xl-320"))
    way = {}
    for stored in ({}, {"max_torque": 60}):
        servo = Dynamixel2Servo(EmulatedServo(1, "xl-320", start_ticks=512, firmware=30, registers=stored), table)
        most = stored.get("max_torque", 1023)
        assert servo.read(35, 2, 0.0) == (0, most.to_bytes(2, "little"))  # Torque Limit
        servo.write(30, (900).to_bytes(2, "little"), 0.0)
        servo.write(24, b"\x01", 0.0)
        way[most] = servo.state(0.1)["position"] - 512
        servo.write(35, b"\x05\x00", 0.1)
        servo.power_cycle(0.1)
        assert servo.read(35, 2, 0.5) == (0, most.to_bytes(2, "little"))
    assert 0 < way[60] < way[1023] / 2


def test_turns_are_forgotten_at_power_up_however_few_they_are():
    bench = Bench()
    bench.servo.turn(4150, 0.0)
    assert bench.servo.state(0.0)["position"] == 4150
    bench.servo.power_cycle(0.0)
    assert bench.servo.state(1.0)["position"] == 4150 - 4096
