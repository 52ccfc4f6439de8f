"""Wheels, many turns, PWM and steps of AX, MX (1.0), STS and SCS; what waits between REG WRITE and ACTION.

Frames are written out byte by byte, as the makers' manuals have them, so that no code of this package makes them.
"""

import pytest
from emulated_devices import chain_of

BAUD = 1_000_000
AX, MX, STS, SCS = "ax-12a", "mx-28-1.0", "sts3215", "scs0009"
AX_DEG_S, AX_TICKS_DEG, STS_TICKS_S = 354, 1024 / 300, 298.8 / 360 * 4096  # 59 rpm without load


class Bench:
    """One servo with id 1."""

    def __init__(self, model, start_ticks=None, **registers):
        self.device = chain_of(model, start_ticks=start_ticks, registers=registers)
        self.high_first = model == SCS
        self.now_s = 0.0

    def send(self, code, *params):
        body = [1, len(params) + 2, code, *params]
        return self.device.receive(bytes([255, 255, *body, ~sum(body) & 255]), BAUD, self.now_s)

    def word(self, value):
        value &= 0xFFFF
        return (value >> 8, value & 255) if self.high_first else (value & 255, value >> 8)

    def write(self, address, *data):
        answer = self.send(3, address, *data)
        assert answer[:2] == b"\xff\xff" and answer[4] == 0, answer.hex(" ")

    def read(self, address, size=2):
        return int.from_bytes(self.send(2, address, size)[5:-1], "big" if self.high_first else "little")

    def after(self, seconds):
        self.now_s += seconds
        return self

    @property
    def shaft(self):
        return self.device.servo(1).state(self.now_s)["position"]


WHEELS = [  # model, registers before, bytes written, word written (address, value), ticks per second
    (AX, {}, [(6, 0, 0, 0, 0), (24, 1)], (32, 1023), AX_DEG_S * AX_TICKS_DEG),  # angle limits 0: wheel
    (AX, {}, [(6, 0, 0, 0, 0), (24, 1)], (32, 1024 + 512), -AX_DEG_S * AX_TICKS_DEG * 512 / 1023),
    (AX, {}, [(6, 0, 0, 0, 0), (24, 1)], (32, 1024), 0.0),  # no speed, clockwise
    (MX, {"cw_angle_limit": 0, "ccw_angle_limit": 0}, [(24, 1)], (32, 100), 11.4 * 4096 / 60),  # 11.4 rpm
    (MX, {"cw_angle_limit": 3000, "ccw_angle_limit": 1000}, [(24, 1)], (32, 100), 0.0),  # the wrong way round
    (STS, {}, [(33, 1), (40, 1)], (46, 1000), 1000.0),
    (STS, {}, [(33, 1), (40, 1)], (46, 0x8000 | 2000), -2000.0),  # bit 15: the other way
    (STS, {"operating_mode": 2}, [(40, 1)], (44, 500), 0.5 * STS_TICKS_S),  # PWM
    (STS, {"operating_mode": 2}, [(40, 1)], (44, 0x800 | 500), -0.5 * STS_TICKS_S),  # bit 11
    (SCS, {}, [(48, 0), (9, 0, 0, 0, 0), (40, 1)], (44, 400), 0.4 * 1024),
    (SCS, {}, [(48, 0), (9, 0, 0, 0, 0), (40, 1)], (44, 1024 + 400), -0.4 * 1024),  # bit 10
]


@pytest.mark.parametrize(("model", "registers", "writes", "goal", "ticks_s"), WHEELS)
def test_a_wheel_turns_at_the_speed_it_is_told_and_shows_one_turn(model, registers, writes, goal, ticks_s):
    bench = Bench(model, **registers)
    for each in writes:
        bench.write(*each)
    bench.write(goal[0], *bench.word(goal[1]))
    start = bench.after(2.0).shaft
    assert bench.after(10.0).shaft - start == pytest.approx(10 * ticks_s, rel=0.05, abs=0.1)
    position, speed, sign = (36, 38, 0x400) if model in (AX, MX) else (56, 58, 0x8000)
    assert bench.read(position) < (4096 if model in (MX, STS) else 1024)
    assert bool(bench.read(speed) & sign) is (ticks_s < 0) or model == SCS


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
    assert bench.after(10.0).read(36) == 2148 and bench.device.servo(1).plant.position - shaft == pytest.approx(400)


@pytest.mark.parametrize(("phase", "seen"), [(12, 3000 % 4096), (12 | 16, 3000 + 4096)])
def test_sts_counts_turns_when_its_phase_says_so(phase, seen):
    bench = Bench(STS, 100, min_position_limit=0, max_position_limit=0, phase=phase)
    bench.write(42, *bench.word(3000 + 4096))
    assert bench.after(20.0).read(56) == seen and bench.shaft == 3000 + 4096


def test_sts_steps_add_up():
    bench = Bench(STS, 2000, operating_mode=3)
    bench.write(42, *bench.word(300))
    assert bench.after(3.0).shaft == 2300
    bench.write(42, *bench.word(300))
    bench.write(42, *bench.word(0x8000 | 100))
    assert bench.after(3.0).shaft == 2500


@pytest.mark.parametrize(("model", "goal", "pending"), [(AX, 30, 44), (MX, 30, 44), (STS, 42, 64), (SCS, 42, 64)])
def test_registered_write_is_pending_until_action(model, goal, pending):
    bench = Bench(model)
    assert bench.read(pending, 1) == 0
    bench.send(4, goal, *bench.word(600))  # REG WRITE
    assert bench.read(pending, 1) == 1 and bench.read(goal) != 600
    bench.send(5)  # ACTION
    assert bench.read(pending, 1) == 0 and bench.read(goal) == 600
    bench.send(4, goal, *bench.word(601))
    bench.device.servo(1).power_cycle(0.0)
    assert bench.read(pending, 1) == 0
