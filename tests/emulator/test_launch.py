import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch, wait
from sfms_robot.errors import BusError
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.servo.chain.protocol1_link import Protocol1Link
from sfms_robot.servo.port import VirtualTimePort
from sfms_robot.servo.registers import Table


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
    code = "import sys, sfms_robot.emulator.chain_process, sfms_robot.emulator.servo_chains; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.split()
    assert "sfms_robot.emulator.servo_chains" in loaded
    assert not {"torch", "scipy", "numpy", "pydantic", "yaml"} & {*loaded}


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
