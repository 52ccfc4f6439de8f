"""Every kind of bad input is one line on stderr that names file, key, value and choices; the exit code says which."""

import socket
from pathlib import Path

import pytest
import soundfile
import yaml

from sfms_robot.cli.main import main
from sfms_robot.data import data_dir

HEAD = data_dir("configs") / "heads" / "face28" / "head.yaml"
LISTENER = data_dir("configs") / "listeners" / "sfms-small"


@pytest.fixture
def fails(capsys):
    """Run a command line that must fail; gives exit code and the one line on stderr."""

    def run(*arguments: object) -> tuple[object, str]:
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        told = capsys.readouterr().err.strip()
        assert len(told.splitlines()) == 1, told
        return ended.value.code, told

    return run


def changed_head(folder: Path, change) -> Path:
    head = yaml.safe_load(HEAD.read_text())
    change(head)
    (folder / "head.yaml").write_text(yaml.safe_dump(head))
    return folder


def listener(folder: Path, weights: bytes) -> Path:
    (folder / "config.yaml").write_bytes((LISTENER / "config.yaml").read_bytes())
    (folder / "model.safetensors").write_bytes(weights)
    return folder


def test_a_missing_sound_file(fails):
    code, told = fails("run", "--audio", "nowhere.wav")
    assert code == 2 and "nowhere.wav" in told and "no such file" in told and "none" in told


def test_a_seed_that_is_too_large():
    with pytest.raises(SystemExit) as ended:
        main(["run", "--fast", "--duration", "0.2", "--seed", str(2**64)])
    assert ended.value.code == 2


@pytest.mark.parametrize("option", ["--plot", "--sheet"])
def test_a_picture_that_cannot_be_one(fails, tmp_path, option):
    (tmp_path / "folder.png").mkdir()
    for file, why in (("x.jpg", "FILE.png"), ("folder.png", "is a folder"), ("none/x.png", "no folder")):
        code, told = fails("replay", tmp_path, option, tmp_path / file)
        assert code == 2 and option in told and file in told and why in told


@pytest.mark.parametrize("option", ["--audio", "--face", "--head", "--listener"])
def test_a_name_that_no_file_can_have(fails, option):
    code, told = fails("run", option, "x" * 300)
    assert code == 2 and "x" * 300 in told


def test_a_folder_without_maps_is_not_sound(fails, tmp_path):
    code, told = fails("servo", "maps", "--check", tmp_path)
    assert code == 2 and "no firmware map" in told


def test_dyads_into_a_file(fails, tmp_path):
    (tmp_path / "file").write_text("mine")
    code, told = fails("data", "compose", "--data", tmp_path, "--out", tmp_path / "file")
    assert code == 2 and "--out" in told and (tmp_path / "file").read_text() == "mine"


def test_an_empty_sound_file(fails, tmp_path):
    soundfile.write(tmp_path / "empty.wav", [], 16_000)
    code, told = fails("run", "--audio", tmp_path / "empty.wav")
    assert code == 2 and "empty.wav" in told


def test_a_text_that_calls_itself_sound(fails, tmp_path):
    (tmp_path / "text.wav").write_text("hello")
    code, told = fails("run", "--audio", tmp_path / "text.wav")
    assert code == 2 and "text.wav" in told


def test_a_face_track_without_a_known_column(fails, tmp_path):
    (tmp_path / "face.csv").write_text("time_s,temperature\n0,1\n0.04,2\n")
    code, told = fails("run", "--face", tmp_path / "face.csv")
    assert code == 2 and "face.csv" in told and "jawOpen" in told


def test_an_unknown_head_and_an_unknown_listener(fails):
    code, told = fails("run", "--head", "face99")
    assert code == 2 and "head 'face99'" in told and "face28" in told
    code, told = fails("run", "--listener", "psychic")
    assert code == 2 and "listener 'psychic'" in told and "sfms-small" in told


def test_a_joint_given_twice(fails, tmp_path):
    (tmp_path / "head.yaml").write_text(HEAD.read_text().replace("  jaw: {id", "  neck_yaw: {id"))
    code, told = fails("run", "--head", tmp_path)
    assert code == 2 and "head.yaml:" in told and "'neck_yaw' is given twice" in told


def test_limits_reversed(fails, tmp_path):
    folder = changed_head(tmp_path, lambda head: head["joints"]["jaw"].update(min_deg=40))
    code, told = fails("run", "--head", folder)
    assert code == 2 and "joints.jaw" in told and "min_deg 40" in told and "limits reversed" in told


def test_an_id_used_twice(fails, tmp_path):
    folder = changed_head(tmp_path, lambda head: head["joints"]["jaw"].update(id=1))
    code, told = fails("run", "--head", folder)
    assert code == 2 and "joints.jaw.id = 1" in told and "eye_pan_left" in told


def test_an_unknown_channel(fails, tmp_path):
    folder = changed_head(tmp_path, lambda head: head["joints"]["jaw"].update(drive="jawOpne"))
    code, told = fails("run", "--head", folder)
    assert code == 2 and "joints.jaw" in told and "'jawOpne'" in told and "jawOpen" in told


def test_an_unknown_servo_model(fails, tmp_path):
    folder = changed_head(tmp_path, lambda head: head["joints"]["jaw"].update(model="xl999"))
    code, told = fails("run", "--head", folder)
    assert code == 2 and "'xl999'" in told and "xl330-m288" in told


def test_corrupt_weights(fails, tmp_path):
    code, told = fails("run", "--fast", "--duration", 1, "--listener", listener(tmp_path, b"not weights"))
    assert code == 5 and "model.safetensors" in told


def test_truncated_weights_in_the_listener_process(fails, tmp_path):
    whole = (LISTENER / "model.safetensors").read_bytes()
    code, told = fails("run", "--duration", 1, "--listener", listener(tmp_path, whole[: len(whole) // 2]))
    assert code == 5 and "model.safetensors" in told


def test_a_port_that_is_not_there(fails):
    code, told = fails("run", "--port", "/dev/ttyNowhere", "--duration", 1)
    assert code == 3 and "/dev/ttyNowhere" in told and "no such device" in told


def test_a_folder_without_a_recording(fails, tmp_path):
    code, told = fails("replay", tmp_path)
    assert code == 2 and str(tmp_path) in told


def test_a_flag_of_the_wrong_kind(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["run", "--duration", "long"])
    assert ended.value.code == 2 and "--duration" in capsys.readouterr().err


def test_a_status_port_that_is_in_use(fails):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, told = fails("run", "--fast", "--duration", "0.2", "--head", "interbotix_wxxms", "--status", port)
    assert code == 3 and f"--status {port}: Address already in use" in told and "0 for a free one" in told


def test_a_halt_switch_that_cannot_be_one(fails, tmp_path):
    (tmp_path / "there").touch()
    for where, why in (
        (tmp_path / "none" / "halt", "no such folder"),
        (tmp_path / "there", "is there already"),
        ("/dev/gpiochip999:4", "No such file or directory"),
    ):
        code, told = fails("run", "--fast", "--duration", "0.2", "--head", "interbotix_wxxms", "--halt-on", where)
        assert code == 2 and f"--halt-on {where}" in told and why in told


@pytest.mark.parametrize("words", [["--play"], ["--play", "USB", "--agent-audio", "none"]])
def test_a_robot_that_says_nothing_is_not_played(fails, words):
    code, told = fails("run", *words)
    assert code == 2 and "nothing is played of --agent-audio none" in told and "tcp" in told and "katie" in told


def test_what_is_heard_takes_real_time(fails):
    code, told = fails("run", "--fast", "--duration", "1", "--agent-audio", "katie", "--play")
    assert code == 2 and "--play default" in told and "--fast has none" in told


def test_a_status_port_that_is_none(fails):
    code, told = fails("run", "--status", "http")
    assert code == 2 and "--status http: is no TCP port" in told
