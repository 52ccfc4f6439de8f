"""What differs between operating systems: polling instead of a descriptor, RS-485 direction, missing modules."""

import os
import subprocess
import sys
import tty
from contextlib import contextmanager

import pytest
import serial
from virtual_time import Time

from sfms_robot.config import load_head
from sfms_robot.errors import BusError, PortError
from sfms_robot.servo.port import DEVICE_ERRORS, PolledIO, RtsDirection, SerialPort, serial_io


@contextmanager
def looped():
    """A device of pyserial's without a file descriptor, that gives back what it was sent."""
    with serial.serial_for_url("loop://", timeout=0) as port:
        yield port


def test_where_there_is_no_descriptor_pyserial_is_asked():
    with looped() as port:
        io = serial_io(port, "loop")
        assert isinstance(io, PolledIO)
        assert io.read(9, 0.0) == b""
        io.write(b"abcde")
        assert io.read(3, 60.0) == b"abc"  # as soon as there are any, never more than asked for
        assert io.read(9, 60.0) == b"de"
        assert io.read(9, 0.0) == b""


def test_a_polled_device_that_is_gone_is_an_error_of_the_device():
    with looped() as port:
        io = PolledIO(port)
    with pytest.raises(DEVICE_ERRORS):
        io.write(b"a")
    with pytest.raises(DEVICE_ERRORS):
        io.read(1, 60.0)


class Line:
    """The part of pyserial that the RS-485 direction needs, with a diary of what was done in which order."""

    def __init__(self, broken: bool = False):
        self.done: list[object] = []
        self.broken = broken

    @property
    def rts(self) -> bool:
        raise AssertionError("never asked")

    @rts.setter
    def rts(self, on: bool) -> None:
        self.done.append(on)

    def write(self, data: bytes) -> None:
        self.done.append(data)
        if self.broken:
            raise BusError("gone")

    def read(self, n: int, timeout_s: float) -> bytes:
        return b"answer"[:n]

    def flush(self) -> None:
        self.done.append("sent")


def test_rts_is_on_from_before_the_first_byte_until_the_last_has_left():
    line = Line()
    io = RtsDirection(line, line, "ttyAMA0")
    io.write(b"goal")
    assert line.done == [False, True, b"goal", "sent", False]
    assert io.read(3, 0.0) == b"ans" and line.done[-1] is False


def test_rts_is_off_again_when_writing_fails():
    line = Line(broken=True)
    with pytest.raises(BusError):
        RtsDirection(line, line, "ttyAMA0").write(b"goal")
    assert line.done[-1] is False


def test_a_driver_that_switches_by_itself_is_told_to():
    with looped() as port:
        serial_io(port, "ttyS4", "kernel")
        assert port.rs485_mode.rts_level_for_tx and not port.rs485_mode.rts_level_for_rx


@pytest.mark.parametrize(("how", "problem"), [("kernel", "driver of this device does not"), ("rts", "no RTS line")])
def test_a_device_without_a_direction_is_refused_and_left_closed(how, problem):
    far, near = os.openpty()
    tty.setraw(near)
    device = os.ttyname(near)
    with pytest.raises(PortError, match=f"{device}: rs485 = '{how}': .*{problem}"):
        SerialPort(device, 57600, Time(), how)
    SerialPort(device, 57600, Time()).close()  # somebody who still held it would be in the way
    os.close(near)
    os.close(far)


def test_a_head_says_who_switches_the_direction(tmp_path):
    text = "name: a\ndescription: b\nbuses: {main: {family: feetech, baud: 1000000, rs485: rts}}\n"
    text += "limits: {l: {speed_deg_s: 1, acceleration_deg_s2: 1, jerk_deg_s3: 1}}\n"
    text += "joints: {j: {bus: main, id: 1, model: sts3215, zero_ticks: 0, min_deg: -1, max_deg: 1, limits: l}}\n"
    (tmp_path / "head.yaml").write_text(text)
    assert load_head(str(tmp_path)).buses["main"].rs485 == "rts"


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
