"""Emulated servos and boards against packets that this package did not make.

Requests come from `tests/assets` (published by the makers, or computed by another program). Answers are bytes of the
same files, or written out here and closed with a checksum of the maker's page, spelt out below. The codecs of the host
are tested against the same files, so neither side is only tested against the other.
"""

import pytest
from emulated_devices import device_of, servos_of
from published import rows

BAUD = 1_000_000


def vectors(file, column):
    return {row["name"]: row[column] for row in rows(file)}


NEW = {name: bytes.fromhex(text) for name, text in vectors("dxl2_packets.csv", "packet").items()}
OLD = {name: bytes.fromhex(text) for name, text in vectors("protocol1_packets.csv", "frame").items()}
BOARD = vectors("board_commands.csv", "bytes")


def crc(data):
    """CRC-16/UMTS: polynomial 8005, start 0, not reflected; bit by bit."""
    out = 0
    for byte in data:
        out ^= byte << 8
        for _ in range(8):
            out = (out << 1 ^ 0x8005) & 0xFFFF if out & 0x8000 else out << 1
    return out


def status2(servo, error, *data):
    body = bytes([255, 255, 253, 0, servo, len(data) + 4, 0, 0x55, error, *data])
    return body + crc(body).to_bytes(2, "little")


def status1(servo, error, *data):
    body = [servo, len(data) + 2, error, *data]
    return bytes([255, 255, *body, ~sum(body) & 255])


def servos(model, *ids, firmware=53, start_ticks=None, **registers):
    stored = {"firmware": firmware, "start_ticks": start_ticks, "registers": registers}
    return device_of(*servos_of(model, *ids, **stored))


def test_the_checksum_of_this_file_is_the_makers():
    assert crc(b"123456789") == 0xFEE8
    name = "status to ping id1: model 1030 fw 38"
    assert status2(1, 0, 0x06, 0x04, 0x26) == NEW[name]


def test_protocol_2_ping_of_an_xm430_w210():
    chain = servos("xm430-w210", 1, firmware=38)
    for request in ("ping id1", "ping broadcast"):
        assert chain.receive(NEW[request], BAUD, 0.0) == NEW["status to ping id1: model 1030 fw 38"]


def test_protocol_2_reads():
    chain = servos("xl330-m288", 1, 2, start_ticks=0x0823)
    one, two = status2(1, 0, 0x23, 8, 0, 0), status2(2, 0, 0x23, 8, 0, 0)
    assert chain.receive(NEW["read 4 bytes at 132 id1"], BAUD, 0.0) == one
    assert chain.receive(NEW["sync read 4 bytes at 132 ids 1 2"], BAUD, 0.0) == one + two
    bulk = chain.receive(NEW["bulk read id1 2 bytes at 144 + id2 1 byte at 146"], BAUD, 0.0)
    assert bulk == status2(1, 0, 50, 0) + status2(2, 0, 31)  # 5.0 V, 31 degrees
    fast = bytes.fromhex("ff ff fd 00 fe 11 00 55 00 01 23 08 00 00")
    fast += crc(fast).to_bytes(2, "little") + bytes.fromhex("00 02 23 08 00 00")
    answer = chain.receive(NEW["fast sync read 4 bytes at 132 ids 1 2"], BAUD, 0.0)
    assert answer == fast + crc(fast).to_bytes(2, "little")


def test_protocol_2_writes():
    chain = servos("xl330-m288", 1, 2)
    assert chain.receive(NEW["write 512 to goal position id1"], BAUD, 0.0) == status2(1, 0)
    assert chain.servo(1).state(0.0)["goal"] == 512
    assert chain.receive(NEW["torque on id1 (X series)"], BAUD, 0.0) == status2(1, 0)
    assert chain.servo(1).state(5.0)["position"] == 512
    assert chain.receive(NEW["sync write goal position id1=150 id2=170"], BAUD, 5.0) == b""
    assert [chain.servo(i).state(5.0)["goal"] for i in (1, 2)] == [150, 170]
    # Unstuffed it is four bytes, not five, so its length is right; but 00FDFFFF is more than a goal may be.
    assert chain.receive(NEW["write ff ff fd 00 to goal position (stuffing)"], BAUD, 5.0) == status2(1, 4)


def test_protocol_2_limits_velocity_and_resets():
    chain = servos("xm430-w350", 1, 2)
    request = "bulk write id1 max voltage 160 + id2 temp limit 80"
    assert chain.receive(NEW[request], BAUD, 0.0) == b""
    assert chain.servo(1).read(32, 2, 0.0) == (0, b"\xa0\x00") and chain.servo(2).read(31, 1, 0.0) == (0, b"\x50")
    assert chain.receive(NEW["write -1 to goal velocity id1"], BAUD, 0.0) == status2(1, 0)
    assert chain.servo(1).read(104, 4, 0.0) == (0, b"\xff\xff\xff\xff")
    chain.servo(1).turn(2 * 4096 + 7, 0.0)
    assert chain.receive(NEW["clear multi-turn id1"], BAUD, 0.0) == status2(1, 0)
    assert chain.servo(1).state(0.0)["position"] == 7
    assert chain.receive(NEW["reboot id1"], BAUD, 0.0) == status2(1, 0)
    assert chain.receive(NEW["ping id1"], BAUD, 0.1) == b""  # it starts
    chain.servo(1).write(9, b"\x07", 1.0)
    assert chain.receive(NEW["factory reset id1 except id"], BAUD, 1.0) == status2(1, 0)
    assert chain.servo(1).read(9, 1, 2.0) == (0, b"\xfa") and chain.servo(1).baud == 57_600


def test_protocol_2_alert_and_access_error():
    chain = servos("xl330-m288", 1)
    chain.servo(1).fail(1 << 5, 0.0)  # overload, of those that shut it down
    name = "status with alert bit and access error (0x87) id1"
    assert chain.receive(NEW["torque on id1 (X series)"], BAUD, 0.0) == NEW[name]


def test_dynamixel_1_frames():
    chain = servos("ax-12a", 0, 1, 2, 3)
    assert chain.receive(OLD["ping id1"], BAUD, 0.0) == status1(1, 0)
    assert chain.receive(OLD["read temperature id1 (43,1)"], BAUD, 0.0) == status1(1, 0, 31)
    assert chain.receive(OLD["AX goal position 512 id1"], BAUD, 0.0) == status1(1, 0)
    assert chain.servo(1).state(0.0)["goal"] == 512
    assert chain.receive(OLD["AX sync write goal+speed ids 0 1 2 3"], BAUD, 0.0) == b""
    assert [chain.servo(i).state(0.0)["goal"] for i in range(4)] == [0x10, 0x220, 0x30, 0x220]
    assert [chain.servo(i).read(32, 2, 0.0)[1].hex() for i in range(4)] == ["5001", "6003", "7001", "8003"]


def test_feetech_frames():
    chain = servos("sts3215", 1, 2, start_ticks=0x0456)
    one, two = (status1(i, 0, 0x56, 4, 0, 0) for i in (1, 2))
    assert chain.receive(OLD["read position id1"], BAUD, 0.0) == status1(1, 0, 0x56, 4)
    assert chain.receive(OLD["sync read pos+speed (56,4) ids 1 2"], BAUD, 0.0) == one + two
    assert chain.receive(OLD["write pos 1000 time 0 speed 0 id2"], BAUD, 0.0) == status1(2, 0)
    assert chain.servo(2).state(3.0)["position"] == 1000
    assert chain.receive(OLD["write acc 50 pos 1000 time 0 speed 1000 id1"], BAUD, 3.0) == status1(1, 0)
    assert chain.servo(1).read(41, 7, 3.0)[1].hex(" ") == "32 e8 03 00 00 e8 03"
    assert chain.receive(OLD["sync write acc+pos+time+speed ids 1 2"], BAUD, 3.0) == b""
    assert [chain.servo(i).state(3.0)["goal"] for i in (1, 2)] == [2048, 2048]


def test_feetech_turns_and_id():
    chain = servos("sts3215", 1, lock=1, phase=28)
    chain.servo(1).turn(3 * 4096 + 9, 0.0)
    assert chain.receive(OLD["clear turns id1"], BAUD, 0.0) == status1(1, 0)
    assert chain.receive(OLD["read position id1"], BAUD, 0.0) == status1(1, 0, 9, 0)
    assert chain.receive(OLD["unlock EPROM broadcast (STS lock 55)"], BAUD, 0.0) == b""
    assert chain.receive(OLD["set id 2 on id 1"], BAUD, 0.0) == status1(1, 0)
    assert chain.servo(2) is not None and chain.servo(1) is None


def test_feetech_with_the_high_byte_first():
    chain = servos("scs0009", 1)
    request = "write pos 512 time 0 speed 0 id1 (high byte first)"
    assert chain.receive(OLD[request], BAUD, 0.0) == status1(1, 0) and chain.servo(1).state(0.0)["goal"] == 512


@pytest.fixture
def maestro():
    board = device_of(*servos_of("maestro-24", *range(6), baud=9600))
    board.receive(b"\xaa", 9600, 0.0)
    return board


def test_maestro_commands(maestro):
    def send(name):
        return maestro.receive(bytes.fromhex(BOARD[name]), 9600, 0.0)

    def pulses():
        return [channel.pulse for channel in maestro.servos]

    middle = "set target channel 0 1500 us", "set target channel 0 1500 us device 12", "mini ssc channel 0 neutral"
    for name in middle:
        maestro.restart(0.0)
        maestro.receive(b"\xaa", 9600, 0.0)
        assert send(name) == b"" and pulses() == [6000, 0, 0, 0, 0, 0]
    send("set targets channels 3 and 4 0 and 6000")
    assert pulses() == [6000, 0, 0, 0, 6000, 0]
    assert send("get position channel 2") == b"\x00\x00" and send("get errors") == b"\x00\x00"
    send("set speed channel 5 140")
    send("set acceleration channel 5 5")
    assert (maestro.channels[5].speed, maestro.channels[5].acceleration) == (140 * 100.0, 5 * 1250.0)
    send("go home")
    assert pulses() == [0] * 6
    assert maestro.receive(b"\x90", 9600, 0.0) == b"" and maestro.receive(b"\xa1", 9600, 0.0) == b"\x10\x00"


def test_ssc32_commands():
    board = device_of(*servos_of("ssc-32", 3, 4, 5, 10, baud=9600))

    def send(name, now_s):
        return board.receive(BOARD[name].replace("<CR>", "\r").encode(), 9600, now_s)

    board.receive(b"#5P1500#10P1500#4P1500\r", 9600, 0.0)
    assert send("group move", 0.0) == b"" and send("query movement", 1.0) == b"+"
    assert send("query movement", 2.6) == b"." and send("query pulse", 2.6) == bytes([160])
    assert send("outputs", 2.6) == b"" and board.channels[4].pulse == 0
    send("single with speed", 2.6)
    assert board.channels[5].speed == 750
