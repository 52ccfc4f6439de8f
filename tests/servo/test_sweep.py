"""Who is asked for what in a tick, and which answers count. In virtual time, over real ports."""

import logging
from contextlib import contextmanager
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import Bus, load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.chain.dynamixel2_bus import Dynamixel2Bus
from sfms_robot.servo.chain.dynamixel2_link import Dynamixel2Link
from sfms_robot.servo.chain.protocol1_link import Protocol1Link
from sfms_robot.servo.chain.schedule import Rotation, blocks_per_tick, read_s, write_s
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.protocol1 import encode
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import VirtualTimePort


class Through:
    """A port that hands everything on to another."""

    def __init__(self, port):
        self.port, self.name = port, port.name

    def write(self, data):
        self.port.write(data)

    def read(self, n, deadline_s):
        return self.port.read(n, deadline_s)

    def discard_input(self):
        self.port.discard_input()

    def now_s(self):
        return self.port.now_s()

    def set_baud(self, baud):
        self.port.set_baud(baud)

    def close(self):
        self.port.close()


class OldFirmware(Through):
    """Servos that do not know the fast sync read."""

    fast = 0

    def write(self, data):
        if data[7] == dxl2.FAST_SYNC_READ:
            self.fast += 1
        else:
            super().write(data)


class SlowAdapter(Through):
    """From `late` on, every answer comes only after the next request has gone out."""

    late = False
    kept = ready = b""

    def write(self, data):
        super().write(data)
        self.ready, self.kept = self.kept, b""

    def read(self, n, deadline_s):
        data = super().read(n, deadline_s)
        if not self.late:
            return data
        self.kept += data
        data, self.ready = self.ready, b""
        return data


@contextmanager
def bus_over(rig, make_port, fast_read="auto"):
    """Another bus on the rig's wire, and the port it has opened."""
    port = make_port(VirtualTimePort(rig.chain.device, rig.chain.control, rig.baud, rig.clock))
    servos = [BusServo(f"joint{i}", i, load_firmware_map("xl330-m288"), -1.0, 1.0) for i in range(1, rig.count + 1)]
    config = Bus(family="dynamixel", baud=rig.baud, fast_read=fast_read)
    rig.bus = Dynamixel2Bus("face", servos, rig.bus._conversion, lambda: port, rig.baud, config=config)
    try:
        yield port
    finally:
        rig.bus.close()


def five(make_rig):
    return make_rig([EmulatedServo(i, start_ticks=2000 + i) for i in range(1, 6)])


@pytest.mark.parametrize("fast_read", ["auto", "on"])
def test_servos_without_fast_sync_read_are_read_plainly_from_then_on(make_rig, fast_read, caplog):
    with caplog.at_level(logging.WARNING), five(make_rig) as rig, bus_over(rig, OldFirmware, fast_read) as port:
        held = rig.hold()
        for _ in range(60):
            assert all(r.age_s == 0.0 for r in rig.ticks(held, 1).values())
        tried = port.fast
        rig.ticks(held, 60)
        assert port.fast == tried <= 6
        assert ("fast sync read is not answered" in caplog.text) == (fast_read == "on")


class Patience(Through):
    """Counts how often a deadline was waited for in vain."""

    silences = 0

    def read(self, n, deadline_s):
        data = super().read(n, deadline_s)
        self.silences += not data
        return data


@pytest.mark.parametrize("dead", [1, 3, 5])
def test_dead_servo_costs_one_silence_in_a_tick_wherever_it_stands(make_rig, dead):
    with five(make_rig) as rig, bus_over(rig, Patience) as port:
        held = rig.hold()
        rig.ticks(held, 5)
        port.silences = 0
        rig.ticks(held, 5)
        quiet = port.silences
        rig.chain.kill(dead)
        for _ in range(12):
            before = port.silences
            readings = rig.ticks(held, 1)
            assert port.silences - before <= 1
            assert all(r.age_s == 0.0 for joint, r in readings.items() if joint != f"joint{dead}")
        assert quiet == 0 and rig.bus.statistics()["silent"] == [dead]


def test_late_answer_is_never_taken_for_a_fresh_one(make_rig):
    with five(make_rig) as rig, bus_over(rig, SlowAdapter) as port:
        held = rig.hold()
        rig.ticks(held, 5)
        before = rig.clock.t
        port.late = True
        for k in range(50):
            readings = rig.ticks(held + 0.002 * k, 1)
            assert all(r.age_s >= rig.clock.t - before - 1e-9 for r in readings.values())
        port.late = False
        _, readings = rig.until(held, lambda r: all(x.age_s == 0.0 for x in r.values()), 2.0)
        for i, reading in enumerate(readings.values()):
            actual = rig.chain.state(i + 1)["position"]
            assert reading.position_rad == pytest.approx((actual - 2048) * 2 * np.pi / 4096, abs=0.004)


@pytest.mark.parametrize(
    "fault", ["delay=0.012", "corrupt=0.2", "truncate=0.2", "duplicate=0.5", "noise=0.3", "echo=1"]
)
def test_positions_are_right_or_old_whatever_the_wire_does(make_rig, fault):
    with five(make_rig) as rig:
        held = rig.hold()
        rig.ticks(held, 5)
        rig.chain.inject(fault)
        for k in range(150):
            readings = rig.ticks(held + 0.003 * k * (k < 100), 1)
            for i, reading in enumerate(readings.values()):
                if reading.age_s == 0.0:
                    actual = rig.chain.state(i + 1)["position"]
                    assert reading.position_rad == pytest.approx((actual - 2048) * 2 * np.pi / 4096, abs=0.004)
        rig.chain.clear_faults()
        rig.until(held, lambda r: all(x.age_s == 0.0 for x in r.values()), 2.0)


def test_slow_wire_brings_positions_every_tick_and_the_rest_in_turn(make_rig):
    with make_rig([EmulatedServo(i, start_ticks=2048) for i in range(1, 29)]) as rig:
        held = rig.hold()
        rig.chain.supply(5.5)
        seen = []
        for _ in range(28):
            readings = rig.ticks(held, 1)
            assert all(r.age_s == 0.0 for r in readings.values())
            seen.append(sum(r.extra["voltage_V"] > 5.3 for r in readings.values()))
        assert 0 < seen[0] < 14 and seen[-1] == 28


@given(st.integers(1, 60), st.sampled_from([57600, 1_000_000, 4_000_000]), st.floats(20, 200), st.booleans())
def test_blocks_fit_in_what_goals_and_positions_leave(count, baud, rate_hz, fast):
    blocks = blocks_per_tick(count, 4, 21, 4, baud, rate_hz, fast)
    assert 1 <= blocks <= count
    spent_s = write_s(count, 4, baud) + read_s(count, 4, baud, fast) + read_s(blocks, 21, baud, fast)
    assert blocks == 1 or blocks == count or spent_s <= 1 / rate_hz


@given(st.integers(1, 30), st.integers(1, 30))
def test_everybody_has_a_turn(count, at_once):
    rotation, ids = Rotation(), list(range(count))
    turns = [rotation.take(ids, at_once) for _ in range(2 * count)]
    assert all(turn == sorted(turn) and len(turn) == min(count, at_once) for turn in turns)
    for servo in ids:
        at = [k for k, turn in enumerate(turns) if servo in turn]
        assert max(b - a for a, b in pairwise([-1, *at])) <= -(-count // at_once) + 1


REPLIES = [(1, 0, b"\x01\x02\xff\xff"), (7, 0x80, b"\xfd\x00\xff\xff"), (9, 0, b"\xfd\xfd\x00\x55")]


@given(st.integers(0, 60))
def test_fast_answer_that_stops_short_gives_those_in_front_of_the_gap(cut):
    whole = dxl2.encode_fast_status(REPLIES)
    got = dxl2.split_fast_status(whole[:cut], 4)
    assert got == REPLIES[: len(got)]
    assert len(got) == sum(8 + 8 * (k + 1) <= min(cut, len(whole)) for k in range(3))


def test_fast_answer_of_another_length_is_none():
    assert dxl2.split_fast_status(dxl2.encode_fast_status(REPLIES), 5) == []


@pytest.mark.parametrize(
    ("kind", "more", "answer"),
    [(Dynamixel2Link, (), dxl2.encode_status(1, 0, bytes(4))), (Protocol1Link, ("feetech",), encode(1, 0, bytes(4)))],
)
def test_adapter_that_holds_answers_back_is_waited_for(kind, more, answer, caplog):
    clock = [0.0]

    class Slow:
        """An FTDI adapter as it comes: answers lie in it for 16 ms."""

        name = "slow"

        def write(self, data):
            self.sent_s, self.kept = clock[0], answer

        def read(self, n, deadline_s):
            due_s = self.sent_s + 0.016
            if due_s > deadline_s or not self.kept:
                clock[0] = deadline_s
                return b""
            clock[0] = max(clock[0], due_s)
            came, self.kept = self.kept, b""
            return came

        def discard_input(self): ...

        def now_s(self):
            return clock[0]

        def set_baud(self, baud): ...

        def close(self): ...

    assert kind(Slow(), 1_000_000, 0.003, *more).read(1, 132, 4) is None
    link = kind(Slow(), 1_000_000, 0.003, *more)
    with caplog.at_level(logging.WARNING):
        assert link.adapt(1, 132, 4) == pytest.approx(0.02, abs=0.001)
    assert "slow: an answer is held back for 15.7 ms, so a silent servo costs 19.6 ms" in caplog.text
    assert link.read(1, 132, 4) is not None
