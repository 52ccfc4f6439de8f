"""Anything may happen to servos in any order: what a bus may never do, on emulated servos where silence costs time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from timed import timed

from sfms_robot.config import LoadRule, Safety
from sfms_robot.servo.chain.member import NEAR, POWERED

COUNT = 4
IDS = st.integers(1, COUNT)
STEP_RAD = 0.004  # a goal moves so far in a tick


class Troubles(RuleBasedStateMachine):
    """Four servos, goals that wander, and everything that can go wrong with a servo or the wire."""

    family = "dynamixel2"

    @initialize(policy=st.sampled_from(["limp", "hold", "reduce", "reboot_and_ease_in"]))
    def begin(self, policy):
        rule_ = LoadRule(current_mA=300, for_s=0.1, then="limp")
        tells = self.family in ("dynamixel2", "sts")
        self.rig = timed(self.family, COUNT, safety=Safety(on_fault=policy, pinch=rule_ if tells else None))
        self.goals = self.rig.hold()
        self.driven: set[int] = set()  # who got the last goals
        self.mark = 0
        self.tick_s = 0.0

    @rule(n=st.integers(1, 20), towards=st.floats(-0.5, 0.5))
    def tick(self, n, towards):
        for _ in range(n):
            self.goals += np.clip(towards - self.goals, -STEP_RAD, STEP_RAD)
            trusted = {m.id for m in self.rig.bus._members if m.state in POWERED and m.torque_seen}
            self.mark = len(self.rig.port.sent)
            readings = self.rig.tick(self.goals)
            self.look_at_goals(trusted)
            for i, reading in enumerate(readings.values()):
                assert reading.age_s >= 0.0
                if reading.rejoined:
                    self.goals[i] = np.clip(reading.position_rad, -0.7, 0.7)

    def look_at_goals(self, trusted):
        """The goal packet of the last tick, if there was one."""
        told = self.goals_sent()
        assert told.keys() <= trusted, "a goal went to a servo whose torque is not wanted and seen on"
        for servo in told.keys() - self.driven:
            stands = self.rig.port.device.servo(servo).plant.position
            near = NEAR * self.rig.family.table.ticks_per_revolution + 4
            if self.driven or self.mark > 0:
                assert abs(told[servo] - stands) <= near, "the first goal after an absence is far from where it stands"
        if told:
            self.driven = set(told)

    def goals_sent(self):
        table = self.rig.family.table
        goal = table.role("goal_position")
        for packet in self.rig.port.sent[self.mark : self.mark + 1]:
            if table.protocol == 2 and packet[7] == 0x83 and int.from_bytes(packet[8:10], "little") == goal.address:
                body = packet[12:-2]
            elif table.protocol == 1 and packet[4] == 0x83 and packet[5] == goal.address:
                body = packet[7:-1]
            else:
                continue
            each = goal.size + 1
            return {body[k]: goal.from_bytes(body[k + 1 : k + each]) for k in range(0, len(body), each)}
        return {}

    @rule(servo=IDS)
    def falls_mute(self, servo):
        self.rig.port.mute = {servo}

    @rule()
    def wire_mends(self):
        self.rig.port.mute, self.rig.port.deaf = set(), False
        self.rig.port.lose = lambda servo: False

    @rule(servo=IDS)
    def answers_are_lost(self, servo):
        self.rig.port.lose = lambda other: other == servo

    @rule()
    def nobody_hears(self):
        self.rig.port.deaf = True

    @rule(servo=IDS)
    def is_stuck(self, servo):
        self.rig.port.device.servo(servo).plant.stuck = True

    @rule(servo=IDS)
    def is_free(self, servo):
        self.rig.port.device.servo(servo).plant.stuck = False

    @rule(servo=IDS, bit=st.sampled_from([2, 5]))
    def fails(self, servo, bit):
        self.rig.port.device.servo(servo).fail(1 << bit, self.rig.clock.t)

    @rule(servo=IDS)
    def torque_is_taken(self, servo):
        device = self.rig.port.device.servo(servo)
        torque = device.table.role("torque_enable")
        device.write(torque.address, torque.to_bytes(0), self.rig.clock.t)

    @invariant()
    def polls_keep_their_budget(self):
        if hasattr(self, "rig") and self.rig.polls_s:
            assert max(self.rig.polls_s) <= self.rig.bus._poll.budget_s + 0.002

    def teardown(self):
        """What is limp is seen limp once the wire is well, and stop releases all."""
        if not hasattr(self, "rig"):
            return
        self.wire_mends()
        for _ in range(150):
            self.rig.tick(self.goals)
        for member in self.rig.bus._members:
            if member.state in ("limp", "given up"):
                assert member.torque_seen is False and self.rig.torques()[member.index] == 0
        self.rig.bus.stop("release")
        assert self.rig.torques() == [0] * COUNT


@pytest.mark.parametrize("family", ["dynamixel2", "dynamixel1", "sts"])
def test_no_order_of_troubles_breaks_a_promise(family):
    machine = type("Troubles", (Troubles,), {"family": family})
    quick = settings(max_examples=12, stateful_step_count=15, deadline=None, suppress_health_check=list(HealthCheck))
    run_state_machine_as_test(machine, settings=quick)
