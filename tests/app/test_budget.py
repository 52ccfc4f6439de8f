"""The wire budget against packets that the codec builds, and against figures known from real chains."""

from dataclasses import asdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.app.servo.diagnosis import wire_budget
from sfms_robot.servo.codecs import dxl2

FACTORY = {"baud": 57_600, "return_delay_us": 500.0, "latency_ms": 16.0}
TUNED = {"baud": 1_000_000, "return_delay_us": 0.0, "latency_ms": 1.0}


@given(servos=st.integers(1, 40), read=st.integers(1, 20), write=st.sampled_from([2, 4]))
def test_bytes_are_those_of_the_packets(servos, read, write):
    ids = bytes(range(1, servos + 1))
    head = bytes([116, 0, write, 0])
    goals = dxl2.encode_instruction(
        dxl2.BROADCAST, dxl2.SYNC_WRITE, head + b"".join(bytes([i]) + bytes(write) for i in ids)
    )
    ask = dxl2.encode_instruction(dxl2.BROADCAST, dxl2.SYNC_READ, bytes([132, 0, read, 0]) + ids)
    answers = servos * len(dxl2.encode_status(1, 0, bytes(read)))
    fast = len(dxl2.encode_fast_status([(i, 0, bytes(read)) for i in ids]))
    budget = wire_budget("dynamixel2", servos, **TUNED, read_bytes=read, write_bytes=write)
    assert budget.write_only.bytes == len(goals)
    assert budget.plain.bytes == len(goals) + len(ask) + answers
    assert budget.fast.bytes == len(goals) + len(ask) + fast


@pytest.mark.parametrize(
    ("servos", "wire", "ms"),
    [
        (9, FACTORY, 58.2),
        (25, FACTORY, 124.5),
        (9, {**FACTORY, "baud": 1_000_000}, 22.7),
        (25, {**FACTORY, "baud": 1_000_000}, 34.0),
        (9, TUNED, 3.2),
        (25, TUNED, 6.5),
    ],
)
def test_figures_of_a_sync_read_and_a_sync_write_of_four_bytes(servos, wire, ms):
    assert wire_budget("dynamixel2", servos, **wire, read_bytes=4).plain.ms == pytest.approx(ms, abs=0.06)


def test_fast_sync_read_spares_the_return_delays_and_most_of_the_headers():
    for servos, ms in ((9, 2.6), (25, 4.9)):
        budget = wire_budget("dynamixel2", servos, **TUNED, read_bytes=4)
        assert budget.fast.ms == pytest.approx(ms, abs=0.05) and budget.fast.hz > budget.plain.hz


def test_single_reads_pay_the_adapter_once_per_servo():
    slow = wire_budget("dynamixel1", 9, 1_000_000, 500.0, 16.0, read_bytes=2, write_bytes=2)
    assert slow.plain.ms == pytest.approx(150, abs=0.5) and slow.fast is None
    assert wire_budget("feetech", 9, 1_000_000, 0.0, 16.0, 2, 2, together=False).plain.ms > 9 * 16
    assert wire_budget("feetech", 9, 1_000_000, 0.0, 16.0, 2, 2).plain.ms < 18


def test_single_reads_of_twenty_five_servos():
    budget = wire_budget("dynamixel1", 25, 1_000_000, 500.0, 1.0, read_bytes=2, write_bytes=2)
    assert budget.plain.ms == pytest.approx(42, abs=0.8)


def test_budget_is_rounded_and_complete():
    plain = asdict(wire_budget("dynamixel2", 28, **TUNED, read_bytes=10))
    assert plain["plain"]["bytes"] == 14 + 28 * 5 + 14 + 28 + 28 * 21 and plain["fast"]["hz"] > plain["plain"]["hz"]
