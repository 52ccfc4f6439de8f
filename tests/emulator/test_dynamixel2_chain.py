"""The emulated chain without a terminal: packets in, packets out."""

import pytest
from emulated_devices import device_of, table_of
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import Packet, encode_instruction, maybe_packet

TABLE = table_of("xl330-m288")
BAUD = 1_000_000


class Host:
    """A host that talks at one baud, at a time it sets."""

    def __init__(self, *servos: int, firmware: int = 53):
        self.chain = device_of(*(EmulatedServo(i, start_ticks=2000 + i, firmware=firmware) for i in servos))
        self.t = 0.0

    def replies(self, servo: int, instruction: int, params: bytes = b""):
        return self.chain.replies(encode_instruction(servo, instruction, params), BAUD, self.t)

    def ask(self, servo: int, instruction: int, params: bytes = b"") -> list[Packet]:
        buffer = bytearray(self.chain.receive(encode_instruction(servo, instruction, params), BAUD, self.t))
        out = []
        while (packet := maybe_packet(buffer)) is not None:
            out.append(packet)
        assert not buffer
        return out

    def write(self, servo: int, name: str, value: int) -> int:
        """The error byte."""
        field = TABLE[name]
        [status] = self.ask(servo, dxl2.WRITE, field.address.to_bytes(2, "little") + field.to_bytes(value))
        return status.error

    def read(self, servo: int, name: str) -> int:
        field = TABLE[name]
        request = field.address.to_bytes(2, "little") + field.size.to_bytes(2, "little")
        [status] = self.ask(servo, dxl2.READ, request)
        return field.from_bytes(status.params)


def words(*values: int) -> bytes:
    return b"".join(value.to_bytes(2, "little") for value in values)


@pytest.fixture
def host():
    return Host(1, 2, 3)


@pytest.mark.parametrize(
    ("name", "value", "error"),
    [
        ("present_position", 5, dxl2.ACCESS_ERROR),
        ("torque_enable", 2, dxl2.DATA_RANGE_ERROR),
        ("operating_mode", 99, dxl2.DATA_RANGE_ERROR),
        ("goal_position", 5000, dxl2.DATA_LIMIT_ERROR),
        ("bus_watchdog", -1, dxl2.DATA_RANGE_ERROR),
        ("led", 1, 0),
    ],
)
def test_write_is_checked(host, name, value, error):
    before = host.read(1, name)
    assert host.write(1, name, value) == error and host.read(1, name) == (before if error else value)


def test_status_return_level_decides_who_answers(host):
    assert host.ask(1, dxl2.WRITE, words(68) + b"\x01") == []  # the new level counts at once
    assert host.ask(1, dxl2.WRITE, words(65) + b"\x01") == [] and host.read(1, "led") == 1
    host.ask(1, dxl2.WRITE, words(68) + b"\x00")
    assert host.ask(1, dxl2.READ, words(65, 1)) == [] and len(host.ask(1, dxl2.PING)) == 1


def test_unfinished_packet_is_forgotten_after_a_pause(host):
    host.chain.receive(encode_instruction(1, dxl2.READ, words(0, 2))[:-4], BAUD, 0.0)
    host.t = 0.2
    assert len(host.ask(1, dxl2.PING)) == 1


@given(st.integers(0, 255), st.integers(0, 255), st.binary(max_size=40))
def test_no_instruction_whatever_its_parameters_breaks_the_chain(servo, instruction, params):
    host = Host(1)
    if servo not in (0xFD, 0xFF):
        host.chain.receive(encode_instruction(servo, instruction, params), BAUD, 0.0)


POSITIONS = words(132, 4)


@pytest.mark.parametrize("dead", [None, 3, 2, 1])
def test_fast_sync_read_is_one_packet_that_stops_short_at_a_silent_id(host, dead):
    if dead:
        host.chain.servo(dead).dead = True
    replies = host.replies(dxl2.BROADCAST, dxl2.FAST_SYNC_READ, POSITIONS + b"\x01\x02\x03")
    there = (1, 2, 3)[: dead - 1 if dead else 3]
    assert [reply.servos for reply in replies] == ([there] if there else [])
    if there:
        parts = dxl2.split_fast_status(replies[0].data, 4)
        assert parts == [(i, 0, (2000 + i).to_bytes(4, "little")) for i in there]
        assert len(replies[0].data) == 8 + 8 * len(there)
        assert replies[0].data[5] == 1 + 3 * 8  # announced whole


def test_fast_bulk_read_has_its_own_length_for_each_and_old_firmware_knows_no_fast_reads(host):
    request = b"\x01" + words(132, 4) + b"\x02" + words(146, 1)
    [reply] = host.replies(dxl2.BROADCAST, 0x9A, request)
    assert reply.data[8:14] == bytes([0, 1]) + (2001).to_bytes(4, "little")
    assert reply.data[16:19] == bytes([0, 2, 31])
    assert Host(1, firmware=44).replies(dxl2.BROADCAST, dxl2.FAST_SYNC_READ, POSITIONS + b"\x01") == []


def test_fast_read_of_a_block_that_holds_a_header_is_not_stuffed():
    host = Host(1)
    host.write(1, "goal_position", 0)
    host.write(1, "indirect_data_1", 0xFF)
    host.write(1, "indirect_data_2", 0xFF)
    host.write(1, "indirect_data_3", 0xFD)
    [plain] = host.replies(1, dxl2.READ, words(224, 3))
    [fast] = host.replies(dxl2.BROADCAST, dxl2.FAST_SYNC_READ, words(224, 3) + b"\x01")
    assert b"\xff\xff\xfd\xfd" in plain.data and b"\xff\xff\xfd\xfd" not in fast.data
    assert dxl2.split_fast_status(fast.data, 3) == [(1, 0, b"\xff\xff\xfd")]


def test_second_id_obeys_and_says_nothing(host):
    for servo in (2, 3):
        assert host.write(servo, "secondary_id", 1) == 0
    assert [p.servo for p in host.ask(1, dxl2.WRITE, words(65) + b"\x01")] == [1]
    assert [host.read(i, "led") for i in (1, 2, 3)] == [1, 1, 1]
    host.ask(dxl2.BROADCAST, dxl2.SYNC_WRITE, words(65, 1) + b"\x01\x00")
    assert [host.read(i, "led") for i in (1, 2, 3)] == [0, 0, 0]


def test_a_changed_id_is_answered_under_the_old_one_and_two_of_one_id_talk_over_one_another(host):
    assert [p.servo for p in host.ask(3, dxl2.WRITE, words(7) + b"\x09")] == [3]
    assert [p.servo for p in host.ask(9, dxl2.PING)] == [9] and host.write(2, "id", 1) == 0
    both = host.replies(1, dxl2.READ, POSITIONS)
    assert len(both) == 1 and maybe_packet(bytearray(both[0].data)) is None  # 2001 and 2002 at once: the crc is wrong


def test_watchdog_is_fed_by_any_instruction(host):
    host.write(1, "torque_enable", 1)
    host.write(1, "bus_watchdog", 5)
    for k in range(20):
        host.t = 0.09 * k
        host.ask(2, dxl2.PING)
    assert host.read(1, "bus_watchdog") == 5
