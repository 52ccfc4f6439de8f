"""What is said of servos that come and go."""

import logging

import pytest

from sfms_robot.servo.policy import SAID_EVERY_S, Absences


@pytest.fixture
def said(caplog):
    caplog.set_level(logging.WARNING)
    return lambda: [record.getMessage() for record in caplog.records]


def test_who_goes_and_comes_back_is_said(said):
    absences = Absences(["jaw (id 4)"])
    absences.gone(0, 1.0)
    absences.gone(0, 1.1, again=False)
    absences.back(0)
    assert said() == ["jaw (id 4) is silent", "jaw (id 4) answers again"]


def test_a_loose_contact_is_said_once_in_ten_seconds_with_a_count(said):
    absences = Absences(["jaw (id 4)", "brow (id 5)"])
    for tick in range(200):
        absences.gone(0, tick * 0.1)
        absences.back(0)
    assert said() == [
        "jaw (id 4) is silent",
        "jaw (id 4) answers again",
        "jaw (id 4) is silent (99 times since the last word)",
        "jaw (id 4) answers again",
    ]
    absences.gone(1, 19.95)
    assert said()[-1] == "brow (id 5) is silent"


def test_who_stays_away_in_the_quiet_time_is_said_when_it_is_over(said):
    absences = Absences(["jaw (id 4)"])
    absences.gone(0, 0.0)
    absences.back(0)
    absences.gone(0, 1.0)
    for now_s in (2.0, 9.9):
        absences.gone(0, now_s, again=False)
    assert len(said()) == 2
    absences.gone(0, SAID_EVERY_S, again=False)
    assert said()[-1] == "jaw (id 4) is silent (1 times since the last word)"
