"""`bench bus`: the bus beside the vendor SDK's calls, on the same emulated servos, in real time.

    write, tick     host CPU of a sync write; of a write and a read of all servos
    tick_FAMILY     the same for a head of 12 servos of each bus family
    cpu_share       of a core, at 100 ticks a second
    wire_use        bytes x 10 / baud over the host's time for ticks without pauses, on a line with the timing of a
                    wire; time by which the emulator itself was late does not count
    one_silent      ticks a second at 100 Hz with one dead servo, with those behind it silent too, and with them working

A servo counts as silent after `DEADLINE_MS`, longer than on a wire: the emulator shares the computer's cores.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np

from sfms_robot.app.open_head import build_bus
from sfms_robot.app.wiring import emulated
from sfms_robot.config import Head, load_head
from sfms_robot.config.wire_time import BITS
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.lab.bench.measure import HEAD, Row, row, times
from sfms_robot.runtime.clock import RealClock, tick_times

RATE_HZ: Final = 100.0
DEADLINE_MS: Final = 8.0
_CALLS: Final = 500
_PACED_TICKS: Final = 200
_WINDOW: Final = 25  # ticks over which a rate is taken
_POSITION: Final = (132, 4)
_BLOCK: Final = (126, 21)  # load to temperature, of X servos
_GOAL: Final = (116, 4)
_MIDDLE: Final = b"\x00\x08\x00\x00"
_SERVOS: Final = 12  # of the heads that each protocol is measured with


@dataclass(frozen=True, kw_only=True)
class VendorModel:
    """A servo model as the vendor SDK addresses it: its middle, and (address, length) of its registers."""

    protocol: float = 1.0
    model: str
    zero_ticks: int = 2048
    goal: tuple[int, int]
    position: tuple[int, int]


_XL330: Final = VendorModel(protocol=2.0, model="xl330-m288", goal=_GOAL, position=_POSITION)
_MODELS: Final = {  # by bus family
    "dynamixel2": _XL330,
    "dynamixel1": VendorModel(model="mx-28-1.0", goal=(30, 2), position=(36, 2)),
    "feetech": VendorModel(model="sts3215", goal=(42, 2), position=(56, 2)),  # frame and sync write of Protocol 1.0
}


@dataclass(frozen=True)
class Host:
    """A program that moves all servos of a head: `write` sends goals, `tick` also reads."""

    write: Callable[[], object]
    tick: Callable[[], object]


def bus() -> dict[str, Row]:
    """Return all rows; ours first, then the vendor SDK on the same servos."""
    head = _changed(load_head(HEAD), read_deadline_ms=DEADLINE_MS)
    return {
        **_cpu(head),
        **{f"bus.tick_{family}": _tick(family, model) for family, model in _MODELS.items()},
        "bus.wire_use_1M": _wire_use(head, 1_000_000, _POSITION),
        "bus.wire_use_4M": _wire_use(head, 4_000_000, _BLOCK),
        "bus.one_silent_chain_break": _one_silent(head, "chain_break"),
        "bus.one_silent_skip": _one_silent(head, "skip"),
    }


def _cpu(head: Head) -> dict[str, Row]:
    def measured(host: Host) -> list[list[float]]:
        calls = [times(call, _CALLS, time.process_time) for call in (host.write, host.tick)]
        return [*calls, _paced(host)[1]]

    with launch(_plugged(head)) as chain:
        with _ours(head, chain.device) as host:
            ours = measured(host)
        with _vendor(head, chain.device, _POSITION) as host:
            peers = measured(host)
    write = "dynamixel-sdk GroupSyncWrite"
    tick = f"{write} + GroupSyncRead"
    units = {"write": ("ms CPU", write), "tick": ("ms CPU", tick), "cpu_share": ("of a core at 100 Hz", tick)}
    return {
        f"bus.{name}": row(own, peer, *unit) for (name, unit), own, peer in zip(units.items(), ours, peers, strict=True)
    }


def _tick(family: str, model: VendorModel) -> Row:
    """Measure write and read of all servos of one family."""
    head = _changed(load_head(HEAD), family=family, baud=1_000_000, read_deadline_ms=DEADLINE_MS)
    some = list(head.joints.items())[:_SERVOS]
    values = {"model": model.model, "zero_ticks": model.zero_ticks}
    head = head.model_copy(update={"joints": {name: joint.model_copy(update=values) for name, joint in some}})
    with launch(_plugged(head)) as chain:
        with _ours(head, chain.device) as host:
            ours = times(host.tick, _CALLS, time.process_time)
        with _vendor(head, chain.device, model.position, model) as host:
            peers = times(host.tick, _CALLS, time.process_time)
    reads = "GroupSyncRead" if model.protocol == 2.0 else "a read of each"
    return row(ours, peers, f"ms CPU, {_SERVOS} servos", f"dynamixel-sdk GroupSyncWrite + {reads}")


def _one_silent(head: Head, behind: Literal["chain_break", "skip"]) -> Row:
    """Measure while the servo in the middle of the chain is dead."""
    ids = _ids(head)
    with launch(_plugged(head), behind_silent=behind) as chain:
        with _ours(head, chain.device) as host:
            host.tick()
            chain.kill(ids[len(ids) // 2])
            rates = _paced(host)[0]
        with _vendor(head, chain.device, _POSITION) as host:
            peer_rates = _paced(host)[0]
    return row(rates, peer_rates, f"ticks/s, one of {len(ids)} dead", "dynamixel-sdk group calls")


def _wire_use(head: Head, baud: int, where: tuple[int, int]) -> Row:
    """Measure the share of each tick in which the line carried bytes."""
    head = _changed(head, baud=baud)
    with launch(_plugged(head), timing="wire") as chain:
        with _ours(head, chain.device):
            pass  # the handshake sets the return delays to 0, for both
        with _reading(head, chain.device, where) as host:
            ours = _shares(chain, host, baud)
        with _vendor(head, chain.device, where) as host:
            peers = _shares(chain, host, baud)
    what = "goals and positions" if where == _POSITION else "goals and whole blocks"
    return row(ours, peers, f"of the wire's time at {baud // 1_000_000} Mbit/s, {what}", "dynamixel-sdk group calls")


def _shares(chain: Chain, host: Host, baud: int, ticks: int = 100) -> list[float]:
    """Return one share per tick, from the emulator's count of bytes and its stamps of lateness.

    Ticks with an unusual number of bytes are left out: the host gave up, and the rest came with the next tick.
    """
    for _ in range(10):
        host.tick()
    seen: list[tuple[int, float]] = []
    for _ in range(ticks):
        before = chain.statistics()
        began_s = time.perf_counter()
        host.tick()
        spent_s = time.perf_counter() - began_s
        after = chain.statistics()
        count = after["bytes_in"] + after["bytes_out"] - before["bytes_in"] - before["bytes_out"]
        last = chain.stamps()[-1]
        late_s = max(0.0, last["sent_s"] - last["due_s"])
        seen.append((count, count * BITS / baud / (spent_s - late_s)))
    usual, _ = Counter(count for count, _ in seen).most_common(1)[0]
    return [share for count, share in seen if count == usual]


def _paced(host: Host) -> tuple[list[float], list[float]]:
    """Return (ticks a second, processor seconds a second) at 100 Hz, by window; late ticks are not made up for."""
    pace = RealClock()
    rates, shares = [], []
    ticks = tick_times(pace, RATE_HZ, pace.now_s())
    for _ in range(_PACED_TICKS // _WINDOW):
        began_s, used_s = pace.now_s(), time.process_time()
        for _ in range(_WINDOW):
            next(ticks)
            host.tick()
        spent_s = pace.now_s() - began_s
        rates.append(_WINDOW / spent_s)
        shares.append((time.process_time() - used_s) / spent_s)
    return rates, shares


# --- hosts ----------------------------------------------------------------------------------------------------------


@contextmanager
def _ours(head: Head, device: str) -> Iterator[Host]:
    """Open the bus that `run` uses."""
    clock = RealClock()
    bus = build_bus(head, {next(iter(head.buses)): device}, clock)
    bus.connect()
    held = bus.enable(list(head.joints))
    joints = head.joints.values()  # without power the joints sag out of their ranges: they move in first
    held = np.clip(held, [joint.min_rad for joint in joints], [joint.max_rad for joint in joints])

    def write() -> None:
        bus.write(held, clock.now_s())

    def tick() -> None:
        write()
        bus.poll(clock.now_s())

    try:
        yield Host(write, tick)
    finally:
        bus.stop("release")
        bus.close()


@contextmanager
def _reading(head: Head, device: str, where: tuple[int, int]) -> Iterator[Host]:
    """Open a link that makes the two requests of a tick as the bus does: goals, and one fast sync read of `where`."""
    from sfms_robot.servo.chain.protocol2 import Dynamixel2Link
    from sfms_robot.servo.port import SerialPort

    config = next(iter(head.buses.values()))
    port = SerialPort(device, config.baud, RealClock())
    link = Dynamixel2Link(port, config.baud, DEADLINE_MS / 1e3)
    ids = _ids(head)
    goals = dict.fromkeys(ids, (2048).to_bytes(_GOAL[1], "little"))

    def write() -> None:
        link.sync_write(_GOAL[0], goals)

    def tick() -> None:
        write()
        link.read_many(*where, ids, fast=True)

    try:
        yield Host(write, tick)
    finally:
        port.close()


@contextmanager
def _vendor(head: Head, device: str, where: tuple[int, int], model: VendorModel = _XL330) -> Iterator[Host]:
    """Open the vendor's SDK, with the calls of its examples. Its bulk read of Protocol 1.0 (4.1.0) fails."""
    import dynamixel_sdk as sdk

    port, protocol = sdk.PortHandler(device), sdk.PacketHandler(model.protocol)
    port.openPort()
    port.setBaudRate(next(iter(head.buses.values())).baud)
    writer = sdk.GroupSyncWrite(port, protocol, *model.goal)
    reader = sdk.GroupSyncRead(port, protocol, *where)
    ids, middle = _ids(head), list(_MIDDLE[: model.goal[1]])
    for servo in ids:
        writer.addParam(servo, middle)
        reader.addParam(servo)

    def write() -> None:
        for servo in ids:
            writer.changeParam(servo, middle)
        writer.txPacket()

    def tick() -> None:
        write()
        if model.protocol == 2.0:
            reader.txRxPacket()
        else:
            for servo in ids:
                protocol.readTxRx(port, servo, *where)

    try:
        yield Host(write, tick)
    finally:
        port.closePort()


def _changed(head: Head, **values: Any) -> Head:
    """Return the head with other values of its only bus."""
    name, config = next(iter(head.buses.items()))
    return head.model_copy(update={"buses": {name: config.model_copy(update=values)}})


def _plugged(head: Head) -> list[EmulatedServo]:
    return emulated(head)[next(iter(head.buses))]


def _ids(head: Head) -> list[int]:
    return [joint.id for joint in head.joints.values()]
