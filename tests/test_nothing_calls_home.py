"""No command contacts another computer or looks a name up: every group of commands under `strace`.

It sees every socket of every process, those of native libraries too. The first tests show that it sees a stranger.
"""

import ipaddress
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from ended import PROGRAM
from free_ports import free_tcp_port
from tiny_sfms_training import configuration, write_dyads

ROOT = Path(__file__).parents[1]
HEAD = "interbotix_wxxms"
LIMIT_S = 240.0
STRACE = ["strace", "--seccomp-bpf", "-f", "-qq", "-s", "0", "-e", "signal=none"]
CALLS = ["-e", "trace=connect,bind,sendto,sendmsg,sendmmsg"]
ADDRESS = r"sin6?_port=htons\((\d+)\),.*?(?:inet_addr\(|inet_pton\(AF_INET6, )\"([^\"]+)\""
NAMES_PORT = 53  # also on loopback: a question there looks a name up
SOCKET = "import socket; socket.socket(socket.{}, socket.SOCK_DGRAM)"


class Watched:
    """Commands under strace, each in the same empty folder."""

    def __init__(self, folder):
        self.folder, self.trace = folder, folder / "strace.txt"
        homes = {name: str(folder / name) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")}
        self.environment = {**os.environ, **homes, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)])}

    def start(self, *words, program=PROGRAM):
        return subprocess.Popen(
            [*STRACE, *CALLS, "-A", "-o", self.trace, *program, *map(str, words)],
            cwd=self.folder, env=self.environment, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip

    def run(self, *words, codes=(0,), program=PROGRAM):
        """Run a command to its end; its exit code must be one of `codes`. Return stdout."""
        with self.start(*words, program=program) as running:
            out, err = running.communicate(timeout=LIMIT_S)
        assert running.returncode in codes, (words, running.returncode, err)
        return out

    def addressed(self):
        """Return (host, port) of every internet address that was used."""
        return [(host, int(port)) for port, host in re.findall(ADDRESS, self.trace.read_text())]

    def strangers(self):
        """Return the addresses beyond loopback, and those at which names are looked up."""
        return [at for at in self.addressed() if at[1] == NAMES_PORT or not ipaddress.ip_address(at[0]).is_loopback]


@pytest.fixture
def watched(tmp_path):
    if shutil.which("strace") is None:
        pytest.skip("needs strace")
    if subprocess.run([*STRACE, *CALLS, "-o", os.devnull, "true"], capture_output=True, check=False).returncode:
        pytest.skip("strace is not permitted here")
    return Watched(tmp_path)


@pytest.mark.parametrize(
    ("family", "call", "seen"),
    [
        ("AF_INET", "connect(('192.0.2.1', 9))", "192.0.2.1"),
        ("AF_INET", "bind(('0.0.0.0', 0))", "0.0.0.0"),
        ("AF_INET6", "connect(('2001:db8::1', 9))", "2001:db8::1"),
    ],
)
def test_strace_sees_a_stranger(watched, family, call, seen):
    watched.run(program=[sys.executable, "-c", f"{SOCKET.format(family)}.{call}"], codes=(0, 1))
    assert seen in [host for host, _ in watched.strangers()]


def test_strace_sees_into_children_and_loopback_is_no_stranger(watched):
    inner = f"{SOCKET.format('AF_INET')}.connect(('127.0.0.1', 9))"
    outer = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}], check=True)"
    watched.run(program=[sys.executable, "-c", outer])
    assert ("127.0.0.1", 9) in watched.addressed() and watched.strangers() == []


def test_a_name_that_is_looked_up_is_a_stranger(watched):
    watched.run("servo", "scan", "--port", "socket://robot.invalid:1", codes=(3,))
    assert watched.strangers() or Path("/etc/resolv.conf").read_text().find("nameserver") < 0


LOOK_UPS = [
    ["--help"], ["head", "list"], ["head", "check", HEAD], ["head", "show", HEAD], ["listener", "list"],
    ["speaker", "list"], ["port", "list"], ["servo", "maps"], ["bench", "--help"],
]  # fmt: skip


EACH = """
from sfms_robot.cli.main import main
for words in {}:
    try: main(words)
    except SystemExit as ended: assert not ended.code, words
"""


def test_commands_that_look_something_up_address_nobody(watched):
    watched.run(program=[sys.executable, "-P", "-c", EACH.format(LOOK_UPS)])
    assert watched.strangers() == []


@pytest.mark.slow
def test_commands_that_listen_and_move_stay_here(watched):
    agent = f"tcp:{free_tcp_port()}"
    watched.run("run", "--head", HEAD, "--duration", "2", "--record", "kept", "--status", "0", "--agent-audio", agent)
    watched.run("run", "--head", HEAD, "--duration", "2", "--view", "0")
    watched.run(*f"run --head {HEAD} --fast --duration 1 --listener arig-small --agent-audio katie".split())
    watched.run("demo", "--head", HEAD, "--fast", "--duration", "2", "--out", "shown")
    watched.run("replay", "kept", "--json")
    assert watched.strangers() == []


@pytest.mark.slow
def test_commands_that_speak_to_servos_stay_here(watched):
    device = watched.folder / "servos"
    (watched.folder / "poses.csv").write_text("x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad\n0,0,0,0,0.1,0\n")
    with watched.start("emulate", "--head", HEAD, "--link", device) as emulator:
        while not device.is_symlink():
            assert emulator.poll() is None, emulator.communicate()
        line = ["--port", device, "--baud", "1000000"]
        watched.run("servo", "scan", "--ids", "1-2", *line)
        watched.run("servo", "ping", "1-2", *line)
        watched.run("servo", "read", "1", "all", *line)
        watched.run("servo", "dump", "dump.yaml", "--ids", "1", *line)
        watched.run("doctor", "--head", HEAD, "--port", device)
        watched.run("run", "--head", HEAD, "--port", device, "--dry-run")
        watched.run("head", "solve", "reachy_mini", "--poses", "poses.csv")
        os.killpg(emulator.pid, signal.SIGTERM)
        emulator.communicate(timeout=LIMIT_S)
    assert watched.strangers() == []


@pytest.mark.slow
def test_commands_that_learn_and_measure_stay_here(watched):
    write_dyads(watched.folder / "data")
    (watched.folder / "tiny.yaml").write_text(yaml.safe_dump(configuration(steps=1), sort_keys=False))
    watched.run("data", "check", "data")
    flags = ["--config", "tiny.yaml", "--data", "data", "--out", "out", "--device", "cpu"]
    watched.run("train", "tokenizer", *flags, "--tensorboard")
    watched.run("train", "listener", *flags, "--no-tensorboard")
    watched.run("evaluate", "tokenizer", "--listener", "out", "--data", "data", "--split", "validation")
    watched.run("bench", "retarget")
    assert watched.strangers() == []


@pytest.mark.slow
def test_a_listener_that_is_served_is_heard_and_a_fleet_stays_here(watched):
    pytest.importorskip("zenoh")
    pytest.importorskip("prometheus_client")
    with watched.start("serve", "--hop", "3", "--everybody", "--metrics", "0", "--json") as server:
        while "up to" not in (line := server.stderr.readline()):
            assert line, server.communicate()
        run = f"run --head {HEAD} --listener zenoh/sfms-small --fleet one --duration 4 --json"
        report = json.loads(watched.run(*run.split()).splitlines()[-1])
        assert report["listener_state"]["link"]["round_trip_ms"]["p50"] is not None
        watched.run("fleet", "--json")
        watched.run("fleet", "halt", codes=(1,))  # no head is left
        os.killpg(server.pid, signal.SIGTERM)
        assert json.loads(server.communicate(timeout=LIMIT_S)[0].splitlines()[-1])["plans"] > 0
    assert watched.strangers() == []


@pytest.mark.slow
def test_the_tools_of_an_assistant_stay_here(watched):
    pytest.importorskip("mcp")
    watched.run("mcp")  # until stdin ends
    assert watched.strangers() == []


@pytest.mark.slow
def test_a_webcam_stays_here(watched):
    """MediaPipe's later releases contact their maker; those that are asked for do not."""
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("mediapipe")
    video = cv2.VideoWriter(str(watched.folder / "grey.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (320, 240))
    for _ in range(50):
        video.write(np.full((240, 320, 3), 128, np.uint8))
    video.release()
    watched.run("run", "--head", HEAD, "--audio", "none", "--face", "webcam:grey.avi", "--duration", "2")
    assert watched.strangers() == []
