"""Keys of a real terminal while a panel is on it, and the terminal afterwards as it was."""

import os
import select
import signal
import subprocess
import sys
import termios

import pytest

from sfms_robot.app.listen.panel import Keyboard

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="no pseudo terminals here")
LIMIT_S = 60.0  # only what never comes waits for so long,
MOST = 50_000  # or until this much else was shown
HIDE, SHOW = "\x1b[?25l", "\x1b[?25h"
PROGRAM = """
import logging, os, sys, threading
from sfms_robot.app.listen.panel import live_panel
from sfms_robot.app.options import RunOptions
from sfms_robot.app.listen.knobs import RunControls
from sfms_robot.config import load_head
from sfms_robot.runtime.safety import signals_to

terminal = os.open(sys.argv[1], os.O_RDWR)  # becomes the one that controls this session
for each in range(3):
    os.dup2(terminal, each)
os.environ["TERM"] = "xterm"
logging.basicConfig(format="%(message)s")
run = RunControls(load_head("op3_head"), RunOptions())
if sys.argv[2] == "button":
    run.halt.switches["button"] = lambda: True

def document():
    state = "halted" if run.halt.by else "listening"
    return {"state": state, "note": sys.argv[2], "intensity": run.knobs.values["intensity"]}

run.document = document
with signals_to(run.interrupt), live_panel(run):
    while not run.interrupt():
        threading.Event().wait(0.01)
        if sys.argv[2] == "fails" and run.halt.by:
            raise SystemExit(7)
"""


class Shown:
    """A program on a terminal of its own. `until` waits for what it shows, from where the last one was found."""

    def __init__(self, note="all is well"):
        self._near, self.far = os.openpty()
        self.usual = termios.tcgetattr(self.far)
        self.text = ""
        words = [sys.executable, "-c", PROGRAM, os.ttyname(self.far), note]
        self.process = subprocess.Popen(words, start_new_session=True, stdin=subprocess.DEVNULL)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.wait()
        os.close(self._near)
        os.close(self.far)

    def press(self, keys):
        os.write(self._near, keys)

    def until(self, part):
        while part not in self.text:
            assert len(self.text) < MOST, f"{part!r} never came: {self.text!r}"
            ready, _, _ = select.select([self._near], [], [], LIMIT_S)
            assert ready, f"{part!r} never came: {self.text!r}"
            self.text += os.read(self._near, 4096).decode()
        before, _, self.text = self.text.partition(part)
        return before

    def stopped(self):
        """Wait until Ctrl-Z has stopped it, reading on: who writes to a full terminal stops nowhere."""
        for _ in range(round(LIMIT_S / 0.05)):
            pid, state = os.waitpid(self.process.pid, os.WUNTRACED | os.WNOHANG)
            if pid:
                assert os.WIFSTOPPED(state)
                return
            if select.select([self._near], [], [], 0.05)[0]:
                self.text += os.read(self._near, 4096).decode()
        raise AssertionError(f"it was never stopped: {self.text[-500:]!r}")

    def single_keys(self):
        return not termios.tcgetattr(self.far)[3] & (termios.ICANON | termios.ECHO)


def test_keys_halt_resume_help_and_end():
    with Shown() as shown:
        shown.until("listening")
        shown.until("? help")
        for key in (b" ", b"h", b"\x1b", b"\x1b[A"):  # an arrow begins with Esc: in doubt it halts
            shown.press(key)
            shown.until(" halted ")
            shown.press(b"r")
            shown.until(" listening ")
        assert shown.single_keys()
        for key, level in ((b"+", "1.1"), (b"=", "1.2"), (b"-", "1.1")):
            shown.press(key)
            shown.until(level)
        shown.press(b"?")
        shown.until("torque off at once")
        shown.press(b"xqq")  # one that is held down asks once
        shown.until(SHOW)
        assert shown.process.wait(LIMIT_S) == 0 and termios.tcgetattr(shown.far) == shown.usual


def test_a_resume_that_is_refused_is_answered_on_the_terminal():
    with Shown("button") as shown:
        shown.until("? help")
        shown.press(b" ")
        shown.until(" halted ")
        shown.press(b"r")
        shown.until("still halted: button: still on; release it")
        shown.press(b"q")
        assert " listening " not in shown.until(SHOW)


@pytest.mark.parametrize(
    ("note", "how", "code"),
    [
        ("well", lambda shown: shown.press(b"\x03"), 1),
        ("well", lambda shown: shown.process.terminate(), 1),
        ("fails", lambda shown: shown.press(b"h"), 7),
    ],
    ids=["ctrl-c", "sigterm", "exception"],
)
def test_however_it_ends_the_terminal_is_as_it_was(note, how, code):
    with Shown(note) as shown:
        shown.until(HIDE)
        shown.until("? help")
        how(shown)
        shown.until(SHOW)
        assert shown.process.wait(LIMIT_S) in (code, -signal.SIGINT) and termios.tcgetattr(shown.far) == shown.usual


def test_a_keyboard_that_was_left_is_not_taken_again():
    """Its thread may be about to, while a signal ends the program."""
    near, far = os.openpty()
    usual, keys = termios.tcgetattr(far), Keyboard(far)
    assert keys.take() and termios.tcgetattr(far) != usual
    keys.leave()
    assert not keys.take() and termios.tcgetattr(far) == usual


def test_a_suspended_run_leaves_the_terminal_and_takes_it_again():
    with Shown() as shown:
        shown.until("? help")
        shown.press(b" ")
        shown.until(" halted ")
        assert shown.single_keys()
        shown.press(b"\x1a")
        shown.stopped()
        assert termios.tcgetattr(shown.far) == shown.usual
        shown.until(SHOW)
        shown.process.send_signal(signal.SIGCONT)
        shown.until(HIDE)
        shown.press(b"r\n")  # a whole line, should it not have taken the terminal again yet
        shown.until(" listening ")
        assert shown.single_keys()
        shown.press(b"q")
        shown.until(SHOW)
        assert shown.process.wait(LIMIT_S) == 0
