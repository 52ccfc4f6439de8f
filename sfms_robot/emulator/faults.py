"""Faults of an emulated wire, specified by kind, ids, start, end and value.

    KIND[:IDS][@START[-END]][=VALUE]        drop:3,5-7@2-4=0.5    delay:2=0.012    brownout@1    noise=0.1

Times are seconds of the emulator's clock; a fault without an END lasts for ever, except brownout and hangup. All random
numbers come from one seeded generator, so that in virtual time the same requests have the same faults.

`drop`, `corrupt`, `delay` and similar kinds affect packets from servos. `request-drop`, `request-corrupt` and
`request-delay` affect data from the host: each write as a whole, in the same way for all servos of the wire. In corrupt
data one byte is replaced by another.
"""

from __future__ import annotations

import math
import random
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, Final, NamedTuple

from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError


class Kind(NamedTuple):
    """Meaning of VALUE ("" if there is no value), its default and range, and the default duration of the fault."""

    meaning: str
    value: float = 1.0
    low: float = 0.0
    high: float = 1.0
    lasts_s: float = math.inf
    ids: bool = True


_OF_REPLIES: Final = Kind("fraction of replies")
_OF_REQUESTS: Final = Kind("fraction of requests", ids=False)
_STATE: Final = Kind("")
TO_SERVOS: Final = "request-"  # prefix of the kinds that affect requests to servos; the others affect replies
KINDS: Final = {
    "drop": _OF_REPLIES,
    "delay": Kind("seconds", 0.02, 0.0, 60.0),
    "corrupt": _OF_REPLIES,
    "duplicate": _OF_REPLIES,
    "truncate": _OF_REPLIES,
    "echo": _OF_REQUESTS,
    "noise": _OF_REQUESTS,
    "request-drop": _OF_REQUESTS,
    "request-corrupt": _OF_REQUESTS,
    "request-delay": Kind("seconds", 0.02, 0.0, 60.0, ids=False),
    "silent": _STATE,
    "mute": _STATE,
    "stuck": _STATE,
    "overload": _STATE,
    "overheat": _STATE,
    "load": Kind("fraction of full torque", 0.1, -1.0, 1.0),
    "voltage": Kind("volts", 0.0, 0.0, 60.0, ids=False),
    "brownout": Kind("volts", 0.0, 0.0, 60.0, lasts_s=0.2, ids=False),
    "hangup": Kind("", lasts_s=1.0, ids=False),
}
_SPEC: Final = re.compile(
    r"(?P<kind>[a-z-]+)(:(?P<ids>[0-9,-]+))?(@(?P<start>[0-9.]+)(?P<dash>-(?P<end>[0-9.]+)?)?)?(=(?P<value>-?[0-9.e-]+))?"
)


@dataclass(frozen=True, kw_only=True)
class Fault:
    """One fault. `ids` None: all servos. `text`: the spec from which it was read."""

    kind: str
    ids: frozenset[int] | None
    start_s: float
    end_s: float
    value: float
    text: str

    def concerns(self, servo: Any) -> bool:
        """Return whether a servo or channel can have this fault."""
        return self.ids is None or servo.id in self.ids

    def meets(self, servos: Sequence[int], now_s: float) -> bool:
        """Return whether this fault affects a packet from `servos` now."""
        return self.start_s <= now_s < self.end_s and (self.ids is None or not self.ids.isdisjoint(servos))


def parse_fault(text: str, now_s: float = 0.0) -> Fault:
    """Read a fault from its spec; without a START it begins at `now_s`. Raises ConfigError of one line."""

    def refuse(problem: str, choices: Iterable[object] = ()) -> ConfigError:
        return ConfigError.at("emulate", "fault", text, problem, choices)

    found = _SPEC.fullmatch(text.strip())
    if found is None:
        raise refuse("cannot be read: KIND[:IDS][@START[-END]][=VALUE]", KINDS)
    name, kind = found["kind"], KINDS.get(found["kind"])
    if kind is None:
        raise refuse(f"has no such kind as {name!r}", KINDS)
    if found["ids"] and not kind.ids:
        raise refuse(f"cannot name ids: {name} concerns the whole wire")
    if name == "voltage" and found["value"] is None:
        raise refuse("needs a value in volts, as in voltage=7.2")
    if found["value"] is not None and not kind.meaning:
        raise refuse(f"has no value: {name} is there or not")
    try:
        start_s = now_s if found["start"] is None else float(found["start"])
        end_s = start_s + kind.lasts_s if found["end"] is None else float(found["end"])
        value = kind.value if found["value"] is None else float(found["value"])
        ids = frozenset(parse_ids(found["ids"])) if found["ids"] else None
    except ValueError:
        raise refuse("holds a bad number") from None
    if not kind.low <= value <= kind.high:
        raise refuse(f"is out of range: {kind.meaning} of {name}", [f"{kind.low:g}..{kind.high:g}"])
    if end_s <= start_s:
        raise refuse(f"ends at {end_s:g} s, before it starts")
    return Fault(kind=name, ids=ids, start_s=start_s, end_s=end_s, value=value, text=text.strip())


def parse_ids(text: str) -> list[int]:
    """Read `3,5-7` as [3, 5, 6, 7]. Raises ValueError."""
    out: list[int] = []
    for part in text.split(","):
        first, _, last = (each.strip() for each in part.partition("-"))
        ids = range(whole_number(first), whole_number(last or first) + 1)
        if not ids or ids[-1] > 255:
            raise ValueError(f"{part!r} is not a range of ids")
        out += ids
    return out


class WireFaults:
    """The faults of one wire, and their random numbers."""

    def __init__(self, seed: int) -> None:
        self._random = random.Random(seed)
        self._faults: list[Fault] = []
        self._edges: list[tuple[float, Fault, bool]] = []  # (time, fault, whether it begins), in order of time

    def add(self, fault: Fault) -> None:
        """Add a fault."""
        self._faults.append(fault)
        self._edges += [(fault.start_s, fault, True), (fault.end_s, fault, False)]
        self._edges.sort(key=itemgetter(0))

    def clear(self, now_s: float) -> None:
        """Remove all faults. Those that have begun end at `now_s`."""
        self._edges = [(now_s, fault, False) for fault in self._faults if fault.start_s <= now_s < fault.end_s]
        self._faults = []

    def texts(self, now_s: float) -> list[str]:
        """Return the specs of current and future faults."""
        return [fault.text for fault in self._faults if now_s < fault.end_s]

    @property
    def next_s(self) -> float:
        """Time at which the next fault begins or ends."""
        return self._edges[0][0] if self._edges else math.inf

    def edges(self, now_s: float) -> Iterator[tuple[float, Fault, bool]]:
        """Yield (time, fault, whether it begins) for each begin and end of a fault up to `now_s`, once, in order."""
        while self.next_s <= now_s:
            time_s, fault, began = self._edges.pop(0)
            if not began and fault in self._faults:
                self._faults.remove(fault)
            yield time_s, fault, began

    def spoil(self, servos: Sequence[int], data: bytes, now_s: float, way: str = "") -> list[tuple[bytes, float]]:
        """Return the packets that arrive for a reply of `servos`, or with `way` `TO_SERVOS` for one write of the host.

        Each packet is (bytes, seconds late); the list is empty if the packet is lost.
        """
        out = [(data, 0.0)]
        for fault in self._faults:
            if not fault.kind.startswith(way) or not fault.meets(servos, now_s):
                continue
            kind = fault.kind.removeprefix(way)
            if kind == "delay":
                out = [(each, late_s + fault.value) for each, late_s in out]
            elif kind in _SPOILERS and self._random.random() < fault.value:
                out = [(spoilt, late_s) for each, late_s in out for spoilt in _SPOILERS[kind](each, self._random)]
        return out

    def strikes(self, kind: str, now_s: float) -> bool:
        """Return whether a fault of the adapter (echo, noise) occurs at this request."""
        return any(self._random.random() < f.value for f in self._faults if f.kind == kind and f.meets((), now_s))

    def noise(self, now_s: float) -> bytes:
        """Return bytes of noise that follow a request."""
        return self._random.randbytes(self._random.randint(1, 12)) if self.strikes("noise", now_s) else b""


def _corrupted(data: bytes, dice: random.Random) -> list[bytes]:
    """Return `data` with one byte replaced by any other."""
    at = dice.randrange(len(data))
    return [data[:at] + bytes([data[at] ^ dice.randrange(1, 256)]) + data[at + 1 :]]


_SPOILERS: Final = {
    "drop": lambda data, dice: [],
    "duplicate": lambda data, dice: [data, data],
    "truncate": lambda data, dice: [data[: dice.randrange(len(data))]],
    "corrupt": _corrupted,
}
