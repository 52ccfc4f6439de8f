"""ROBOTIS' own Python SDK, with its own port: what its examples do."""

import pytest
from dynamixel_sdk import BROADCAST_ID, COMM_SUCCESS, GroupSyncRead, GroupSyncWrite, PortHandler, Protocol2PacketHandler

from sfms_robot.emulator.launch import EmulatedServo

pytestmark = pytest.mark.realtime

IDS = (1, 2, 3)
NO_ERROR = (COMM_SUCCESS, 0)


@pytest.fixture(params=["instant", "wire"])
def bench(plugged_in, request):
    """(port, packet handler, chain) with three servos."""
    servos = [EmulatedServo(i, start_ticks=2000 + i) for i in IDS]
    chain = plugged_in(servos, timing=request.param)
    port = PortHandler(chain.device)
    assert port.openPort() and port.setBaudRate(1_000_000)
    yield port, Protocol2PacketHandler(), chain
    port.closePort()


def test_ping_and_broadcast_ping(bench, again):
    port, sdk, _ = bench
    assert again(lambda: sdk.ping(port, 2), lambda a: a[1] == COMM_SUCCESS) == (1200, COMM_SUCCESS, 0)
    found = again(lambda: sdk.broadcastPing(port), lambda a: len(a[0]) == 3, tries=3)
    assert found[0] == {i: [1200, 53] for i in IDS}


def test_sync_write_and_all_sync_reads(bench, again):
    port, sdk, _ = bench
    for servo in IDS:
        assert again(lambda i=servo: sdk.write1ByteTxRx(port, i, 64, 1), lambda a: a == NO_ERROR)
    write, read = GroupSyncWrite(port, sdk, 116, 4), GroupSyncRead(port, sdk, 132, 4)
    for servo in IDS:
        assert write.addParam(servo, list((2100 + servo).to_bytes(4, "little"))) and read.addParam(servo)
    assert write.txPacket() == COMM_SUCCESS

    def positions():
        return [read.getData(i, 132, 4) for i in IDS]

    wanted = [2101, 2102, 2103]
    again(read.txRxPacket, lambda result: result == COMM_SUCCESS and positions() == wanted)
    again(read.fastSyncRead, lambda result: result == COMM_SUCCESS and positions() == wanted)


def test_registered_write_action_clear_reboot_and_factory_reset(bench, again):
    port, sdk, _ = bench
    again(lambda: sdk.regWriteTxRx(port, 1, 65, 1, [1]), lambda a: a == NO_ERROR)
    assert again(lambda: sdk.read1ByteTxRx(port, 1, 65), lambda a: a[1] == COMM_SUCCESS) == (0, COMM_SUCCESS, 0)
    sdk.action(port, BROADCAST_ID)  # to one id it would be answered, and the SDK does not read that answer
    assert again(lambda: sdk.read1ByteTxRx(port, 1, 65), lambda a: a[1] == COMM_SUCCESS)[0] == 1
    again(lambda: sdk.clearMultiTurn(port, 1), lambda a: a == NO_ERROR)
    sdk.reboot(port, 1)
    again(lambda: sdk.read1ByteTxRx(port, 1, 65), lambda a: a == (0, COMM_SUCCESS, 0))
    again(lambda: sdk.write1ByteTxRx(port, 1, 9, 7), lambda a: a == NO_ERROR)
    sdk.factoryReset(port, 1, 0x02)
    again(lambda: sdk.read1ByteTxRx(port, 1, 9), lambda a: a == (250, COMM_SUCCESS, 0))
