import json
import os
import signal
import subprocess

import pytest
import serial
from ended import PROGRAM

from sfms_robot.servo.codecs import dxl2


@pytest.mark.parametrize(("ending", "more"), [(signal.SIGTERM, []), (signal.SIGINT, ["--json"])])
def test_an_emulator_serves_until_a_signal_ends_it_and_leaves_nothing_behind(tmp_path, ending, more):
    link = tmp_path / "servos"
    words = ["emulate", "--servo", "xl330-m288:1-2,ax-12a:20", "--link", str(link), *more]
    with subprocess.Popen([*PROGRAM, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        line = process.stdout.readline().strip()
        with serial.Serial(str(link), 1_000_000, timeout=10) as port:
            port.write(dxl2.encode_instruction(2, dxl2.PING))
            assert dxl2.maybe_packet(bytearray(port.read(14))).servo == 2
            port.write(bytes.fromhex("ff ff 14 02 01 e8"))  # ping, protocol 1
            assert port.read(6) == bytes.fromhex("ff ff 14 02 00 e9")
        process.send_signal(ending)
        rest, error = process.communicate(timeout=30)
    assert process.returncode == 0 and "Traceback" not in error and not os.path.lexists(link)
    assert (line, rest) == (str(link), "") or more
    if more:
        (bus,) = json.loads(line)["buses"].values()
        models = {each["id"]: each["model"] for each in bus["servos"]}
        assert (rest, error, models) == ("", "", {1: "xl330-m288", 2: "xl330-m288", 20: "ax-12a"})
