"""No command contacts another computer or looks a name up: every group of commands under a watcher.

There are two watchers. `strace` sees every socket of every process, those of native libraries too; not every system
allows it. The other is a hook inside every Python process, in a network namespace that has only loopback where the
system grants one: it sees the calls of Python, and a library that tries something else reaches nothing. Tests show that
both see a stranger.
"""

import ipaddress
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from ended import PROGRAM
from tiny_sfms_training import configuration, write_dyads

ROOT = Path(__file__).parents[1]
HEAD = "interbotix_wxxms"
LIMIT_S = 240.0
CALLS = "connect,bind,sendto,sendmsg,sendmmsg"
NAMES_PORT = 53  # also on loopback: a question there looks a name up

HOOK = """
import json, os, socket, sys

def look(event, arguments):
    if event in ("socket.connect", "socket.bind", "socket.sendto", "socket.sendmsg"):
        if arguments[0].family in (socket.AF_INET, socket.AF_INET6) and arguments[1] is not None:
            note(event, arguments[1][0], arguments[1][1])
    elif event in ("socket.getaddrinfo", "socket.gethostbyname", "socket.gethostbyaddr"):
        note(event, arguments[0], 0)

def note(call, host, port):
    with open(os.environ["ADDRESSES"], "a") as file:
        file.write(json.dumps([call, str(host), int(port or 0)]) + "\\n")

note("started", "127.0.0.1", 0)
sys.addaudithook(look)
"""
# Loopback up, then the command: a new namespace has it down.
LOOPBACK_UP = """
import fcntl, os, socket, struct, sys
with socket.socket() as any_socket:
    fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh14x", b"lo", 0x41))
os.execvp(sys.argv[1], sys.argv[1:])
"""
ALONE = ["unshare", "-n", sys.executable, "-S", "-c", LOOPBACK_UP]


def works(*words):
    return (
        shutil.which(words[0]) is not None and subprocess.run(words, capture_output=True, check=False).returncode == 0
    )


class Strace:
    """The watcher outside the processes."""

    def __init__(self, folder):
        self.file = folder / "strace.txt"
        trace = ["strace", "--seccomp-bpf", "-f", "-qq", "-s", "0", "-e", f"trace={CALLS}", "-e", "signal=none"]
        self.command = [*trace, "-A", "-o", str(self.file)]
        self.environment = {}

    @staticmethod
    def usable():
        return works("strace", "--seccomp-bpf", "-f", "-qq", "-e", f"trace={CALLS}", "-o", os.devnull, "true")

    def addressed(self):
        """Return (call, host, port) of every internet address that was used."""
        return [
            (call, host, int(port))
            for line in self.file.read_text().splitlines()
            for call, port, host in re.findall(
                r"(\w+)\(.*sin6?_port=htons\((\d+)\),.*?(?:inet_addr\(|inet_pton\(AF_INET6, )\"([^\"]+)\"", line
            )
        ]


class Hook:
    """The watcher inside the Python processes."""

    def __init__(self, folder):
        (folder / "sitecustomize.py").write_text(HOOK)
        self.file = folder / "addresses.txt"
        self.command = ALONE if works(*ALONE, "true") else []
        self.environment = {"PYTHONPATH": str(folder), "ADDRESSES": str(self.file)}

    @staticmethod
    def usable():
        return True

    def addressed(self):
        return [tuple(json.loads(line)) for line in self.file.read_text().splitlines()]


WATCHERS = [Strace, Hook]


class Watched:
    """Commands under a watcher, each in the same empty folder."""

    def __init__(self, watcher, folder):
        self.watcher, self.folder = watcher, folder
        paths = [watcher.environment.get("PYTHONPATH"), str(ROOT), *sys.path]
        homes = {name: str(folder / name) for name in ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")}
        self.environment = {**os.environ, **homes, **watcher.environment}
        self.environment["PYTHONPATH"] = os.pathsep.join(filter(None, paths))

    def start(self, *words, program=None):
        command = [*self.watcher.command, *(program or PROGRAM), *map(str, words)]
        return subprocess.Popen(
            command, cwd=self.folder, env=self.environment, text=True, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip

    def run(self, *words, codes=(0,), program=None):
        """Run a command to its end; its exit code must be one of `codes`. Return stdout."""
        with self.start(*words, program=program) as running:
            out, err = running.communicate(timeout=LIMIT_S)
        assert running.returncode in codes, (words, running.returncode, err)
        return out

    def strangers(self):
        """Return the calls that left loopback or looked a name up."""
        return [each for each in self.watcher.addressed() if is_stranger(*each)]


def is_stranger(call, host, port):
    if port == NAMES_PORT:
        return True
    if host in ("", "None", "localhost") and call != "bind":
        return False
    try:
        return not ipaddress.ip_address(host).is_loopback
    except ValueError:
        return True  # a name


@pytest.fixture(params=WATCHERS, ids=lambda watcher: watcher.__name__.lower())
def watched(request, tmp_path):
    """Commands under each watcher, for quick tests."""
    if not request.param.usable():
        pytest.skip("strace may not be used here")
    return Watched(request.param(tmp_path), tmp_path)


@pytest.fixture
def best(tmp_path):
    """Commands under the watcher that sees most."""
    return Watched((Strace if Strace.usable() else Hook)(tmp_path), tmp_path)


def python(code):
    return [sys.executable, "-c", code]


@pytest.mark.parametrize(
    ("code", "seen"),
    [
        ("import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).connect(('192.0.2.1', 9))", "192.0.2.1"),
        ("import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).bind(('0.0.0.0', 0))", "0.0.0.0"),
        ("import socket; socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).connect(('2001:db8::1', 9))", "2001:db8::1"),
    ],
)
def test_a_watcher_sees_a_stranger(watched, code, seen):
    watched.run(program=python(code), codes=(0, 1))
    assert seen in [host for _, host, _ in watched.strangers()]


def test_a_watcher_sees_into_children(watched):
    inner = "import socket; socket.socket(socket.AF_INET, socket.SOCK_DGRAM).connect(('127.0.0.1', 9))"
    watched.run(
        program=python(f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}], check=True)")
    )
    assert ("127.0.0.1", 9) in [(host, port) for _, host, port in watched.watcher.addressed()]
    assert watched.strangers() == []


def test_a_name_that_is_looked_up_is_a_stranger(watched):
    watched.run("servo", "scan", "--port", "socket://robot.invalid:1", codes=(3,))
    assert watched.strangers() or Path("/etc/resolv.conf").read_text().find("nameserver") < 0


LOOK_UPS = [
    ["--help"], ["head", "list"], ["head", "check", HEAD], ["head", "show", HEAD], ["listener", "list"],
    ["speaker", "list"], ["port", "list"], ["servo", "maps"], ["bench", "--help"],
]  # fmt: skip


@pytest.mark.parametrize("words", LOOK_UPS, ids=" ".join)
def test_commands_that_look_something_up_address_nobody(best, words):
    best.run(*words)
    assert best.strangers() == []


@pytest.mark.slow
def test_commands_that_listen_and_move_stay_here(best):
    with socket.create_server(("127.0.0.1", 0)) as found:
        port = found.getsockname()[1]
    best.run(
        "run", "--head", HEAD, "--duration", "2", "--record", "kept", "--status", "0", "--agent-audio", f"tcp:{port}"
    )
    best.run("run", "--head", HEAD, "--duration", "2", "--view", "0")
    best.run("run", "--head", HEAD, "--fast", "--duration", "1", "--listener", "arig-small", "--agent-audio", "katie")
    best.run("demo", "--head", HEAD, "--fast", "--duration", "2", "--out", "shown")
    best.run("replay", "kept", "--json")
    assert best.strangers() == []


@pytest.mark.slow
def test_commands_that_speak_to_servos_stay_here(best):
    device = best.folder / "servos"
    (best.folder / "poses.csv").write_text("x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad\n0,0,0,0,0.1,0\n")
    with best.start("emulate", "--head", HEAD, "--link", device) as emulator:
        while not device.is_symlink():
            assert emulator.poll() is None, emulator.communicate()
        line = ["--port", device, "--baud", "1000000"]
        best.run("servo", "scan", "--ids", "1-2", *line)
        best.run("servo", "ping", "1-2", *line)
        best.run("servo", "read", "1", "all", *line)
        best.run("servo", "dump", "dump.yaml", "--ids", "1", *line)
        best.run("doctor", "--head", HEAD, "--port", device)
        best.run("run", "--head", HEAD, "--port", device, "--dry-run")
        best.run("head", "solve", "reachy_mini", "--poses", "poses.csv")
        os.killpg(emulator.pid, signal.SIGTERM)
        emulator.communicate(timeout=LIMIT_S)
    assert best.strangers() == []


@pytest.mark.slow
def test_commands_that_learn_and_measure_stay_here(best):
    write_dyads(best.folder / "data")
    (best.folder / "tiny.yaml").write_text(yaml.safe_dump(configuration(steps=1), sort_keys=False))
    best.run("data", "check", "data")
    flags = ["--config", "tiny.yaml", "--data", "data", "--out", "out", "--device", "cpu"]
    best.run("train", "tokenizer", *flags, "--tensorboard")
    best.run("train", "listener", *flags, "--no-tensorboard")
    best.run("evaluate", "tokenizer", "--listener", "out", "--data", "data")
    best.run("bench", "retarget", "--frames", "50")
    assert best.strangers() == []


@pytest.mark.slow
def test_a_listener_that_is_served_and_a_fleet_stay_here(best):
    pytest.importorskip("zenoh")
    pytest.importorskip("prometheus_client")
    with best.start("serve", "--hop", "3", "--everybody", "--metrics", "0") as server:
        while "up to" not in (line := server.stderr.readline()):
            assert line, server.communicate()
        best.run("run", "--head", HEAD, "--listener", "zenoh/sfms-small", "--fleet", "one", "--duration", "2")
        best.run("fleet", "--json")
        best.run("fleet", "halt", codes=(1,))  # no head is left
        os.killpg(server.pid, signal.SIGTERM)
        server.communicate(timeout=LIMIT_S)
    assert best.strangers() == []


@pytest.mark.slow
def test_a_webcam_stays_here(best):
    """MediaPipe's later releases contact their maker; those that are asked for do not."""
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("mediapipe")
    video = cv2.VideoWriter(str(best.folder / "grey.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 25, (320, 240))
    for _ in range(50):
        video.write(np.full((240, 320, 3), 128, np.uint8))
    video.release()
    best.run("run", "--head", HEAD, "--audio", "none", "--face", "webcam:grey.avi", "--duration", "2")
    assert best.strangers() == []
