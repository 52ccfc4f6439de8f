"""The hair of the virtual head in pictures."""

import numpy as np
import pytest
from motion_rows import motion

from sfms_robot.face.human import load_human, with_hair
from sfms_robot.frames import BLENDSHAPES

BALD = load_human()
HEAD = with_hair(BALD)
COUNT = len(BALD.rest)


def moved(**channels):
    return HEAD.vertices(motion(**channels)) - HEAD.rest


def test_the_head_itself_stays_what_it_was():
    asked = motion(pitch=0.2, jawOpen=0.7)
    np.testing.assert_array_equal(HEAD.vertices(asked)[:COUNT], BALD.vertices(asked))
    assert HEAD.triangles.max() < len(HEAD.rest) == len(HEAD.colors) == len(HEAD.share)


@pytest.mark.parametrize("channel", BLENDSHAPES)
def test_no_morph_moves_hair(channel):
    assert np.abs(moved(**{channel: 1.0})[COUNT:]).max() == 0.0


def test_hair_covers_the_top_of_the_skull_and_nods_with_it():
    shown = np.unique(HEAD.triangles[(HEAD.triangles >= COUNT).all(axis=1)])
    assert HEAD.rest[shown, 2].max() > BALD.rest[:, 2].max() + 0.005
    top = HEAD.rest[:, 2] > 0.10
    assert (np.linalg.norm(moved(pitch=0.3)[top], axis=1) > 0.02).all()


def test_no_hair_comes_out_of_the_neck():
    neck = (HEAD.rest[:, 2] > -0.09) & (HEAD.rest[:, 2] < -0.045) & (HEAD.rest[:, 0] > 0.0)
    hair = HEAD.triangles[(HEAD.triangles >= COUNT).all(axis=1)]
    assert not neck[hair].any()
