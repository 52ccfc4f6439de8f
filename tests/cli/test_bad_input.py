"""Bad input is one line on stderr that names file, key, value and choices; the exit code says which kind it is."""

import shlex
import socket

import pytest
import soundfile

from sfms_robot.data import data_dir
from sfms_robot.emulator.launch import EmulatedServo, launch

HEAD = data_dir("configs") / "heads" / "face28" / "head.yaml"
LISTENER = data_dir("configs") / "listeners" / "sfms-small"
FAST = "run --fast --duration 0.2 --head interbotix_wxxms"
LIVE = "run --head none --audio none --duration 4 --output "
READS = "--face live-link:0.0.0.0:1234,flip=yaw"
TABLE = "evaluate tokenizer --table"
MINE = "mine"
BITS = [f"--weight-bits {bits}" for bits in (0, 4, 12, -8)]

# Command, exit code, parts of the line; `{name}` is a place of the fixture `places`.
CASES = [
    ("run --audio nowhere.wav", 2, ["nowhere.wav", "no such file", "none"]),
    ("run --audio {tmp}/empty.wav", 2, ["empty.wav"]),
    ("run --audio {tmp}/text.wav", 2, ["text.wav"]),
    ("run --head face99", 2, ["head 'face99'", "face28"]),
    ("run --head {tmp}/unknown_servo", 2, ["'xl999'", "xl330-m288"]),
    ("run --listener psychic", 2, ["listener 'psychic'", "sfms-small"]),
    ("run --fast --duration 1 --listener {tmp}/corrupt", 5, ["model.safetensors"]),
    ("run --duration 1 --listener {tmp}/truncated", 5, ["model.safetensors"]),  # in the process of the listener
    ("run --port /dev/ttyNowhere --duration 1", 3, ["/dev/ttyNowhere", "no such device"]),
    ("run --port socket://nohost", 3, ["--port socket://nohost", "socket://HOST:PORT"]),
    ("run --port main=ftp://host:1", 3, ["--port ftp://host:1", "/dev/ttyUSB0", "socket://HOST:PORT"]),
    ("run --status http", 2, ["--status http: expected a TCP port"]),
    (f"run --status {'1' * 5000}", 2, ["expected a TCP port"]),
    (FAST + " --status {taken}", 3, ["--status: TCP port {taken} on 127.0.0.1: is used by another", "0: any free one"]),
    (f"run --view {'1' * 5000}", 2, ["--view"]),
    ("run --duration 1 --fast --view", 2, ["--view auto: a page shows what takes real time"]),
    ("run --duration 1 --dry-run --view 9000", 2, ["--view 9000: nothing moves in a --dry-run"]),
    ("run --duration 1 --view nowhere", 2, ["--view nowhere: not a TCP port"]),
    ("run --duration 1 --view-cert a.pem", 2, ["no page is served"]),
    ("run --duration 1 --view --view-cert a.pem", 2, ["https needs both"]),
    ("run --duration 1 --fast --audio browser", 2, ["a page shows what takes real time"]),
    (f"run --face webcam:{'1' * 200} --duration 1", 2, ["expected a whole number of up to 20 digits"]),
    ("run --record {tmp}/run --record-format xml", 2, ["--record-format: expected one of json, ros2, got 'xml'"]),
    (FAST + " --record-format ros2", 2, ["--record-format ros2: nothing is recorded (--record DIR)"]),
    (FAST + " --face ros2:a.b", 2, ["--face ros2: expected a topic such as /audio"]),
    ("run --face {tmp}/face.csv", 2, ["face.csv", "jawOpen"]),
    ("run --addressed perhaps", 2, ["--addressed: addressed = 'perhaps'", "'sense', 'assume' or 'never'"]),
    ("run --calmness addressed=1", 2, ["--calmness addressed", "nod, shake"]),
    ("run --fast --audio none", 2, ["never ends"]),
    (FAST + " --port {device}", 2, ["emulated servos"]),
    (FAST + " --audio mic:2", 2, ["--audio mic:2: what a microphone hears takes real time, so --fast is not possible"]),
    (FAST + " --without tail", 2, ["--without: expected a joint of head 'interbotix_wxxms', got 'tail'"]),
    (FAST + " --agent-audio nowhere.wav", 2, ["nowhere.wav", "no such file", "none", "katie"]),
    (FAST + " --agent-audio {tmp}/text.wav", 2, ["text.wav"]),
    (FAST + " --agent-audio {tmp}/empty.wav", 2, ["empty.wav"]),
    (FAST + " --agent-audio {tmp}", 2, ["is a folder, not a sound file"]),
    (FAST + " --agent-audio loopback", 2, ["loopback", "no such file"]),
    (LIVE + "vcm", 2, ["--output vcm: expected KIND or KIND:ADDRESS (valid: json, vmc, vmc-single"]),
    (LIVE + "vmc:1:2:3", 2, ["--output vmc:1:2:3: expected HOST:PORT, HOST or :PORT (IPv6 in brackets), got"]),
    (LIVE + "vmc --output vmc:39539", 2, ["--output vmc:39539: 127.0.0.1:39539 gets vmc already"]),
    (LIVE + "vmc --fast", 2, ["--output vmc: what is shown elsewhere takes real time"]),
    (LIVE + "vmc --face vmc", 2, ["--output vmc:127.0.0.1:39539: --face vmc reads what is sent there"]),
    (LIVE + "live-link:localhost:1234 " + READS, 2, [f"--output live-link:localhost:1234: {READS} reads what is"]),
    (LIVE + "json:{taken}", 3, ["--output json: TCP port {taken} on 127.0.0.1: is used"]),
    ("run --listener 'zenoh/a b'", 2, ["expected a name of letters"]),
    ("run --listener zenoh/x --fast", 2, ["another machine takes real time"]),
    ("run --fleet listen --duration 1", 2, ["that name is taken"]),
    ("run --listener zenoh/x --zenoh nowhere.json5", 2, ["nowhere.json5: no such file"]),
    ("serve --listener psychic", 2, ["listener 'psychic'"]),
    ("serve --metrics high", 2, ["--metrics high: not a TCP port"]),
    ("run --play", 2, ["nothing to play of --agent-audio none", "tcp", "katie"]),
    ("run --play USB --agent-audio none", 2, ["nothing to play of --agent-audio none"]),
    ("run --fast --duration 1 --agent-audio katie --play", 2, ["--play default", "--fast is not possible"]),
    (FAST + " --halt-on {tmp}/none/halt", 2, ["--halt-on {tmp}/none/halt", "no such folder"]),
    (FAST + " --halt-on {tmp}/file", 2, ["--halt-on {tmp}/file", "exists already"]),
    (FAST + " --halt-on /dev/gpiochip999:4", 2, ["--halt-on /dev/gpiochip999:4", "No such file or directory"]),
    *((f"run {option} {'x' * 300}", 2, ["x" * 300]) for option in ("--audio", "--face", "--head", "--listener")),
    ("run --fast --duration long", 2, ["--duration"]),
    (f"run --fast --seed {2**64}", 2, ["--seed"]),
    ("replay {tmp}", 2, ["{tmp}"]),
    *(
        ("replay {tmp} " + f"{option} {{tmp}}/{file}", 2, [option, file, why])
        for option in ("--plot", "--sheet")
        for file, why in (("x.jpg", "FILE.png"), ("folder.png", "is a folder"), ("none/x.png", "no folder"))
    ),
    ("head calibrate face28 --port /dev/nowhere", 3, ["/dev/nowhere: no such device"]),
    ("head calibrate face28 --port sim --joint chin", 2, ["--joint = 'chin' is not a joint of this"]),
    ("head calibrate face29 --port sim", 2, ["'face29' is neither a shipped name nor a folder"]),
    ("head show face28", 2, ["face28.yaml: head = 'op3_head' is another head (face28)"]),  # its overlay is of another
    ("bench startup --write {tmp}/folder.png", 2, ["--write", "{tmp}/folder.png"]),  # before any work, as the next two
    ("export sfms-small --out {tmp}/file", 2, ["--out", "{tmp}/file"]),
    *((f"export sfms-small --out {{tmp}}/w {bits}", 2, [f"{bits}: must be 8, 16 or 32"]) for bits in BITS),
    ("servo dump --port sim {tmp}/file", 2, ["{tmp}/file", "exists already"]),
    ("servo restore {tmp}/file --port sim", 2, ["{tmp}/file: expected keys with values"]),
    ("data compose --data {tmp} --out {tmp}/file", 2, ["--out"]),
    ("servo maps --check {tmp}/folder.png", 2, ["no firmware map"]),
    ("servo scan --port /dev/null --baud 5", 2, ["--baud 5", "57600"]),
    ("doctor --port /dev/null --baud 5", 2, ["--baud 5", "57600"]),
    ("servo scan --port sim --head face24_maestro", 2, ["--head face24_maestro", "Maestro"]),
    ("servo ping 1 --port {tmp}", 3, ["directory"]),
    ("servo ping 9-1 {line}", 2, ["list of ids"]),
    ("servo read 9 led {line}", 4, ["no answer from id 9"]),
    ("servo write 1 return_delay_time 0 {line}", 2, ["--yes"]),
    ("servo write 1 goal_position -5 {line}", 4, ["goal_position := -5", "limit"]),  # a value, and no option
    ("servo set-id 1 2 --yes {line}", 2, ["taken"]),
    ("emulate --servo xl330-m288:1 --fault dorp:1", 2, ["emulate: fault = 'dorp:1' has no such kind as 'dorp' (drop,"]),
    *(
        (command.format(number), 2, ["111"])
        for command in (
            "emulate --servo xl330-m288:{}",
            "emulate --servo xl330-m288:1 --start 1={}",
            "servo write --port sim 1 goal_position {}",
            "servo move --port sim 1 --to {}",
            "servo read --port sim {} all",
        )
        for number in ("1" * 21, "1" * 5000)
    ),
    (TABLE + " 5", 2, ["--table '5' is not one of 3, 4, 3-placements, 4-codes, all"]),
    (TABLE + " 3 --train", 2, ["--train needs --models DIR"]),
    (TABLE + " 4 --data {tmp}/folder.png --models {tmp}/m", 2, ["no face tracks (*.csv, *.csv.gz) below it"]),
    ("evaluate tokenizer", 2, ["--data is needed without --table"]),
    (f"{TABLE} 3 --split validation", 2, ["--split validation: dyads have parts"]),
    *((f"fleet {each} halt", 2, [f"fleet halt {each[:6]}"]) for each in ("--zenoh file.json5", "--json", "--insecure")),
]


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A folder with files that cannot be used, a port that is taken, and a line with the servos 1 and 2."""
    tmp = tmp_path_factory.mktemp("bad")
    (tmp / "folder.png").mkdir()
    (tmp / "file").write_text(MINE)
    (tmp / "text.wav").write_text("hello")
    soundfile.write(tmp / "empty.wav", [], 16_000)
    (tmp / "face.csv").write_text("time_s,temperature\n0,1\n0.04,2\n")
    weights = (LISTENER / "model.safetensors").read_bytes()
    for name, content in (("corrupt", b"not weights"), ("truncated", weights[: len(weights) // 2])):
        (tmp / name).mkdir()
        (tmp / name / "config.yaml").write_bytes((LISTENER / "config.yaml").read_bytes())
        (tmp / name / "model.safetensors").write_bytes(content)
    (tmp / "unknown_servo").mkdir()
    (tmp / "unknown_servo" / "head.yaml").write_text(HEAD.read_text().replace("xl330-m288", "xl999"))
    overlays = tmp / "config" / "sfms-robot" / "heads"
    overlays.mkdir(parents=True)
    (overlays / "face28.yaml").write_text("head: op3_head\n")
    with socket.create_server(("127.0.0.1", 0)) as taken, launch([EmulatedServo(1), EmulatedServo(2)]) as chain:
        line = f"--port {chain.device} --baud 1000000"
        yield {"tmp": str(tmp), "taken": taken.getsockname()[1], "device": chain.device, "line": line}


@pytest.mark.parametrize(("words", "code", "parts"), CASES, ids=[words[:60] for words, _, _ in CASES])
def test_bad_input_is_one_line_and_an_exit_code(command_line, monkeypatch, places, words, code, parts):
    if words == "head show face28":
        monkeypatch.setenv("XDG_CONFIG_HOME", f"{places['tmp']}/config")
    if words.startswith("serve") or "nowhere.json5" in words:
        pytest.importorskip("zenoh", reason="needs the extra [remote]")
    ended = command_line(*shlex.split(words.format_map(places)), "--json")
    said = ended.err if ended.err.startswith("Usage") else ended.complaint
    assert ended.err.startswith("Usage") or ended.told["exit_code"] == code
    assert ended.code == code, said
    assert [part for part in parts if part.format_map(places) not in said] == [], said
    with open(f"{places['tmp']}/file") as kept:
        assert kept.read() == MINE
