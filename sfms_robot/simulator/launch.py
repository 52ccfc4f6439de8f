"""Start an emulated servo chain in a process of its own, and stop it again.

    with launch([EmulatedServo(1), EmulatedServo(2, start_ticks=1500)]) as chain:
        SerialPort(chain.device, 1_000_000, clock)

The process ends with the `with` block, and by itself when this one dies.
"""

from __future__ import annotations

import json
import select
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import IO, Self, cast

from sfms_robot.config import load_firmware_map
from sfms_robot.errors import BusError, ConfigError

_START_S = 20.0


@dataclass(frozen=True)
class EmulatedServo:
    """What is plugged in: `start_ticks` is where its shaft stands at power-up, torque off."""

    id: int
    model: str = "xl330-m288"
    baud: int = 1_000_000
    start_ticks: int = 2048
    firmware: int = 53


class Chain:
    """A running chain.

    Attributes:
        device: path of the serial device.
        control: path of the control socket.
        virtual: True when time is virtual, so that the device answers only through a `VirtualTimePort`.
    """

    def __init__(self, process: subprocess.Popen[bytes], virtual: bool, device: str, control: str, folder: str) -> None:
        self.virtual = virtual
        self.device = device
        self.control = control
        self._process = process
        self._folder = folder

    @property
    def pid(self) -> int:
        return self._process.pid

    def kill(self, servo_id: int) -> None:
        """The servo falls silent, as with its cable out; its motor keeps doing what it was told."""
        self._ask(f"kill {servo_id}")

    def revive(self, servo_id: int) -> None:
        self._ask(f"revive {servo_id}")

    def fault(self, servo_id: int, bits: int) -> None:
        """Latch hardware error bits until the servo is rebooted."""
        self._ask(f"fault {servo_id} {bits}")

    def turn(self, servo_id: int, ticks: int) -> None:
        """Turn the shaft by hand."""
        self._ask(f"turn {servo_id} {ticks}")

    def digest(self) -> tuple[str, int]:
        """SHA-256 and number of all bytes that hosts have sent."""
        _, sha, count = self._ask("digest").split()
        return sha, int(count)

    def close(self) -> None:
        """End the process and remove its folder. Idempotent."""
        if self._process.poll() is None:
            self._process.terminate()
        _reap(self._process)
        shutil.rmtree(self._folder, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, tb: TracebackType | None) -> None:
        self.close()

    def _ask(self, request: str) -> str:
        try:
            with socket.socket(socket.AF_UNIX) as control:
                control.connect(self.control)
                control.sendall(request.encode() + b"\n")
                answer = control.makefile().readline().strip()
        except OSError as error:
            raise BusError(f"the emulated chain {self.device} is gone: {error}") from error
        if not answer or answer.startswith("error"):
            raise BusError(f"the emulated chain {self.device} refuses {request!r}: {answer or 'no answer'}")
        return answer


def launch(servos: Sequence[EmulatedServo], virtual: bool = False) -> Chain:
    """Start a chain and wait until it can be opened.

    Raises ConfigError for an unknown model, a baud it does not have or an id used twice; BusError when the process
    does not start.
    """
    maps = {model: load_firmware_map(model) for model in sorted({servo.model for servo in servos})}
    _check(servos, {model: sorted(each.baud_codes.values()) for model, each in maps.items()})
    description = {
        "virtual": virtual,
        "tables": {model: each.model_dump(mode="json") for model, each in maps.items()},
        "servos": [asdict(servo) for servo in servos],
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "sfms_robot.simulator.serve"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,  # signals of the terminal are for the host
    )
    stdin, stdout = cast("IO[bytes]", process.stdin), cast("IO[bytes]", process.stdout)
    try:
        stdin.write(json.dumps(description).encode() + b"\n")
        stdin.flush()
        ready = stdout.readline() if select.select([stdout], [], [], _START_S)[0] else b""
    except OSError:
        ready = b""
    if not ready.startswith(b"ready "):
        process.kill()
        _reap(process)
        raise BusError(f"the emulated chain did not start (exit code {process.returncode})")
    told = json.loads(ready.removeprefix(b"ready "))
    return Chain(process, virtual, told["device"], told["control"], told["folder"])


def _check(servos: Sequence[EmulatedServo], bauds: dict[str, list[int]]) -> None:
    seen: set[int] = set()
    for servo in servos:
        if servo.id in seen:
            raise ConfigError.at("emulated chain", "id", servo.id, "is used twice")
        seen.add(servo.id)
        if not 0 <= servo.id <= 252:
            raise ConfigError.at("emulated chain", "id", servo.id, "is not a servo id", ["0..252"])
        if servo.baud not in bauds[servo.model]:
            raise ConfigError.at(
                "emulated chain", "baud", servo.baud, f"is no rate of {servo.model}", bauds[servo.model]
            )


def _reap(process: subprocess.Popen[bytes]) -> None:
    """Wait for the end, with force if it takes too long, and close the pipes."""
    try:
        process.wait(timeout=5.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    for pipe in (process.stdin, process.stdout):
        if pipe is not None and not pipe.closed:
            pipe.close()
