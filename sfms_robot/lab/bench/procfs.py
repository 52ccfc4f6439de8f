"""What Linux tells of processes under /proc (proc(5)). All raise OSError where a process has ended, or is no /proc."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal

_KIB_PER_MIB = 1024


def processor_time_s(pid: int, thread: int | None = None) -> float:
    """In user and kernel mode, since it began; of one of its threads by the number of that."""
    place = f"/proc/{pid}/stat" if thread is None else f"/proc/{pid}/task/{thread}/stat"
    fields = Path(place).read_text(encoding="utf-8").rpartition(")")[2].split()
    ticks: float = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return ticks


def memory_mb(key: Literal["VmRSS", "VmHWM"], pid: int | None = None) -> float | None:
    """Resident now (VmRSS) or at most (VmHWM); of this process without `pid`. None for one that is just over."""
    lines = Path(f"/proc/{pid or 'self'}/status").read_text(encoding="utf-8").splitlines()
    return next((int(line.split()[1]) / _KIB_PER_MIB for line in lines if line.startswith(f"{key}:")), None)


def children_of(pid: int) -> list[int]:
    """Those that its threads have started, and that live."""
    found: list[int] = []
    for task in Path(f"/proc/{pid}/task").iterdir():
        try:
            found += map(int, (task / "children").read_text(encoding="utf-8").split())
        except OSError:  # a thread that has ended meanwhile
            continue
    return found
