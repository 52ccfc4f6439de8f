"""Outputs over WebSockets, against servers that answer as their peers' documentation says, and against bad ones."""

import json
import socket
import stat
import threading
import time
from collections import deque
from contextlib import suppress
from http import HTTPStatus
from itertools import count

import numpy as np
import pytest
from free_ports import free_tcp_port
from motion_rows import motion
from websockets.exceptions import ConnectionClosed
from websockets.server import ServerProtocol
from websockets.sync.server import serve

from sfms_robot import load_head
from sfms_robot.errors import OutputError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, CHANNELS, MOTION_DIM
from sfms_robot.outputs import websocket_peer
from sfms_robot.outputs.furhat import Furhat, params_of
from sfms_robot.outputs.reachy_mini import ReachyMini, ReachyMiniOverlay, antennas, body_yaw, following, in_reach
from sfms_robot.outputs.sender import MotionShaper
from sfms_robot.outputs.vtube_studio import VtubeStudio, VtubeStudioAdd, inputs_of
from sfms_robot.ports import OutputFrame
from sfms_robot.retarget.head_retargeter import HeadRetargeter

MOVERS = [ReachyMini, ReachyMiniOverlay, Furhat]
AWAKE = {"type": "daemon_status", "state": "running", "version": "1.13.0"}
AWAKE |= {"backend_status": {"motor_control_mode": "enabled"}}
HOME = {"type": "head_pose", "head_pose": np.eye(4).tolist()}


def frame_of(**channels):
    return OutputFrame(time_s=0.0, motion=motion(**channels), state="listening")


class Fake:
    """A WebSocket server on loopback. `answer` returns the answers to a message; `pages`: of its HTTP side, by path."""

    def __init__(self, answer=lambda message: (), pages=()):
        self.messages = deque()
        self.arrived = threading.Condition()
        self._answer, self._pages = answer, dict(pages)
        self._server = serve(self._talk, "127.0.0.1", 0, process_request=self._page, close_timeout=0.1)
        self.address = "{}:{}".format(*self._server.socket.getsockname())
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._server.shutdown()

    def take(self, number, kind=None):
        """Return the first `number` messages (of a type), once they are there."""

        def chosen():
            return [each for each in self.messages if kind in (None, each.get("type"), each.get("messageType"))]

        with self.arrived:
            assert self.arrived.wait_for(lambda: len(chosen()) >= number, 10), list(self.messages)
            return chosen()[:number]

    def _page(self, connection, request):
        if request.path in self._pages:
            return connection.respond(HTTPStatus.OK, json.dumps(self._pages[request.path]))
        return None

    def _talk(self, connection):
        for text in connection:
            message = json.loads(text)
            with self.arrived:
                self.messages.append(message)
                self.arrived.notify_all()
            with suppress(ConnectionClosed):  # what was sent before is read all the same
                for each in self._answer(message):
                    connection.send(json.dumps(each))


class Raw:
    """A TCP server that answers the first request with `data`, behind a WebSocket's greeting where it `greets`.

    It closes then; without data it keeps the connection and reads nothing.
    """

    def __init__(self, data=b"", greets=True):
        self._data, self._greets, self._done = data, greets, threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.address = "{}:{}".format(*self._listening.getsockname())

    def __enter__(self):
        threading.Thread(target=self._work, daemon=True).start()
        return self.address

    def __exit__(self, *_):
        self._done.set()
        self._listening.close()

    def _work(self):
        connection, _ = self._listening.accept()
        with connection:
            protocol = ServerProtocol()
            protocol.receive_data(connection.recv(4096))
            if self._greets:
                protocol.send_response(protocol.accept(protocol.events_received()[0]))
            connection.sendall(b"".join(protocol.data_to_send()) + self._data)
            self._done.wait(0 if self._data else None)


def answered(output, frame, now_s=0.0, opens=False, step_s=0.0):
    """Send frames until the output raises; return the error's text. `step_s`: between two, for the output."""
    with pytest.raises(OutputError) as caught:
        if opens:
            output.open()
        for step in count():
            output.send(frame, now_s + step * step_s)
    return str(caught.value)


def test_antennas_and_body_move_as_those_of_the_shipped_head():
    retargeter, rng = HeadRetargeter(load_head("reachy_mini")), np.random.default_rng(0)
    for _ in range(50):
        shown = motion(**dict(zip(CHANNELS[6:], rng.random(52), strict=True)), yaw=rng.uniform(-2.5, 2.5))
        angles = dict(zip(retargeter.joints, retargeter.angles(shown), strict=True))
        assert antennas(shown) == pytest.approx([angles["right_antenna"], angles["left_antenna"]], abs=1e-6)
        assert body_yaw(float(shown[2])) == pytest.approx(angles["body_rotation"], abs=1e-6)


def test_every_pose_that_is_sent_is_within_reach_of_the_legs():
    neck = HeadRetargeter(load_head("reachy_mini")).neck
    wanted = np.random.default_rng(1).uniform(-1, 1, (2000, 6)) * [0.7, 0.7, 0.7, 0.02, 0.02, 0.02]
    assert neck.reachable(np.array([in_reach(pose) for pose in wanted])).all()
    assert in_reach(np.array([0.1, 0.2, 1.0, 0.001, 0, 0])) == pytest.approx([0.1, 0.2, 1.0, 0.001, 0, 0])


def test_a_lag_is_found_in_what_is_reported():
    times_s = np.arange(0, 20, 0.02)
    angle = 0.1 * np.sin(5 * times_s) * np.sin(0.7 * times_s)
    sent = list(zip(times_s, angle, strict=True))
    assert following(sent, list(zip(times_s + 0.048, angle, strict=True))) == {
        "pitch_correlation": pytest.approx(1.0, abs=1e-3),
        "lag_ms": pytest.approx(48, abs=4),
    }
    still = [(time_s, 0.0) for time_s in times_s]
    assert following(still, still) == following([], []) == {"pitch_correlation": None, "lag_ms": None}


def test_furhat_gets_52_shapes_neck_and_gaze_in_degrees():
    shown = motion(browInnerUp=0.5, tongueOut=1, yaw=0.5, pitch=-0.1, eyeLookOutLeft=0.5, eyeLookInRight=0.5)
    params = params_of(shown)
    assert len(params) == len(BLENDSHAPES) + 5
    assert (params["BROW_INNER_UP"], params["TONGUE_OUT"], params["EYE_LOOK_OUT_LEFT"]) == (0.5, 1.0, 0.0)
    assert (params["NECK_PAN"], params["NECK_TILT"]) == (pytest.approx(28.648), pytest.approx(-5.73))
    assert (params["GAZE_PAN"], params["GAZE_TILT"]) == (15.0, 0.0)


def test_vtube_studio_gets_degrees_and_shares_that_are_0_for_a_neutral_face_in_the_mode_add():
    neutral, added = inputs_of(motion()), inputs_of(motion(), added=True)
    assert (neutral["EyeOpenLeft"], neutral["MouthSmile"]) == (1.0, 0.5)
    assert set(added.values()) == {0.0}
    moved = inputs_of(motion(yaw=0.5, pitch=0.1, eyeBlinkLeft=1, mouthSmileLeft=1, mouthSmileRight=1))
    assert (moved["FaceAngleX"], moved["FaceAngleY"]) == (pytest.approx(28.648, abs=1e-3), pytest.approx(-5.73, 1e-3))
    assert (moved["EyeOpenLeft"], moved["EyeOpenRight"], moved["MouthSmile"]) == (0.0, 1.0, 1.0)


@pytest.mark.parametrize("mover", MOVERS)
def test_a_step_is_limited_and_a_halt_holds(mover):
    output = mover("127.0.0.1:1")
    shaper, period_s = MotionShaper(output.limits, output.rate_hz), 1 / output.rate_hz
    far = np.full(MOTION_DIM, 10.0, np.float32)
    shown, rows = shaper.start(0.0), []
    for tick in range(200):
        phase = "live" if tick < 40 else "held" if tick < 150 else "neutral"  # 0.8 s: in the middle of the way
        shown = shaper.step(far, phase, tick * period_s, shown)
        rows.append([shown.motion[CHANNEL_INDEX[name]] for name in output.limits])
    moved = np.array(rows, np.float64)
    low, high, speed, acceleration = np.array(list(output.limits.values())).T
    assert (moved >= low - 1e-6).all() and (moved <= high + 1e-6).all()
    assert (np.abs(np.diff(moved, axis=0)) / period_s <= speed * 1.001 + 1e-3).all()
    assert (np.abs(np.diff(moved, 2, axis=0)) / period_s**2 <= acceleration * 1.01 + 0.1).all()
    assert (moved[80:150] == moved[80]).all() and np.abs(moved[80]).max() > 0.1  # held, and not at neutral


def daemon(status=AWAKE, lock="free", answer=lambda message: (AWAKE, HOME)):
    pages = {"/api/daemon/status": status, "/api/daemon/robot-app-lock-status": {"state": lock, "holder_name": "radio"}}
    return Fake(answer, pages)


@pytest.fixture
def quick(monkeypatch):
    """Make the way to neutral short."""
    monkeypatch.setattr(ReachyMini, "neutral_s", 0.05)
    monkeypatch.setattr(Furhat, "neutral_s", 0.2)


@pytest.mark.usefixtures("quick")
def test_reachy_mini_goes_to_neutral_first():
    with daemon() as fake:
        output = ReachyMini(fake.address)
        output.open()
        output.send(frame_of(pitch=0.1), time.monotonic())
        neutral, target = fake.take(2)
        output.close()
    assert neutral["type"] == "goto_target" and np.array(neutral["head"]).reshape(4, 4) == pytest.approx(np.eye(4))
    assert target["type"] == "set_full_target" and target["head"][8] == pytest.approx(-np.sin(0.1))
    assert target["antennas"] == pytest.approx(np.radians([-10, 10]))


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("fake", "line"),
    [
        (dict(status=AWAKE | {"state": "stopped"}), "its daemon is stopped, not running"),
        (dict(status=AWAKE | {"backend_status": {"motor_control_mode": "disabled"}}), "its motors are disabled"),
        (dict(status=["x"]), "is not Reachy Mini's daemon: /api/daemon/status is not an object"),
        (dict(lock="local_app"), "app radio drives it: stop the app, or use reachy-mini-overlay"),
        (dict(answer=lambda message: ()), "reports no head_pose"),
        (dict(answer=lambda message: [{"type": "head_pose", "head_pose": [1]}]), "reports a head_pose that is not 4x4"),
        (dict(answer=lambda message: [HOME | {"head_pose": (-np.eye(4)).tolist()}]), "did not go to neutral"),
    ],
)
def test_reachy_mini_that_cannot_be_driven_is_one_line(fake, line):
    with daemon(**fake) as peer, pytest.raises(OutputError, match=line):
        ReachyMini(peer.address).open()


@pytest.mark.usefixtures("quick")
def test_a_reachy_mini_that_reports_no_poses_any_more_is_lost():
    with daemon(answer=lambda message: (AWAKE, HOME)[: 1 + (message["type"] == "goto_target")]) as fake:
        output = ReachyMini(fake.address)
        output.open()
        with pytest.raises(OutputError, match="reports no head_pose"):
            output.send(frame_of(), time.monotonic() + websocket_peer.SILENT_S)
        output.close()


def test_an_overlay_runs_beside_an_app_and_ends_at_0():
    with daemon(lock="local_app") as fake:
        output = ReachyMiniOverlay(fake.address)
        output.open()
        output.send(frame_of(pitch=0.1, x=0.01), time.monotonic())
        output.send(frame_of(pitch=0.0005), time.monotonic())
        output.close()
        offsets = [each["offsets"] for each in fake.take(4)]
    assert offsets == [[0] * 6, pytest.approx([0.01, 0, 0, 0, 0.1, 0]), pytest.approx([0, 0, 0, 0, 0.0005, 0]), [0] * 6]


@pytest.mark.parametrize("gone", [True, False])
def test_an_offset_is_eased_away_after_a_break_of_the_network_alone(gone):
    with daemon() as fake:
        output = ReachyMiniOverlay(fake.address)
        output.open()
        output.send(frame_of(yaw=0.2), time.monotonic())
        output.link.closed = gone  # True: the daemon closed the connection, and its offset is gone with it
        output.close()
        fake.take(2)
        output.open()
        output.close()
        yaw = [each["offsets"][5] for each in fake.take(3 if gone else 30)]
    assert max(-np.diff(yaw[1:])) < (0.21 if gone else 0.02)
    assert yaw[2] == pytest.approx(0 if gone else 0.2, abs=1e-3)


@pytest.mark.usefixtures("quick")
def test_furhat_is_taken_over_and_given_back(monkeypatch):
    monkeypatch.setenv("FURHAT_KEY", "secret")
    with Fake(lambda each: [{"type": "response.auth", "access": each.get("key") == "secret"}]) as fake:
        output = Furhat(fake.address)
        output.open()
        output.send(frame_of(jawOpen=0.5), 0.0)
        output.close()
        auth, config, pose, params, back = fake.take(5)
        assert auth == {"type": "request.auth", "key": "secret"}
        assert (config["blinking"], back["blinking"]) == (False, True)
        assert (pose["yaw"], params["params"]["JAW_OPEN"]) == (0, 0.5)
        monkeypatch.setenv("FURHAT_KEY", "wrong")
        with pytest.raises(OutputError, match="refuses access: set FURHAT_KEY"):
            output.open()


class Studio:
    """Answers of VTube Studio."""

    def __init__(self, allows=True, version="1.0", error=None, token="abc"):
        self.allows, self.version, self.error, self.token = allows, version, error, token

    def __call__(self, message):
        kind, data = message["messageType"], message["data"]
        error = self.error if kind == "InjectParameterDataRequest" else None
        answer = {}
        if kind == "AuthenticationTokenRequest" and self.allows:
            answer = {"authenticationToken": self.token}
        elif kind == "AuthenticationTokenRequest":
            error = {"errorID": 50, "message": "User has denied API access for your plugin."}
        elif kind == "AuthenticationRequest":
            answer = {"authenticated": data["authenticationToken"] == self.token}
        kind = "APIError" if error else kind.replace("Request", "Response")
        return [{"apiVersion": self.version, "messageType": kind, "data": error or answer}]


def injected_by(output, fake, number):
    """Send frames, a quarter of a second apart, until the fake has `number` of them; return these."""
    taken = []
    while len(taken) < number:
        output.send(frame_of(yaw=0.5), 100.0 + len(taken) * 0.25)
        if output.statistics()["access"]:  # else it waits for the token
            taken = fake.take(len(taken) + 1, "InjectParameterDataRequest")
    return taken


@pytest.mark.parametrize(("output", "mode"), [(VtubeStudio, "set"), (VtubeStudioAdd, "add")])
def test_vtube_studio_gives_a_token_once(tmp_path, output, mode):
    with Fake(Studio()) as fake:
        studio = output(fake.address, tmp_path)
        studio.open()
        injected = injected_by(studio, fake, 5)
        studio.close()
        (file,) = tmp_path.iterdir()
        assert (file.read_text(), stat.S_IMODE(file.stat().st_mode)) == ("abc", 0o600)
        studio.open()
        injected_by(studio, fake, 6)
        studio.close()
        assert sum(each["messageType"] == "AuthenticationTokenRequest" for each in fake.messages) == 1
    first, last = injected[0]["data"], injected[-1]["data"]
    assert (last["mode"], last["faceFound"]) == (mode, mode == "set")
    values = [{each["id"]: each for each in data["parameterValues"]}["FaceAngleX"] for data in (first, last)]
    grown = [each.get("weight", each["value"] / 28.6479) for each in values]  # a weight, or the value itself
    assert grown == [0.0, pytest.approx(1.0, abs=1e-4)]


def test_a_token_that_is_not_valid_any_more_is_asked_for_again(tmp_path):
    with Fake(Studio()) as fake:
        studio = VtubeStudio(fake.address, tmp_path)
        (tmp_path / "vtube_studio_127.0.0.1.token").write_text("old")
        studio.open()
        injected_by(studio, fake, 1)
        studio.close()
    assert (tmp_path / "vtube_studio_127.0.0.1.token").read_text() == "abc"


@pytest.mark.parametrize(
    ("answers", "line"),
    [
        (Studio(allows=False), "User has denied API access for your plugin (error 50); start the run again"),
        (Studio(version="2.0"), "speaks API version 2.0, not 1.0"),
        (Studio(token="a b"), "gives 'a b', which is not a token"),
        (Studio(error={"errorID": 454, "message": "Taken."}), "Taken (error 454); stop the other plug-in, or use"),
    ],
)
def test_a_refusal_of_vtube_studio_is_one_line(tmp_path, answers, line):
    with Fake(answers) as fake:
        studio = VtubeStudio(fake.address, tmp_path)
        studio.open()
        assert answered(studio, frame_of()).startswith(line)
        studio.close()
        if not answers.allows:  # its user is not asked again and again
            with pytest.raises(OutputError, match="denied access"):
                studio.open()


GREETING = b"HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: "
NOT_FOUND = b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"


@pytest.mark.parametrize(
    ("reply", "line"),
    [
        (NOT_FOUND, "the program that listens there has no WebSocket at /v1/events: it answers HTTP 404"),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "it answers other bytes"),
        (GREETING + b"wrong\r\n\r\n", "it answers other bytes"),
    ],
)
def test_another_program_is_one_line(reply, line):
    with Raw(reply, greets=False) as address, pytest.raises(OutputError, match=line):
        Furhat(address).open()


def test_no_program_and_no_host_are_one_line(monkeypatch):
    with pytest.raises(OutputError, match="^connection refused: name the robot's host"):
        Furhat(f":{free_tcp_port()}").open()
    with pytest.raises(OutputError, match="no host of the network has the name nowhere.invalid"):
        Furhat("nowhere.invalid").open()
    monkeypatch.setattr(websocket_peer, "CONNECT_S", 0.05)
    with Raw(greets=False) as address, pytest.raises(OutputError, match="does not answer within 0.05 s"):
        Furhat(address).open()


class Plain(Furhat):
    """An output without a greeting."""

    def greet(self):
        return


@pytest.mark.parametrize(
    ("data", "line"),
    [
        (b"\x81\x05hello", "answers with 'hello', which is not a JSON object"),
        (b"\x81\x02[]", "answers with '[]', which is not a JSON object"),
        (b"\xff\xff\xff\xff", "answers with bytes that are not of a WebSocket"),
        (b"\x81\x7f\x00\x00\x00\x00\x7f\xff\xff\xff", "answers with bytes that are not of a WebSocket"),
        (b'\x81\x7e\x01\x00{"type"', "has closed the connection"),
        (b"\x88\x09\x03\xe9restart", "has closed the connection (restart)"),
        (b'\x81\x17{"type":"system.error"}', "answers system.error"),
    ],
)
def test_wrong_bytes_after_the_greeting_are_one_line(data, line):
    with Raw(data) as address:
        output = Plain(address)
        assert answered(output, frame_of(), opens=True).startswith(line)
        output.close()


def test_a_peer_that_takes_nothing_costs_frames_and_then_the_connection(caplog):
    with Raw() as address:
        output = Plain(address)
        output.open()
        frame, now_s = frame_of(), output.link.heard_s
        for _ in range(100_000):  # until the buffers of both sides are full
            output.send(frame, now_s)
            if output.link.dropped == 300:
                break
        assert output.statistics()["dropped"] == 300
        assert "is slower than 50 frames a second" in caplog.text
        assert answered(output, frame, now_s, step_s=0.02) == "has accepted no data for 2 s"
        output.close()


def test_a_daemon_that_says_nothing_any_more_is_lost():
    with daemon(answer=lambda message: ()) as fake:
        output = ReachyMiniOverlay(fake.address)
        output.open()
        assert answered(output, frame_of(), output.link.heard_s, step_s=0.02) == "has sent nothing for 2 s"
        output.close()
