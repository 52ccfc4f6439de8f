"""Every head, its joints found wherever servos can stand: a short run ends at rest, under the limits, and limp."""

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from sfms_robot.app.open_head import OpenHead, build_bus, build_motion
from sfms_robot.app.options import HeadOptions
from sfms_robot.app.session import drive_head, run_parts
from sfms_robot.app.wiring import calibration_of, plugged_in
from sfms_robot.config import load_head
from sfms_robot.data import head_names
from sfms_robot.emulator.launch import launch
from sfms_robot.frames import FRAME_S, MOTION_DIM, Plan, SpeakerFrame
from sfms_robot.runtime.clock import InlineFeed, VirtualClock
from sfms_robot.runtime.safety import Interrupt
from sfms_robot.servo.families import family_named
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.recording import RecordedVoice

HEADS = head_names()
LISTEN_S = 0.5
AT_REST_DEG = 1.0  # of a servo's place: what its gear and the last 1e-4 rad of its goal leave


class Nodder:
    """A listener that throws the head about and blinks."""

    hop, horizon = 2, 6

    def start(self, seed: int) -> np.random.Generator:
        return np.random.default_rng(seed)

    def step(self, speaker: SpeakerFrame, memory: np.random.Generator) -> tuple[Plan | None, np.random.Generator]:
        if round(speaker.time_s / FRAME_S) % self.hop:
            return None, memory
        frames = memory.uniform(-1, 1, (self.horizon, MOTION_DIM)).astype(np.float32)
        return Plan(speaker.time_s, speaker.time_s + FRAME_S * np.arange(1.0, self.horizon + 1), frames), memory


def found_anywhere(head, rng):
    """Servos of the head, half of them beyond an end of their joint: up to 60 degrees, or as far as a turn goes."""
    servos, names = plugged_in(head.name, head), {(j.bus, j.id): name for name, j in head.joints.items()}
    out = {}
    for bus, row in servos.items():
        out[bus] = []
        for servo in row:
            joint = head.joints[names[bus, servo.id]]
            beyond = rng.uniform(0.002, 1.05)
            angle = [rng.uniform(joint.min_rad, joint.max_rad), joint.min_rad - beyond, joint.max_rad + beyond][
                rng.choice(3, p=[0.5, 0.25, 0.25])
            ]
            here = calibration_of({"": joint})
            turn = round(float(abs(here.ticks_per_rad[0]) * 2 * np.pi / joint.ratio))
            ticks = round(float(here.zero_ticks[0] + here.ticks_per_rad[0] * angle))
            low = servo.registers.get("min_position_limit", 1)  # a servo takes no goal beyond what it has stored
            high = servo.registers.get("max_position_limit", turn - 2)
            out[bus].append(replace(servo, start_ticks=min(max(ticks, low), high)))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("seed", [11, 12, 13])
@pytest.mark.parametrize("name", HEADS)
def test_wherever_joints_stand_a_run_ends_at_rest_and_limp(name, seed):
    head = load_head(name)
    rate_hz, clock = max(bus.rate_hz for bus in head.buses.values()), VirtualClock()
    with ExitStack() as stack:
        servos = found_anywhere(head, np.random.default_rng(seed))
        chains = {bus: stack.enter_context(launch(servos[bus], virtual=True)) for bus in servos}
        bus = build_bus(head, chains, clock)
        stack.callback(bus.close)
        bus.connect()
        motion = build_motion(head, rate_hz)
        there = OpenHead(
            options=HeadOptions(head=name, fast=True), config=head, motion=motion, bus=bus, clock=clock, opened=chains
        )
        silence = PairedSource(RecordedVoice(np.zeros(round(LISTEN_S * 16_000), np.float32)), duration_s=LISTEN_S)
        parts = run_parts(there, silence, InlineFeed(Nodder(), seed, 0.01))
        drove = drive_head(there, parts, Interrupt(), duration_s=LISTEN_S, signals=False)
        states = {key: chains[joint.bus].state(joint.id) for key, joint in head.joints.items()}
    assert (drove.outcome, drove.error) == ("done", None)
    assert drove.log.audited.violations == 0
    assert not [key for key, state in states.items() if state["torque"]]
    assert far_from_rest(head, states) == {}


def far_from_rest(head, states):
    """Degrees that joints stand away from rest; of servos that tell their place."""
    out = {}
    for key, joint in head.joints.items():
        if family_named(head.buses[joint.bus].family).board:
            continue
        here = calibration_of({key: joint})
        angle = (states[key]["position"] - here.zero_ticks[0]) / here.ticks_per_rad[0]
        if (off := float(np.degrees(abs(angle - joint.rest_rad)))) > AT_REST_DEG:
            out[key] = off
    return out
