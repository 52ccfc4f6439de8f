"""Random bytes at the buses of all families, in virtual time: no exception, no hang, no memory that grows.

Before what the emulated servos answer, the port gives bytes that nobody sent: half of them random, half made to look
like the beginning of a packet. The loop goes on meanwhile; afterwards every joint has to come back. A checksum of 8
bits lets one forged answer in 256 through, so positions are not judged here, but the goals that servos hold are.
"""

from __future__ import annotations

import logging
import random
import resource
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from sfms_robot.lab.bench.campaign_rig import FAMILIES, RECOVERY_S, Judge, Rig, head_of, plugged_in
from sfms_robot.lab.bench.measure import Told
from sfms_robot.servo.port import WrappedPort

BYTES: Final = 1_000_000
MEMORY_MIB: Final = 64.0  # more than this is growth
_MOST: Final = 1024  # bytes in one tick
_WAITING: Final = 8 * _MOST  # a driver's buffer holds no more
_CALM_TICKS: Final = 240
_SHARE: Final = 0.8  # of the ticks that are noisy
_BEGINNINGS: Final = (b"\xff\xff\xfd\x00", b"\xff\xff", b"\xff\xf5", b"\xff\xff\xfd\x00\xfe", b"\xff\xff\xfe")


@dataclass(frozen=True)
class Fuzzed:
    """What random bytes did to one family."""

    family: str
    bytes: int
    ticks: int
    escaped: str | None
    outside: int
    recovered_s: float | None
    named: Sequence[str]
    slowest_tick_ms: float
    grown_mib: float

    @property
    def passed(self) -> bool:
        back = self.recovered_s is not None and self.recovered_s <= RECOVERY_S
        return self.escaped is None and not self.outside and back and self.grown_mib < MEMORY_MIB


@dataclass
class Noise:
    """Bytes that wait to be read or thrown away, and how many were."""

    dice: random.Random
    waiting: bytearray = field(default_factory=bytearray)
    count: int = 0

    def rise(self) -> None:
        """A tick's worth."""
        if self.dice.random() < _SHARE and len(self.waiting) < _WAITING:
            start = self.dice.choice(_BEGINNINGS) if self.dice.random() < 0.5 else b""
            self.waiting += start + self.dice.randbytes(self.dice.randint(1, _MOST))

    def take(self, n: int) -> bytes:
        """A piece of what waits, of any length up to `n`."""
        piece = bytes(self.waiting[: self.dice.randint(1, n)])
        del self.waiting[: len(piece)]
        self.count += len(piece)
        return piece

    def discard(self) -> None:
        self.count += len(self.waiting)
        self.waiting.clear()


@dataclass
class NoisyPort(WrappedPort):
    """A port that gives noise before what comes in."""

    noise: Noise

    def read(self, n: int, deadline_s: float) -> bytes:
        return self.noise.take(n) if self.noise.waiting else super().read(n, deadline_s)

    def discard_input(self) -> None:
        self.noise.discard()
        super().discard_input()


def fuzz_one(family: str, count: int = BYTES, seed: int = 0) -> Fuzzed:
    """`count` bytes at the bus of one family, and then calm."""
    noise = Noise(random.Random(seed))
    with plugged_in(head_of(family), wrap=lambda port: NoisyPort(port, noise)) as rig:
        rig.hold()
        return _storm(rig, family, noise, count)


def _storm(rig: Rig, family: str, noise: Noise, count: int) -> Fuzzed:
    judge, ticks, slowest_s, escaped = Judge(rig), 0, 0.0, None
    end_s, before_mib = rig.clock.now_s(), _memory_mib()
    calm = 0
    while calm < _CALM_TICKS:
        if noise.count < count:
            noise.rise()
            end_s = rig.clock.now_s()
        else:
            noise.waiting.clear()
            calm += 1
        ticks += 1
        began_s = time.perf_counter()
        try:
            readings = rig.tick()
        except Exception as error:  # what escapes is what is looked for
            escaped = f"{type(error).__name__}: {error}"
            break
        slowest_s = max(slowest_s, time.perf_counter() - began_s)
        judge.see(readings)
    recovered_s, grown_mib = judge.recovered_s(end_s), _memory_mib() - before_mib
    return Fuzzed(
        family, noise.count, ticks, escaped, judge.outside, recovered_s, judge.named, 1e3 * slowest_s, grown_mib
    )


def _memory_mib() -> float:
    """The most this process has ever used."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def run_fuzz(
    minutes: float = 0.0,
    families: Iterable[str] = tuple(FAMILIES),
    count: int = BYTES,
    seed: int = 0,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Fuzzed]:
    """Every family once, then again with other dice until `minutes` are over."""
    until_s = time.monotonic() + 60.0 * minutes
    families, out = list(families), []
    while True:
        for family in families:
            progress(f"{family}: {count} bytes, dice {seed}")
            out.append(fuzz_one(family, count, seed))
        seed += 1
        if time.monotonic() >= until_s:
            return out


def measure(say: Callable[[str], None], minutes: float = 0.0) -> Told:
    """`run_fuzz`, as `bench` tells it; 0 minutes: a million bytes each."""
    logging.getLogger("sfms_robot").setLevel(logging.CRITICAL)  # thousands of faults are said elsewhere
    fuzzed = run_fuzz(minutes, progress=say)
    plain = [asdict(each) | {"passed": each.passed} for each in fuzzed]
    passed = all(each.passed for each in fuzzed)
    return Told({"passed": passed, "runs": plain}, table(fuzzed), passed=passed)


def table(fuzzed: Sequence[Fuzzed]) -> list[dict[str, Any]]:
    """A row per run, as printed."""
    return [
        {
            "family": each.family,
            "bytes": each.bytes,
            "escaped": each.escaped or 0,
            "outside": each.outside,
            "back s": None if each.recovered_s is None else round(each.recovered_s, 2),
            "out": len(each.named),
            "ms": round(each.slowest_tick_ms, 1),
            "MiB": round(each.grown_mib, 1),
            "passed": "yes" if each.passed else "NO",
        }
        for each in fuzzed
    ]
