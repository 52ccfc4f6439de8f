"""`head calibrate` and `head pose` as they are typed; a file of lines takes the place of a person at a keyboard."""

import io

import pytest

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.config.overlay import overlay_file
from sfms_robot.emulator.launch import launch


@pytest.fixture
def calibrate(command_line, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))

    def run(head, joint, lines, port="sim", more=()):
        monkeypatch.setattr("sys.stdin", lines)
        return command_line("head", "calibrate", head, "--port", port, "--joint", joint, *more)

    return run


def test_calibrate_leads_through_a_joint_and_says_what_it_wrote(calibrate):
    ended = calibrate("face28", "jaw", io.StringIO("k\n5\n\n10\n\n-5\n\nn\n"), more=["--json"])
    told = ended.told
    assert (ended.code, told["exit"], told["measured"], told["problems"]) == (0, "done", ["jaw"], [])
    assert told["file"] == str(overlay_file("face28", practice=True)) and len(told["missing"]) == 27
    assert "LOWER end" in ended.out and "UPPER end" in ended.out and "REST" in ended.out


def test_a_line_that_breaks_off_is_an_interruption(calibrate):
    ended = calibrate("face28", "jaw", io.StringIO("k\n5\n"))
    assert ended.code == 130 and "measured: none" in ended.out
    assert "to calibrate first (until then 20 % of the travel, 0.3 of the speed): eye" in ended.out


class Typist(io.StringIO):
    """Lines that are typed; before the last one the cable of the servo comes off."""

    def __init__(self, chain, lines):
        super().__init__(lines)
        self.chain, self.left = chain, lines.count("\n")

    def readline(self, *size):
        self.left -= 1
        if self.left == 0:
            self.chain.kill(1)
        return super().readline(*size)


@pytest.mark.parametrize("last", ["n", "q"])
def test_calibrate_ends_with_4_when_torque_is_not_confirmed_off(calibrate, last):
    with launch(emulated(load_head("interbotix_wxxms"))["main"]) as chain:
        lines = Typist(chain, f"k\n5\n\n5\n\n\n{last}\n")
        ended = calibrate("interbotix_wxxms", "pan", lines, chain.device, ["--json"])
        assert chain.state(1)["torque"]
    assert (ended.code, ended.told["torque_unconfirmed"]) == (4, ["pan"])
    assert ended.err.splitlines()[-1].startswith("sfms-robot: torque of pan could not be confirmed off")


def test_pose_names_the_joints_that_moved_and_the_channels_that_cannot_be_shown(command_line):
    words = ("head", "pose", "op3_head", "yaw=0.3", "jawOpen=1", "--hold", "0.2", "--fast", "--json")
    ended = command_line(*words)
    assert ended.code == 0 and ended.told["blind"] == ["jawOpen"] and len(ended.told["joints"]) == 1
