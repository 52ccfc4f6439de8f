from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.servo.chain.roster import LONGEST_PAUSE_S, QUIET_POLLS, Roster


def test_servo_where_answers_stop_leaves_the_list_at_once():
    roster = Roster([5, 6, 7])
    assert roster.blame(True, gaps=[6], missed=[], now_s=0.0) == [6]
    assert roster.listed == [5, 7] and roster.silent == [6]


def test_one_lost_answer_is_forgiven():
    roster = Roster([5, 6])
    assert roster.blame(True, [], missed=[5], now_s=0.0) == []
    roster.answered(5)
    assert roster.blame(True, [], missed=[5], now_s=0.0) == []
    assert roster.blame(True, [], missed=[5], now_s=0.0) == [5]


def test_wire_without_any_answer_is_blamed_before_its_servos():
    roster = Roster([5, 6])
    for _ in range(QUIET_POLLS - 1):
        assert roster.blame(False, gaps=[5], missed=[], now_s=0.0) == []
    assert roster.blame(False, gaps=[5], missed=[], now_s=0.0) == [5, 6]  # then the supply may be gone: all of them


def test_when_one_is_back_the_others_are_asked_at_once():
    roster = Roster([5, 6])
    roster.suspect_all(0.0)
    for _ in range(8):
        for servo in (5, 6):
            roster.probe_failed(servo, 0.0)
    assert roster.due(0.5) is None
    roster.answered(5)
    roster.hurry(0.5)
    assert roster.due(0.5) == 6


@given(st.floats(0, 1000))
def test_probes_of_a_dead_servo_become_rare_and_never_stop(start_s):
    roster = Roster([5])
    roster.blame(True, [5], [], start_s)
    times = [start_s + 0.01 * k for k in range(2000)]
    probes = []
    for t in times:
        if (servo := roster.due(t)) is not None:
            probes.append(t)
            roster.probe_failed(servo, t)
    gaps = [b - a for a, b in zip(probes, probes[1:], strict=False)]
    assert 15 < len(probes) < 30
    assert gaps[0] < 0.2 and LONGEST_PAUSE_S - 0.02 <= gaps[-1] <= LONGEST_PAUSE_S + 0.02


def test_servo_that_answers_is_asked_with_the_others_again():
    roster = Roster([5, 6])
    roster.blame(True, [5], [], 0.0)
    assert roster.due(0.01) is None and roster.due(1.0) == 5
    roster.answered(5)
    assert roster.listed == [5, 6] and roster.due(9.0) is None
