"""Limiter, goals and audit are one law, wherever joints are found and whatever they are asked for."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.app.open_head import bus_servos
from sfms_robot.app.wiring import calibration_of
from sfms_robot.config import Head, load_head
from sfms_robot.config.head import held_back
from sfms_robot.data import head_names
from sfms_robot.motion.audit import CommandAudit
from sfms_robot.motion.jerk_step import StopChase, TimeOptimalChase
from sfms_robot.motion.limits import JerkLimiter, JointLimits, curve_s
from sfms_robot.runtime.safety import ARRIVED_RAD, EASE_S, FOLLOW_S, REST_LIMIT_S
from sfms_robot.servo.bus import Goals

DT_S = 0.01
HEADS = head_names()
CHASES = [TimeOptimalChase, StopChase]


def sliver(head: Head) -> Head:
    """The head with a tenth of a degree of travel in every joint."""
    joints = {
        name: joint.model_copy(update={"min_deg": joint.rest_deg - 0.05, "max_deg": joint.rest_deg + 0.05})
        for name, joint in head.joints.items()
    }
    return head.model_copy(update={"joints": joints})


SIZES = [lambda head: head, lambda head: held_back(head, head.joints), sliver]


def latest_in_s(limits: JointLimits, angles) -> np.ndarray:
    """Seconds (J,) after which joints found at `angles` are in range for any reference.

    The duration of the curve; then, from standing still at its end, the time to come to a stop wherever the joint is
    by then, and to come in from there as fast as the limits allow.
    """
    out_rad = np.abs(angles - limits.range.nearest(angles))
    rates = limits.speed, limits.acceleration, limits.jerk
    ramp_s = limits.speed / limits.acceleration + limits.acceleration / limits.jerk
    return np.where(out_rad == 0, 0.0, 1e-6 + curve_s(out_rad, *rates) + out_rad / limits.speed + 2 * ramp_s)


class Law:
    """One head's limiter, goals and audit fed with the same; `tick` checks every law that holds at every tick."""

    def __init__(self, head: Head, chase) -> None:
        joints = head.joints
        servos, calibration = bus_servos(head, joints), calibration_of(joints)
        self.limits = JointLimits.of(head)
        self.count = len(servos)
        self.limiter = JerkLimiter(self.limits, DT_S, chase)
        self.goals = Goals("law", servos, calibration)
        self.audit = CommandAudit(self.limits, calibration, DT_S)
        self.calibration = calibration

    def start(self, angles) -> None:
        self.state, self.audited = self.limiter.start(angles), self.audit.start(angles)
        self.found, self.last = angles.copy(), angles.copy()
        self.due_s = latest_in_s(self.limits, angles)
        for index, angle in enumerate(angles):
            self.goals.hold(index, angle)

    def restart(self, joints, angles) -> None:
        angles = np.where(joints, angles, self.last)
        self.state = self.limiter.restart(joints, angles, self.state)
        self.audited = self.audit.restart(joints, angles, self.audited)
        for index in np.flatnonzero(joints):
            self.goals.hold(index, angles[index])
        self.last = angles
        self.due_s = np.where(joints, latest_in_s(self.limits, angles), self.due_s)

    def tick(self, reference, sent) -> np.ndarray:
        goals, self.state = self.limiter.step(reference, self.state)
        self.goals.ticks(goals, sent)  # raises for a goal that is refused
        self.audited = self.audit.step(goals, reference[0], self.audited)
        assert self.audited.violations == 0
        low, high = self.limits.low, self.limits.high
        assert (goals >= np.minimum(low, self.last)).all() and (goals <= np.maximum(high, self.last)).all()
        self.due_s = self.due_s - DT_S
        inside = (goals >= low) & (goals <= high)
        assert (inside | (self.due_s > 0)).all()
        self.last = goals
        return inside


def anywhere(rng, limits: JointLimits) -> np.ndarray:
    """Inside, just outside, far outside, on either side; a joint each."""
    width = limits.high - limits.low
    side = np.where(rng.random(len(width)) < 0.5, -1.0, 1.0)
    out = rng.choice([0.0, 1e-9, 1e-3, 0.3, 3.0], len(width)) * rng.random(len(width))
    edge = np.where(side < 0, limits.low, limits.high)
    return np.where(rng.random(len(width)) < 0.3, limits.low + rng.random(len(width)) * width, edge + side * out)


def asked(rng, limits: JointLimits, last, kind: str) -> np.ndarray:
    """A reference (3, J)."""
    width, still = limits.high - limits.low, np.zeros(len(last))
    rates = rng.choice([-1.0, 0, 1], (2, len(last))) * rng.uniform(0, 2) * np.stack([limits.speed, limits.acceleration])
    if kind == "here, at speed":  # needs a run-up
        return np.stack([last + rng.normal(size=len(last)) * 1e-3, *rates])
    if kind == "outward":
        return np.stack([np.where(last > limits.high, 9.0, -9.0), still, still])
    if kind == "edge, at speed":
        return np.stack([np.where(rng.random(len(last)) < 0.5, limits.low, limits.high), *rates])
    if kind == "broken":
        bad = rng.choice([np.nan, np.inf, -np.inf, 1e300, 0.0], (3, len(last)))
        return np.where(rng.random((3, len(last))) < 0.5, bad, last)
    return np.stack([limits.low + width * rng.uniform(-1, 2, len(last)), *rates])


KINDS = ["here, at speed", "outward", "edge, at speed", "broken", "anywhere"]


def tormented(law: Law, seed: int, kinds, ticks: int) -> None:
    rng = np.random.default_rng(seed)
    law.start(anywhere(rng, law.limits))
    everybody = np.arange(law.count)
    hold, reference = 1, None
    for tick in range(ticks):
        if tick % hold == 0:
            hold = int(rng.choice([1, 1, 3, 20]))
            reference = asked(rng, law.limits, law.last, kinds[rng.integers(len(kinds))])
        if rng.random() < 0.02:
            law.restart(rng.random(law.count) < 0.3, anywhere(rng, law.limits))
        law.tick(reference, everybody[rng.random(law.count) < 0.8])


@pytest.mark.parametrize("chase", CHASES)
@pytest.mark.parametrize("size", SIZES, ids=["whole", "calibrate first", "sliver"])
@pytest.mark.parametrize("name", HEADS)
@settings(max_examples=3)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=3))
def test_no_goal_is_refused_and_no_joint_goes_farther_out(name, size, chase, seed, kinds):
    tormented(Law(size(load_head(name)), chase), seed, kinds, 120)


@pytest.mark.parametrize(("name", "chase"), [("op3_head", StopChase), ("face28", TimeOptimalChase)])
@pytest.mark.parametrize("size", SIZES, ids=["whole", "calibrate first", "sliver"])
@settings(max_examples=2)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=3))
def test_every_joint_is_inside_its_range_in_the_stated_time_and_stays(name, chase, size, seed, kinds):
    law, rng = Law(size(load_head(name)), chase), np.random.default_rng(seed)
    law.start(anywhere(rng, law.limits))
    everybody, latest_s = np.arange(law.count), law.due_s.max()
    before = np.zeros(law.count, bool)
    for _ in range(int(latest_s / DT_S) + 20):
        inside = law.tick(asked(rng, law.limits, law.last, kinds[rng.integers(len(kinds))]), everybody)
        assert not (before & ~inside).any()
        before = inside
    assert before.all()


@pytest.mark.parametrize("size", SIZES, ids=["whole", "calibrate first", "sliver"])
@pytest.mark.parametrize("name", ["op3_head", "open_duck_mini_v2_head", "face28"])
@settings(max_examples=5)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=3))
def test_braking_stops_every_joint_where_no_limit_is_broken_and_nobody_goes_farther_out(name, size, seed, kinds):
    law = Law(size(load_head(name)), TimeOptimalChase)
    tormented(law, seed, kinds, 60)
    limits = law.limits
    longest_s = (limits.speed / limits.acceleration + 2 * limits.acceleration / limits.jerk).max()
    low, high = np.minimum(limits.low, law.last), np.maximum(limits.high, law.last)
    for _ in range(int(longest_s / DT_S) + 2):
        before = law.last
        goals, law.state = law.limiter.brake(law.state)
        law.goals.ticks(goals, np.arange(law.count))
        law.audited = law.audit.step(goals, goals, law.audited)
        assert (goals >= low).all() and (goals <= high).all()
        law.last = goals
    assert law.audited.violations == 0 and np.array_equal(law.last, before)
    law.restart(np.ones(law.count, bool), law.last)  # and it goes on from there
    law.tick(asked(np.random.default_rng(seed), limits, law.last, "anywhere"), np.arange(law.count))


def rest_of(head: Head) -> np.ndarray:
    return np.array([joint.rest_rad for joint in head.joints.values()])


def needed_s(limits: JointLimits, way_rad) -> np.ndarray:
    """As docs/safety.md states it (J,): stop first, then from rest to rest; `StopChase` takes a little longer."""
    ramp_s = limits.speed / limits.acceleration + limits.acceleration / limits.jerk
    return 1.05 * (way_rad / limits.speed + 3 * ramp_s) + 0.05


@pytest.mark.parametrize("chase", CHASES)
@pytest.mark.parametrize("size", SIZES, ids=["whole", "calibrate first", "sliver"])
@pytest.mark.parametrize("name", ["op3_head", "face28", "inmoov2_maestro"])
@settings(max_examples=4)
@given(seed=st.integers(0, 2**32 - 1), ticks=st.integers(0, 60))
def test_whatever_a_joint_does_it_is_at_rest_in_the_stated_time_once_it_is_asked_to(name, size, chase, seed, ticks):
    head = size(load_head(name))
    law, rest_rad = Law(head, chase), rest_of(head)
    tormented(law, seed, KINDS, ticks)
    due_s = needed_s(law.limits, np.abs(law.last - rest_rad))
    asked_rad = np.stack([rest_rad, 0 * rest_rad, 0 * rest_rad])
    for tick in range(int(due_s.max() / DT_S) + 2):
        late = tick * DT_S > due_s
        assert (np.abs(law.last - rest_rad) < ARRIVED_RAD)[late].all()
        law.tick(asked_rad, np.arange(law.count))
    assert (np.abs(law.last - rest_rad) < ARRIVED_RAD).all()


@pytest.mark.parametrize("name", HEADS)
def test_the_way_to_rest_of_a_shipped_head_is_never_cut_short_wherever_its_joints_are_found(name):
    for head in (whole := load_head(name), held_back(whole, whole.joints)):
        assert needed_s(JointLimits.of(head), 2 * np.pi).max() + EASE_S + FOLLOW_S < REST_LIMIT_S
