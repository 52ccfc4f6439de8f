import json
import os
import signal
import subprocess
import sys

import pytest
import serial

from sfms_robot.servo.codecs import dxl2


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGINT])
def test_emulator_serves_until_it_is_told_to_stop_and_leaves_nothing_behind(tmp_path, ending):
    link = tmp_path / "servos"
    command = [sys.executable, "-c", "from sfms_robot.cli.main import main; main()", "emulate"]
    arguments = ["--servo", "xl330-m288:1-3", "--link", str(link)]
    with subprocess.Popen([*command, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline().strip() == str(link)
        with serial.Serial(str(link), 1_000_000, timeout=10) as port:
            port.write(dxl2.encode_instruction(2, dxl2.PING))
            assert dxl2.maybe_packet(bytearray(port.read(14))).servo == 2
        process.send_signal(ending)
        _, told = process.communicate(timeout=30)
    assert process.returncode == 0 and "Traceback" not in told
    assert not os.path.lexists(link)


def test_bad_fault_is_one_line_and_code_2(command_line):
    ended = command_line("emulate", "--servo", "xl330-m288:1", "--fault", "dorp:1")
    assert ended.code == 2
    assert ended.complaint.startswith(
        "sfms-robot: emulate: fault = 'dorp:1' has no such kind as 'dorp' (drop, delay, corrupt"
    )


def test_json_is_one_object_with_devices_and_servos_and_it_serves_on():
    command = [sys.executable, "-c", "from sfms_robot.cli.main import main; main()", "emulate", "--json"]
    servos = ["--servo", "xl330-m288:1-2,ax-12a:20"]
    with subprocess.Popen([*command, *servos], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        told = json.loads(process.stdout.readline())
        [wire] = told["buses"].values()
        assert [(s["id"], s["model"]) for s in wire["servos"]] == [
            (1, "xl330-m288"), (2, "xl330-m288"), (20, "ax-12a"),
        ]  # fmt: skip
        with serial.Serial(wire["device"], 1_000_000, timeout=10) as port:
            port.write(bytes.fromhex("ff ff 14 02 01 e8"))  # ping, protocol 1
            assert port.read(6) == bytes.fromhex("ff ff 14 02 00 e9")
        process.terminate()
        rest, error = process.communicate(timeout=30)
    assert process.returncode == 0 and rest == "" and error == ""
