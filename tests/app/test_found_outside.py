"""Heads whose joints stand outside their limits at power-on, sagged or turned by hand, run on emulated servos."""

from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from sfms_robot.app.open_head import OpenHead, build_bus, build_motion, run_log
from sfms_robot.app.options import HeadOptions
from sfms_robot.app.session import drive_head, run_parts
from sfms_robot.app.wiring import calibration_of, plugged_in
from sfms_robot.config import load_head
from sfms_robot.config.head import held_back
from sfms_robot.data import head_names
from sfms_robot.emulator.launch import launch
from sfms_robot.frames import FRAME_S, MOTION_DIM, Plan, SpeakerFrame
from sfms_robot.motion.limits import JointLimits
from sfms_robot.runtime.clock import InlineFeed, VirtualClock
from sfms_robot.runtime.safety import ARRIVED_RAD, EASE_S, FOLLOW_S, STANDS_RAD, Interrupt
from sfms_robot.servo.families import family_named
from sfms_robot.sources.paired import PairedSource

HEADS = head_names()
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


def found_outside(head, whole, rng, least_rad=0.002, most_rad=1.0, share=1.0):
    """The head's servos, a share of them that far outside the range of their joint, as far as their turn goes."""
    names = {(joint.bus, joint.id): name for name, joint in head.joints.items()}

    def found(bus, servo):
        name = names[bus, servo.id]
        joint, out = head.joints[name], rng.uniform(least_rad, most_rad)
        angle = joint.min_rad - out if rng.random() < 0.5 else joint.max_rad + out
        if rng.random() >= share:
            angle = rng.uniform(joint.min_rad, joint.max_rad)
        calibration = calibration_of({name: whole.joints[name]})
        ticks = round(float(calibration.zero_ticks[0] + calibration.ticks_per_rad[0] * angle))
        turn = round(float(abs(calibration.ticks_per_rad[0]) * 2 * np.pi / joint.ratio))
        low = servo.registers.get("min_position_limit", 1)  # a servo takes no goal beyond what it has stored
        high = servo.registers.get("max_position_limit", turn - 2)
        return replace(servo, start_ticks=min(max(ticks, low), high))

    return {bus: [found(bus, servo) for servo in servos] for bus, servos in plugged_in(head).items()}


def driven(head, servos, seconds, seed, fault=None):
    """A run of that long: its log, its motion, the time it took in all, and where the servos stand after it, ticks."""
    rate_hz, clock = max(bus.rate_hz for bus in head.buses.values()), VirtualClock()
    with ExitStack() as stack:
        opened = {bus: stack.enter_context(launch(servos[bus], True)) for bus in servos}
        bus = build_bus(head, opened, clock)
        stack.callback(bus.close)
        bus.connect()
        for chain in opened.values() if fault else ():
            chain.inject(fault)
        options = HeadOptions(head=head.name, fast=True)
        silence = PairedSource(duration_s=seconds)
        motion = build_motion(head, rate_hz)
        there = OpenHead(options=options, config=head, motion=motion, bus=bus, clock=clock, opened=opened)
        began_s = clock.now_s()
        parts, log = run_parts(there, silence, InlineFeed(Restless(), seed)), run_log(there.config, there.rate_hz)
        report = drive_head(there, parts, Interrupt(), duration_s=seconds, log=log)
        stand = {name: opened[joint.bus].state(joint.id) for name, joint in head.joints.items()}
    assert (report["exit"], report["error"]) == ("done", None)
    assert not any(state["torque"] for state in stand.values())
    return log, motion, clock.now_s() - began_s, {name: state["position"] for name, state in stand.items()}


def far_from_rest(head, whole, stand):
    """Radians that joints stand away from rest; of servos that report their position."""
    out = {}
    for key, joint in head.joints.items():
        here = calibration_of({key: whole.joints[key]})
        angle = (stand[key] - here.zero_ticks[0]) / here.ticks_per_rad[0]
        if not family_named(head.buses[joint.bus].family).board and abs(angle - joint.rest_rad) > 2 * STANDS_RAD:
            out[key] = angle - joint.rest_rad
    return out


@pytest.mark.parametrize(
    ("careful", "seed", "share"),
    [(False, 0, 1.0), (True, 1, 1.0), pytest.param(False, 11, 0.5, marks=pytest.mark.slow)],
)
@pytest.mark.parametrize("name", HEADS)
def test_a_head_found_outside_its_limits_runs_and_comes_to_rest(name, careful, seed, share):
    whole = load_head(name)
    head = held_back(whole, whole.joints) if careful else whole
    servos = found_outside(head, whole, np.random.default_rng(seed), share=share)
    log, motion, _, stand = driven(head, servos, SECONDS, seed)
    assert log.audited.violations == 0
    assert motion.limiter.start(log.audited.recent_rad[-1]).recovery is None  # all are inside
    assert far_from_rest(head, whole, stand) == {}


@pytest.mark.parametrize("name", ["op3_head", "reachy_mini", "face28"])
def test_torque_stays_on_until_the_slowest_joint_has_come_to_rest(name):
    """Asked to end while joints are far outside: at 0.3 of their pace they need longer than the face's own easing."""
    whole = load_head(name)
    head = held_back(whole, whole.joints)
    servos = found_outside(head, whole, np.random.default_rng(2), 2.0, 3.0)
    log, motion, took_s, stand = driven(head, servos, 0.1, 2)
    assert log.audited.violations == 0 and np.abs(log.audited.recent_rad[-1] - motion.rest_rad).max() < ARRIVED_RAD
    assert took_s > 3.0
    assert far_from_rest(head, whole, stand) == {}


def test_servos_that_do_not_move_get_as_long_as_their_goals_need_and_no_longer():
    whole = load_head("op3_head")
    head = held_back(whole, whole.joints)
    servos = found_outside(head, whole, np.random.default_rng(2), 2.0, 3.0)
    log, motion, took_s, stand = driven(head, servos, 0.1, 2, "stuck")
    assert np.abs(log.audited.recent_rad[-1] - motion.rest_rad).max() < ARRIVED_RAD
    assert took_s < EASE_S + np.pi / JointLimits.of(head).speed.min() + FOLLOW_S + 1.0
    assert list(stand.values()) == [servo.start_ticks for servo in servos["main"]]
