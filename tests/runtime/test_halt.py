"""The latch holds a set of causes and opens when none is left; docs/safety.md has one row for each."""

import logging
import os
import signal
import struct
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import pytest

from sfms_robot.errors import ConfigError, HaltedError
from sfms_robot.runtime.halt import MOST_CAUSES, HaltLatch, halt_signals, halt_switch, open_line, watching_line

LONG_S = 60.0  # for what must happen; nothing waits so long unless it fails
DOORS = ("device", "page", "fleet")
GPIO = "/dev/gpiochip0:17"


class Wire:
    """What a latch releases: nothing is plugged in, so it only tells when."""

    def __init__(self, held_up: threading.Event | None = None) -> None:
        self.released, self._held_up = threading.Event(), held_up

    def torque_off(self, policy: str) -> None:
        assert policy == "release"
        self.released.set()
        if self._held_up is not None:
            self._held_up.wait(LONG_S)


class Seen(HaltLatch):
    """A latch that a test can wait for."""

    def until(self, *causes: str) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self.causes == causes, LONG_S), self.causes


class Chip:
    """What the kernel answers for a GPIO chip with one button: <linux/gpio.h>, version 2."""

    def __init__(self, pressed: bool = False) -> None:
        self.events, self.presses = os.pipe()
        self.pressed = pressed
        self.broken = False
        self.offset = self.flags = 0

    def ioctl(self, fd: int, request: int, body: bytearray) -> int:
        if self.broken:
            raise OSError(19, "No such device")
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
            struct.pack_into("=Q", body, 0, int(self.pressed))
        return 0

    def edge(self, pressed: bool, level: bool | None = None) -> None:
        """`level`: what the line reads by the time that the edge is looked at, where that is not the same."""
        self.pressed = pressed if level is None else level
        os.write(self.presses, struct.pack("=QIIII24x", 1, 1 if pressed else 2, self.offset, 1, 1))


@dataclass
class Cause:
    """A row: how it begins, how it stops being active (None: it never is), where it is cleared."""

    name: str
    begin: Callable[[], None]
    end: Callable[[], None] | None = None
    cleared_by: str = "device"


@dataclass
class Rows:
    latch: Seen
    causes: dict[str, Cause]


@pytest.fixture
def rows(tmp_path: Path) -> Iterator[Rows]:
    """Every cause of the table on one latch; keys, page and fleet have their doors tested where those are."""
    latch, chip, file = Seen(), Chip(), tmp_path / "stop"
    with ExitStack() as stack:
        stack.enter_context(halt_signals(latch))
        stack.enter_context(halt_switch(str(file), latch))
        stack.enter_context(watching_line(open_line("/dev/null", 17, ioctl=chip.ioctl), GPIO, latch))
        causes = [
            Cause("key", lambda: latch.close("key")),
            Cause("signal", lambda: signal.raise_signal(signal.SIGUSR1)),
            Cause("Robot.halt()", lambda: latch.close("Robot.halt()")),
            Cause(str(file), file.touch, file.unlink),
            Cause(GPIO, lambda: chip.edge(True), lambda: chip.edge(False)),
            Cause("page", lambda: latch.close("page", "page"), cleared_by="page"),
            Cause("the fleet", lambda: latch.close("the fleet", "fleet"), cleared_by="fleet"),
        ]
        yield Rows(latch, dict(zip(ROWS, causes, strict=True)))
        os.close(chip.presses)


ROWS = ("key", "SIGUSR1", "Robot.halt()", "FILE", "GPIO", "page", "fleet")


def test_the_table_on_safety_has_these_rows() -> None:
    page = (Path(__file__).parents[2] / "docs" / "safety.md").read_text(encoding="utf-8")
    section = page.partition("\n## Emergency stop")[2].partition("\n## ")[0]
    table = [[cell.strip() for cell in line.split("|")[1:-1]] for line in section.splitlines() if line.startswith("|")]
    assert table[0] == ["cause", "active while", "cleared by"] and len(table) == 2 + len(ROWS)
    for row, (cause, active, cleared_by) in zip(ROWS, table[2:], strict=True):
        assert row in cause and (active == "-") == (row not in ("FILE", "GPIO"))
        assert all((door in cleared_by) == (door in ("device", row)) for door in DOORS)


COMBINATIONS = [names for size in (1, 2) for names in combinations(ROWS, size)]


@pytest.mark.parametrize("doors", [("device",), ("page", "fleet", "device")], ids="-".join)
@pytest.mark.parametrize("names", COMBINATIONS, ids="-".join)
def test_each_door_clears_its_own_causes_and_the_device_all_but_none_while_one_is_active(
    rows: Rows, names: tuple[str, ...], doors: tuple[str, ...]
) -> None:
    latch, causes = rows.latch, [rows.causes[name] for name in names]
    for count, cause in enumerate(causes, 1):
        cause.begin()
        latch.until(*(each.name for each in causes[:count]))
    for cause in causes:
        if cause.end is not None:
            for door in DOORS:
                with pytest.raises(HaltedError, match="still on") as refused:
                    latch.resume(door)
                assert cause.name in str(refused.value) and "\n" not in str(refused.value)
            assert latch.causes == tuple(each.name for each in causes)  # nothing was cleared
            cause.end()
    left = causes
    for door in doors:
        left = [cause for cause in left if door not in ("device", cause.cleared_by)]
        if left:
            with pytest.raises(HaltedError) as refused:
                latch.resume(door)
            assert all(f"{cause.name} (cleared at the {cause.cleared_by})" in str(refused.value) for cause in left)
        else:
            latch.resume(door)
        assert latch.causes == tuple(cause.name for cause in left)


def test_a_cause_that_comes_again_while_a_resume_reads_the_switches_stays() -> None:
    latch = HaltLatch()
    latch.close("key")
    latch.close("page", "page")

    def pressed_meanwhile() -> bool:
        latch.close("key")
        return False

    latch.switches["button"] = pressed_meanwhile
    with pytest.raises(HaltedError, match=r"still halted: key \(cleared at the device\)"):
        latch.resume("device")
    assert latch.causes == ("key",)


def test_a_switch_whose_edge_was_missed_is_found_by_a_resume() -> None:
    latch, on = HaltLatch(), [False]
    latch.switches["button"] = lambda: on[0]
    latch.resume("page")  # open already: nothing happens
    on[0] = True
    with pytest.raises(HaltedError, match="button"):
        latch.resume("page")
    assert latch.causes == ("button",)


def test_clients_that_choose_names_fill_no_memory() -> None:
    latch = HaltLatch()
    for k in range(1000):
        latch.close(f"client {k}", "fleet")
    latch.close("key")
    assert len(latch.causes) <= MOST_CAUSES + 1
    with pytest.raises(HaltedError, match="device"):
        latch.resume("fleet")
    latch.resume("device")
    assert latch.by is None


def test_a_loop_that_does_not_answer_is_released_and_one_that_does_is_not() -> None:
    for answers in (False, True):
        latch, wire = HaltLatch(), Wire()
        with latch.watched(wire):
            latch.close("key")
            if answers:
                assert not latch.answer()
            else:
                assert wire.released.wait(LONG_S)
                with pytest.raises(HaltedError, match="the loop does not answer"):
                    latch.resume("device")
                assert latch.answer()  # it is back, and has to know that torque went off
                latch.resume("device")
        assert wire.released.is_set() != answers


def test_each_halt_wants_an_answer_of_its_own() -> None:
    latch, wire = HaltLatch(), Wire()
    with latch.watched(wire):
        latch.close("key")
        latch.answer()
        latch.resume("device")
        latch.close("file")
        assert wire.released.wait(LONG_S)


def free(latch: HaltLatch) -> bool:
    """Whether another thread gets through the latch."""
    thread = threading.Thread(target=latch.close, args=("key",), daemon=True)
    thread.start()
    thread.join(LONG_S)
    return not thread.is_alive()


def test_torque_off_that_is_held_up_does_not_hold_the_latch() -> None:
    latch, held_up = HaltLatch(), threading.Event()
    wire = Wire(held_up)
    with latch.watched(wire):
        latch.close("page", "page")
        assert wire.released.wait(LONG_S)
        assert free(latch) and latch.causes == ("page", "key")
        held_up.set()


class Blocked(logging.Handler):
    """A log whose terminal takes nothing: Ctrl-S, or a pipe that is full and not read."""

    def __init__(self) -> None:
        super().__init__()
        self.reached, self.opened = threading.Event(), threading.Event()

    def emit(self, record: logging.LogRecord) -> None:
        self.reached.set()
        self.opened.wait(LONG_S)


def test_a_log_that_is_held_up_keeps_neither_a_signal_nor_another_thread_from_halting() -> None:
    latch, blocked, root = Seen(), Blocked(), logging.getLogger("sfms_robot.runtime")
    root.addHandler(blocked)
    try:
        with halt_signals(latch):
            latch.switches["button"] = lambda: True
            signal.raise_signal(signal.SIGUSR2)  # refused, and the refusal is logged
            assert blocked.reached.wait(LONG_S)
            signal.raise_signal(signal.SIGUSR2)
            signal.raise_signal(signal.SIGUSR1)
            latch.until("button", "signal")
            assert free(latch)
    finally:
        blocked.opened.set()
        root.removeHandler(blocked)


def test_a_handler_does_not_wait_for_the_latch_that_it_interrupts() -> None:
    latch = Seen()
    with halt_signals(latch):
        with latch._changed:  # where a signal may find the thread that handles it
            signal.raise_signal(signal.SIGUSR1)
            assert latch.by is None
        latch.until("signal")
    assert signal.getsignal(signal.SIGUSR1) is signal.SIG_DFL


@pytest.mark.parametrize(
    ("where", "says"),
    [
        ("{tmp}/no/stop", "no such folder"),
        ("{tmp}", "exists already"),
        ("{tmp}/a/b", "exists already, or its folder cannot be read"),
        ("/dev/gpiochip97:4", "No such file"),
    ],
)
def test_what_cannot_be_watched_is_refused_in_one_line(tmp_path: Path, where: str, says: str) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").symlink_to("b")  # a loop: it cannot be looked at
    with pytest.raises(ConfigError, match=says) as error, halt_switch(where.format(tmp=tmp_path), HaltLatch()):
        pass
    assert "\n" not in str(error.value) and where.format(tmp=tmp_path) in str(error.value)


@pytest.mark.parametrize("then", ["removed", "unreadable"])
def test_a_folder_that_cannot_be_looked_into_any_more_halts(tmp_path: Path, then: str) -> None:
    latch, folder = Seen(), tmp_path / "switches"
    folder.mkdir()
    with halt_switch(str(folder / "stop"), latch):
        folder.rmdir()
        if then == "unreadable":
            folder.symlink_to(folder)
        latch.until(str(folder / "stop"))
        with pytest.raises(HaltedError, match="still on"):
            latch.resume("device")


def test_a_line_of_a_gpio_chip_is_asked_for_as_the_kernel_wants_it() -> None:
    chip = Chip()
    assert (open_line("/dev/null", 17, ioctl=chip.ioctl).fd, chip.offset) == (chip.events, 17)
    assert chip.flags == 0b1_0011_0110  # input, active low, both edges, pull-up
    open_line("/dev/null", 17, active_low=False, ioctl=chip.ioctl)
    assert chip.flags == 0b11_0100  # input, both edges


@pytest.mark.parametrize(("pressed", "level"), [(True, True), (True, False), (False, True)])
def test_a_button_halts_also_when_it_is_let_go_at_once_or_its_first_edge_was_lost(pressed: bool, level: bool) -> None:
    chip, latch = Chip(), Seen()
    with watching_line(open_line("/dev/null", 17, ioctl=chip.ioctl), "button", latch):
        chip.edge(pressed, level)
        latch.until("button")


def test_letting_go_of_a_button_halts_nothing() -> None:
    chip = Chip()
    line = open_line("/dev/null", 17, ioctl=chip.ioctl)
    chip.edge(False)
    assert not line.pressed() and not line.active()


@pytest.mark.parametrize("how", ["no more events", "no level"])
def test_a_line_that_cannot_be_read_halts_until_the_run_ends(how: str) -> None:
    chip, latch = Chip(), Seen()
    with watching_line(open_line("/dev/null", 17, ioctl=chip.ioctl), "button", latch):
        if how == "no level":
            chip.broken = True
            chip.edge(False)
        else:
            os.close(chip.presses)
        latch.until("button")
        for _ in range(2):
            with pytest.raises(HaltedError, match="button: still on"):
                latch.resume("device")


@pytest.mark.parametrize("broken", [False, True])
def test_a_button_that_is_pressed_already_or_cannot_be_read_is_refused(broken: bool) -> None:
    chip = Chip(pressed=True)

    def ioctl(fd: int, request: int, body: bytearray) -> int:
        chip.broken = broken and fd == chip.events
        return chip.ioctl(fd, request, body)

    with pytest.raises(ConfigError, match="is active already, or cannot be read"):
        open_line("/dev/null", 17, ioctl=ioctl)


def test_a_file_that_is_no_chip_is_refused(tmp_path: Path) -> None:
    (tmp_path / "chip").touch()
    with pytest.raises(ConfigError, match="expected a character device"):
        open_line(str(tmp_path / "chip"), 17, ioctl=Chip().ioctl)
