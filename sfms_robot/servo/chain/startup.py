"""What first contact is made of: checked, repeated requests to the servos of a bus, and jobs in steps.

A job is a generator of *steps*: between two exchanges on the wire it yields how long it would like to wait. At
start-up a job is run through at once; when a servo comes back while the bus is running, a tick takes a few steps and
goes on with its own work. Whatever is written is read back.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Sequence
from typing import ClassVar, Final, Generic, TypeVar

from sfms_robot.errors import BusError, ServoError
from sfms_robot.servo.chain.link import Answer, Found, RegisterLink
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Table

T = TypeVar("T")
L = TypeVar("L", bound=RegisterLink)
Steps = Generator[float, None, T]  # yields seconds to wait before it is asked to go on

TRIES: Final = 3
PATIENCE_S: Final = 0.05  # an adapter may hold an answer back for 16 ms


class Silent(ServoError):
    """A servo did not answer, as opposed to one that refuses."""


class Contact(ABC, Generic[L]):
    """Requests to the servos of a bus. `index` counts servos in bus order.

    Args:
        bus: its name, for messages.
        tables: of each servo; a protocol whose servos tell their firmware replaces those of another layout.
        baud: for messages.
        tries: before a servo counts as silent; 1 beside a running bus.

    Attributes:
        can_reboot: whether the protocol has an instruction for it.
    """

    can_reboot: ClassVar[bool]

    def __init__(
        self, bus: str, link: L, servos: Sequence[BusServo], tables: list[Table], baud: int, tries: int = TRIES
    ) -> None:
        self._bus = bus
        self._link = link
        self._servos = servos
        self.tables = tables
        self._baud = baud
        self._tries = tries

    @abstractmethod
    def run(self) -> list[int]:
        """Identify and prepare every servo; latched faults as bits where the protocol has such a register, else 0.

        Raises BusError listing the ids that do not answer, ServoError for one that is not what it should be.
        """

    @abstractmethod
    def torque_on(self, index: int) -> Steps[int]:
        """Goal := present, read back, torque on, read back; the position held, in ticks."""

    @abstractmethod
    def bring_back(self, index: int, reboot: bool) -> Steps[int]:
        """A servo that was away, from the beginning: is it still the same, settings, torque on; the position held."""

    def switch_on(self, index: int) -> int:
        """Torque on without a jump; the position held, in ticks."""
        with self._link.patient(PATIENCE_S):
            return finish(self.torque_on(index))

    def _identify(self) -> None:
        """Find everybody, and have a look at who it is."""
        found: dict[int, Found] = {}
        for _ in range(self._tries):
            for index in range(len(self._servos)):
                if index not in found and (who := self._meet(index)) is not None:
                    found[index] = who
        absent = [f"{s.id} ({s.joint})" for i, s in enumerate(self._servos) if i not in found]
        if absent:
            there = ", ".join(str(self._servos[i].id) for i in sorted(found)) or "none"
            raise BusError(
                f"bus {self._bus!r} on {self._link.port.name} at {self._baud} baud: "
                f"no answer from id {', '.join(absent)}; ids that answer: {there}"
            )
        for index, who in found.items():
            self._recognise(index, who)

    def _meet(self, index: int) -> Found | None:
        return self._link.ping(self._servos[index].id)

    def _recognise(self, index: int, found: Found) -> None:
        """Refuse another model. One without a number cannot be told from others."""
        table = self.tables[index]
        if table.model_number is not None and found.model_number != table.model_number:
            raise self._error(
                index, f"is model number {found.model_number}, the head says {table.model} ({table.model_number})"
            )

    def _repeat(self, index: int, what: str, request: Callable[[], Answer | None]) -> Answer:
        for _ in range(self._tries):
            answer = request()
            if answer is not None:
                break
        else:
            raise Silent(self._about(index, f"does not answer to {what}"))
        if refusal := self._refusal(answer):
            raise self._error(index, f"refuses {what}: {refusal}")
        return answer

    @abstractmethod
    def _refusal(self, answer: Answer) -> str:
        """Why a request was refused, in words; empty when it was not."""

    def _error(self, index: int, problem: str) -> ServoError:
        return ServoError(self._about(index, problem))

    def _about(self, index: int, problem: str) -> str:
        servo = self._servos[index]
        return f"{servo.joint} (id {servo.id}) {problem}"


def finish(steps: Steps[T]) -> T:
    """Run a job through, without the pauses it would like."""
    while True:
        try:
            next(steps)
        except StopIteration as end:
            result: T = end.value
            return result
