"""The head looks at the person, and away as people do."""

import math
from dataclasses import replace

import numpy as np
import pytest
from life_rig import FULL_RAD, TICK_S, gaze_deg, head_deg, lived, still

from sfms_robot.config import CameraMount, Gaze, Life, Person
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S
from sfms_robot.ports import Watched
from sfms_robot.retarget.gaze import HeadTurn
from sfms_robot.signals.gaze_kinematics import direction_to, turn
from sfms_robot.signals.rotations import rotation

BASE = CameraMount(on="base")
HERE = (1.2, 0.0, 0.0)
STEADY = Person(look_away=0)
EYES = Gaze()
COARSE_S = 0.02  # of ticks of ten minutes


def aimed(watched, seconds, person=STEADY, gaze=EYES, camera=BASE, listener=still, tick_s=TICK_S) -> np.ndarray:
    return lived(Life(gaze=gaze, person=person), seconds, listener, watched, camera=camera, tick_s=tick_s)


def at(place_m):
    """Seen 25 times a second at a place, or at a function of time."""

    def watched(t, shown):
        seen_s = math.floor(t / FRAME_S + 1e-6) * FRAME_S
        where = place_m(seen_s) if callable(place_m) else place_m
        return Watched(seen_s=seen_s, place_m=None if where is None else np.array(where, np.float32))

    return watched


def beside(yaw_deg, metres=1.2):
    return (metres * math.cos(math.radians(yaw_deg)), metres * math.sin(math.radians(yaw_deg)), 0.0)


def test_eyes_go_to_the_person_first_and_the_head_follows():
    shown = aimed(at(lambda t: HERE if t < 1 else beside(30)), 4.0)[:, 0]
    gaze, head = gaze_deg(shown)[:, 0], head_deg(shown)[:, 0]
    eyes_there, head_half = np.argmax(gaze > 29) * TICK_S, np.argmax(head > 9) * TICK_S
    assert 1.15 < eyes_there < 1.5  # as long as people take
    assert 0.15 < head_half - eyes_there < 0.6
    assert gaze[-1] == pytest.approx(30, abs=0.1) and head[-1] == pytest.approx(18, abs=0.1)
    assert np.abs(gaze[round(eyes_there / TICK_S) + 2 :] - 30).max() < 0.2  # the eyes give back what the head brings
    assert head.max() < 18.1  # and it does not overshoot


@pytest.mark.slow
def test_noise_of_a_tracker_moves_nothing():
    noise_m = np.random.default_rng(0).normal(0, 0.02, (3000, 3))
    shown = aimed(at(lambda t: beside(20) + noise_m[round(t / FRAME_S)]), 90.0)[300:]
    assert np.ptp(gaze_deg(shown), axis=(0, 1)).max() < 1e-3
    assert np.ptp(head_deg(shown[200:]), axis=(0, 1)).max() < 1e-3


def test_a_nod_of_the_listener_stays_a_nod():
    def nod(t):
        row = still(t)
        row[CHANNEL_INDEX["pitch"]] = math.radians(6) * math.sin(2 * math.pi * 1.5 * t)
        return row

    shown = aimed(at(beside(25)), 6.0, listener=nod)[300:]
    assert np.ptp(head_deg(shown)[:, 0, 1]) == pytest.approx(12, abs=0.05)
    assert np.ptp(gaze_deg(shown), axis=(0, 1)).max() < 0.01  # at the person all the while


def test_who_walks_is_followed():
    shown = aimed(at(lambda t: beside(min(10 * t, 40))), 6.0)[:, 0]
    t = TICK_S * np.arange(len(shown))
    behind = np.minimum(10 * t, 40) - gaze_deg(shown)[:, 0]
    assert np.abs(behind[100:]).max() < 7 and abs(behind[-1]) < 3


def test_no_joint_jumps_whatever_its_lead():
    yaws = np.random.default_rng(2).uniform(-40, 40, 40)
    shown = aimed(at(lambda t: beside(yaws[int(t / 0.7)])), 20.0, person=Person(look_away=2))
    assert np.abs(np.diff(gaze_deg(shown), axis=0)).max() / TICK_S < 1000  # a saccade of 80 degrees
    head = head_deg(shown)
    assert np.abs(np.diff(head, axis=0)).max() / TICK_S < 200
    assert np.abs(np.diff(head, 2, axis=0)).max() / TICK_S**2 < 3000


def test_the_head_goes_back_slowly_when_the_person_has_gone_looks_around_and_finds_them_again():
    def watched(t, shown):
        return at(beside(30))(min(t, 3.0) if t < 30 else t, shown)

    shown = aimed(watched, 34.0)[:, 0]
    gaze, head = gaze_deg(shown)[:, 0], head_deg(shown)[:, 0]
    assert gaze[400] == pytest.approx(30, abs=0.1)  # a second without a face is nothing
    assert abs(head[700]) < 12
    assert gaze[-1] == pytest.approx(30, abs=0.1)


def test_nobody_left_is_looked_for():
    shown = aimed(lambda t, shown: Watched(seen_s=min(t, 1.0)), 60.0, person=Person())[:, 0]
    assert np.ptp(gaze_deg(shown[:300])[:, 0]) < 1 and np.ptp(head_deg(shown[400:])[:, 0]) > 10


def test_without_a_face_a_camera_or_the_section_nothing_is_aimed_at():
    for watched, camera in ((lambda t, shown: Watched(), BASE), (at(beside(30)), None)):
        assert not aimed(watched, 5.0, camera=camera).any()
    assert not aimed(at(beside(30)), 2.0, person=None).any()


def test_a_camera_on_the_head_sees_one_person_while_the_neck_turns():
    """The sighting is a tenth of a second old, and the neck has turned since."""
    mount, person_m = CameraMount(on="head", at_m=(0.05, 0, 0.04)), np.array(beside(35))

    def watched(t, shown):
        seen_s = math.floor((t - 0.1) / FRAME_S + 1e-6) * FRAME_S
        if seen_s < 0:
            return Watched()
        pose = shown[round(seen_s / TICK_S)][0, :6].astype(float)
        return Watched(seen_s=seen_s, place_m=(person_m - pose[3:]) @ rotation(pose[:3]) - mount.at_m)

    gaze = gaze_deg(aimed(watched, 4.0, camera=mount)[:, 0])
    assert gaze[-1] == pytest.approx(np.degrees(direction_to(person_m)), abs=0.1)
    moving = np.abs(np.diff(gaze[:, 0])) > 0.01
    assert np.count_nonzero(moving[1:] & ~moving[:-1]) == 1  # one jump


def test_what_is_asked_by_hand_is_not_moved_aside():
    def point(t):
        row = still(t)
        turn(row, np.radians([[-10.0, 0.0]] * 2), FULL_RAD)
        return row

    def watched(t, shown):
        return replace(at(beside(30))(t, shown), by_hand=t > 2)

    shown = aimed(watched, 5.0, person=Person(look_away=2), listener=lambda t: point(t) if t > 2 else still(t))
    assert gaze_deg(shown)[-100:] == pytest.approx(np.full((100, 3, 2), [-10.0, 0.0]), abs=0.05)


def test_a_head_without_eyes_turns_all_the_way_and_one_without_a_neck_not_at_all():
    assert head_deg(aimed(at(beside(30)), 4.0, gaze=None))[-1, 0, 0] == pytest.approx(30, abs=0.1)
    shown = aimed(at(beside(20)), 4.0, gaze=Gaze(neck_gain=0))
    assert not head_deg(shown).any() and gaze_deg(shown)[-1, 0, 0] == pytest.approx(20, abs=0.1)


def test_a_turn_goes_on_at_the_speed_that_it_has():
    before = HeadTurn(np.zeros((3, 2)), np.array([0.5, 0.1]), 0.0, 9.0)
    after = before.to(np.array([-0.3, 0.0]), 0.2, 9.0)
    times_s = np.linspace(0.2, 2.0, 1801)
    assert after.states(times_s)[0] == pytest.approx(before.states(times_s)[0])
    angle, speed, acceleration = np.moveaxis(after.states(times_s), 1, 0)
    assert after.at(times_s) == pytest.approx(angle)
    assert np.gradient(angle, times_s, axis=0)[1:-1] == pytest.approx(speed[1:-1], abs=1e-3)
    assert np.gradient(speed, times_s, axis=0)[1:-1] == pytest.approx(acceleration[1:-1], abs=1e-2)
    assert after.at(np.array([5.0]))[0] == pytest.approx([-0.3, 0.0], abs=1e-6)


def looks(gaze: np.ndarray) -> tuple[float, float, float]:
    """Share within 5 degrees of straight ahead, shifts of 5 degrees or more a minute, mean seconds away."""
    away = np.hypot(*gaze.T) > 5
    moved = np.hypot(*(gaze[5:] - gaze[:-5]).T) >= 5
    minutes, out = len(gaze) * COARSE_S / 60, np.count_nonzero(away[1:] & ~away[:-1])
    return 1 - away.mean(), np.count_nonzero(moved[1:] & ~moved[:-1]) / minutes, away.mean() * 60 * minutes / out


@pytest.mark.slow
@pytest.mark.parametrize(("said", "share", "shifts"), [(False, (0.92, 0.98), (4, 11)), (True, (0.5, 0.7), (38, 58))])
def test_ten_minutes_of_looking_away_are_those_of_people(said, share, shifts):
    """Medians of 14 people: 95 % and 60 % within 5 degrees, 7 and 49 shifts a minute."""
    shown = aimed(lambda t, shown: Watched(said_s=t if said else -1.0), 600.0, person=Person(), tick_s=COARSE_S)
    gaze = gaze_deg(shown[:, 0])
    at_person, shifts_per_minute, away_s = looks(gaze)
    assert share[0] < at_person < share[1]
    assert shifts[0] < shifts_per_minute < shifts[1]
    assert 0.6 < away_s < 1.4


@pytest.mark.slow
def test_a_listener_that_looks_aside_often_enough_is_left_alone():
    def aside(t):
        row = still(t)
        turn(row, np.radians([[10.0 if t % 10 < 0.8 else 0.0, 0.0]] * 2), FULL_RAD)
        return row

    person = aimed(lambda t, shown: Watched(), 120.0, person=Person(), listener=aside)
    nobody = aimed(lambda t, shown: Watched(), 120.0, person=STEADY, listener=aside)
    assert np.array_equal(person, nobody)
