"""Cutting motion primitives: a swing is cut whole, a resting face is zero, and saved pieces are loaded."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, FRAME_HZ
from sfms_robot.lab.corpora.clips import SPLITS, read_takes
from sfms_robot.lab.corpora.compose.motions import slow
from sfms_robot.lab.corpora.compose.voices import facegood_mouth
from sfms_robot.signals.motion_primitives import KINDS, read_motions
from sfms_robot.signals.tracks import Take

TAKE = {"train": "yes1", "validation": "apfel", "test": "facial"}
cut = runpy.run_path(str(Path(__file__).parents[3] / "scripts" / "cut_recordings.py"))


def test_every_swing_is_cut_and_normalised_slow_motion_kept_and_a_resting_face_zero():
    times = np.arange(10 * FRAME_HZ) / FRAME_HZ
    found = cut["cycles"](np.deg2rad(4) * (0.5 - 0.5 * np.cos(2 * np.pi * 2 * times)), FRAME_HZ)
    assert 16 <= len(found) <= 20
    for cycle in found:
        assert cycle[0] == cycle[-1] == 0 and cycle.max() == pytest.approx(1)
    assert cut["cycles"](np.full(250, 0.1), FRAME_HZ) == []
    times = np.arange(40 * FRAME_HZ) / FRAME_HZ
    drift, tremor = np.sin(2 * np.pi * 0.1 * times), np.sin(2 * np.pi * 4 * times)
    kept = slow(np.stack([drift, tremor], axis=1))[100:-100]
    assert np.ptp(kept[:, 0]) == pytest.approx(2, abs=0.1) and np.ptp(kept[:, 1]) < 0.05
    face = np.full((40, len(BLENDSHAPES)), 0.3, np.float32)
    face[10:20] = np.nan
    assert not cut["neutral"](face, 50).any()


def test_saved_pieces_are_loaded_in_their_split(tmp_path):
    rng, save, file = np.random.default_rng(0), cut["save_primitives"], tmp_path / "motions.npz"
    named = [(kind, TAKE[split], rng.uniform(0, 1, (5, 52))) for split in SPLITS for kind in KINDS]
    save(file, named)
    loaded = read_motions(file)
    for (kind, _, array), split in zip(named, np.repeat(SPLITS, len(KINDS)), strict=True):
        np.testing.assert_allclose(getattr(loaded[split], kind)[0], array, atol=6e-4)
    save(file, [("nods", "yes1", np.zeros(24, np.float32))])
    with pytest.raises(ConfigError, match="no shakes for train"):
        read_motions(file)
    take = Take("one", rng.uniform(0, 1, (90, 58)).astype(np.float32))
    cut["save_takes"](tmp_path / "t.npz", [("train", take), ("held_out", take), ("held_out", take)])
    found = read_takes(tmp_path / "t.npz")
    assert len(found["train"]) == 1 and len(found["held_out"]) == 2
    np.testing.assert_allclose(found["train"][0].motion, take.motion, atol=1.1e-4)


def test_rig_weights_become_arkit_channels_at_25_fps(tmp_path):
    names = np.array(["mouth_stretch_c", "mouth_oh_c", "mouth_lipCornerPull_l", "tooth_d_d"])
    weights = np.tile(np.float32([0.5, 0.8, 0.3, 1.0]), (61, 1))
    np.savez(tmp_path / "take.npz", weights=weights, names=names, fps=30.0)
    mouth = facegood_mouth(tmp_path / "take.npz")
    moving = {name: mouth[0, index] for index, name in enumerate(BLENDSHAPES) if mouth[0, index]}
    assert len(mouth) == 50
    assert moving == pytest.approx({"jawOpen": 0.5, "mouthPucker": 0.4, "mouthSmileLeft": 0.3})
