"""Processes that train one model together, as `torchrun` starts them, and their communication.

A step's batch is cut into pieces, each drawn with a generator of its own; process r of W takes pieces r, r + W, ...
A piece is the same in every process, so the losses of a run do not depend on the number of processes, up to the order
of summation. One process with one piece computes what plain training does.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch.distributed.rendezvous import rendezvous

from sfms_robot.errors import ConfigError, GroupError

PATIENCE = timedelta(minutes=30)  # a process looks at held-out data, or stages files, while others wait


@dataclass(frozen=True)
class ProcessGroup:
    """This process among `size` that train together; `local_rank` among those on its machine."""

    rank: int = 0
    size: int = 1
    local_rank: int = 0
    restarts: int = 0

    @property
    def first(self) -> bool:
        """Return whether this process writes files and prints."""
        return self.rank == 0

    def mean(self, values: Sequence[float]) -> list[float]:
        """Means over all processes. Raises GroupError when one of them is gone."""
        if self.size == 1:
            return list(values)
        sums = torch.tensor(values, dtype=torch.float64, device=_device())
        with self.talking():
            dist.all_reduce(sums)
        return [float(each) / self.size for each in sums]

    def told_by_first(self, find: Callable[[], float]) -> float:
        """Return what the first process finds; the others wait for it."""
        if self.size == 1:
            return find()
        found = torch.tensor([find() if self.first else 0.0], dtype=torch.float64, device=_device())
        with self.talking():
            dist.broadcast(found, 0)
        return float(found)

    def wait(self) -> None:
        """Until all are here."""
        self.mean([0.0])

    @contextmanager
    def talking(self) -> Iterator[None]:
        """Where others may be gone: raises GroupError then."""
        try:
            yield
        except RuntimeError as error:  # gloo and NCCL raise this and its children
            if self.size == 1 or isinstance(error, torch.cuda.OutOfMemoryError):
                raise
            said = f"process {self.rank} of {self.size} has lost another one: {_first_line(error)}"
            raise GroupError(said) from error


@contextmanager
def joined(device: torch.device) -> Iterator[ProcessGroup]:
    """The group that `torchrun` says this process is of, or this process alone. Raises ConfigError, GroupError."""
    size = _number("WORLD_SIZE", 1)
    if size == 1:
        yield ProcessGroup(restarts=_number("TORCHELASTIC_RESTART_COUNT", 0))
        return
    group = ProcessGroup(_number("RANK", 0), size, local_rank(), _number("TORCHELASTIC_RESTART_COUNT", 0))
    if device.type == "cuda":
        torch.cuda.set_device(device)
    with group.talking():
        store, _, _ = next(rendezvous("env://", timeout=PATIENCE))
        # torchrun goes on with a store that holds addresses of the dead.
        store = dist.PrefixStore(f"restart {group.restarts}", store)  # type: ignore[attr-defined]
        backend = "nccl" if device.type == "cuda" else "gloo"
        dist.init_process_group(backend, timeout=PATIENCE, world_size=size, rank=group.rank, store=store)
    try:
        yield group
    finally:
        dist.destroy_process_group()


def local_rank() -> int:
    """Which of the processes on this machine this is: which GPU is its own."""
    return _number("LOCAL_RANK", 0)


def _number(name: str, otherwise: int) -> int:
    text = os.environ.get(name, str(otherwise))
    if not text.isdecimal():
        raise ConfigError(f"{name}={text} in the environment: expected a number, as torchrun sets it")
    return int(text)


def _device() -> torch.device:
    return torch.device("cuda", torch.cuda.current_device()) if dist.get_backend() == "nccl" else torch.device("cpu")


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0]
