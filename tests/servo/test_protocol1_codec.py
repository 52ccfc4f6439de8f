import pytest
from dynamixel_sdk import Protocol1PacketHandler
from hypothesis import given
from hypothesis import strategies as st
from published import rows
from vendor_port import VendorPort

from sfms_robot.errors import PacketError
from sfms_robot.servo.codecs import protocol1
from sfms_robot.servo.codecs.protocol1 import Frame, encode, salvage
from sfms_robot.servo.codecs.protocol1 import maybe_frame as take

ROWS = rows("protocol1_packets.csv")

ids = st.integers(0, protocol1.BROADCAST)
codes = st.integers(0, 255)
# Nothing is stuffed, so parameters that look like a header are what a reader has to get over.
tricky = st.lists(st.sampled_from([b"\xff", b"\xff\xff", b"\x01", b"\x02", b"\x00"]), max_size=40).map(b"".join)
params = st.binary(max_size=60) | tricky


def frame_of(name: str) -> Frame:
    frame = take(bytearray.fromhex(next(row["frame"] for row in ROWS if row["name"] == name)))
    assert frame is not None
    return frame


def test_known_requests_mean_what_their_names_say():
    goals = frame_of("AX sync write goal+speed ids 0 1 2 3")
    assert goals.params.hex().startswith("1e04") and goals.params[7:12].hex() == "0120026003"
    sync = frame_of("sync read pos+speed (56,4) ids 1 2")
    assert protocol1.sync_read_params(56, 4, [1, 2]) == sync.params
    assert frame_of("clear turns id1").code == protocol1.RESET_TURNS
    bulk = encode(protocol1.BROADCAST, protocol1.BULK_READ, protocol1.bulk_read_params([(1, 0x1E, 2), (2, 0x24, 2)]))
    assert bulk.hex() == "fffffe09920002011e0202241d"  # the example of the e-manual


@given(ids, codes, params)
def test_round_trip(servo, code, data):
    assert take(bytearray(encode(servo, code, data))) == Frame(servo, code, data)
    assert take(bytearray(b"\xff" + encode(servo, code, data))) == Frame(servo, code, data)  # a third FF is header


def test_lengths_that_no_frame_has_are_refused_or_pass_where_a_parameter_is_the_right_sum():
    assert len(encode(1, 3, bytes(protocol1.MAX_PARAMS))) == protocol1.MAX_FRAME
    with pytest.raises(PacketError, match="254 parameters is longer than 253"):
        encode(1, 3, bytes(254))
    wrong = bytearray(encode(1, protocol1.WRITE, b"\x1e\x01\x02\xd5"))
    assert take(bytearray(wrong)) is not None
    wrong[3] = 5
    assert take(wrong) == Frame(1, protocol1.WRITE, b"\x1e\x01\x02")  # as sent, and the rest is lost


@given(params, st.integers(1, 200))
def test_frame_cut_off_does_not_swallow_the_next(data, cut):
    whole, part = encode(4, 0, b"\x01\x02"), encode(3, 0, data)
    buffer, found = bytearray(part[: max(0, len(part) - cut)] + whole), []
    while (frame := take(buffer)) is not None:
        found.append(frame)
    assert Frame(4, 0, b"\x01\x02") in found + salvage(buffer) and not buffer


@given(params, st.integers(0, 7), st.data())
def test_flipped_bit_is_no_frame_of_that_servo_with_other_content(data, bit, draw):
    wire = bytearray(encode(7, 0, data))
    wire[draw.draw(st.integers(0, len(wire) - 1))] ^= 1 << bit
    for frame in salvage(wire):
        assert len(frame.params) < len(data)  # at most a shorter one inside, which its length gives away


SYNC_WRITE = encode(protocol1.BROADCAST, protocol1.SYNC_WRITE, bytes.fromhex("1e 02 01 00 02 02 34 01 03 cd 02"))


@pytest.mark.parametrize("at", [i for i in range(len(SYNC_WRITE)) if i != 3])
def test_any_change_of_one_byte_but_the_length_is_detected(at):
    for change in range(1, 256):
        wrong = bytearray(SYNC_WRITE)
        wrong[at] ^= change
        assert salvage(wrong) == []


def test_error_bits_about_the_request_are_told_from_those_about_the_servo():
    of_servo = 1 << 0 | 1 << 2 | 1 << 5  # voltage, overheating, overload
    assert (protocol1.refusal_text(protocol1.RANGE | of_servo), protocol1.refusal_text(of_servo)) == ("range error", "")


@given(st.integers(0, 252), st.integers(0, 255), st.binary(min_size=1, max_size=200))
def test_writes_are_those_of_the_vendor_sdk(servo, address, data):
    port = VendorPort()
    Protocol1PacketHandler().writeTxOnly(port, servo, address, len(data), list(data))
    assert port.written == encode(servo, protocol1.WRITE, bytes([address]) + data)


@given(st.dictionaries(st.integers(0, 252), st.binary(min_size=2, max_size=2), min_size=1, max_size=40))
def test_sync_writes_are_those_of_the_vendor_sdk(values):
    port = VendorPort()
    flat = [byte for servo, data in values.items() for byte in (servo, *data)]
    Protocol1PacketHandler().syncWriteTxOnly(port, 30, 2, flat, len(flat))
    assert port.written == protocol1.encode_sync_write(30, 2, bytes(flat))


@given(st.integers(0, 252), st.integers(0, 127), st.binary(min_size=1, max_size=100))
def test_the_vendor_sdk_reads_our_status_frames(servo, error, data):
    port = VendorPort(encode(servo, error, data))
    got, result, told = Protocol1PacketHandler().readRx(port, servo, len(data))
    assert (bytes(got), result, told) == (data, 0, error)
