"""Feetech's Python SDK (feetech-servo-sdk, module scservo_sdk), as in its sync read and write example."""

import pytest

from sfms_robot.emulator.launch import EmulatedServo

sdk = pytest.importorskip("scservo_sdk")

pytestmark = pytest.mark.realtime

IDS = (1, 2)
LITTLE_END = 0


def test_sts_servos_are_synced(plugged_in, again):
    port = sdk.PortHandler(plugged_in([EmulatedServo(i, "sts3215", start_ticks=2000) for i in IDS]).device)
    handler = sdk.PacketHandler(LITTLE_END)
    assert port.openPort() and port.setBaudRate(1_000_000)
    again(lambda: handler.ping(port, 1), lambda a: a == (777, 0, 0))
    write, read = sdk.GroupSyncWrite(port, handler, 42, 2), sdk.GroupSyncRead(port, handler, 56, 4)
    for servo in IDS:
        again(lambda i=servo: handler.write1ByteTxRx(port, i, 40, 1), lambda a: a == (0, 0))
        assert write.addParam(servo, [sdk.SCS_LOBYTE(2100), sdk.SCS_HIBYTE(2100)]) and read.addParam(servo)
    assert write.txPacket() == 0
    again(read.txRxPacket, lambda result: result == 0 and [read.getData(i, 56, 2) for i in IDS] == [2100, 2100])
    port.closePort()
