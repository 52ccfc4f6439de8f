"""One emulated wire: it passes bytes from the host to devices and their answers back, with delays and faults.

In `instant` timing an answer leaves at once. In `wire` timing the request takes 10 bits a byte to arrive, each servo
waits for its return delay, and its answer takes 10 bits a byte. An answer is due when its last bit has been sent. If it
leaves more than `LATE_S` after that, the emulator is too slow; such answers are counted as `emulator_late`.

`EmulatedServo` is plain data, so that the process of an emulated chain loads neither configs nor libraries.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any, Final, Literal, NamedTuple

from sfms_robot.data import Report
from sfms_robot.emulator.faults import TO_SERVOS, Fault, WireFaults
from sfms_robot.errors import ConfigError

Timing = Literal["instant", "wire"]
LATE_S: Final = 0.001
_BITS: Final = 10  # bits of a byte on the line, with start and stop bit
_STAMPS: Final = 4096


@dataclass(frozen=True)
class EmulatedServo:
    """A servo that is plugged in, or a channel of a board.

    Attributes:
        start_ticks: Its position when the host connects, with torque off. It may be outside its limits, or beyond one
            turn if the shaft was turned by hand after the servo was switched on.
        registers: Values stored in it, by name (homing offset, position limits, shutdown, ...).
        supply_v: Supply voltage; None for a voltage within its limits.
    """

    id: int
    model: str = "xl330-m288"
    baud: int = 1_000_000
    start_ticks: int = 2048
    _: KW_ONLY
    firmware: int = 53
    registers: Mapping[str, int] = field(default_factory=dict)
    supply_v: float | None = None


class Reply(NamedTuple):
    """One packet on the wire: its senders (none for a board), its bytes, and the pause on the line before it."""

    servos: tuple[int, ...]
    data: bytes
    pause_s: float = 0.0


class EmulatedDevice(ABC):
    """All servos of one protocol, or one board. It receives every byte of the wire into its own buffer."""

    servos: Sequence[Any]

    @abstractmethod
    def replies(self, data: bytes, baud: int | None, now_s: float) -> list[Reply]:
        """Process bytes that the host sent at `baud` (None: unknown); return the answers, packet by packet."""

    def receive(self, data: bytes, baud: int | None, now_s: float) -> bytes:
        """Return the bytes of `replies`."""
        return b"".join(reply.data for reply in self.replies(data, baud, now_s))

    def servo(self, servo_id: int) -> Any:
        """Return the first servo or channel with an id, or None."""
        return next((servo for servo in self.servos if servo.id == servo_id), None)

    def advance(self, now_s: float) -> None:
        """Advance all its servos to `now_s`."""
        for servo in self.servos:
            servo.advance(now_s)

    def restart(self, now_s: float) -> None:
        """Restart a board whose supply failed or came back; servos with a controller restart without this call."""
        return


class Out(NamedTuple):
    """Bytes on their way to the host. `late`: True if a fault delays them."""

    due_s: float
    number: int
    servos: tuple[int, ...]
    data: bytes
    late: bool


class EmulatedWire:
    """Devices, the line to them, and its faults. Times are seconds of the emulator's clock.

    Attributes:
        faults: Current and future faults; `add` adds one.
        hung: True while the adapter is unplugged; the server then closes the terminal.
    """

    def __init__(self, devices: Sequence[EmulatedDevice], timing: Timing, faults: Iterable[Fault], seed: int) -> None:
        self.hung = False
        self._devices = devices
        self._on_the_wire = timing == "wire"
        self.faults = WireFaults(seed)
        self._inbox = deque[tuple[float, bytes, int | None]]()  # (arrives at, data, baud), in that order
        self._outbox: list[Out] = []
        self._number = 0
        self._free_s = 0.0  # time until which the line is busy
        self._before_brownout: dict[int, float] = {}
        self._seen = hashlib.sha256()
        self._stamps = deque[tuple[tuple[int, ...], float, float]](maxlen=_STAMPS)
        self._counts = {"bytes_in": 0, "bytes_out": 0, "replies": 0, "emulator_late": 0}
        self._busy_s = 0.0
        for fault in faults:
            self.add(fault)

    def servo(self, servo_id: int) -> Any:
        """Return the servo or channel with an id on any device, or None."""
        return next((servo for each in self._devices if (servo := each.servo(servo_id)) is not None), None)

    @property
    def traffic(self) -> tuple[int, int]:
        """Bytes received and bytes sent so far."""
        return self._counts["bytes_in"], self._counts["bytes_out"]

    def digest(self) -> tuple[str, int]:
        """Return SHA-256 and number of all bytes that the host has sent, at any baud rate."""
        return self._seen.hexdigest(), self._counts["bytes_in"]

    # --- traffic ------------------------------------------------------------------------------------------------

    def receive(self, data: bytes, baud: int | None, now_s: float) -> None:
        """Receive bytes that the host sent at `baud` (None: unknown); put the answers into the outbox."""
        self.advance(now_s)
        self._seen.update(data)
        self._counts["bytes_in"] += len(data)
        if self.hung:
            return
        through_s = self._occupy(now_s, len(data), baud)
        if self.faults.strikes("echo", now_s):
            self._post(Reply((), data), through_s, 0.0)
        for spoilt, late_s in self.faults.spoil((), data, now_s, TO_SERVOS):
            # Bytes do not overtake one another.
            self._inbox.append((max([now_s + late_s, *(each[0] for each in self._inbox)]), spoilt, baud))
        self.advance(now_s)
        if noise := self.faults.noise(now_s):
            self._post(Reply((), noise), self._free_s if self._on_the_wire else now_s, 0.0)

    def _deliver(self, until_s: float) -> None:
        """Pass the requests that arrive by `until_s` to the devices, and post their answers."""
        while self._inbox and self._inbox[0][0] <= until_s:
            now_s, data, baud = self._inbox.popleft()
            self._turn_faults(now_s)
            for device in self._devices:
                for reply in device.replies(data, baud, now_s):
                    start_s = max(now_s, self._free_s) + (reply.pause_s if self._on_the_wire else 0.0)
                    due_s = self._occupy(start_s, len(reply.data), baud)
                    for spoilt, late_s in self.faults.spoil(reply.servos, reply.data, now_s):
                        self._post(reply._replace(data=spoilt), due_s, late_s)

    def take(self, until_s: float, all_but_late: bool = False) -> list[Out]:
        """Return the bytes due by `until_s`, in order; with `all_but_late` also all bytes that no fault delays."""
        self._deliver(until_s)
        if not self._outbox:
            return []
        out = sorted(each for each in self._outbox if each.due_s <= until_s or (all_but_late and not each.late))
        self._outbox = [each for each in self._outbox if each not in out]
        return out

    def sent(self, outs: Iterable[Out], now_s: float | None) -> None:
        """Record the time of bytes that have just left; `now_s` None: in virtual time, where nothing is late."""
        for out in outs:
            at_s = out.due_s if now_s is None else now_s
            self._stamps.append((out.servos, out.due_s, at_s))
            self._counts["replies"] += 1
            self._counts["bytes_out"] += len(out.data)
            self._counts["emulator_late"] += self._on_the_wire and at_s - out.due_s > LATE_S

    @property
    def next_s(self) -> float:
        """Time of the next event without the host: a request arrives, an answer is due, a fault begins or ends."""
        return min([self.faults.next_s, *(out.due_s for out in self._outbox), *(each[0] for each in self._inbox)])

    def statistics(self) -> Report:
        """Return counts since the start, the lateness of answers [ms], and the time that the line was busy [s]."""
        late: Sequence[float | None] = sorted(1e3 * (at_s - due_s) for _, due_s, at_s in self._stamps) or [None]
        spread = {f"p{q}": late[min(len(late) - 1, len(late) * q // 100)] for q in (50, 99)} | {"max": late[-1]}
        return {**self._counts, "busy_s": self._busy_s, "late_ms": spread}

    def stamps(self) -> list[Report]:
        """Return the last answers: senders, time due, time sent."""
        return [{"ids": ids, "due_s": due_s, "sent_s": at_s} for ids, due_s, at_s in self._stamps]

    def _occupy(self, start_s: float, count: int, baud: int | None) -> float:
        """Occupy the line with `count` bytes from `start_s` on; return the time when the last one is sent."""
        seconds = _BITS * count / baud if baud else 0.0
        self._busy_s += seconds
        if not self._on_the_wire:
            return start_s
        self._free_s = max(start_s, self._free_s) + seconds
        return self._free_s

    def _post(self, reply: Reply, due_s: float, late_s: float) -> None:
        if reply.data:
            self._number += 1
            self._outbox.append(Out(due_s + late_s, self._number, reply.servos, reply.data, late_s > 0.0))

    # --- faults -------------------------------------------------------------------------------------------------

    def add(self, fault: Fault) -> None:
        """Add a fault. Raises ConfigError if no servo of the wire can have it."""
        servos = self._supplied if fault.kind == "voltage" else self._servos
        if fault.kind not in ("echo", "noise", "hangup") and not any(map(fault.concerns, servos)):
            raise ConfigError.at("emulate", "fault", fault.text, "concerns no servo of this wire")
        self.faults.add(fault)

    def advance(self, now_s: float) -> None:
        """Let requests arrive and faults begin and end by `now_s`, in the order of their times."""
        self._deliver(now_s)
        self._turn_faults(now_s)

    def idle(self, now_s: float) -> None:
        """Advance all devices, so that no servo has to catch up after a long silence."""
        self.advance(now_s)
        for device in self._devices:
            device.advance(now_s)

    def set_supply(self, volts: float, now_s: float) -> None:
        """Change the supply of all servos that measure it."""
        for servo in self._supplied:
            servo.set_supply(volts, now_s)

    @property
    def _servos(self) -> list[Any]:
        return [servo for device in self._devices for servo in device.servos]

    @property
    def _supplied(self) -> list[Any]:
        """Servos with their own controller; servos of a board do not measure their supply."""
        return [servo for servo in self._servos if hasattr(servo, "set_supply")]

    def _turn_faults(self, now_s: float) -> None:
        """Let faults begin and end by `now_s`."""
        for time_s, fault, began in self.faults.edges(now_s):
            kind = fault.kind
            if kind == "hangup":
                self.hung = began
                self._inbox.clear()
                self._outbox.clear()
            elif kind in ("voltage", "brownout"):
                for servo in self._supplied:
                    usual_v = self._before_brownout.setdefault(servo.id, servo.supply_v)
                    servo.set_supply(fault.value if began else usual_v, time_s)
                if not began:
                    self._before_brownout.clear()
            for servo in filter(fault.concerns, self._servos):
                if kind == "silent" or (kind == "brownout" and not hasattr(servo, "set_supply")):
                    servo.dead = began
                elif kind == "mute":
                    servo.mute = began
                elif kind in ("stuck", "load"):
                    servo.advance(time_s)
                    setattr(servo.plant, kind, began if kind == "stuck" else fault.value * began)
                elif kind in ("overload", "overheat") and began:
                    servo.fail(servo.fault_bits["overheating" if kind == "overheat" else kind], time_s)
            if kind == "brownout":
                for device in self._devices:
                    device.restart(time_s)  # a board without a supply sends no pulses either
