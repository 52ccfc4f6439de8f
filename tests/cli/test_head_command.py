"""`head calibrate`, `head pose` and `head show` as they are typed; the one who types is a file of lines."""

import io
import json

import pytest

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.config.overlay import overlay_file
from sfms_robot.emulator.launch import launch


@pytest.fixture
def run(command_line, monkeypatch, tmp_path):
    """Run `sfms-robot ARGUMENTS` with lines to type; (exit code, stdout, stderr)."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))

    def command(*words: str, typed: str = ""):
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        return command_line(*words)

    return command


def test_calibrate_leads_through_a_joint_and_says_what_it_wrote(run):
    typed = "k\n5\n\n10\n\n-5\n\nn\n"
    code, out, _ = run("head", "calibrate", "face28", "--port", "sim", "--joint", "jaw", "--json", typed=typed)
    told = json.loads(out.splitlines()[-1])
    assert (code, told["exit"], told["measured"], told["problems"]) == (0, "done", ["jaw"], [])
    assert told["file"] == str(overlay_file("face28", practice=True)) and len(told["missing"]) == 27
    assert "LOWER end" in out and "UPPER end" in out and "REST" in out


def test_a_line_that_breaks_off_is_an_interruption(run):
    code, out, _ = run("head", "calibrate", "face28", "--port", "sim", "--joint", "jaw", typed="k\n5\n")
    assert code == 130 and "measured: none" in out and "to calibrate first (until then 20 % of the travel, 0.3 of the speed): eye" in out


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
def test_calibrate_ends_with_4_when_torque_is_not_confirmed_off(command_line, monkeypatch, tmp_path, last):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    device = tmp_path / "servos"
    with launch(emulated(load_head("interbotix_wxxms"))["main"], link=str(device)) as chain:
        monkeypatch.setattr("sys.stdin", Typist(chain, f"k\n5\n\n5\n\n\n{last}\n"))
        words = ("head", "calibrate", "interbotix_wxxms", "--port", device, "--joint", "pan", "--json")
        ended = command_line(*words)
        assert chain.state(1)["torque"]
    assert (ended.code, ended.told["torque_unconfirmed"]) == (4, ["pan"])
    assert ended.err.splitlines()[-1].startswith("sfms-robot: torque of pan could not be confirmed off")


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["calibrate", "face28", "--port", "/dev/nowhere"], 3, "/dev/nowhere: no such device"),
        (["calibrate", "face28", "--port", "sim", "--joint", "chin"], 2, "--joint = 'chin' is not a joint of this"),
        (["calibrate", "face29", "--port", "sim"], 2, "'face29' is neither a shipped name nor a folder"),
    ],
)
def test_what_is_wrong_is_one_line_with_its_exit_code(run, words, code, message):
    ended, _, err = run("head", *words)
    assert ended == code and message in err and "Traceback" not in err


def test_pose_tells_which_joints_moved_and_what_cannot_be_shown(run):
    code, out, _ = run("head", "pose", "op3_head", "yaw=0.3", "jawOpen=1", "--hold", "0.2", "--fast", "--json")
    told = json.loads(out.splitlines()[-1])
    assert code == 0 and told["blind"] == ["jawOpen"] and len(told["joints"]) == 1


def test_show_warns_of_an_overlay_that_does_not_fit(run):
    file = overlay_file("face28")
    file.parent.mkdir(parents=True)
    file.write_text("head: op3_head\n")
    code, _, err = run("head", "show", "face28")
    assert code == 2 and f"{file}: head = 'op3_head' is another head (face28)" in err
