"""Nods, smiles and laughs are seen as they come, and lying faces show few of them."""

import numpy as np
import pytest

from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, MOTION_DIM, FaceFrame
from sfms_robot.listeners.events.evidence import FaceState, read_signs

SECONDS = 60
FRAMES = round(SECONDS / FRAME_S)
PITCH = CHANNEL_INDEX["pitch"]
CORNERS = [CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["mouthSmileRight"]]
JAW = CHANNEL_INDEX["jawOpen"]


def seen(motion):
    """Signs of motion (N, 58): nods, smiles, laughs (N,) each."""
    state, rows = FaceState(), []
    for index, row in enumerate(motion):
        signs, state = read_signs(FaceFrame.of((index + 1) * FRAME_S, row), state)
        rows.append((signs.nods, signs.smiles, signs.laughs))
    return np.array(rows).T


def still(frames=FRAMES):
    rng, motion = np.random.default_rng(0), np.zeros((frames, MOTION_DIM), np.float32)
    motion[:, PITCH] = np.radians(rng.normal(0, 0.2, frames))
    return motion


def nodding(at_s, deg=5.0, hz=2.0):
    motion, times = still(), np.arange(FRAMES) * FRAME_S
    for start in at_s:
        inside = (times >= start) & (times < start + 1 / hz)
        motion[inside, PITCH] += np.radians(deg) * np.sin(np.pi * hz * (times[inside] - start)) ** 2
    return motion


@pytest.mark.parametrize("deg", [4, 8, -6])
@pytest.mark.parametrize("offset", [0.0, np.pi, -1.0])
def test_each_nod_is_seen_once_as_it_ends(deg, offset):
    at_s = np.arange(5, 55, 5.0)
    motion = nodding(at_s, deg)
    motion[:, PITCH] = (motion[:, PITCH] + offset + np.pi) % (2 * np.pi) - np.pi
    found = np.flatnonzero(seen(motion)[0]) * FRAME_S
    assert len(found) == len(at_s) and (np.abs(found - at_s - 0.45) < 0.2).all()


def test_a_look_down_and_noise_are_no_nods():
    motion = still()
    motion[300:, PITCH] += np.radians(np.minimum(15, np.arange(FRAMES - 300) * 1.0))
    assert not seen(motion)[0].any()
    motion = np.random.default_rng(1).normal(0, 0.3, (FRAMES, MOTION_DIM)).astype(np.float32)
    assert seen(motion)[0].sum() <= 6


def test_a_head_that_swings_all_the_time_nods_where_it_stands_out():
    motion, times = nodding([30.0], deg=12.0, hz=1.5), np.arange(FRAMES) * FRAME_S
    motion[:, PITCH] += np.radians(1.5) * np.sin(2 * np.pi * 0.9 * times)
    found = np.flatnonzero(seen(motion)[0]) * FRAME_S
    assert found[found > 5] == pytest.approx([30.6], abs=0.4)


@pytest.mark.parametrize("level", [0.0, 1.0, -5.0, 100.0])
def test_a_stuck_face_shows_nothing(level):
    assert not seen(np.full((FRAMES, MOTION_DIM), level, np.float32)).any()


def test_what_is_not_finite_shows_nothing_and_is_forgotten():
    motion = nodding(np.arange(5, 55, 5.0))
    motion[::7] = np.nan
    assert not seen(motion)[0].any()


def test_a_smile_is_seen_while_it_lasts_is_a_laugh_over_a_moving_mouth_and_becomes_neutral_in_time():
    motion = still()
    motion[250:350, CORNERS] = 0.6
    smiles = seen(motion)[1]
    assert smiles[260:345].all() and not smiles[:250].any() and not smiles[360:].any()
    motion[250:, CORNERS] = 0.6
    assert not seen(motion)[1][-100:].any()
    motion = still()
    motion[250:350, CORNERS] = 0.7
    assert not seen(motion)[2].any()
    motion[250:350, JAW] = 0.15 + 0.15 * np.sin(2 * np.pi * 4.5 * np.arange(100) * FRAME_S)
    laughs = seen(motion)[2]
    assert laughs[270:345].mean() > 0.9 and not laughs[:250].any() and not laughs[380:].any()
