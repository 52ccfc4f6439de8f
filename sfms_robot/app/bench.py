"""`sfms-robot bench`: each part against a peer or a baseline, both measured in the same run.

| name | measured | peer |
|---|---|---|
| help | process start of `sfms-robot --help` | the same Python doing nothing |
| bus.write, bus.tick | our sync write; write and read of a head (CPU time) | the vendor SDK's own group calls |
| retarget.tick | timeline, mapping, limits of a head | a plain matrix product of the mapping's size |
| listener.plan | one plan on one thread | the time it covers: hop x 40 ms |
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from sfms_robot.app.heads import build_bus, build_motion, emulated
from sfms_robot.config import find, load_head
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, MOTION_DIM, Plan, SpeakerFrame
from sfms_robot.runtime.clock import RealClock
from sfms_robot.runtime.loop import difference
from sfms_robot.simulator.launch import launch

HEAD = "face28"
LISTENER = "sfms-small"
Row = dict[str, Any]


def run_bench(name: str) -> dict[str, Row]:
    """Measure `name`, or everything for "all". A row has median, p99, unit, peer, peer_median and ratio."""
    parts: Mapping[str, Callable[[], dict[str, Row]]] = {
        "startup": _startup,
        "bus": _bus,
        "retarget": _retarget,
        "listener": _listener,
    }
    chosen = parts.values() if name == "all" else [parts[name]]
    return {key: row for part in chosen for key, row in part().items()}


def _row(ours: list[float], peers: list[float], unit: str, peer: str) -> Row:
    median, peer_median = float(np.median(ours)), float(np.median(peers))
    return {
        "median": median,
        "p99": float(np.percentile(ours, 99)),
        "unit": unit,
        "peer": peer,
        "peer_median": peer_median,
        "ratio": median / peer_median,
    }


def _times(call: Callable[[], object], count: int, clock: Callable[[], float] = time.perf_counter) -> list[float]:
    """`count` durations of `call` [ms] after a tenth as many to warm up."""
    for _ in range(max(1, count // 10)):
        call()
    out = []
    for _ in range(count):
        began = clock()
        call()
        out.append((clock() - began) * 1e3)
    return out


def _startup() -> dict[str, Row]:
    def python(*arguments: str) -> Callable[[], object]:
        return lambda: subprocess.run([sys.executable, *arguments], stdout=subprocess.DEVNULL, check=True)

    ours = _times(
        python("-c", "from sfms_robot.cli.main import main; import sys; sys.argv[1:] = ['--help']; main()"), 10
    )
    return {"help": _row(ours, _times(python("-c", "pass"), 10), "ms", "python -c pass")}


def _bus() -> dict[str, Row]:
    """Host CPU time on a real-time emulated chain; ours first, then the vendor SDK on the same servos."""
    head = load_head(HEAD)
    name = next(iter(head.buses))
    clock = RealClock()
    with launch(emulated(head)[name]) as chain:
        bus = build_bus(head, {name: chain}, clock)
        bus.connect()
        held = bus.enable(list(head.joints))

        def tick() -> None:
            bus.write(held, clock.now_s())
            bus.poll(clock.now_s())

        writes = _times(lambda: bus.write(held, clock.now_s()), 500, time.process_time)
        ticks = _times(tick, 500, time.process_time)
        bus.stop("release")
        bus.close()
        sdk_writes, sdk_ticks = _vendor(chain.device, head.buses[name].baud, [j.id for j in head.joints.values()])
    return {
        "bus.write": _row(writes, sdk_writes, "ms CPU", "dynamixel-sdk GroupSyncWrite"),
        "bus.tick": _row(ticks, sdk_ticks, "ms CPU", "dynamixel-sdk GroupSyncWrite + GroupSyncRead"),
    }


def _vendor(device: str, baud: int, ids: list[int]) -> tuple[list[float], list[float]]:
    from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler

    port, protocol = PortHandler(device), PacketHandler(2.0)
    port.openPort()
    port.setBaudRate(baud)
    writer = GroupSyncWrite(port, protocol, 116, 4)
    reader = GroupSyncRead(port, protocol, 126, 10)
    for servo in ids:
        writer.addParam(servo, [0, 8, 0, 0])
        reader.addParam(servo)

    def write() -> None:
        for servo in ids:
            writer.changeParam(servo, [0, 8, 0, 0])
        writer.txPacket()

    def tick() -> None:
        write()
        reader.txRxPacket()

    times = _times(write, 500, time.process_time), _times(tick, 500, time.process_time)
    port.closePort()
    return times


def _retarget() -> dict[str, Row]:
    head = load_head(HEAD)
    rate_hz = 100.0
    motion = build_motion(head, rate_hz)
    rng = np.random.default_rng(0)
    timeline, limiter = motion.timeline.start(), motion.limiter.start(motion.rest_rad)
    neck = motion.retargeter.start()
    before = here = motion.rest_rad
    now_s = 0.0

    def tick() -> None:
        nonlocal timeline, limiter, neck, before, here, now_s
        if round(now_s * rate_hz) % 16 == 0:
            times_s = now_s + FRAME_S * np.arange(1, 9)
            wave = 0.3 + 0.2 * np.sin(2 * np.pi * times_s[:, None] * rng.uniform(0.2, 1.0, MOTION_DIM))
            timeline = motion.timeline.accept(
                Plan(now_s, times_s.astype(np.float64), wave.astype(np.float32)), timeline
            )
        times = np.concatenate([[now_s], now_s + motion.leads_s + 1 / rate_hz])
        frames, timeline = motion.timeline.sample(times, now_s, timeline)
        ahead, neck = motion.retargeter.step(frames[1:], neck)
        _, limiter = motion.limiter.step(difference(before, here, ahead, 1 / rate_hz), limiter)
        before, here, now_s = here, ahead, now_s + 1 / rate_hz

    matrix, frame = rng.normal(size=(len(head.joints), MOTION_DIM)), rng.normal(size=MOTION_DIM)
    return {
        "retarget.tick": _row(_times(tick, 2000), _times(lambda: matrix @ frame, 2000), "ms", "28 x 58 matrix product")
    }


def _listener() -> dict[str, Row]:
    from sfms_robot.listeners.registry import load_listener, one_thread

    one_thread()
    listener = load_listener(find("listeners", LISTENER, "config.yaml"))
    memory = listener.start(0)
    rng = np.random.default_rng(0)
    plans = []
    for index in range(400):
        audio = (0.1 * rng.normal(size=FRAME_SAMPLES)).astype(np.float32)
        frame = SpeakerFrame((index + 1) * FRAME_SAMPLES / AUDIO_HZ, audio)
        began_s = time.perf_counter()
        plan, memory = listener.step(frame, memory)
        if plan is not None:
            plans.append((time.perf_counter() - began_s) * 1e3)
    return {"listener.plan": _row(plans, [listener.hop * FRAME_S * 1e3], "ms", f"hop of {listener.hop} frames")}
