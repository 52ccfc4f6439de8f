"""What a listener lacks is found again: patterns, their sizes and their spectra, of stretches in which a face rests."""

from dataclasses import replace

import numpy as np
import pytest

from sfms_robot.frames import BLENDSHAPES, FRAME_HZ, FRAME_SAMPLES, MOTION_DIM, SHAPES, ListenerEvent
from sfms_robot.lab.learning.idle_fit import fit_idle, resting
from sfms_robot.listeners.idle import IDLE_BANDS, KNOTS, IdleMotion

SMILES = [BLENDSHAPES.index(f"mouthSmile{side}") for side in ("Left", "Right")]
FROWN = BLENDSHAPES.index("mouthFrownLeft")
HELD = np.repeat(np.linspace(0.3, 0.7, KNOTS, dtype=np.float32)[:, None], len(BLENDSHAPES), axis=1)


def explained(idle):
    """(52,) deviation of every channel that it adds."""
    return np.sqrt((idle.loadings.astype(np.float64) ** 2).sum(0))


def learned():
    """Both corners together, mostly slowly, and a frown, faster."""
    loadings = np.zeros((2, len(BLENDSHAPES)), np.float32)
    loadings[0, SMILES] = 0.03
    loadings[1, FROWN] = 0.02
    amplitude = np.zeros((IDLE_BANDS, 2), np.float32)
    amplitude[:3, 0] = amplitude[2:5, 1] = 3**-0.5
    return IdleMotion(loadings, amplitude, 0.0, HELD, HELD)


def people(idle, count=16, frames=3000):
    times_s = 5 + (np.arange(frames) + 1) / FRAME_HZ
    still = np.full((frames, MOTION_DIM), 0.5, np.float32)
    return [resting(still if idle is None else idle.start(seed).added(still, times_s), ()) for seed in range(count)]


def test_what_is_lacking_is_found_again():
    found = fit_idle(people(learned()), people(None))
    assert len(found.loadings) == 2
    added = explained(found)
    np.testing.assert_allclose(added[SMILES], 0.03, rtol=0.15)
    assert added[FROWN] == pytest.approx(0.02, rel=0.15) and added.sum() == pytest.approx(0.08, rel=0.15)
    assert np.square(found.amplitude[:3, 0]).sum() > 0.85 < np.square(found.amplitude[1:6, 1]).sum()


def test_what_a_listener_shows_already_is_not_added_twice():
    half = replace(learned(), loadings=learned().loadings * 0.5**0.5)
    added = explained(fit_idle(people(learned()), people(half)))
    np.testing.assert_allclose(added[SMILES], 0.03 * 0.5**0.5, rtol=0.2)
    assert explained(fit_idle(people(half), people(learned()))).max() < 0.005


def test_where_people_rest_elsewhere_and_how_unevenly_is_shown():
    """People whose muscles are slack a third of the time, and a listener that rests somewhere else, as bells do."""
    elsewhere = replace(learned(), shown=HELD + np.linspace(-0.1, 0.1, len(BLENDSHAPES), dtype=np.float32))
    slack = [np.maximum(one, 0.5).astype(np.float32) for one in people(learned())]
    found = fit_idle(slack, people(elsewhere))
    shown = [with_idle(found, seed, one) for seed, one in enumerate(people(elsewhere))]
    for channel in (*SMILES, FROWN):
        ours, theirs = (np.concatenate([one for one in faces])[..., channel] for faces in (shown, slack))
        np.testing.assert_allclose(*(np.quantile(one, [0.1, 0.3, 0.5, 0.8, 0.95]) for one in (ours, theirs)), 0, 0.006)
    looks = np.array([name.startswith("eyeLook") for name in BLENDSHAPES])
    np.testing.assert_array_equal(found.shown[:, looks], found.held[:, looks])


def with_idle(idle, seed, windows):
    motion = np.zeros((windows[..., 0].size, MOTION_DIM), np.float32)
    motion[:, SHAPES] = windows.reshape(-1, len(BLENDSHAPES))
    return idle.start(seed).added(motion, 5 + np.arange(len(motion)) / FRAME_HZ)[:, SHAPES].reshape(windows.shape)


def test_slow_motion_is_not_taken_for_faster_motion_nor_for_less_than_it_is():
    """Two seconds show a third of what drifts in five as motion within them."""
    slow = replace(learned(), amplitude=np.eye(IDLE_BANDS, 1, dtype=np.float32) * np.ones(2, np.float32))
    found = fit_idle(people(slow), people(None))
    np.testing.assert_allclose(explained(found)[[*SMILES, FROWN]], [0.03, 0.03, 0.02], rtol=0.2)
    assert np.square(found.amplitude[0]).min() > 0.85


def test_people_who_rest_apart_differ_slowly_and_without_rest_nothing_is_learned():
    still = [np.full((9, 50, 52), 0.5 + off, np.float32) for off in (-0.03, 0.03)]
    found = fit_idle(still, people(None))
    assert explained(found)[FROWN] > 0.02 and np.square(found.amplitude[0]).min() > 0.99
    with pytest.raises(ValueError, match="rests"):
        fit_idle([resting(np.zeros((20, MOTION_DIM), np.float32), ())], people(None, 1))


def test_a_face_that_smiles_blinks_or_talks_does_not_rest():
    frames = 20 * FRAME_HZ
    motion, said = np.zeros((frames, MOTION_DIM), np.float32), np.zeros(frames * FRAME_SAMPLES, np.float32)
    said[12 * FRAME_HZ * FRAME_SAMPLES : 13 * FRAME_HZ * FRAME_SAMPLES] = 0.1
    motion[5 * FRAME_HZ : 6 * FRAME_HZ, SHAPES] = 1.0
    motion[12 * FRAME_HZ : 13 * FRAME_HZ, SHAPES] = 1.0
    found = resting(motion, [ListenerEvent("smile", 5.0, 1.0, 0.5), ListenerEvent("nod", 8.0, 1.0, 0.1)], said)
    assert len(found) == 7 and not found.any()
