"""Wheels, many turns, PWM and steps of AX, MX (1.0), STS and SCS; what waits between REG WRITE and ACTION.

Frames are written out byte by byte, as the makers' manuals have them, so that no code of this package makes them.
"""

import pytest
from emulated_devices import chain_of

BAUD = 1_000_000
AX, MX, STS, SCS = "ax-12a", "mx-28-1.0", "sts3215", "scs0009"
TURN = {AX: 1228.8, MX: 4096, STS: 4096, SCS: 1228.8}


class Bench:
    """One servo with id 1."""

    def __init__(self, model, start_ticks=None, **registers):
        self.device = chain_of(model, start_ticks=start_ticks, registers=registers)
        self.high_first = model == SCS
        self.now_s = 0.0

    def send(self, code, *params):
        body = [1, len(params) + 2, code, *params]
        frame = bytes([255, 255, *body, ~sum(body) & 255])
        return self.device.receive(frame, BAUD, self.now_s)

    def word(self, value):
        value &= 0xFFFF
        return (value >> 8, value & 255) if self.high_first else (value & 255, value >> 8)

    def write(self, address, *data):
        answer = self.send(3, address, *data)
        assert answer[:2] == b"\xff\xff" and answer[4] == 0, answer.hex(" ")

    def read(self, address, size=2):
        data = self.send(2, address, size)[5:-1]
        return int.from_bytes(data, "big" if self.high_first else "little")

    def after(self, seconds):
        self.now_s += seconds
        return self

    @property
    def shaft(self):
        return self.device.servo(1).state(self.now_s)["position"]


def test_ax_wheel_turns_both_ways_for_ever_and_shows_one_turn_with_a_gap():
    bench = Bench(AX)
    bench.write(6, 0, 0, 0, 0)  # CW and CCW angle limit 0: wheel
    bench.write(24, 1)
    bench.write(32, 0xFF, 0x03)  # 1023: all it has, counter-clockwise
    start = bench.shaft
    assert bench.after(3.0).shaft - start == pytest.approx(3.0 * 354 / 300 * 1024, rel=0.05)  # 59 rpm
    assert bench.read(38) & 0x400 == 0
    seen = {bench.after(0.013).read(36) for _ in range(300)}
    assert max(seen) == 1023 and min(seen) < 20
    bench.write(32, 0x00, 0x06)  # 1024 + 512: half of it, clockwise
    start = bench.after(0.5).shaft
    assert bench.after(2.0).shaft - start == pytest.approx(-2.0 * 354 / 300 * 1024 * 512 / 1023, rel=0.05)
    assert bench.read(38) & 0x400
    bench.write(32, 0x00, 0x04)  # 1024: no speed, clockwise
    still = bench.after(0.5).shaft
    assert bench.after(1.0).shaft == still


def test_mx_wheel_keeps_the_speed_it_is_told():
    bench = Bench(MX, cw_angle_limit=0, ccw_angle_limit=0)
    bench.write(24, 1)
    bench.write(32, 100, 0)  # 11.4 rpm
    start = bench.after(0.5).shaft
    assert bench.after(60.0).shaft - start == pytest.approx(11.4 * 4096, rel=0.01)


def test_mx_multi_turn_goes_beyond_one_turn_and_back():
    bench = Bench(MX, cw_angle_limit=4095, ccw_angle_limit=4095)
    bench.write(30, *bench.word(3 * 4096))
    assert bench.after(20.0).read(36) == 3 * 4096
    bench.write(30, *bench.word(-28672))
    assert bench.after(40.0).read(36) == 0x10000 - 28672
    assert bench.send(3, 30, *bench.word(28673))[4] & 0x08  # range error


def test_mx_multi_turn_offset_and_divider():
    bench = Bench(MX, 2048, cw_angle_limit=4095, ccw_angle_limit=4095, multi_turn_offset=1000, resolution_divider=4)
    assert bench.read(36) == 2048
    bench.write(30, *bench.word(2148))
    shaft = bench.device.servo(1).plant.position
    assert bench.after(10.0).read(36) == 2148
    assert bench.device.servo(1).plant.position - shaft == pytest.approx(400)


def test_mx_whose_limits_are_the_wrong_way_round_does_not_move():
    bench = Bench(MX, cw_angle_limit=3000, ccw_angle_limit=1000)
    bench.write(24, 1)
    assert bench.after(2.0).shaft == 2048


def test_sts_wheel_obeys_goal_speed_and_acceleration_and_shows_one_turn():
    bench = Bench(STS)
    bench.write(33, 1)
    bench.write(41, 10)  # 1000 step/s^2
    bench.write(40, 1)
    bench.write(46, *bench.word(1000))
    start = bench.shaft
    assert bench.after(0.5).shaft - start == pytest.approx(125, rel=0.3)
    assert bench.after(9.5).shaft - start == pytest.approx(9500, rel=0.02)
    assert bench.read(56) < 4096 and bench.read(58) == pytest.approx(1000, abs=2)
    bench.write(46, *bench.word(0x8000 | 2000))  # bit 15: the other way
    start = bench.after(3.0).shaft
    assert bench.after(1.0).shaft - start == pytest.approx(-2000, rel=0.02)
    assert bench.read(58) & 0x8000


def test_sts_counts_turns_when_its_phase_says_so():
    for phase, seen in ((12, 3000 % 4096), (12 | 16, 3000 + 4096)):
        bench = Bench(STS, 100, min_position_limit=0, max_position_limit=0, phase=phase)
        bench.write(42, *bench.word(3000 + 4096))
        assert bench.after(20.0).read(56) == seen
        assert bench.shaft == 3000 + 4096


def test_sts_pwm_is_open_loop_with_a_sign():
    bench = Bench(STS, operating_mode=2)
    bench.write(40, 1)
    bench.write(44, *bench.word(500))
    start = bench.after(0.5).shaft
    forwards = bench.after(1.0).shaft - start
    assert forwards == pytest.approx(0.5 * 298.8 / 360 * 4096, rel=0.02)
    bench.write(44, *bench.word(0x800 | 500))  # bit 11
    start = bench.after(0.5).shaft
    assert bench.after(1.0).shaft - start == pytest.approx(-forwards, rel=0.02)


def test_sts_steps_add_up():
    bench = Bench(STS, 2000, operating_mode=3)
    bench.write(42, *bench.word(300))
    assert bench.after(3.0).shaft == 2300
    bench.write(42, *bench.word(300))
    bench.write(42, *bench.word(0x8000 | 100))
    assert bench.after(3.0).shaft == 2500


def test_scs_motor_mode_takes_pwm_from_running_time():
    bench = Bench(SCS, 500)
    bench.write(48, 0)  # unlock
    bench.write(9, 0, 0, 0, 0)
    bench.write(40, 1)
    bench.write(44, *bench.word(400))
    start = bench.after(0.5).shaft
    forwards = bench.after(1.0).shaft - start
    assert forwards > 100
    bench.write(44, *bench.word(1024 + 400))  # bit 10
    start = bench.after(0.5).shaft
    assert bench.after(1.0).shaft - start == pytest.approx(-forwards, rel=0.02)
    assert bench.read(56) <= 1023


@pytest.mark.parametrize(("model", "goal", "pending"), [(AX, 30, 44), (MX, 30, 44), (STS, 42, 64), (SCS, 42, 64)])
def test_registered_write_is_pending_until_action(model, goal, pending):
    bench = Bench(model)
    assert bench.read(pending, 1) == 0
    bench.send(4, goal, *bench.word(600))  # REG WRITE
    assert bench.read(pending, 1) == 1 and bench.read(goal) != 600
    bench.send(5)  # ACTION
    assert bench.read(pending, 1) == 0
    assert bench.read(goal) == 600
    bench.send(4, goal, *bench.word(601))
    bench.device.servo(1).power_cycle(0.0)
    assert bench.read(pending, 1) == 0
