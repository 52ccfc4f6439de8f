"""Start an emulated servo chain in a child process, and stop it again.

    with launch([EmulatedServo(1), EmulatedServo(2, start_ticks=1500)]) as chain:
        SerialPort(chain.device, 1_000_000, clock)

Servos of several protocols, and boards, may share one wire.

The process ends with the `with` block, and when the process that started it dies.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from typing import Any, Final, Literal, Self, cast

from sfms_robot.config import FirmwareMap, load_firmware_map, variant
from sfms_robot.data import Report
from sfms_robot.emulator.emulated_wire import EmulatedServo, Timing
from sfms_robot.endpoint import connect
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.processes import Child
from sfms_robot.servo.registers import Table

__all__ = ["BehindSilent", "Chain", "EmulatedServo", "Timing", "launch"]

BehindSilent = Literal["chain_break", "skip"]
Transport = Literal["pty", "tcp"]

READ_DEADLINE_S = 0.02  # an emulator shares the computer's cores: it may be late without being silent
PROMPT_DEADLINE_S = 0.005  # deadline for an emulator with real-time priority

_START_S = 20.0
_CLOSE_S = 5.0


def _usual() -> Transport:
    """Return "pty" on Linux, where a terminal reports the rate that its host has set; elsewhere "tcp"."""
    try:
        return "pty" if sys.platform == "linux" and import_module("fcntl") and import_module("termios") else "tcp"
    except ImportError:
        return "tcp"


TRANSPORT: Final = _usual()

_refusal = partial(ConfigError.at, "emulated chain")
_BOARD_SETTINGS = {"maestro": {"crc"}}  # stored in a board as a whole: "Enable CRC"


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """A running chain.

    Attributes:
        device: Path of the serial device, or socket://HOST:PORT; it stays the same when the adapter is unplugged and
            comes back.
        control: Path of the control socket, or HOST:PORT.
        virtual: True if time is virtual, so that the device answers only through a `VirtualTimePort`.
        servos: servos and channels that are plugged in.
        priority: "fifo" if it answers as promptly as hardware; else the reason (`processes.realtime_priority`).
        child, folder: its process, and the folder of its socket; `close` ends and removes them.
    """

    child: Child
    servos: Sequence[EmulatedServo]
    virtual: bool
    device: str
    control: str
    folder: str
    priority: str

    @property
    def pid(self) -> int:
        """Return the id of its process."""
        return self.child.process.pid

    @property
    def read_deadline_s(self) -> float:
        """Return the time without an answer after which one of its servos counts as silent [s]."""
        return PROMPT_DEADLINE_S if self.priority == "fifo" else READ_DEADLINE_S

    def kill(self, servo_id: int) -> None:
        """Silence a servo, as with its cable unplugged; its motor follows its last goal."""
        self.ask(f"kill {servo_id}")

    def revive(self, servo_id: int) -> None:
        """Let a servo answer again."""
        self.ask(f"revive {servo_id}")

    def fault(self, servo_id: int, bits: int) -> None:
        """Latch hardware error bits until the servo is rebooted."""
        self.ask(f"fault {servo_id} {bits}")

    def turn(self, servo_id: int, ticks: int) -> None:
        """Turn the shaft by hand to reported position `ticks`, which may be beyond one turn."""
        self.ask(f"turn {servo_id} {ticks}")

    def heat(self, servo_id: int, temperature_C: float) -> None:
        """Set the temperature of a servo, which follows its load from then on."""
        self.ask(f"heat {servo_id} {temperature_C}")

    def state(self, servo_id: int) -> Report:
        """Return the true state of a servo: position [ticks], goal, torque, faults, temperature_C."""
        return cast("Report", self._json(f"state {servo_id}"))

    def inject(self, spec: str) -> None:
        """Begin a fault, such as `drop:3=0.5` or `brownout` (see `emulator.faults`)."""
        self.ask(f"inject {spec}")

    def clear_faults(self) -> None:
        """End all faults."""
        self.ask("clear")

    def faults(self) -> list[str]:
        """Return the specs of current and future faults."""
        return cast("list[str]", self._json("faults"))

    def supply(self, volts: float) -> None:
        """Set the supply voltage of all servos."""
        self.ask(f"supply {volts!r}")

    def hang_up(self) -> None:
        """Unplug the adapter: the device vanishes for hosts."""
        self.ask("hangup")

    def come_back(self) -> None:
        """Plug the adapter in again."""
        self.ask("return")

    def time_is(self, now_s: float) -> None:
        """Advance virtual time to `now_s` without a host."""
        self.ask(f"time {now_s!r}")

    def statistics(self) -> Report:
        """Return bytes_in, bytes_out, replies, emulator_late, busy_s, late_ms {p50, p99, max}."""
        return cast("Report", self._json("stats"))

    def stamps(self) -> list[Report]:
        """Return the last replies: ids, due_s, sent_s."""
        return cast("list[Report]", self._json("stamps"))

    def digest(self) -> tuple[str, int]:
        """Return SHA-256 and number of all bytes that hosts have sent."""
        _, sha, count = self.ask("digest").split()
        return sha, int(count)

    def close(self) -> None:
        """End the process and remove its folder. Idempotent."""
        self.child.close(_CLOSE_S)
        shutil.rmtree(self.folder, ignore_errors=True)
        if os.path.islink(self.device) and not os.path.exists(self.device):
            os.unlink(self.device)  # the process was killed and did not remove its link

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _json(self, request: str) -> Any:
        return json.loads(self.ask(request).removeprefix("json "))

    def ask(self, request: str) -> str:
        """Send one line to the control socket and return the answer. Raises BusError if it is refused."""
        try:
            with connect(self.control) as control:
                control.sendall(request.encode() + b"\n")
                answer = control.makefile().readline().strip()
        except OSError as error:
            raise BusError(f"the emulated chain {self.device} is gone: {error}") from error
        if not answer or answer.startswith("error"):
            raise BusError(f"the emulated chain {self.device} refuses {request!r}: {answer or 'no answer'}")
        return answer


def launch(
    servos: Sequence[EmulatedServo],
    virtual: bool = False,
    *,
    timing: Timing = "instant",
    behind_silent: BehindSilent = "chain_break",
    faults: Sequence[str] = (),
    seed: int = 0,
    link: str | None = None,
    transport: Transport = TRANSPORT,
) -> Chain:
    """Start a chain and wait until it can be opened.

    Args:
        virtual: the host sets the time (see `servo.port.VirtualTimePort`).
        timing: "instant": replies at once; "wire": after the time of bytes and return delays.
        behind_silent: "chain_break" silences the ids after a silent id in a sync read.
        faults: specs (see `emulator.faults`); `seed`: seed of their random numbers.
        link: a symbolic link to the device, removed at the end.
        transport: pseudo terminal, or TCP port of loopback, which has only one rate: that of the first servo.

    Raises ConfigError for an unknown model, register or fault, a baud rate that the model does not have, an id used
    twice or a link that already exists; BusError if the process does not start.
    """
    named = {servo.model: load_firmware_map(servo.model) for servo in servos}
    maps = [
        variant(each.model, each.firmware) if named[each.model].protocol == 2 else named[each.model] for each in servos
    ]
    _check(servos, maps)
    if link is not None:
        if transport == "tcp":
            raise _refusal("link", link, "needs a pseudo terminal, which only Linux has: use the printed address")
        if os.path.exists(link) or (os.path.lexists(link) and not os.path.islink(link)):
            raise _refusal("link", link, "is already there")
        if not os.path.isdir(os.path.dirname(os.path.abspath(link))):
            raise _refusal("link", link, "lies in a folder that does not exist")
    description = {
        "virtual": virtual,
        "transport": transport,
        "timing": timing,
        "behind_silent": behind_silent,
        "faults": list(faults),
        "seed": seed,
        "link": link and os.path.abspath(link),
        "tables": {each.model: Table.of(each) for each in maps},
        "servos": [replace(servo, model=each.model) for servo, each in zip(servos, maps, strict=True)],
    }
    child = Child("sfms_robot.emulator.chain_process:main", description, name="emulator")
    answer = child.receive(_START_S)
    if isinstance(answer, dict):
        return Chain(child=child, servos=tuple(servos), virtual=virtual, **answer)
    child.close(_CLOSE_S)
    if isinstance(answer, ConfigError):
        raise answer
    raise BusError(f"the emulated chain did not start (exit code {child.process.returncode})")


def _check(servos: Sequence[EmulatedServo], maps: Sequence[FirmwareMap]) -> None:
    seen = set[tuple[str, int]]()
    for servo, table in zip(servos, maps, strict=True):
        highest = 252 if table.channels is None else table.channels - 1
        key = ("" if table.channels is None else servo.model, servo.id)
        if key in seen:
            raise _refusal("id", servo.id, "is used twice")
        seen.add(key)
        if not 0 <= servo.id <= highest:
            raise _refusal("id", servo.id, "is not a servo id", [f"0..{highest}"])
        bauds = sorted(table.baud_codes.values())
        if bauds and servo.baud not in bauds:
            raise _refusal("baud", servo.baud, f"is not a rate of {servo.model}", bauds)
        if table.channels is not None:
            if servo.registers.keys() - _BOARD_SETTINGS.get(table.family, set()) or servo.supply_v is not None:
                problem = "is a board of hobby servos: it has no registers, and does not know its supply"
                raise _refusal("model", servo.model, problem)
            continue
        for name, value in servo.registers.items():
            register = table.registers.get(name)
            if register is None:
                raise _refusal("register", name, f"is not a register of {servo.model}", table.registers)
            if not register.low <= value <= register.high:
                raise _refusal(name, value, f"is out of range of {servo.model}", [f"{register.low}..{register.high}"])
