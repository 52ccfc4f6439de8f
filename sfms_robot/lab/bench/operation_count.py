"""The cost of torch code, counted as it runs, independent of the machine; and of a frame of each listener.

An operation is one multiplication or addition of a matrix product, a convolution or an attention (torch's formulas), or
one number produced by any other call. Bytes are those of all tensors that each call reads and writes, as without
caches: the traffic to memory for large tensors, an upper bound for small ones.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode, sdpa_backward_flop_count, sdpa_flop_count

from sfms_robot import config
from sfms_robot.data import data_dir
from sfms_robot.frames import FRAME_S, FRAME_SAMPLES, FaceFrame, SpeakerFrame
from sfms_robot.lab.bench.measure import BenchResult, machine
from sfms_robot.listeners.registry import load_listener


def _attention(query: Any, key: Any, value: Any, *_: Any, **__: Any) -> int:
    return int(sdpa_flop_count(query, key, value))  # type: ignore[no-untyped-call]


def _attention_backward(gradient: Any, query: Any, key: Any, value: Any, *_: Any, **__: Any) -> int:
    return int(sdpa_backward_flop_count(gradient, query, key, value))  # type: ignore[no-untyped-call]


_CPU_ATTENTION = {  # torch has the formulas for other devices' kernels alone
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _attention,
    torch.ops.aten._scaled_dot_product_flash_attention_for_cpu_backward: _attention_backward,
}


_DRAWING = ("rand", "normal", "uniform", "exponential", "bernoulli", "multinomial")


class OperationCount(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """A context manager that counts the calls inside it.

    Attributes:
        matrix, other: Operations of products, and numbers from other calls.
        bytes, calls: Bytes moved and calls made, views of tensors excluded.
        drawn: Random numbers.
    """

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self._products = FlopCounterMode(display=False, custom_mapping=_CPU_ATTENTION)
        self._known: set[Any] = set(self._products.flop_registry)
        self.other = self.bytes = self.calls = self.drawn = 0

    @property
    def matrix(self) -> int:
        return self._products.get_total_flops()

    @property
    def operations(self) -> int:
        return self.matrix + self.other

    def __enter__(self) -> OperationCount:
        self._products.__enter__()  # type: ignore[no-untyped-call]
        super().__enter__()  # type: ignore[no-untyped-call]
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        super().__exit__(kind, value, at)  # type: ignore[no-untyped-call]
        self._products.__exit__(kind, value, at)  # type: ignore[no-untyped-call]

    def __torch_dispatch__(
        self, func: Any, types: Sequence[type], args: Sequence[Any] = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        out = func(*args, **(kwargs or {}))
        if func.is_view:
            return out
        made = [each for each in tree_leaves(out) if isinstance(each, Tensor)]
        used = [each for each in tree_leaves((args, kwargs)) if isinstance(each, Tensor)]
        self.calls += 1
        self.bytes += sum(each.numel() * each.element_size() for each in [*made, *used])
        if func._overloadpacket not in self._known:
            self.other += sum(each.numel() for each in made)
        if func._overloadpacket.__name__.startswith(_DRAWING):
            self.drawn += sum(each.numel() for each in made)
        return out


# --- a frame of a listener ------------------------------------------------------------------------------------------
#
# A board's time is max(operations / (clock x operations a cycle x share reached), bytes / bandwidth) + calls x cost of
# one call, on one core. No such board was measured: the assumptions are printed with the figures.

_LISTENERS: Final = ("sfms-small", "arig-small")
_FRAMES: Final = 32  # that are counted: whole hops
_WARM_UP: Final = 16
_REACHED: Final = 0.25  # of a core's peak, in products as small as these
_FRAME_MS: Final = FRAME_S * 1e3


@dataclass(frozen=True)
class BoardCore:
    """One core of a small computer: clock [GHz], fp32 operations a cycle, memory [GB/s], cost of a call [us]."""

    clock_ghz: float
    per_cycle: int
    memory_gb_s: float
    call_us: float

    def ms(self, operations: float, moved_bytes: float, calls: float) -> float:
        """Return the time of work on this core."""
        computed_s = operations / (self.clock_ghz * 1e9 * self.per_cycle * _REACHED)
        return 1e3 * max(computed_s, moved_bytes / (self.memory_gb_s * 1e9)) + calls * self.call_us * 1e-3


_BOARDS: Final = {
    "Raspberry Pi 4 (Cortex-A72)": BoardCore(1.8, 8, 3.0, 12.0),
    "Raspberry Pi 5 (Cortex-A76)": BoardCore(2.4, 16, 8.0, 5.0),
    "Jetson Orin Nano (Cortex-A78AE)": BoardCore(1.5, 16, 15.0, 7.0),
}
_ASSUMED: Final = (
    f"computed for one core, {_REACHED:.0%} of its peak reached, nothing kept in a cache between two calls; "
    + "; ".join(
        f"{name}: {one.clock_ghz:g} GHz, {one.per_cycle} fp32 operations a cycle, {one.memory_gb_s:g} GB/s, "
        f"{one.call_us:g} us a call"
        for name, one in _BOARDS.items()
    )
)


def budget() -> BenchResult:
    """Count the cost of a frame of each listener in fp32 torch, and compute its time on boards. Blocks for seconds.

    The time of numpy beside the networks is in `here_ms`, which is measured, not in the counts.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        figures: dict[str, Any] = {name: _counted(name) for name in _LISTENERS}
    finally:
        torch.set_num_threads(threads)
    table = [
        {
            "listener": name,
            "M operations": round(each["operations"] / 1e6, 2),
            "MB": round(each["bytes"] / 1e6, 2),
            "calls": each["calls"],
            "here ms": each["here_ms"],
            **{f"{board.split(' (')[0]} ms": each["boards"][board]["ms"] for board in _BOARDS},
        }
        for name, each in figures.items()
    ]
    lines = [_ASSUMED, f"a frame lasts {_FRAME_MS:g} ms; measured on {machine()}; none was run on such a board"]
    return BenchResult({**figures, "assumed": _ASSUMED, "machine": machine()}, table, lines)


def _counted(name: str) -> dict[str, Any]:
    folder = data_dir("configs") / "listeners" / name
    listener = load_listener(folder, engine="torch")
    memory: Any = listener.start(0)
    rng = np.random.default_rng(0)
    costs, took_s = [], []
    for index in range(_WARM_UP + 2 * _FRAMES):
        voice, own = (rng.normal(0, size, FRAME_SAMPLES).astype(np.float32) for size in (0.1, 1e-3))
        time_s = (index + 1) * FRAME_S
        frame = SpeakerFrame(time_s, voice, FaceFrame.of(time_s, rng.uniform(0, 0.2, 58)), own)
        began_s = time.perf_counter()
        if _WARM_UP <= index < _WARM_UP + _FRAMES:
            with OperationCount() as count:
                _, memory = listener.step(frame, memory)
            costs.append((count.operations, count.bytes, count.calls))
        else:
            _, memory = listener.step(frame, memory)
            took_s.append(time.perf_counter() - began_s)
    operations, moved, calls = np.mean(costs, axis=0).tolist()
    most = max(costs)
    return {
        "precision": getattr(config.load_listener(folder / "config.yaml"), "precision", "fp32"),
        "operations": round(operations),
        "bytes": round(moved),
        "calls": round(calls),
        "largest_frame_operations": most[0],
        "here_ms": round(1e3 * float(np.mean(took_s[-_FRAMES:])), 3),
        "boards": {
            board: {
                "ms": round(one.ms(operations, moved, calls), 2),
                "largest_frame_ms": round(one.ms(*most), 2),
                "share_of_a_core": round(one.ms(operations, moved, calls) / _FRAME_MS, 3),
            }
            for board, one in _BOARDS.items()
        },
    }
