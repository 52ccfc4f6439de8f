"""Writing a register and making sure: the one retry rule of startup, members and tools; and work done in steps.

An acknowledgement proves nothing by its absence (it may have been lost, the status return level may forbid it), nor
by its presence (a locked EEPROM of Dynamixel 1.0 or Feetech acknowledges and takes nothing). Only the value read back
counts.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import closing
from typing import Final, TypeVar

from sfms_robot.errors import ServoError
from sfms_robot.servo.chain.link import RegisterLink
from sfms_robot.servo.registers import Field

T = TypeVar("T")
Steps = Generator[float, None, T]  # work in steps: between two exchanges it yields the seconds it would like to wait

TRIES: Final = 3


class Silent(ServoError):
    """A servo did not answer, as opposed to one that refuses."""


def verified_write(
    link: RegisterLink,
    servo_id: int,
    field: Field,
    value: int,
    *,
    lock: Field | None = None,
    tries: int = TRIES,
    about: str | None = None,
) -> Steps[None]:
    """Write one register, read it back, and repeat until it holds `value`.

    Args:
        lock: the register that opens the EEPROM (0) and closes it (1), for a field behind one. It is closed again
            whatever happens.
        tries: writes before it is given up; a refusal, a silence and another value read back all count alike, since a
            garbled request can look like any of them.
        about: how messages call the servo; `id 5` by default.

    Yields between exchanges: 0.0, or after a silence the seconds that it cost, so that a running bus ends its tick
    there. One exchange blocks at most `link.silence_s` beyond the time its bytes take.

    Raises Silent when no read back was answered, ServoError for a value that does not fit, is refused or not taken,
    BusError when the port is gone.
    """
    name = about or f"id {servo_id}"
    if lock is None or not field.eeprom:
        yield from _write(link, servo_id, field, value, tries, name)
        return
    yield from _write(link, servo_id, lock, 0, tries, name)
    try:
        yield from _write(link, servo_id, field, value, tries, name)
    except BaseException:  # a job that is dropped half way too
        link.write(servo_id, lock.address, lock.to_bytes(1))
        raise
    yield from _write(link, servo_id, lock, 1, tries, name)


def _write(link: RegisterLink, servo_id: int, field: Field, value: int, tries: int, name: str) -> Steps[None]:
    try:
        data = field.to_bytes(value)
    except OverflowError:
        raise ServoError(f"{name}: {field.name} = {value} does not fit the register") from None
    failure: ServoError = Silent(f"{name} does not answer to {field.name} := {value}")
    for _ in range(tries):
        answer = link.write(servo_id, field.address, data)
        if answer is not None and (refusal := link.refusal(answer)):
            failure = ServoError(f"{name} refuses {field.name} := {value}: {refusal}")
            yield 0.0
            continue
        yield 0.0 if answer is not None else link.silence_s
        seen = link.read(servo_id, field.address, field.size)
        if seen is None or len(seen.data) != field.size:
            yield link.silence_s
        elif (now := field.from_bytes(seen.data)) == value:
            yield 0.0
            return
        else:
            failure = ServoError(f"{name}: {field.name} was set to {value} and reads {now}")
            yield 0.0
    raise failure


def finish(steps: Steps[T], wait: Callable[[float], None] = lambda duration_s: None) -> T:
    """Run a job through; its result.

    Args:
        wait: what to do between two exchanges, for so many seconds. What it raises ends the job.
    """
    with closing(steps):
        while True:
            try:
                pause_s = next(steps)
            except StopIteration as end:
                result: T = end.value
                return result
            wait(pause_s)
