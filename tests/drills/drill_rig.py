"""The command line in processes of its own, on emulated servos in real time, and what an onlooker sees of both."""

import fcntl
import os
import pty
import subprocess
import sys
import termios
import threading
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

from ended import Ended

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import launch
from sfms_robot.sources.registry import DEFAULT_SPEAKER

CHECKOUT = Path(__file__).parents[2]
START = [sys.executable, "-P", "-c", "from sfms_robot.cli.main import main; main()"]
HEAD = "interbotix_wxxms"
PAN, TILT = 1, 2
AWAY_TICKS = 2448  # inside the limits, and a second of easing from rest
LOOKS = 12_000  # of `LOOK_S` each before something counts as not coming
LOOK_S = 0.01
TICKS_20 = 1000  # bytes on the wire of this head


class Terminal:
    """What a program shows on a terminal."""

    def __init__(self):
        self._near, self.far = pty.openpty()
        self.shown = b""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        while True:
            try:
                part = os.read(self._near, 4096)
            except OSError:  # nobody has the far end any more
                return
            if not part:
                return
            self.shown += part

    def press(self, keys):
        os.write(self._near, keys)

    def closed(self):
        """All that was shown."""
        os.close(self.far)
        self._reader.join()
        os.close(self._near)
        return self.shown


class Command:
    """A command line that runs. `stderr` is a file descriptor, or None for a pipe that `ended` reads.

    `keyboard`: far end of a terminal, which controls the command and is its stdin.
    """

    def __init__(self, *words, stderr=None, keyboard=None, **environment):
        paths = os.pathsep.join([*environment.pop("paths", []), str(CHECKOUT)])
        env = {**os.environ, "PYTHONPATH": paths, **environment}
        self.process = subprocess.Popen(
            [*START, *map(str, words)],
            stdin=subprocess.DEVNULL if keyboard is None else keyboard,
            start_new_session=keyboard is not None,
            preexec_fn=None if keyboard is None else partial(fcntl.ioctl, 0, termios.TIOCSCTTY, 0),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE if stderr is None else stderr,
            text=True,
            env=env,
        )
        self.pid = self.process.pid

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()

    def ended(self) -> Ended:
        out, err = self.process.communicate(timeout=LOOKS * LOOK_S)
        return Ended(self.process.returncode, out, err or "")

    def until(self, happened):
        """Look again and again, as long as the command runs. It must not end before."""
        for _ in range(LOOKS):
            if happened():
                return
            with suppress(subprocess.TimeoutExpired):
                code = self.process.wait(LOOK_S)
                raise AssertionError(f"ended before, with {code}: {self.process.communicate()}")
        raise AssertionError("it never happened")

    def signal(self, number):
        self.process.send_signal(number)

    def children(self) -> list[int]:
        return [int(pid) for pid in Path(f"/proc/{self.pid}/task/{self.pid}/children").read_text().split()]

    def heeded(self) -> bool:
        """Whether no signal waits to be delivered."""
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        return all(int(line.split()[1], 16) == 0 for line in lines if line.startswith(("SigPnd", "ShdPnd")))


def command(*words, **how) -> Ended:
    """One that ends by itself."""
    with Command(*words, **how) as running:
        return running.ended()


def gone(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


@contextmanager
def servos(link, start_ticks=AWAY_TICKS):
    """The emulated servos of the head behind `link`."""
    found = [replace(servo, start_ticks=start_ticks) for servo in emulated(load_head(HEAD))["main"]]
    with launch(found, link=str(link)) as chain:
        yield chain


def torque(chain) -> tuple[bool, bool]:
    return chain.state(PAN)["torque"], chain.state(TILT)["torque"]


def said(chain) -> int:
    """Bytes that hosts have sent."""
    return chain.digest()[1]


def more_said(running, chain, count=TICKS_20):
    """Wait until the host has sent that many bytes more."""
    before = said(chain)
    running.until(lambda: said(chain) > before + count)


def loading(running, chain):
    """The listener loads, in a process of its own."""
    running.until(running.children)


def connecting(running, chain):
    """The host speaks; torque waits for the listener."""
    running.until(lambda: said(chain))
    assert torque(chain) == (False, False)


def enabling(running, chain):
    """One servo has torque, the other not yet: the head's file lets a second pass between them."""
    running.until(lambda: any(torque(chain)))
    assert torque(chain) == (True, False)


def listening(running, chain):
    """Both have torque and get goals."""
    running.until(lambda: all(torque(chain)))
    more_said(running, chain)


def resting(running, chain):
    """The same in a run of one frame: what lasts is the way to rest."""
    listening(running, chain)


DURATION_S = {resting: 0.04}  # of the others: until somebody ends them


def run(head, device, *words, duration_s=600.0, **how) -> Command:
    person = () if "--audio" in words else ("--audio", DEFAULT_SPEAKER)
    return Command("run", "--head", head, "--port", device, *person, "--duration", duration_s, *words, **how)
