"""Faults on every family: a few of them on two families, and the whole campaign marked slow."""

from dataclasses import replace

import numpy as np
import pytest

from sfms_robot.emulator.faults import KINDS
from sfms_robot.errors import ConfigError
from sfms_robot.lab.bench import campaign
from sfms_robot.lab.bench.campaign_rig import FAMILIES, Judge, head_of, plugged_in

BOARDS = ("maestro", "maestro-crc", "ssc32")
UNCHECKED = ("maestro", "ssc32")
IMPOSSIBLE = {(case, board) for case in (campaign.STORED, campaign.MANY_TURNS) for board in BOARDS} | {
    (campaign.MANY_TURNS, family) for family in ("dynamixel1", "scs")
}
EVERY_RUN = ("dynamixel2", "maestro")  # families of `make test`
SOME = [each if each in EVERY_RUN else pytest.param(each, marks=pytest.mark.slow) for each in FAMILIES]
SHORT = ("drop", "corrupt", "silent", "brownout", "hangup", "request-drop", "request-delay")


@pytest.fixture
def rig():
    with plugged_in(head_of("dynamixel2")) as rig:
        rig.hold()
        yield rig


def test_every_kind_of_fault_is_tried():
    assert set(campaign.SPECS) == set(KINDS) < set(campaign.CASES)


def test_unknown_family_is_named():
    with pytest.raises(ConfigError, match="'hitec' is not a family"):
        head_of("hitec")


@pytest.mark.parametrize("family", EVERY_RUN)
@pytest.mark.parametrize("case", ["a fault", campaign.OUTSIDE, campaign.HALF_DEAD, campaign.MUTE_AT_STOP])
def test_nothing_escapes_and_everybody_comes_back(family, case):
    fault = SHORT[list(FAMILIES).index(family) % len(SHORT)] if case == "a fault" else case
    outcome = campaign.one(family, fault, ticks=300)
    assert outcome.possible and outcome.passed and outcome.refused is None, outcome


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("case", [campaign.STORED, campaign.MANY_TURNS])
def test_servos_that_contradict_the_heads_file_are_refused_or_mended(family, case):
    outcome = campaign.one(family, case, ticks=200)
    assert outcome.passed, outcome
    assert outcome.possible == ((case, family) not in IMPOSSIBLE)
    if case == campaign.STORED and outcome.refused is not None:
        assert "limit" in outcome.refused


@pytest.mark.parametrize("family", SOME)
def test_corrupted_byte_moves_no_servo_out_of_its_limits_where_packets_have_a_checksum(family):
    outcome = campaign.one(family, campaign.CORRUPT, ticks=500)
    [(name, said)] = campaign.corrupted_bytes([outcome]).items()
    assert outcome.passed and name == family, outcome
    if family in UNCHECKED:
        assert outcome.outside > 0 and said["checksum"] == "no checksum"
        shortest_us, longest_us = (992, 2000) if family == "maestro" else (500, 2500)  # what the board itself allows
        assert shortest_us <= outcome.pulse_us[0] <= outcome.pulse_us[1] <= longest_us
    else:
        assert outcome.outside == 0 and said["goals"] == "0 outside limits"


def test_a_servo_that_stays_out_says_why():
    outcome = campaign.one("sts", "voltage", ticks=200)
    assert len(outcome.named) == 4 and all("input voltage" in each for each in outcome.named) and outcome.passed


def test_same_campaign_has_the_same_outcome():
    assert campaign.one("dynamixel2", "noise", ticks=60) == campaign.one("dynamixel2", "noise", ticks=60)


def test_old_position_told_as_fresh_is_noticed(rig):
    judge, told = Judge(rig), []
    for _ in range(100):
        told.append(rig.tick())
        judge.see({name: replace(r, position_rad=told[-10:][0][name].position_rad) for name, r in told[-1].items()})
    assert judge.stale > 0


def test_bad_goal_that_is_taken_is_noticed(rig):
    class TakesAnything:
        def write(self, goals_rad, now_s):
            return None

    rig.tick()
    rig.try_bad_goals(withheld=False)
    rig.bus = TakesAnything()
    with pytest.raises(AssertionError, match="a goal of nan rad is not refused"):
        rig.try_bad_goals(withheld=False)


def test_joint_that_does_not_follow_is_noticed(rig):
    judge = Judge(rig)
    for _ in range(60):
        judge.see(rig.tick())
    assert judge.well_since_s is not None
    rig.goals = rig.goals + np.array([0.0, 0.5, 0.0, 0.0])
    judge.see(rig.bus.poll(rig.clock.now_s()))
    assert judge.well_since_s is None


AMISS = {"escaped": "BusError: gone", "outside": 1, "stale": 1, "recovered_s": None, "left_on": 1}
AMISS |= {"named": ["joint1: torque lost"], "refused": "min_position_limit is 1900"}


@pytest.mark.parametrize(("name", "value"), [*AMISS.items(), ("recovered_s", 2.5)])
def test_anything_amiss_fails(name, value):
    fine = campaign.CaseOutcome(family="sts", case="drop", recovered_s=0.1)
    assert fine.passed and not replace(fine, **{name: value}).passed


@pytest.mark.parametrize("family", FAMILIES)
def test_goal_outside_limits_is_stated_and_no_failure_only_for_corrupted_bytes_without_a_checksum(family):
    outcome = campaign.CaseOutcome(family=family, case=campaign.CORRUPT, recovered_s=0.1, outside=1)
    assert outcome.passed == (family in UNCHECKED) and not replace(outcome, case="drop").passed


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_whole_campaign(family):
    """All but the cases that are tried on every family above."""
    ticks = 1000 if family.startswith("maestro") else 500  # a board that fails is reported later
    others = [case for case in campaign.CASES if case not in (campaign.STORED, campaign.MANY_TURNS, campaign.CORRUPT)]
    assert not [outcome for case in others if not (outcome := campaign.one(family, case, ticks)).passed]
