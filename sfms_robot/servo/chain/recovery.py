"""Servos on their way back: jobs that take a few exchanges per tick, beside the work of the others.

A servo that was silent, lost its torque or was rebooted comes back as at start-up: the same model and firmware, its
settings, goal := present, torque. Where somebody is silent the tick ends for all jobs, so that it costs one deadline.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from sfms_robot.errors import ServoError
from sfms_robot.servo.chain.startup import Silent, Startup, Steps

EXCHANGES: Final = 6  # in one tick, all jobs together
ATTEMPTS: Final = 3  # that may fail in a row before a servo is left alone
AGAIN_S: Final = 2.0  # after a refusal


@dataclass(slots=True)
class _Job:
    steps: Steps[int]
    due_s: float


class Outcome(NamedTuple):
    """Result of a tick: who holds a position now, who fell silent, and who refused, with the reason."""

    back: dict[int, int]
    silent: list[int]
    refused: dict[int, str]


class Recovery:
    """Jobs by servo index. Times are those of the caller's ticks."""

    def __init__(self) -> None:
        self._jobs: dict[int, _Job] = {}

    def __contains__(self, index: int) -> bool:
        return index in self._jobs

    def begin(self, index: int, shake: Startup[Any], due_s: float, reboot: bool = False) -> None:
        """From the beginning, not before `due_s`."""
        self._jobs[index] = _Job(shake.bring_back(index, reboot), due_s)

    def drop(self, index: int) -> None:
        job = self._jobs.pop(index, None)
        if job is not None:
            job.steps.close()

    def step(self, now_s: float) -> Outcome:
        """A tick's share of the work. Raises BusError when the port fails."""
        out = Outcome({}, [], {})
        left = EXCHANGES
        for index, job in list(self._jobs.items()):
            while left > 0 and job.due_s <= now_s:
                left -= 1
                try:
                    job.due_s = now_s + next(job.steps)
                except StopIteration as end:
                    out.back[index] = end.value
                    del self._jobs[index]
                    break
                except Silent:
                    out.silent.append(index)
                    del self._jobs[index]
                    return out
                except ServoError as error:
                    out.refused[index] = str(error)
                    del self._jobs[index]
                    break
        return out
