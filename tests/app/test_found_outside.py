"""Heads whose joints stand outside their limits at power-on, sagged or turned by hand, run on emulated servos."""

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from sfms_robot.app.session import HeadOptions, OpenHead, Programme, build_bus, build_motion, drive_head
from sfms_robot.app.wiring import calibration_of, emulated
from sfms_robot.config import load_head
from sfms_robot.config.calibrate_first import held_back
from sfms_robot.data import data_dir, shipped_names
from sfms_robot.emulator.launch import launch
from sfms_robot.frames import FRAME_S, MOTION_DIM, Plan, SpeakerFrame
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.runtime.feed import InlineFeed
from sfms_robot.runtime.safety import Interrupt
from sfms_robot.sources.paired import PairedSource
from sfms_robot.sources.recording import RecordedVoice

HEADS = shipped_names(data_dir("configs") / "heads", "head.yaml")
SECONDS = 1.6


class Restless:
    """A listener whose face goes from one extreme to another, whatever it hears."""

    hop, horizon = 4, 8

    def start(self, seed: int) -> int:
        return seed

    def step(self, speaker: SpeakerFrame, memory: int) -> tuple[Plan | None, int]:
        memory += 1
        if memory % self.hop:
            return None, memory
        frames = np.random.default_rng(memory).uniform(-1, 1, (self.horizon, MOTION_DIM)).astype(np.float32)
        return Plan(speaker.time_s, speaker.time_s + FRAME_S * np.arange(1.0, self.horizon + 1), frames), memory


def found_outside(head, whole, rng):
    """The servos of `emulated`, each up to a radian outside the range of its joint, as far as its turn goes."""
    servos = emulated(head)
    for name, joint in head.joints.items():
        out = rng.uniform(0.002, 1.0)
        angle = joint.min_rad - out if rng.random() < 0.5 else joint.max_rad + out
        calibration = calibration_of({name: whole.joints[name]})
        ticks = round(float(calibration.zero_ticks[0] + calibration.ticks_per_rad[0] * angle))
        turn = round(float(abs(calibration.ticks_per_rad[0]) * 2 * np.pi / joint.ratio))
        bus = servos[joint.bus]
        place = next(i for i, servo in enumerate(bus) if servo.id == joint.id)
        bus[place] = replace(bus[place], start_ticks=min(max(ticks, 1), turn - 2))
    return servos


@pytest.mark.parametrize(("careful", "seed"), [(False, 0), (True, 1)])
@pytest.mark.parametrize("name", HEADS)
def test_a_head_found_outside_its_limits_runs_and_comes_to_rest(name, careful, seed):
    whole = load_head(name)
    head = held_back(whole) if careful else whole
    rate_hz, clock = max(bus.rate_hz for bus in head.buses.values()), VirtualClock()
    with ExitStack() as stack:
        servos = found_outside(head, whole, np.random.default_rng(seed))
        opened = {bus: stack.enter_context(launch(servos[bus], True)) for bus in servos}
        bus = build_bus(head, opened, clock)
        stack.callback(bus.close)
        bus.connect()
        options = HeadOptions(name, fast=True)
        silence = PairedSource(RecordedVoice(np.zeros(round(SECONDS * 16_000), np.float32)), duration_s=SECONDS)
        motion = build_motion(head, rate_hz)
        there = OpenHead(options, head, motion, bus, clock, rate_hz, opened)
        programme = Programme(silence, InlineFeed(Restless(), seed, 0.01), SECONDS)
        drove = drive_head(there, programme, Interrupt(), signals=False)
    assert (drove.outcome, drove.error) == ("done", None)
    assert drove.log.audited.violations == 0 and drove.log.eased >= rate_hz
    assert motion.limiter.start(drove.log.audited.recent_rad[-1]).way_in is None  # all are inside
