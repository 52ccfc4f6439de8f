"""Every kind of bad input is one line on stderr that names file, key, value and choices; the exit code says which."""

import socket
from pathlib import Path

import pytest
import soundfile

from sfms_robot.data import data_dir

HEAD = data_dir("configs") / "heads" / "face28" / "head.yaml"
LISTENER = data_dir("configs") / "listeners" / "sfms-small"


@pytest.fixture
def fails(command_line):
    """Run a command line that must fail; gives exit code and the one line on stderr."""

    def run(*words: object) -> tuple[int, str]:
        ended = command_line(*words)
        return ended.code, ended.complaint

    return run


def listener(folder: Path, weights: bytes) -> Path:
    (folder / "config.yaml").write_bytes((LISTENER / "config.yaml").read_bytes())
    (folder / "model.safetensors").write_bytes(weights)
    return folder


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (["--audio", "nowhere.wav"], 2, ["nowhere.wav", "no such file", "none"]),
        (["--head", "face99"], 2, ["head 'face99'", "face28"]),
        (["--listener", "psychic"], 2, ["listener 'psychic'", "sfms-small"]),
        (["--port", "/dev/ttyNowhere", "--duration", 1], 3, ["/dev/ttyNowhere", "no such device"]),
        (["--port", "socket://nohost"], 3, ["--port socket://nohost", "socket://HOST:PORT"]),
        (["--port", "main=ftp://host:1"], 3, ["--port ftp://host:1", "/dev/ttyUSB0", "socket://HOST:PORT"]),
        (["--status", "1" * 5000], 2, ["expected a TCP port"]),
        (["--view", "1" * 5000], 2, ["--view"]),
        (["--face", "webcam:" + "1" * 200, "--duration", 1], 2, ["expected a whole number of up to 20 digits"]),
        (["--addressed", "perhaps"], 2, ["--addressed perhaps", "sense, assume, never"]),
        (["--calmness", "addressed=1"], 2, ["--calmness addressed", "nod, shake"]),
        *(([option, "x" * 300], 2, ["x" * 300]) for option in ("--audio", "--face", "--head", "--listener")),
    ],
)
def test_what_is_not_there(fails, words, code, said):
    ended, told = fails("run", *words)
    assert ended == code and all(part in told for part in said)


@pytest.mark.parametrize(("option", "value"), [("--duration", "long"), ("--seed", 2**64)])
def test_a_flag_of_the_wrong_kind_or_size(command_line, option, value):
    ended = command_line("run", "--fast", option, value)
    assert ended.code == 2 and option in ended.err


@pytest.mark.parametrize("digits", [21, 400, 5000])
@pytest.mark.parametrize(
    "words",
    [
        ("emulate", "--servo", "xl330-m288:{}"),
        ("emulate", "--servo", "xl330-m288:1", "--start", "1={}"),
        ("servo", "write", "--port", "sim", "1", "goal_position", "{}"),
        ("servo", "move", "--port", "sim", "1", "--to", "{}"),
        ("servo", "read", "--port", "sim", "{}", "all"),
    ],
    ids=lambda words: " ".join(words[:2]),
)
def test_a_number_that_is_too_long_is_one_line(fails, words, digits):
    code, told = fails(*(word.format("1" * digits) for word in words))
    assert code == 2 and "111" in told


@pytest.mark.parametrize("option", ["--plot", "--sheet"])
def test_a_picture_that_cannot_be_one(fails, tmp_path, option):
    (tmp_path / "folder.png").mkdir()
    for file, why in (("x.jpg", "FILE.png"), ("folder.png", "is a folder"), ("none/x.png", "no folder")):
        code, told = fails("replay", tmp_path, option, tmp_path / file)
        assert code == 2 and option in told and file in told and why in told


def test_a_folder_without_maps_is_not_sound(fails, tmp_path):
    code, told = fails("servo", "maps", "--check", tmp_path)
    assert code == 2 and "no firmware map" in told


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("bench", "startup", "--write"), "--write"),
        (("export", "sfms-small", "--out"), "--out"),
        (("servo", "dump", "--port", "sim"), "is there already"),
    ],
    ids=lambda words: words[0],
)
def test_what_cannot_be_written_is_told_before_the_work(fails, tmp_path, words, said):
    (tmp_path / "there").mkdir()
    (tmp_path / "file").write_text("mine")
    where = tmp_path / ("there" if words[0] == "bench" else "file")
    code, told = fails(*words, where)
    assert code == 2 and said in told and str(where) in told and (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("words", [("servo", "scan"), ("doctor",)])
def test_a_rate_that_no_servo_has_is_not_looked_at_for_minutes(fails, words):
    code, told = fails(*words, "--port", "/dev/null", "--baud", 5)
    assert code == 2 and "--baud 5" in told and "57600" in told


def test_a_board_has_no_servos_to_look_at(fails):
    code, told = fails("servo", "scan", "--port", "sim", "--head", "face24_maestro")
    assert code == 2 and "--head face24_maestro" in told and "Maestro" in told


def test_a_file_that_holds_no_keys(fails, tmp_path):
    (tmp_path / "text.yaml").write_text("hello")
    code, told = fails("servo", "restore", tmp_path / "text.yaml", "--port", "sim")
    assert code == 2 and "text.yaml: is no mapping" in told


def test_dyads_into_a_file(fails, tmp_path):
    (tmp_path / "file").write_text("mine")
    code, told = fails("data", "compose", "--data", tmp_path, "--out", tmp_path / "file")
    assert code == 2 and "--out" in told and (tmp_path / "file").read_text() == "mine"


def test_sound_files_that_are_empty_or_none(fails, tmp_path):
    soundfile.write(tmp_path / "empty.wav", [], 16_000)
    (tmp_path / "text.wav").write_text("hello")
    for file in ("empty.wav", "text.wav"):
        code, told = fails("run", "--audio", tmp_path / file)
        assert code == 2 and file in told


def test_a_face_track_without_a_known_column(fails, tmp_path):
    (tmp_path / "face.csv").write_text("time_s,temperature\n0,1\n0.04,2\n")
    code, told = fails("run", "--face", tmp_path / "face.csv")
    assert code == 2 and "face.csv" in told and "jawOpen" in told


def test_a_servo_that_nobody_knows(fails, tmp_path):
    (tmp_path / "head.yaml").write_text(HEAD.read_text().replace("model: xl330-m288", "model: xl999"))
    code, told = fails("run", "--head", tmp_path)
    assert code == 2 and "'xl999'" in told and "xl330-m288" in told


def test_corrupt_weights(fails, tmp_path):
    code, told = fails("run", "--fast", "--duration", 1, "--listener", listener(tmp_path, b"not weights"))
    assert code == 5 and "model.safetensors" in told


def test_truncated_weights_in_the_listener_process(fails, tmp_path):
    whole = (LISTENER / "model.safetensors").read_bytes()
    code, told = fails("run", "--duration", 1, "--listener", listener(tmp_path, whole[: len(whole) // 2]))
    assert code == 5 and "model.safetensors" in told


def test_a_folder_without_a_recording(fails, tmp_path):
    code, told = fails("replay", tmp_path)
    assert code == 2 and str(tmp_path) in told


def test_a_status_port_that_is_in_use(fails):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, told = fails("run", "--fast", "--duration", "0.2", "--head", "interbotix_wxxms", "--status", port)
    said = f"--status: TCP port {port} on 127.0.0.1: is used by another program"
    assert code == 3 and said in told and "0: any free one" in told


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
    assert code == 2 and "--status http: expected a TCP port" in told
