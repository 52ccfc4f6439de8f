import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PortHandler, Protocol2PacketHandler

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch, wait
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.servo.chain.protocol1_link import Protocol1Link
from sfms_robot.servo.port import VirtualTimePort
from sfms_robot.servo.registers import Table


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
        "import os; from sfms_robot.emulator.launch import *;"
        "chain = launch([EmulatedServo(1)]); print(chain.pid, chain.control, flush=True); os._exit(0)"
    )
    # The chain inherits stderr: its end of file tells that the process is gone, without waiting a fixed time.
    done = subprocess.run([sys.executable, "-c", parent], capture_output=True, text=True, timeout=60)
    pid, control = done.stdout.split()
    assert done.returncode == 0 and done.stderr == ""
    assert not os.path.exists(control) and int(pid) > 0


def test_emulator_needs_no_heavy_library():
    code = "import sys, sfms_robot.emulator.chain_process, sfms_robot.emulator.dynamixel2_chain; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split()
    assert "sfms_robot.emulator.dynamixel2_chain" in loaded
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


@pytest.mark.parametrize(
    ("model", "name", "value"),
    [("ax-12a", "return_delay_time", 7), ("mx-28-1.0", "ccw_angle_limit", 3000), ("sts3215", "homing_offset", -30),
     ("scs0009", "max_position_limit", 900)],
)  # fmt: skip
def test_what_somebody_stored_is_there_in_the_older_families_too(model, name, value):
    table = Table.of(load_firmware_map(model))
    servo = EmulatedServo(1, model, start_ticks=table.center_ticks, registers={name: value}, supply_v=20.0)
    with launch([servo], virtual=True) as chain:
        port = VirtualTimePort(chain.device, chain.control, servo.baud, VirtualClock())
        link = Protocol1Link(port, servo.baud, 0.003, table.family)
        answer = link.read(1, table[name].address, table[name].size)
        link.port.close()
        assert table[name].from_bytes(answer.data) == value
        assert "voltage" in table.status_fault_names(answer.error)
        assert round(chain.state(1)["position"]) == table.center_ticks


def test_link_of_an_emulator_that_was_killed_is_taken_away(tmp_path):
    link = tmp_path / "servos"
    with launch([EmulatedServo(1)], link=str(link)) as chain:
        os.kill(chain.pid, signal.SIGKILL)
        assert wait([chain]) is chain
    assert not link.is_symlink()
