"""The latch keeps, only a person opens it, a dead loop is released, and switches outside the program close it."""

import os
import signal
import struct
import threading
from pathlib import Path

import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.halt_switches import halt_signals, halt_switch, open_line

LONG_S = 5.0  # for what must happen; nothing waits so long unless it fails


class Wire:
    """What a latch releases: nothing is plugged in, so it only tells when."""

    def __init__(self) -> None:
        self.released = threading.Event()

    def torque_off(self, policy: str) -> None:
        assert policy == "release"
        self.released.set()


class Seen(HaltLatch):
    """A latch that tells a test when it has been closed."""

    def __init__(self) -> None:
        super().__init__()
        self.closed = threading.Event()

    def close(self, by: str) -> None:
        super().close(by)
        self.closed.set()


def test_it_stays_closed_for_who_closed_it_first_until_a_person_opens_it() -> None:
    latch = HaltLatch()
    assert latch.by is None
    latch.close("key")
    latch.close("file")
    assert latch.by == "key"
    latch.open()
    assert latch.by is None
    latch.close("file")
    assert latch.by == "file"


def test_a_loop_that_does_not_answer_is_released_and_one_that_does_is_not() -> None:
    for answers in (False, True):
        latch, wire = HaltLatch(), Wire()
        with latch.watched(wire):
            if answers:
                latch.close("key")
                latch.answer()
            else:
                latch.close("key")
                assert wire.released.wait(LONG_S)
        assert wire.released.is_set() != answers


def test_each_halt_wants_an_answer_of_its_own() -> None:
    latch, wire = HaltLatch(), Wire()
    with latch.watched(wire):
        latch.close("key")
        latch.answer()
        latch.open()
        latch.close("file")
        assert wire.released.wait(LONG_S)


def test_a_handler_that_interrupts_the_latch_itself_does_not_wait_for_it() -> None:
    latch = HaltLatch()
    with latch._changed:  # where a signal may find the thread that handles it
        latch.close("signal")
    assert latch.by == "signal"


def test_a_file_that_appears_closes_it(tmp_path: Path) -> None:
    latch, button = Seen(), tmp_path / "stop"
    with halt_switch(str(button), latch):
        assert latch.by is None
        button.touch()
        assert latch.closed.wait(LONG_S)
    assert latch.by == str(button)


def test_one_signal_halts_and_another_lets_go() -> None:
    latch = HaltLatch()
    with halt_signals(latch):
        signal.raise_signal(signal.SIGUSR1)
        assert latch.by == "signal"
        signal.raise_signal(signal.SIGUSR2)
        assert latch.by is None
    assert signal.getsignal(signal.SIGUSR1) is signal.SIG_DFL


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("{tmp}/no/stop", "no such folder"),
        ("{tmp}", "is there already"),
        ("/dev/gpiochip97:4", "No such file"),
    ],
)
def test_what_cannot_be_watched_is_refused_in_one_line(tmp_path: Path, where: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says) as error, halt_switch(where.format(tmp=tmp_path), HaltLatch()):
        pass
    assert "\n" not in str(error.value) and where.format(tmp=tmp_path) in str(error.value)


class Chip:
    """What the kernel answers for a GPIO chip with one button: <linux/gpio.h>, version 2."""

    def __init__(self, pressed: bool = False) -> None:
        self.events, self._presses = os.pipe()
        self._pressed = pressed
        self.offset = self.flags = 0

    def ioctl(self, fd: int, request: int, body: bytearray) -> int:
        kind, number, size = (request >> 8) & 0xFF, request & 0xFF, (request >> 16) & 0x3FFF
        assert request >> 30 == 3 and kind == 0xB4 and size == len(body)
        if number == 0x07:
            (self.offset,) = struct.unpack_from("=I", body, 0)
            assert bytes(body[256:288]).rstrip(b"\0") == b"sfms-robot halt"
            (self.flags,) = struct.unpack_from("=Q", body, 288)
            assert struct.unpack_from("=I", body, 560) == (1,)
            struct.pack_into("=i", body, 588, self.events)
        else:
            assert number == 0x0E and fd == self.events
            struct.pack_into("=Q", body, 0, int(self._pressed))
        return 0

    def press(self) -> None:
        os.write(self._presses, struct.pack("=QIIII24x", 1, 1, self.offset, 1, 1))


def test_a_line_of_a_gpio_chip_is_asked_for_as_the_kernel_wants_it() -> None:
    chip = Chip()
    fd = open_line("/dev/null", 17, ioctl=chip.ioctl)
    assert (fd, chip.offset) == (chip.events, 17)
    assert chip.flags == 0b1_0001_0110  # input, active low, rising edge, pull-up
    open_line("/dev/null", 17, active_low=False, ioctl=chip.ioctl)
    assert chip.flags == 0b1_0100  # input, rising edge


def test_a_button_that_is_pressed_closes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    from sfms_robot.runtime import halt_switches

    chip, latch = Chip(), Seen()
    line = open_line("/dev/null", 17, ioctl=chip.ioctl)
    with halt_switches.watching_line(line, "button", latch):
        assert latch.by is None
        chip.press()
        assert latch.closed.wait(LONG_S)
    assert latch.by == "button"


def test_a_button_that_is_pressed_already_and_a_file_that_is_no_chip_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="is active already"):
        open_line("/dev/null", 17, ioctl=Chip(pressed=True).ioctl)
    (tmp_path / "chip").touch()
    with pytest.raises(ConfigError, match="no character device"):
        open_line(str(tmp_path / "chip"), 17, ioctl=Chip().ioctl)
