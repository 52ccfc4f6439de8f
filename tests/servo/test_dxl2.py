import pytest
from dynamixel_sdk import Protocol2PacketHandler
from hypothesis import assume, example, given
from hypothesis import strategies as st
from vendor_port import VendorPort

from sfms_robot.errors import PacketError
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import Packet, crc16, encode_fast_status, encode_instruction, encode_status
from sfms_robot.servo.codecs.dxl2 import maybe_packet as take

ids = st.integers(0, dxl2.MAX_ID) | st.just(dxl2.BROADCAST)
# Bytes that look like a header are what stuffing is about: make them common.
tricky = st.lists(st.sampled_from([b"\xff", b"\xff\xff\xfd", b"\xfd", b"\x00", b"\x55"]), max_size=40).map(b"".join)
params = st.binary(max_size=60) | tricky


def test_crc_check_value_and_longest_packet():
    assert crc16(b"123456789") == 0xFEE8
    with pytest.raises(PacketError, match="longer than 1024"):
        encode_instruction(1, dxl2.WRITE, bytes(1020))


@given(ids, st.sampled_from([dxl2.READ, dxl2.WRITE, dxl2.SYNC_WRITE]), params)
def test_instruction_round_trip(servo, code, data):
    assert take(bytearray(encode_instruction(servo, code, data))) == Packet(servo, code, data)


@given(st.integers(0, dxl2.MAX_ID), st.integers(0, 255), params)
def test_status_round_trip(servo, error, data):
    wire = encode_status(servo, error, data)
    assert take(bytearray(wire)) == Packet(servo, dxl2.STATUS, data, error)
    assert b"\xff\xff\xfd\x00" not in wire[1:-2]


@given(params, st.integers(1, 200))
@example(bytes(40), 10)  # as long as nothing says that it was cut off, its end is waited for
def test_packet_cut_off_does_not_swallow_the_next(data, cut):
    whole, part = encode_status(4, 0, b"\x01\x02"), encode_status(3, 0, data)
    buffer, found = bytearray(part[: min(cut, len(part) - 3)] + whole), []
    while (packet := take(buffer)) is not None:
        found.append(packet)
    assert found == [Packet(4, dxl2.STATUS, b"\x01\x02")]


@given(st.integers(0, 252), st.integers(0, 1000), st.binary(min_size=1, max_size=20))
def test_vendor_sdk_writes_the_same_bytes(servo, address, data):
    # Version 4.1.0 of the SDK throws its own stuffing away, so it cannot be compared where stuffing is due.
    body = address.to_bytes(2, "little") + data
    if b"\xff\xff\xfd" not in body:
        wire = VendorPort()
        Protocol2PacketHandler().writeTxOnly(wire, servo, address, len(data), list(data))
        assert wire.written == encode_instruction(servo, dxl2.WRITE, body)


@given(st.integers(0, 252), st.integers(0, 255), st.binary(min_size=1, max_size=20) | tricky.filter(bool))
def test_vendor_sdk_reads_what_we_write(servo, error, data):
    # The SDK removes stuffing in place and then looks at bytes it has moved: behind the first it may see another.
    _, header, rest = (bytes([dxl2.STATUS, error]) + data).partition(b"\xff\xff\xfd")
    assume(not header or b"\xfd\xfd" not in rest)
    answer, result, told = Protocol2PacketHandler().readRx(
        VendorPort(encode_status(servo, error, data)), servo, len(data)
    )
    assert (bytes(answer), result, told) == (data, 0, error)


def test_vendor_sdk_reads_our_fast_status():
    wire = encode_fast_status([(1, 0, b"\x01\x02"), (2, 0x80, b"\x03\x04")])
    answer, result, _ = Protocol2PacketHandler().fastSyncReadRx(VendorPort(wire), dxl2.BROADCAST, 2 * 6)
    assert result == 0
    assert bytes(answer[:4]) == b"\x00\x01\x01\x02" and bytes(answer[6:10]) == b"\x80\x02\x03\x04"


WRITE = encode_instruction(dxl2.BROADCAST, dxl2.SYNC_WRITE, bytes.fromhex("74 00 04 00 01 00 08 00 00 02 34 08 00 00"))


@pytest.mark.parametrize("at", range(len(WRITE)))
def test_any_change_of_one_byte_is_detected(at):
    for change in range(1, 256):
        wrong = bytearray(WRITE)
        wrong[at] ^= change
        assert take(wrong) is None
