"""Who is asked for what in a tick, and which answers count. In virtual time, over real ports."""

import logging

import pytest
from chain_rig import bus_of, plugged
from emulated_port import EmulatedPort, Says
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.chain.protocol1 import FeetechLink
from sfms_robot.servo.chain.protocol2 import Dynamixel2Link
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.protocol1 import encode
from sfms_robot.servo.port import WrappedPort


class OldFirmware(WrappedPort):
    """Servos that do not know the fast sync read."""

    fast = 0

    def write(self, data):
        if data[7] == dxl2.FAST_SYNC_READ:
            self.fast += 1
        else:
            super().write(data)


@pytest.mark.parametrize("fast_read", ["auto", "on"])
def test_servos_without_fast_sync_read_are_read_plainly_from_then_on(fast_read, caplog):
    rig = plugged([EmulatedServo(i) for i in range(1, 6)])
    port = OldFirmware(rig.port)
    rig.bus = bus_of([load_firmware_map("xl330-m288")] * 5, range(1, 6), lambda: port, fast_read=fast_read)
    held = rig.hold()
    for _ in range(60):
        assert all(r.age_s == 0.0 for r in rig.ticks(held, 1).values())
    tried = port.fast
    rig.ticks(held, 60)
    assert port.fast == tried <= 6
    assert ("fast sync read is not answered" in caplog.text) == (fast_read == "on")


def test_slow_wire_brings_positions_every_tick_and_the_rest_in_turn():
    rig = plugged([EmulatedServo(i, start_ticks=2048) for i in range(1, 29)])
    held = rig.hold()
    rig.supply(5.5)
    seen = []
    for _ in range(28):
        readings = rig.ticks(held, 1)
        assert all(r.age_s == 0.0 for r in readings.values())
        seen.append(sum(r.extra["voltage_V"] > 5.3 for r in readings.values()))
    assert 0 < seen[0] < 14 and seen[-1] == 28


REPLIES = [(1, 0, b"\x01\x02\xff\xff"), (7, 0x80, b"\xfd\x00\xff\xff"), (9, 0, b"\xfd\xfd\x00\x55")]


@given(st.integers(0, 60))
def test_fast_answer_that_stops_short_gives_those_in_front_of_the_gap(cut):
    whole = dxl2.encode_fast_status(REPLIES)
    got = dxl2.split_fast_status(whole[:cut], 4)
    assert got == REPLIES[: len(got)] and len(got) == sum(8 + 8 * (k + 1) <= min(cut, len(whole)) for k in range(3))
    if 8 <= cut < len(whole):  # what is damaged proves nothing behind it
        damaged = whole[:cut] + bytes([whole[cut] ^ 1]) + whole[cut + 1 :]
        assert dxl2.split_fast_status(damaged, 4) == REPLIES[: (cut - 8) // 8]


@pytest.mark.parametrize(
    ("kind", "answer", "held"),
    [
        (Dynamixel2Link, dxl2.encode_status(1, 0, bytes(4)), "15.7 ms, so a silent servo costs 19.6 ms"),
        (FeetechLink, encode(1, 0, bytes(4)), "15.8 ms, so a silent servo costs 19.8 ms"),
    ],
)
def test_adapter_that_holds_answers_back_is_waited_for(kind, answer, held, caplog):
    class Slow(EmulatedPort):
        """An FTDI adapter as it comes: answers lie in it for 16 ms."""

        def write(self, data):
            super().write(data)
            self.due_s = self.clock.t + 0.016

        def read(self, n, deadline_s):
            data = super().read(n, deadline_s) if self.due_s <= deadline_s else b""
            self.clock.wait_until(self.due_s if data else deadline_s)
            return data

    def slow():
        return Slow(Says(answer), name="slow")

    assert kind(slow(), 1_000_000, 0.003).read(1, 132, 4) is None
    link = kind(slow(), 1_000_000, 0.003)
    with caplog.at_level(logging.WARNING):
        assert link.adapt(1, 132, 4) == pytest.approx(0.02, abs=0.001)
    assert f"slow: an answer is held back for {held}" in caplog.text
    assert link.read(1, 132, 4) is not None
