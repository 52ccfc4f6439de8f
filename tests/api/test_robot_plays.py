"""`Robot(play=...)`: what is said is played, and the robot speaks while it is heard."""

import numpy as np
import pytest

import sfms_robot as sr
from sfms_robot.frames import FRAME_S, MOTION_DIM

pytestmark = pytest.mark.realtime
LIMIT_S = 60.0
LOOK_S = 0.02


class Still(sr.Listener):
    """A listener whose face rests."""

    hop, horizon = 4, 8

    def start(self, seed):
        return 0

    def step(self, speaker, memory):
        memory += 1
        if memory % self.hop:
            return None, memory
        times_s = speaker.time_s + FRAME_S * np.arange(1.0, self.horizon + 1)
        return sr.Plan(speaker.time_s, times_s, np.zeros((self.horizon, MOTION_DIM), np.float32)), memory


def until(robot, state):
    for _ in range(round(LIMIT_S / LOOK_S)):
        if robot.state == state:
            return
        assert not robot.wait(LOOK_S), robot.report()
    raise AssertionError(f"never {state}: {robot.state}")


@pytest.mark.slow
def test_what_it_says_is_played_and_it_speaks_until_it_is_hushed(sound_server):
    noise = (0.3 * np.random.default_rng(0).uniform(-1, 1, 60 * 24_000)).astype(np.float32)
    with sr.Robot("interbotix_wxxms", listener=Still(), play="person") as robot:
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
    robot = sr.Robot("interbotix_wxxms", listener=Still(), audio="katie", play="person")
    with pytest.raises(sr.ConfigError, match="^--play person: nothing is played of --agent-audio none"):
        robot.start()
