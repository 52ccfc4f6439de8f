"""Feetech's Python SDK (feetech-servo-sdk, module scservo_sdk), as in its sync read and write example."""

import pytest

from sfms_robot.emulator.launch import EmulatedServo

sdk = pytest.importorskip("scservo_sdk")

pytestmark = pytest.mark.realtime

IDS = (1, 2)
LITTLE, BIG = 0, 1


@pytest.fixture
def opened(plugged_in):
    ports = []

    def open_(servos, end):
        port = sdk.PortHandler(plugged_in(servos).device)
        ports.append(port)
        assert port.openPort() and port.setBaudRate(1_000_000)
        return port, sdk.PacketHandler(end)

    yield open_
    for port in ports:
        port.closePort()


def test_sts_servos_are_synced(opened, again):
    port, handler = opened([EmulatedServo(i, "sts3215", start_ticks=2000) for i in IDS], LITTLE)
    again(lambda: handler.ping(port, 1), lambda a: a == (777, 0, 0))
    write, read = sdk.GroupSyncWrite(port, handler, 42, 2), sdk.GroupSyncRead(port, handler, 56, 4)
    for servo in IDS:
        again(lambda i=servo: handler.write1ByteTxRx(port, i, 40, 1), lambda a: a == (0, 0))
        assert write.addParam(servo, [sdk.SCS_LOBYTE(2100), sdk.SCS_HIBYTE(2100)])
        assert read.addParam(servo)
    assert write.txPacket() == 0
    again(read.txRxPacket, lambda result: result == 0 and [read.getData(i, 56, 2) for i in IDS] == [2100, 2100])


def test_scs_servos_send_the_high_byte_first(opened, again):
    port, handler = opened([EmulatedServo(1, "scs0009", start_ticks=500)], BIG)
    again(lambda: handler.read2ByteTxRx(port, 1, 56), lambda a: a == (500, 0, 0))
    again(lambda: handler.write1ByteTxRx(port, 1, 40, 1), lambda a: a == (0, 0))
    again(lambda: handler.write2ByteTxRx(port, 1, 42, 600), lambda a: a == (0, 0))
    again(lambda: handler.read2ByteTxRx(port, 1, 56), lambda a: a == (600, 0, 0))
