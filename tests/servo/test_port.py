import fcntl
import os
import socket
import tty
from array import array
from contextlib import contextmanager

import pytest
from emulated_port import ScriptedPort
from virtual_time import Time

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import BusError, PortError
from sfms_robot.servo.chain.protocol2 import Dynamixel2Link
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.port import WRITE_TIMEOUT_S, SerialPort, VirtualTimePort


@contextmanager
def terminal():
    """Two ends of a pseudo terminal: (file descriptor of the far end, device path of the near one)."""
    master, slave = os.openpty()
    tty.setraw(slave)
    try:
        yield master, os.ttyname(slave)
    finally:
        os.close(master)
        os.close(slave)


def test_bytes_go_out_and_come_in():
    with terminal() as (far, device):
        port = SerialPort(device, 1_000_000, Time())
        port.write(b"abc")
        assert os.read(far, 10) == b"abc"
        os.write(far, b"defg")
        assert port.read(3, 60.0) == b"def"
        assert port.read(3, 60.0) == b"g"
        assert port.read(3, 0.0) == b""
        os.write(far, b"late")
        port.discard_input()
        assert port.read(9, 0.0) == b""
        port.close()
        port.close()


def test_port_is_ours_alone():
    with terminal() as (_, device):
        port = SerialPort(device, 57600, Time())
        with pytest.raises(PortError, match=f"{device}: is held by another program"):
            SerialPort(device, 57600, Time())
        port.close()
        SerialPort(device, 57600, Time()).close()


def test_a_relative_path_is_a_path_like_any_other(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder").mkdir()
    with terminal() as (_, device):
        (tmp_path / "head").symlink_to(device)
        port = SerialPort("head", 57600, Time())
        with pytest.raises(PortError, match="^head: is held by another program"):
            SerialPort("head", 57600, Time())
        port.close()
    with pytest.raises(PortError, match="^folder: is a directory"):
        SerialPort("folder", 57600, Time())
    with pytest.raises(PortError, match="^nowhere: no such device"):
        SerialPort("nowhere", 57600, Time())


@pytest.mark.parametrize("baud", [250_000, 1_234_567, 4_500_000])
def test_any_baud_rate_will_do(baud):
    with terminal() as (far, device):
        port = SerialPort(device, 57600, Time())
        port.set_baud(baud)
        settings = array("I", [0] * 64)
        fcntl.ioctl(far, 0x802C542A, settings, True)  # TCGETS2: what the far end sees
        assert settings[10] == baud
        port.close()


@pytest.mark.parametrize("baud", [-1, 2**40])
def test_impossible_baud_rate_is_an_error_of_one_line(baud):
    with terminal() as (_, device):
        with pytest.raises(PortError, match=f"{device}: "):
            SerialPort(device, baud, Time())
        SerialPort(device, 57600, Time()).close()


def test_servo_at_four_and_a_half_megabaud_is_found(make_rig):
    fast = [EmulatedServo(1, model="xm430-w350", baud=4_500_000)]
    with make_rig(fast, baud=4_500_000, firmware_map=load_firmware_map("xm430-w350")) as rig:
        assert rig.ticks(rig.hold(), 3)["joint1"].age_s == 0.0


def test_device_that_takes_no_more_bytes_is_a_failure_and_no_hang():
    with terminal() as (_, device):
        port = SerialPort(device, 57600, Time())
        with pytest.raises(BusError, match="takes no more bytes"):
            port.write(bytes(1 << 20))
        port.close()


@contextmanager
def listening():
    """A server on this computer: its socket and the URL of it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server, f"socket://127.0.0.1:{server.getsockname()[1]}"


def test_a_network_port_sends_at_once_what_is_written():
    with listening() as (server, url):
        port = SerialPort(url, 1_000_000, Time())
        peer, _ = server.accept()
        with peer, socket.socket(fileno=os.dup(port._serial.fileno())) as near:
            assert near.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            port.write(b"goal")
            assert peer.recv(9) == b"goal"
            port.set_baud(57_600)
            peer.sendall(b"answer")
            assert port.read(9, 60.0) == b"answer"
        with pytest.raises(BusError, match="the device is gone"):
            port.read(1, 60.0)
        port.close()


@pytest.mark.parametrize("url", ["loop://", "spy:///dev/null", "hwgrep://x", "nonsense://"])
def test_a_url_without_servos_behind_it_is_refused_in_one_line(url):
    with pytest.raises(PortError, match=f"^{url}: no servos can be behind .*socket://HOST:PORT") as caught:
        SerialPort(url, 57600, Time())
    assert "\n" not in str(caught.value)


def test_device_that_goes_away_is_a_failure_of_the_bus():
    master, slave = os.openpty()
    tty.setraw(slave)
    port = SerialPort(os.ttyname(slave), 57600, Time())
    os.close(slave)
    os.close(master)
    with pytest.raises(BusError, match="the device is gone|cannot be read any more"):
        port.read(1, 1.0)
    port.close()


def test_virtual_port_needs_an_emulator(tmp_path):
    with pytest.raises(PortError, match="no emulator answers there"):
        VirtualTimePort("/dev/null", str(tmp_path / "control"), 57600, Time())


def test_rubbish_neither_hangs_nor_confuses(make_rig):
    noise = bytes((i * i * 31 + i // 7) & 0xFF for i in range(100_000))
    with make_rig([EmulatedServo(1)]) as rig:
        port = rig.port()
        port.write(noise)
        assert port.read(1 << 16, 0.0) == b""
        port.close()
        rig.clock.t = 1.0
        with rig.link() as link:
            assert link.ping(1) is not None
        assert rig.chain.digest()[1] > 100_000


def test_a_busy_machine_is_no_reason_to_give_up_a_write_in_virtual_time(make_rig):
    """A process that gets no turn for half a second, with pyserial's own write under way, lost its bus for good."""
    with make_rig([EmulatedServo(1)]) as rig:
        port = rig.port()
        assert port._serial.write_timeout > 10 * WRITE_TIMEOUT_S
        port.close()


def test_second_host_in_virtual_time_starts_from_zero(make_rig):
    with make_rig([EmulatedServo(1)]) as rig:
        for _ in range(2):
            with rig.link() as link:
                assert link.read(1, 132, 4) is not None


def test_answers_are_taken_by_id_and_length():
    four, late, foreign = (
        dxl2.encode_status(1, 0, b"\x01\x02\x03\x04"),
        dxl2.encode_status(1, 0, b"\x09"),
        dxl2.encode_status(2, 0, b"\x05\x06\x07\x08"),
    )
    link = Dynamixel2Link(ScriptedPort(late + foreign[:5], foreign[5:] + b"\xff\xff" + four), 1_000_000, 0.003)
    assert link.read(1, 132, 4).data == b"\x01\x02\x03\x04"


def test_own_echo_is_not_an_answer():
    echo = dxl2.encode_instruction(1, dxl2.PING)
    link = Dynamixel2Link(ScriptedPort(echo), 1_000_000, 0.003)
    assert link.ping(1) is None


def test_refusal_without_data_is_an_answer():
    link = Dynamixel2Link(ScriptedPort(dxl2.encode_status(1, dxl2.ACCESS_ERROR)), 1_000_000, 0.003)
    assert link.read(1, 132, 4).error == dxl2.ACCESS_ERROR


@pytest.mark.parametrize("data", [b"\xff\xff\xfd\x00", b"\xff\xff\xfd\xfd", b"\x00\xff\xff\xfd"])
def test_data_that_look_like_a_header_are_stuffed(data):
    port = ScriptedPort()
    link = Dynamixel2Link(port, 1_000_000, 0.003)
    link.write(1, 116, data)
    link.sync_write(116, {1: data, 2: bytes(4)})
    for sent in port.sent:
        packet = dxl2.maybe_packet(bytearray(sent))
        assert packet is not None and data in packet.params


@pytest.mark.parametrize(
    "url", ["socket://nohost", "socket://", "socket://:7000", "socket://host:ab", "rfc2217://host"]
)
def test_an_address_without_host_or_port_is_told_what_it_lacks(url):
    with pytest.raises(PortError, match=f"^{url}: names no host and port to connect to .*://HOST:PORT"):
        SerialPort(url, 57600, Time())
