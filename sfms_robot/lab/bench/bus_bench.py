"""`bench bus`: the bus compared with the vendor SDK's calls, on the same emulated servos, in real time.

    write, tick     host CPU time of a sync write, and of a write and a read of all servos
    cpu_share       share of a core at 100 ticks a second
    one_silent      ticks a second at 100 Hz with one dead servo; servos behind it do not answer a shared read

A servo counts as silent after `DEADLINE_MS`. This is longer than on a wire, because the emulator shares the computer's
cores.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.app.open_head import build_bus
from sfms_robot.app.wiring import emulated
from sfms_robot.config import Head, load_head
from sfms_robot.emulator.launch import launch
from sfms_robot.lab.bench.measure import HEAD, Row, Rows, row, times
from sfms_robot.runtime.clock import RealClock, tick_times

RATE_HZ: Final = 100.0
DEADLINE_MS: Final = 8.0
_CALLS: Final = 500
_PACED_TICKS: Final = 200
_WINDOW: Final = 25  # ticks over which a rate is measured
_GOAL: Final = (116, 4)  # (address, length) of the registers of X servos
_POSITION: Final = (132, 4)
_MIDDLE: Final = b"\x00\x08\x00\x00"


@dataclass(frozen=True)
class Host:
    """A program that moves all servos of a head: `write` sends goals, `tick` also reads."""

    write: Callable[[], object]
    tick: Callable[[], object]


def bus() -> Rows:
    """Return all rows; our bus is measured first, then the vendor SDK on the same servos."""
    head = load_head(HEAD)
    patient = head.buses["main"].model_copy(update={"read_deadline_ms": DEADLINE_MS})
    head = head.model_copy(update={"buses": {"main": patient}})
    return {**_cpu(head), "bus.one_silent": _one_silent(head)}


def _cpu(head: Head) -> Rows:
    def measured(host: Host) -> list[list[float]]:
        calls = [times(call, _CALLS, time.process_time) for call in (host.write, host.tick)]
        return [*calls, _paced(host)[1]]

    with launch(emulated(head)["main"]) as chain:
        with _ours(head, chain.device) as host:
            ours = measured(host)
        with _vendor(head, chain.device) as host:
            peers = measured(host)
    write = "dynamixel-sdk GroupSyncWrite"
    tick = f"{write} + GroupSyncRead"
    units = {"write": ("ms CPU", write), "tick": ("ms CPU", tick), "cpu_share": ("of a core at 100 Hz", tick)}
    return {
        f"bus.{name}": row(own, peer, *unit) for (name, unit), own, peer in zip(units.items(), ours, peers, strict=True)
    }


def _one_silent(head: Head) -> Row:
    """Measure while the servo in the middle of the chain is dead."""
    ids = _ids(head)
    with launch(emulated(head)["main"]) as chain:
        with _ours(head, chain.device) as host:
            host.tick()
            chain.kill(ids[len(ids) // 2])
            rates = _paced(host)[0]
        with _vendor(head, chain.device) as host:
            peer_rates = _paced(host)[0]
    return row(rates, peer_rates, f"ticks/s, one of {len(ids)} dead", "dynamixel-sdk group calls")


def _paced(host: Host) -> tuple[list[float], list[float]]:
    """Return (ticks a second, processor seconds a second) of each window at 100 Hz; late ticks are not made up for."""
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
    bus = build_bus(head, {"main": device}, clock)
    bus.connect()
    held = bus.enable(list(head.joints))
    joints = head.joints.values()  # without power the joints sag out of their ranges, so the goals are moved inside
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
def _vendor(head: Head, device: str) -> Iterator[Host]:
    """Open the vendor's SDK, with the calls of its examples."""
    import dynamixel_sdk as sdk

    port, protocol = sdk.PortHandler(device), sdk.PacketHandler(2.0)
    port.openPort()
    port.setBaudRate(head.buses["main"].baud)
    writer = sdk.GroupSyncWrite(port, protocol, *_GOAL)
    reader = sdk.GroupSyncRead(port, protocol, *_POSITION)
    ids, middle = _ids(head), list(_MIDDLE)
    for servo in ids:
        writer.addParam(servo, middle)
        reader.addParam(servo)

    def write() -> None:
        for servo in ids:
            writer.changeParam(servo, middle)
        writer.txPacket()

    def tick() -> None:
        write()
        reader.txRxPacket()

    try:
        yield Host(write, tick)
    finally:
        port.closePort()


def _ids(head: Head) -> list[int]:
    return [joint.id for joint in head.joints.values()]
