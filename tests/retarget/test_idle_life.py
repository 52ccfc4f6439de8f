"""Idle motion fills in what a listener leaves out, and only that."""

import math

import numpy as np
import pytest
from life_rig import LEADS_S, NOBODY, PITCH, YAW, lived, still

from sfms_robot.config import Idle, Life
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM
from sfms_robot.retarget import spontaneous
from sfms_robot.retarget.spontaneous import CLOSED_S, CLOSING_S, OPENING_S

TICK_S = 0.02
BLINK = CHANNEL_INDEX["eyeBlinkLeft"]


def idled(listener, seconds: float, seed: int = 0, **idle) -> np.ndarray:
    return lived(Life(idle=Idle(**idle)), seconds, listener, seed=seed, tick_s=TICK_S)


def blinking(every_s: float):
    def listener(t: float) -> np.ndarray:
        row = still(t)
        row[BLINK : BLINK + 2] = 1.0 if t % every_s > every_s - 0.15 else 0.0
        return row

    return listener


def blinks(shown) -> int:
    closed = shown[:, 0, BLINK] > 0.5
    return int((np.diff(closed.astype(int)) == 1).sum())


def test_with_everything_left_out_or_at_zero_the_face_is_the_same_and_the_input_never_changes():
    alive = spontaneous.HeadLife(Life(), seed=0)
    motion = np.random.default_rng(0).uniform(0, 1, (3, MOTION_DIM)).astype(np.float32)
    assert alive.step(motion, LEADS_S, 0.0, spontaneous.LifeState(), np.asarray, NOBODY)[0] is motion
    motion = np.random.default_rng(0).uniform(0, 1, MOTION_DIM).astype(np.float32)
    shown = idled(lambda t: motion, 10.0, blinks_per_minute=0, head_deg=0, glance_deg=0)
    others = [i for i in range(MOTION_DIM) if not 16 <= i < 24]  # eye channels that pull both ways are evened out
    assert np.array_equal(shown[..., others], np.broadcast_to(motion[others], shown[..., others].shape))
    motion = still(0)[None].repeat(3, axis=0)
    alive = spontaneous.HeadLife(Life(idle=Idle()), seed=0)
    state = spontaneous.LifeState()
    for now_s in np.arange(0, 20, TICK_S):
        _, state = alive.step(motion, now_s + LEADS_S, now_s, state, np.asarray, NOBODY)
    assert not motion.any()


@pytest.mark.parametrize("every_s", [1.0, 2.5, 60 / 14])
def test_a_listener_that_blinks_enough_gets_no_blink_added(every_s):
    listener = blinking(every_s)
    shown = idled(listener, 60.0, head_deg=0, glance_deg=0)
    wanted = np.array([[listener(k * TICK_S + lead) for lead in LEADS_S] for k in range(len(shown))])
    assert np.array_equal(shown[..., BLINK], wanted[..., BLINK])


def test_a_listener_that_never_blinks_gets_the_wanted_rate_until_it_begins_to_blink():
    assert 10 < blinks(idled(still, 210.0)[1500:]) / 3.0 < 18

    def late(t: float) -> np.ndarray:
        return blinking(3.0)(t) if t > 60 else still(t)

    shown = idled(late, 120.0)
    assert blinks(shown[: round(60 / TICK_S)]) > 5
    assert blinks(shown[round(75 / TICK_S) :]) == pytest.approx(45 / 3, abs=1)


def test_a_blink_closes_in_the_time_it_takes_people_and_never_jumps():
    shown = idled(still, 60.0, head_deg=0, glance_deg=0)[..., BLINK]
    assert shown.max() == 1.0 and np.abs(np.diff(shown, axis=0)).max() < 1.9 * TICK_S / CLOSING_S
    length = np.argmax(shown[np.argmax(shown[:, 0] > 0) :, 0] == 0) * TICK_S
    assert length == pytest.approx(CLOSING_S + CLOSED_S + OPENING_S, abs=2 * TICK_S)


def test_the_head_sways_while_the_listener_is_still_and_stops_when_it_moves():
    def nods_from_20_s(t: float) -> np.ndarray:
        row = still(t)
        row[PITCH] = 0.1 * math.sin(2 * math.pi * t) if t > 20 else 0.0
        return row

    shown = np.degrees(idled(nods_from_20_s, 30.0, head_deg=1.2)[:, 0, : YAW + 1])
    before, after = shown[: round(20 / TICK_S)], shown[round(22 / TICK_S) :]
    assert 0.3 < np.abs(before[:, YAW]).max() <= 1.2 and np.abs(before[:, PITCH]).max() <= 0.8
    assert np.abs(after[:, YAW]).max() < 1e-3
    assert np.abs(np.diff(shown[:, YAW])).max() / TICK_S < 3  # deg/s


def test_eyes_glance_about_only_when_the_listener_gives_no_gaze():
    eyes = slice(CHANNEL_INDEX["eyeLookDownLeft"], CHANNEL_INDEX["eyeLookUpRight"] + 1)

    def wandering(t: float) -> np.ndarray:
        row = still(t)
        row[CHANNEL_INDEX["eyeLookOutLeft"]] = row[CHANNEL_INDEX["eyeLookInRight"]] = 0.5 + 0.4 * math.sin(3 * t)
        return row

    assert 0 < idled(still, 20.0)[..., eyes].max() <= 3.0 / 20 + 1e-6
    shown = idled(wandering, 20.0, fade_s=4.0)
    wanted = np.array([[wandering(k * TICK_S + lead) for lead in LEADS_S] for k in range(len(shown))])
    assert shown[..., eyes] == pytest.approx(wanted[..., eyes], abs=0.01)


def test_one_seed_gives_one_life_and_another_seed_another():
    once, again, other = (idled(still, 30.0, seed) for seed in (7, 7, 8))
    assert np.array_equal(once, again) and not np.array_equal(once, other)
