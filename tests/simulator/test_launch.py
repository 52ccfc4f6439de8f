import os
import subprocess
import sys
from pathlib import Path

import pytest
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PortHandler, Protocol2PacketHandler

from sfms_robot.errors import BusError, ConfigError
from sfms_robot.simulator.launch import EmulatedServo, launch


def test_vendor_sdk_works_unchanged():
    """In real time, with the SDK's own port: its set-up, its packets, its waiting."""
    with launch([EmulatedServo(i, start_ticks=2000 + i) for i in (1, 2, 3)]) as chain:
        port, sdk = PortHandler(chain.device), Protocol2PacketHandler()
        assert port.openPort() and port.setBaudRate(1_000_000)
        assert sdk.ping(port, 2) == (1200, 0, 0)
        read = GroupSyncRead(port, sdk, 132, 4)
        goals = GroupSyncWrite(port, sdk, 116, 4)
        for servo in (1, 2, 3):
            assert sdk.write4ByteTxRx(port, servo, 116, 2000 + servo) == (0, 0)
            assert sdk.write1ByteTxRx(port, servo, 64, 1) == (0, 0)
            read.addParam(servo)
            goals.addParam(servo, [0xD0 + servo, 0x07, 0, 0])  # 2000 + servo: where it stands
        assert goals.txPacket() == 0
        assert read.txRxPacket() == 0
        assert [read.getData(servo, 132, 4) for servo in (1, 2, 3)] == [2001, 2002, 2003]
        assert read.fastSyncRead() == 0
        assert [read.getData(servo, 132, 4) for servo in (1, 2, 3)] == [2001, 2002, 2003]
        assert sdk.write1ByteTxRx(port, 1, 9, 0) == (0, 7)  # EEPROM under torque
        port.closePort()


def test_process_ends_and_leaves_nothing_behind():
    with launch([EmulatedServo(1)]) as chain:
        folder = Path(chain.control).parent
        assert folder.is_dir()
    chain.close()
    assert not folder.exists()
    with pytest.raises(BusError, match="is gone"):
        chain.digest()


def test_process_ends_with_its_parent():
    parent = (
        "import os; from sfms_robot.simulator.launch import *;"
        "chain = launch([EmulatedServo(1)]); print(chain.pid, chain.control, flush=True); os._exit(0)"
    )
    # The chain inherits stderr: its end of file tells that the process is gone, without waiting a fixed time.
    done = subprocess.run([sys.executable, "-c", parent], capture_output=True, text=True, timeout=60)
    pid, control = done.stdout.split()
    assert done.returncode == 0 and done.stderr == ""
    assert not os.path.exists(control) and int(pid) > 0


def test_emulator_needs_no_heavy_library():
    code = "import sys, sfms_robot.simulator.serve, sfms_robot.simulator.chain; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split()
    assert "sfms_robot.simulator.chain" in loaded
    assert not {"torch", "scipy", "numpy", "pydantic", "yaml"} & {*loaded}


@pytest.mark.parametrize(
    ("servos", "message"),
    [
        ([EmulatedServo(1), EmulatedServo(1)], "id = 1 is used twice"),
        ([EmulatedServo(253)], "id = 253 is not a servo id"),
        ([EmulatedServo(1, baud=12345)], r"baud = 12345 is no rate of xl330-m288 \(9600, 57600"),
        ([EmulatedServo(1, model="xl999")], "'xl999' has no firmware map"),
    ],
)
def test_impossible_chain_is_refused(servos, message):
    with pytest.raises(ConfigError, match=message):
        launch(servos)


def test_request_that_the_emulator_does_not_know_is_refused():
    with launch([EmulatedServo(1)]) as chain, pytest.raises(BusError, match="no such servo"):
        chain.kill(9)
