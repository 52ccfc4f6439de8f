"""The bus beside the vendor SDK's own calls, on the same emulated servos."""

from __future__ import annotations

import time

from sfms_robot.app.bench.measure import HEAD, Row, row, times
from sfms_robot.app.heads import build_bus, emulated
from sfms_robot.config import load_head
from sfms_robot.runtime.clock import RealClock
from sfms_robot.simulator.launch import launch


def bus() -> dict[str, Row]:
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

        writes = times(lambda: bus.write(held, clock.now_s()), 500, time.process_time)
        ticks = times(tick, 500, time.process_time)
        bus.stop("release")
        bus.close()
        sdk_writes, sdk_ticks = _vendor(chain.device, head.buses[name].baud, [j.id for j in head.joints.values()])
    return {
        "bus.write": row(writes, sdk_writes, "ms CPU", "dynamixel-sdk GroupSyncWrite"),
        "bus.tick": row(ticks, sdk_ticks, "ms CPU", "dynamixel-sdk GroupSyncWrite + GroupSyncRead"),
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

    durations = times(write, 500, time.process_time), times(tick, 500, time.process_time)
    port.closePort()
    return durations
