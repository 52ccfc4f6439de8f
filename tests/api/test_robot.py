"""`Robot` and `open_bus` on emulated servos: threads, errors, refusals, coming to rest, speech that is played."""

import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import sfms_robot as sr
from sfms_robot.app.wiring import emulated
from sfms_robot.emulator.launch import launch
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM

pytestmark = pytest.mark.realtime
HEAD = "reachy_mini"
PITCH = CHANNEL_INDEX["pitch"]
LIMIT_S = 60.0
LOOK_S = 0.02


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))


class Nodder:
    """A `Listener` whose memory is the number of frames: nods for ever."""

    hop, horizon = 1, 2

    def __init__(self, raises_at=None):
        self.threads, self.heard, self._raises_at = set(), [], raises_at

    def start(self, seed):
        return 0

    def step(self, speaker, memory):
        self.threads.add(threading.current_thread().name)
        self.heard.append(speaker)
        if memory == self._raises_at:
            raise RuntimeError("out of ideas")
        times = speaker.time_s + FRAME_S * np.arange(1, 3)
        frames = np.zeros((2, MOTION_DIM), np.float32)
        frames[:, PITCH] = 0.08 * np.sin(2 * np.pi * 1.5 * times)
        return sr.Plan(speaker.time_s, times, frames), memory + 1


class Still(Nodder):
    """A listener whose face stands still."""

    def __init__(self, face):
        super().__init__()
        self._face = face

    def step(self, speaker, memory):
        plan, memory = super().step(speaker, memory)
        return sr.Plan(plan.made_at_s, plan.times_s, np.full((2, MOTION_DIM), self._face, np.float32)), memory


def test_a_listener_object_moves_the_head_and_its_nods_are_told_before_the_end():
    told, began_s = [], time.monotonic()
    with sr.Robot(HEAD, listener=(nodder := Nodder())) as robot:
        assert robot.state == "starting"
        nodded = threading.Event()
        robot.on("nod", lambda event: (told.append(event), nodded.set()))
        assert nodded.wait(30)
        assert robot.report()["exit"] == "running" and robot.report()["frames"] > 0
    report = robot.report()
    assert (robot.state, report["exit"], report["limits"]["violations"]) == ("stopped", "interrupted", 0)
    assert report["listener"] == "Nodder" and report["joints"]
    assert nodder.threads == {"listener"}
    assert len(told) == len({event.start_s for event in told})
    assert all(began_s < event.starts_monotonic_s < time.monotonic() + 1.0 for event in told)


def test_what_is_pushed_is_what_the_listener_hears_from_any_thread():
    face = np.zeros(58, np.float32)
    face[PITCH] = 0.25
    listener = Nodder()
    robot = sr.Robot(HEAD, listener=listener)
    starts = threading.Thread(target=robot.start)
    starts.start()
    starts.join()
    assert robot.state == "starting"
    try:
        for _ in range(50):
            robot.hear(np.full(1920, 8192, np.int16), 48000)
            robot.see(face)
            robot.say(np.full(960, 0.5, np.float32), 24000)
            if robot.wait(0.04):
                break
    finally:
        robot.stop()
    robot.stop()
    assert robot.state == "stopped"
    heard = [frame for frame in listener.heard if len(frame.audio)]
    assert heard and all(len(frame.audio) == 640 and np.abs(frame.audio).max() <= 1 for frame in heard)
    assert np.median(heard[-1].audio) == pytest.approx(0.25, abs=0.01)
    assert any(frame.face is not None and frame.face.pose[1] == pytest.approx(0.25) for frame in listener.heard)
    assert any(frame.agent_audio is not None and frame.agent_audio.max() > 0.4 for frame in listener.heard)


def test_a_listener_that_raises_ends_no_run_and_is_named():
    listener = Nodder(raises_at=3)
    with sr.Robot(HEAD, listener=listener) as robot:
        robot.wait(1.5)
        assert robot.state == "degraded"
    assert robot.report()["states"]["changes"][1]["why"] == ["listener"]
    assert robot.report()["listener_state"]["state"] == "failed: RuntimeError: out of ideas"


def test_show_reaches_the_servos_and_intensity_zero_keeps_them_still():
    travels = []
    for intensity in (1.0, 0.0):
        with sr.Robot(HEAD, audio="katie", duration_s=3.0, fast=True, listener=Still(0.1), seed=1) as robot:
            for region in robot.knobs:
                robot.knobs[region].intensity = intensity
            robot.look_at(1.0, 0.2, 0.0, seconds=0.5)
            assert robot.wait()
        report = robot.report()
        assert (report["exit"], report["frames"], report["limits"]["violations"]) == ("done", 75, 0)
        travels.append(sum(joint["travel_rad"] for joint in report["joints"].values()))
    assert travels[0] > 2 * travels[1]


class BadSource(sr.Source):
    def read(self, now_s):
        if now_s > 0.3:
            raise OSError("the browser tab was closed")
        return []


def test_an_error_in_the_loop_surfaces_at_the_end_of_the_block_with_the_head_at_rest():
    with pytest.raises(sr.RobotError, match="tab was"), sr.Robot(HEAD, source=BadSource(), listener=Nodder()) as robot:
        robot.wait(30)
        assert robot.state == "fault"
    report = robot.report()
    assert report["exit"] == "failed" and report["limits"]["violations"] == 0
    robot.stop()  # told once


def test_an_exception_of_the_program_is_not_hidden_by_the_robots():
    with pytest.raises(ZeroDivisionError), sr.Robot(HEAD, source=BadSource(), listener=Nodder()) as robot:
        robot.wait(30)
        raise ZeroDivisionError


def test_an_error_before_torque_is_raised_by_start():
    with pytest.raises(sr.ConfigError, match="nowhere"), sr.Robot(HEAD, listener="/nowhere", audio="none"):
        pass


REFUSED = [
    ({"head": "nope"}, sr.ConfigError, "'nope' is neither a shipped name"),
    ({"port": "/dev/nowhere"}, sr.PortError, "/dev/nowhere"),
    ({"without": ("nose",)}, sr.ConfigError, f"expected a joint of head '{HEAD}', got 'nose'"),
    ({"fast": True}, sr.InputError, 'another source than audio="push"'),
    ({"face": "me.csv"}, sr.InputError, r"the face comes by see\(\)"),
    ({"intensity": {"ears": 1}}, sr.InputError, r"'ears' is not a region of this head \(.*neck"),
    ({"intensity": {"neck": 2.5}}, sr.InputError, "intensity of neck = 2.5 is not in 0..2"),
]


@pytest.mark.parametrize(("options", "error", "message"), REFUSED)
def test_what_cannot_be_right_is_refused_before_anything_is_opened(options, error, message):
    with pytest.raises(error, match=message):
        sr.Robot(**{"head": HEAD, **options})


def test_hear_with_another_source_raises():
    robot = sr.Robot(HEAD, audio="katie")
    for push in (robot.hear, robot.say):
        with pytest.raises(sr.InputError, match="needs audio=\"push\".*; this robot listens to 'katie'"):
            push(np.zeros(640), 16000)


def test_servos_alone_go_where_they_are_told_within_the_limits_and_rest_at_the_end():
    rng = np.random.default_rng(0)
    with sr.open_bus(HEAD) as bus:
        assert all(reading.position_rad is not None for reading in bus.read().values())
        bus.enable()
        for _ in range(20):  # faster and farther than any joint may go
            bus.write(rng.uniform(bus.low_rad, bus.high_rad))
            assert set(bus.read()) == set(bus.joints)
            bus.move(rng.uniform(bus.low_rad, bus.high_rad), limit_s=0.05)
        goal = bus.rest_rad + 0.1 * (bus.high_rad - bus.rest_rad)
        assert bus.move(goal)
    report = bus.report()
    assert report["exit"] == "interrupted" and report["limits"]["violations"] == 0
    assert set(report["joints"]) == set(bus.joints)


def test_servos_alone_refuse_what_is_no_goal():
    with pytest.raises(sr.ConfigError, match="is not what its file says"):
        sr.open_bus(sr.load_head(HEAD).model_copy(update={"description": "another"}))
    with sr.open_bus(sr.load_head(HEAD)) as bus:
        with pytest.raises(sr.BusError, match=r"enable\(\) first"):
            bus.write(bus.rest_rad)
        bus.enable()
        bus.enable()
        wrong = bus.rest_rad.copy()
        wrong[2] = bus.high_rad[2] + 0.01
        with pytest.raises(sr.InputError, match=f"{bus.joints[2]} = .* rad is not in"):
            bus.write(wrong)
        wrong[2] = np.nan
        with pytest.raises(sr.InputError, match=f"{bus.joints[2]} = nan"):
            bus.write(wrong)
        with pytest.raises(sr.InputError, match="angles have shape"):
            bus.write(bus.rest_rad[1:])
        bus.stop()
        with pytest.raises(sr.BusError, match="the run has ended"):
            bus.write(bus.rest_rad)


SCRIPT = """
import numpy as np, sfms_robot as sr
robot = sr.Robot("reachy_mini", listener="sfms-small").start()
robot.hear(np.zeros(16000, np.int16), 16000)
robot.wait(0.3)
print(robot.state)
"""


def test_a_plain_script_needs_no_main_guard_and_rests_when_it_forgets_to_stop(tmp_path):
    script = tmp_path / "mine.py"
    script.write_text(SCRIPT)
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, check=False, timeout=120)
    busy = ("this computer was too busy", ": an answer is held back")
    told = [line for line in done.stderr.splitlines() if not any(each in line for each in busy)]
    assert (done.returncode, done.stdout.strip(), told) == (0, "starting", [])


def test_a_robot_is_halted_and_goes_on_when_it_is_resumed():
    with sr.Robot(HEAD, listener=Nodder()) as robot:
        robot.wait(0.3)
        robot.halt()
        robot.wait(0.3)
        assert robot.state == "halted"
        robot.resume()
        robot.wait(0.3)
        assert robot.state == "starting"
    assert [change["state"] for change in robot.report()["states"]["changes"]] == [
        "starting", "halted", "starting", "stopping", "stopped",
    ]  # fmt: skip


@pytest.mark.parametrize("opens", [sr.Robot, sr.open_bus])
def test_torque_that_is_not_confirmed_off_is_raised_by_the_end_and_in_the_report(opens, tmp_path):
    servos, device = emulated(sr.load_head(HEAD))["main"], str(tmp_path / "servos")
    with launch(servos, link=device) as chain:
        with pytest.raises(sr.BusError, match="torque .* not be confirmed off"), opens(HEAD, port=device) as robot:
            if opens is sr.open_bus:
                robot.enable()
            chain.kill(servos[0].id)
        report = robot.report()
        unconfirmed = [joint for joint, each in sr.load_head(HEAD).joints.items() if each.id == servos[0].id]
        assert (report["exit"], report["exit_code"], report["torque_unconfirmed"]) == ("failed", 4, unconfirmed)
        assert opens is sr.open_bus or robot.state == "fault"
        assert [servo.id for servo in servos if chain.state(servo.id)["torque"]] == [servos[0].id]


def until(robot, state):
    for _ in range(round(LIMIT_S / LOOK_S)):
        if robot.state == state:
            return
        assert not robot.wait(LOOK_S), robot.report()
    raise AssertionError(f"never {state}: {robot.state}")


@pytest.mark.slow
def test_what_it_says_is_played_and_it_speaks_until_it_is_hushed(sound_server):
    noise = (0.3 * np.random.default_rng(0).uniform(-1, 1, 60 * 24_000)).astype(np.float32)
    with sr.Robot("interbotix_wxxms", listener=Still(0.0), play="person") as robot:
        until(robot, "idle")
        robot.say(noise, 24_000)
        until(robot, "speaking")
        robot.hush()
        until(robot, "idle")
    told = robot.report()["source"]["agent_audio"]
    assert told["device"] == "person" and told["delay_ms"] > 80.0 and told["restarts"] == 0


def test_what_is_said_elsewhere_is_not_played(sound_server):
    class Nobody(sr.Source):
        def read(self, now_s):
            return []

    with pytest.raises(sr.InputError, match="play='person': what a source of your own says is not played"):
        sr.Robot("interbotix_wxxms", source=Nobody(), play="person")
