"""Real and virtual ports, and what differs between operating systems."""

import fcntl
import os
import socket
import subprocess
import sys
import tty
from array import array
from contextlib import contextmanager

import pytest
import serial
from virtual_time import Time

from sfms_robot.errors import BusError, PortError
from sfms_robot.servo.port import DEVICE_ERRORS, PolledIO, RtsDirection, SerialPort, VirtualTimePort, serial_io


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
        assert port.read(3, 60.0) == b"def" and port.read(3, 60.0) == b"g" and port.read(3, 0.0) == b""
        os.write(far, b"late")
        port.discard_input()
        assert port.read(9, 0.0) == b""
        port.close()
        port.close()


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


def test_a_network_port_has_one_rate():
    with listening() as (_, url):
        port = SerialPort(url, 1_000_000, Time())
        port.set_baud(1_000_000)
        with pytest.raises(PortError, match=f"^{url}: cannot change to 57600 baud: a socket:// port has the rate of"):
            port.set_baud(57_600)
        port.close()


def test_a_network_port_sends_at_once_what_is_written():
    with listening() as (server, url):
        port = SerialPort(url, 1_000_000, Time())
        peer, _ = server.accept()
        with peer, socket.socket(fileno=os.dup(port._serial.fileno())) as near:
            assert near.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            port.write(b"goal")
            assert peer.recv(9) == b"goal"
            peer.sendall(b"answer")
            assert port.read(9, 60.0) == b"answer"
        with pytest.raises(BusError, match="the device is gone"):
            port.read(1, 60.0)
        port.close()


NO_SERVOS, NO_PLACE = "no servos can be behind .*socket", "names no host and port to connect to .*"


@pytest.mark.parametrize("url", ["loop://", "spy:///dev/null", "hwgrep://x", "nonsense://", "rfc2217://host",
                                 "socket://nohost", "socket://", "socket://:7000", "socket://host:ab"])  # fmt: skip
def test_an_address_that_leads_to_no_servos_is_refused_in_one_line(url):
    problem = NO_PLACE if url.startswith(("socket", "rfc2217")) else NO_SERVOS
    with pytest.raises(PortError, match=f"^{url}: {problem}://HOST:PORT") as caught:
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


@contextmanager
def looped():
    """A device of pyserial's without a file descriptor, that gives back what it was sent."""
    with serial.serial_for_url("loop://", timeout=0) as port:
        yield port


def test_where_there_is_no_descriptor_pyserial_is_asked():
    with looped() as port:
        io = serial_io(port, "loop")
        assert isinstance(io, PolledIO) and io.read(9, 0.0) == b""
        io.write(b"abcde")
        assert io.read(3, 60.0) == b"abc"  # as soon as there are any, never more than asked for
        assert io.read(9, 60.0) == b"de" and io.read(9, 0.0) == b""


def test_a_polled_device_that_is_gone_is_an_error_of_the_device():
    with looped() as port:
        io = PolledIO(port)
    with pytest.raises(DEVICE_ERRORS):
        io.write(b"a")
    with pytest.raises(DEVICE_ERRORS):
        io.read(1, 60.0)


class Line(list):
    """The part of pyserial that the RS-485 direction needs: what was done, in order. `rts` is never asked."""

    rts = property(fset=list.append)
    broken = False

    def write(self, data: bytes) -> None:
        self.append(data)
        if self.broken:
            raise BusError("gone")

    def read(self, n: int, timeout_s: float) -> bytes:
        return b"answer"[:n]

    def flush(self) -> None:
        self.append("sent")


def test_rts_is_on_from_before_the_first_byte_until_the_last_has_left_or_writing_fails():
    line = Line()
    io = RtsDirection(line, line, "ttyAMA0")
    io.write(b"goal")
    assert line == [False, True, b"goal", "sent", False]
    assert io.read(3, 0.0) == b"ans" and line[-1] is False
    line.broken = True
    with pytest.raises(BusError):
        io.write(b"goal")
    assert line[-2:] == [b"goal", False]


def test_a_driver_that_switches_by_itself_is_told_to():
    with looped() as port:
        serial_io(port, "ttyS4", "kernel")
        assert port.rs485_mode.rts_level_for_tx and not port.rs485_mode.rts_level_for_rx


@pytest.mark.parametrize(("how", "problem"), [("kernel", "driver of this device does not"), ("rts", "no RTS line")])
def test_a_device_without_a_direction_is_refused_and_left_closed(how, problem):
    with terminal() as (_, device):
        with pytest.raises(PortError, match=f"{device}: rs485 = '{how}': .*{problem}"):
            SerialPort(device, 57600, Time(), how)
        SerialPort(device, 57600, Time()).close()  # somebody who still held it would be in the way


REFUSED = """
import dynamixel_sdk, serial  # pyserial has other parts for other systems
import importlib, pkgutil, sys

HIDDEN = {"fcntl", "termios", "pty", "tty", "grp", "pwd", "resource"}

class Refuses:
    def find_spec(self, name, path=None, target=None):
        if name in HIDDEN:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

for name in HIDDEN:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Refuses())
for package in map(importlib.import_module, sys.argv[1:]):
    for found in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if found.name != "sfms_robot.cli.__main__":
            importlib.import_module(found.name)
import sfms_robot.app.session, sfms_robot.app.api.robot, sfms_robot.app.api.servos
print(sorted(HIDDEN & set(sys.modules)))
"""


def test_everything_that_moves_a_head_is_imported_where_only_windows_modules_are():
    packages = [f"sfms_robot.{name}" for name in ("servo", "runtime", "cli")]
    done = subprocess.run([sys.executable, "-c", REFUSED, *packages], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "[]"), done.stderr
