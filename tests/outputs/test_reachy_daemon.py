"""Reachy Mini's own daemon, without a robot, as the peer of both outputs.

The program is REACHY_MINI_DAEMON in the environment, or that of .venv-reachy, which .ci/run makes. It shows a target at
once, so that what it reports can be compared with what was sent.
"""

import json
import os
import subprocess
import sys
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from free_ports import free_tcp_port
from motion_rows import motion
from websockets.sync.client import connect

from sfms_robot.errors import OutputError
from sfms_robot.outputs.reachy_mini import ReachyMini, ReachyMiniOverlay, antennas, in_reach, matrix
from sfms_robot.outputs.sender import OutputSender
from sfms_robot.ports import OutputFrame

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

PROGRAM = os.environ.get("REACHY_MINI_DAEMON", Path(__file__).parents[2] / ".venv-reachy/bin/reachy-mini-daemon")
OPTIONS = ["--mockup-sim", "--headless", "--no-media", "--no-preload-datasets", "--fastapi-port"]
START_S = 120.0


class Daemon:
    """The daemon on a port of its own. Its folder holds an app that only waits."""

    def __init__(self, folder):
        self.port = free_tcp_port()
        self.address, self._folder, self._process = f"127.0.0.1:{self.port}", folder, None
        (folder / "radio.py").write_text("import signal\nsignal.pause()\n")
        about = folder / "radio-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Metadata-Version: 2.1\nName: radio\nVersion: 1.0\n")
        (about / "entry_points.txt").write_text("[reachy_mini_apps]\nradio = radio:Radio\n")

    def start(self):
        quiet = {"REACHY_MINI_TELEMETRY": "0", "HF_HUB_OFFLINE": "1", "HOME": str(self._folder)}
        command = [PROGRAM, *OPTIONS, str(self.port)]
        environment = os.environ | quiet | {"PYTHONPATH": str(self._folder)}
        with open(self._folder / "log", "ab") as log:
            self._process = subprocess.Popen(
                command, cwd=self._folder, env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL
            )
        until_s = time.monotonic() + START_S
        while (self.page("/api/daemon/status") or {}).get("state") != "running":
            assert self._process.poll() is None and time.monotonic() < until_s, (self._folder / "log").read_text()
            threading.Event().wait(0.2)

    def kill(self):
        self._process.kill()
        self._process.wait()

    def page(self, path, method="GET"):
        """Return what the daemon answers over HTTP; None as long as it does not."""
        request = urllib.request.Request(f"http://{self.address}{path}", method=method)
        try:
            with urllib.request.urlopen(request, timeout=60) as answer:
                return json.load(answer)
        except OSError:
            return None

    def reported(self):
        """Return pose (4, 4), body yaw and antennas (2,) that the daemon reports now."""
        found = {}
        with connect(f"ws://{self.address}/ws/sdk") as client:
            while not {"head_pose", "joint_positions"} <= set(found):
                message = json.loads(client.recv(timeout=60))
                found[message["type"]] = message
        pose, joints = found["head_pose"]["head_pose"], found["joint_positions"]
        return np.array(pose), joints["head_joint_positions"][0], joints["antennas_joint_positions"]


@pytest.fixture(scope="module")
def daemon(tmp_path_factory):
    if not Path(PROGRAM).exists():
        pytest.skip(f"needs Reachy Mini's daemon, {PROGRAM}: see .ci/run")
    daemon = Daemon(tmp_path_factory.mktemp("daemon"))
    daemon.start()
    yield daemon
    daemon.kill()


def drive(sender, seconds, face, state="listening"):
    """Step a sender 50 times a second. `face`: motion (58,) by time."""
    began_s, pause = time.monotonic(), threading.Event()
    while (now_s := time.monotonic()) < began_s + seconds:
        sender.step(OutputFrame(time_s=now_s, motion=face(now_s - began_s), state=state), now_s)
        pause.wait(max(0.0, now_s + 0.02 - time.monotonic()))


def finish(sender):
    """Ease a sender to neutral and close its output."""
    while not sender.settled:
        sender.step(OutputFrame(time_s=0.0, motion=motion(), state="stopping"), time.monotonic(), ending=True)
        threading.Event().wait(0.02)
    sender.output.close()


def test_what_is_sent_is_reported_and_a_halt_holds_it(daemon):
    sender = OutputSender(ReachyMini(daemon.address))
    drive(sender, 7.0, lambda t: motion(pitch=0.15 * np.sin(4 * t), yaw=0.5 * np.sin(t), roll=0.1 * np.sin(2 * t)))
    figures = sender.statistics()
    assert figures["losses"] == 0 and figures["pitch_correlation"] >= 0.99 and figures["lag_ms"] <= 120, figures

    held = motion(roll=0.1, pitch=-0.2, yaw=1.5, z=0.005, browInnerUp=0.5, browOuterUpRight=0.5)
    drive(sender, 4.0, lambda t: held)
    pose, body_rad, antennas_rad = daemon.reported()
    assert pose == pytest.approx(matrix(in_reach(held[:6].astype(float))), abs=2e-3)
    assert body_rad == pytest.approx(1.5 - np.radians(40), abs=2e-3)
    assert antennas_rad == pytest.approx(antennas(held), abs=1e-3)

    drive(sender, 0.5, lambda t: motion(), state="halted")
    stopped = daemon.reported()[0]
    drive(sender, 1.0, lambda t: motion(pitch=0.3), state="halted")
    assert daemon.reported()[0] == pytest.approx(stopped, abs=1e-6) and stopped == pytest.approx(pose, abs=0.05)
    drive(sender, 1.5, lambda t: motion())
    finish(sender)
    assert daemon.reported()[0] == pytest.approx(np.eye(4), abs=5e-3)


def test_a_run_reports_how_the_robot_follows(daemon, command_line):
    output = f"reachy-mini:{daemon.address}"
    done = command_line("run", "--head", "none", "--output", output, "--audio", "katie", "--duration", "10", "--json")
    (figures,) = done.told["outputs"]
    sys.stdout.write(f"pitch: correlation {figures['pitch_correlation']}, lag {figures['lag_ms']} ms\n")
    assert done.code == 0 and figures["pitch_correlation"] >= 0.99 and figures["lag_ms"] <= 60, figures


def test_a_move_of_another_program_is_noticed_and_the_robot_eases_in_again(daemon):
    sender, away = OutputSender(ReachyMini(daemon.address)), matrix(np.array([0, 0, 0.8, 0, 0, 0]))
    drive(sender, 2.5, lambda t: motion())
    with connect(f"ws://{daemon.address}/ws/sdk") as other:
        other.send(json.dumps({"type": "goto_target", "head": away.ravel().tolist(), "duration": 3.0}))
        until_s = time.monotonic() + 30.0
        while not sender.lost:
            assert time.monotonic() < until_s, sender.statistics()
            drive(sender, 0.1, lambda t: motion(yaw=-0.3))
        assert sender.statistics()["problem"].startswith(("does not follow", "did not go to neutral"))
    followed = 0
    while followed < 10:  # two seconds: while the other move goes on it is lost again
        assert time.monotonic() < until_s, sender.statistics()
        drive(sender, 0.2, lambda t: motion(yaw=-0.3))
        followed = 0 if sender.lost else followed + 1
    assert daemon.reported()[0] == pytest.approx(matrix(np.array([0, 0, -0.3, 0, 0, 0])), abs=5e-3)
    finish(sender)


def test_an_app_that_drives_the_robot_stays_in_charge_and_an_overlay_is_added(daemon):
    assert daemon.page("/api/apps/start-app/radio", "POST") is not None
    with pytest.raises(OutputError, match="app radio drives it: stop the app, or use reachy-mini-overlay"):
        ReachyMini(daemon.address).open()
    by_app, nod = matrix(np.array([0, 0, 0.4, 0, 0, 0])), matrix(np.array([0, 0.2, 0, 0, 0, 0]))
    with connect(f"ws://{daemon.address}/ws/sdk") as app:
        app.send(json.dumps({"type": "set_full_target", "head": by_app.ravel().tolist()}))
        sender = OutputSender(ReachyMiniOverlay(daemon.address))
        drive(sender, 2.0, lambda t: motion(pitch=0.2))
        assert daemon.reported()[0] == pytest.approx(nod @ by_app, abs=2e-3)
        finish(sender)
        assert daemon.reported()[0] == pytest.approx(by_app, abs=2e-3)
    daemon.page("/api/apps/stop-current-app", "POST")
