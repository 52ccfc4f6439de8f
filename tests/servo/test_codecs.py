"""Laws of every codec: what is written is read, in pieces and behind rubbish, and nothing piles up."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from published import byte_by_byte, rows

from sfms_robot.servo.codecs import dxl2, maestro, protocol1, ssc32

# The reader of each, and a length that no unfinished message reaches.
READERS = {
    "dxl2": (dxl2.maybe_packet, dxl2.MAX_PACKET),
    "protocol1": (protocol1.maybe_frame, protocol1.MAX_FRAME),
    "maestro": (maestro.maybe_command, 3 + 2 + 2 * 127 + 1),
    "ssc32": (ssc32.maybe_command, ssc32.MAX_LINE),
}
STATUS = {
    "dxl2": lambda servo, data: dxl2.encode_status(servo, 0, data),
    "protocol1": lambda servo, data: protocol1.encode(servo, 0, data),
}
PACKETS = [
    pytest.param(codec, bytes.fromhex(row[column]), id=row["name"])
    for codec, column in (("dxl2", "packet"), ("protocol1", "frame"))
    for row in rows(f"{codec}_packets.csv")
]
# Bytes that look like a header are what stuffing is about, and where there is none, what a reader has to get over.
tricky = st.lists(st.sampled_from([b"\xff", b"\xff\xff", b"\xff\xff\xfd", b"\x01", b"\x00", b"\x55"]), max_size=40)
params = st.binary(max_size=60) | tricky.map(b"".join)


@pytest.mark.parametrize(("codec", "wire"), PACKETS)
def test_known_packet_is_read_whole_and_byte_by_byte_and_written(codec, wire):
    take, _ = READERS[codec]
    packet = take(buffer := bytearray(wire))
    assert packet is not None and not buffer and byte_by_byte(take, wire) == packet
    if codec == "protocol1":
        assert protocol1.encode(*packet) == wire
    elif packet.instruction == dxl2.STATUS:
        assert dxl2.encode_status(packet.servo, packet.error, packet.params) == wire
    else:
        assert dxl2.encode_instruction(packet.servo, packet.instruction, packet.params) == wire


@pytest.mark.parametrize("codec", STATUS)
@given(st.binary(max_size=30), params, params)
def test_packets_are_found_behind_rubbish(codec, rubbish, first, second):
    (take, _), status = READERS[codec], STATUS[codec]
    buffer = bytearray(status(3, first) + rubbish.replace(b"\xff", b"\xfe") + status(4, second))
    found = take(buffer), take(buffer)
    assert [(packet.servo, packet.params) for packet in found] == [(3, first), (4, second)]


@pytest.mark.parametrize("codec", READERS)
@given(st.lists(st.binary(max_size=300).map(lambda data: data * 9), max_size=10))
def test_rubbish_neither_hangs_nor_piles_up(codec, chunks):
    take, longest = READERS[codec]
    buffer = bytearray()
    for chunk in chunks:
        buffer += chunk
        for _ in range(len(buffer) + 1):
            if take(buffer) is None:
                break
        assert len(buffer) < longest and take(buffer) is None
