"""The virtual head: its laws, its hair, and the file of it that a browser reads."""

import lzma

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from motion_rows import motion

from sfms_robot.face import human
from sfms_robot.face.human import load_human
from sfms_robot.frames import BLENDSHAPES

BALD, HEAD = load_human(), load_human(hair=True)
FACTS, ARRAYS = human._read_arrays(lzma.decompress((human.FOLDER / "head.bin.xz").read_bytes()))
PARTS, PART = FACTS["parts"], ARRAYS["part"]
COUNT = FACTS["skinned"]  # vertices of the head itself; hair, collar and brows follow
REST = BALD.rest[:COUNT]
GROWN = np.flatnonzero(PART == PARTS.index("hair"))
HAIR = HEAD.triangles[np.isin(HEAD.triangles, GROWN[GROWN >= COUNT]).all(axis=1)]


def moved(head, **channels):
    return head.vertices(motion(**channels)) - head.rest


def test_the_head_looks_along_x_and_signs_of_the_pose_are_ours():
    left_lid = np.abs(BALD.deltas[BLENDSHAPES.index("eyeBlinkLeft")]).sum(axis=1)
    middle = (left_lid @ BALD.rest) / left_lid.sum()
    assert middle[0] > 0.08 and middle[1] > 0.02 and abs(middle[2] - 0.03) < 0.02
    assert np.ptp(REST, axis=0).argmax() == 2
    nose = REST[:, 0].argmax()
    ear = REST[:, 1].argmin()  # the right one
    assert moved(BALD, pitch=0.2)[nose, 2] < -0.01 and moved(BALD, yaw=0.2)[nose, 1] > 0.01
    assert moved(BALD, roll=0.2)[ear, 2] < -0.01
    np.testing.assert_allclose(moved(BALD, z=0.01)[nose], [0, 0, 0.01], atol=1e-6)


def test_rest_is_a_fixed_point_and_weights_add_up():
    np.testing.assert_allclose(HEAD.vertices(motion()), HEAD.rest, atol=1e-6)
    both = moved(HEAD, eyeBlinkLeft=1, jawOpen=0.5)
    np.testing.assert_allclose(both, moved(HEAD, eyeBlinkLeft=1) + moved(HEAD, jawOpen=0.5), atol=1e-6)
    assert moved(HEAD, jawOpen=1)[:, 2].min() < -0.01
    assert np.abs(both[COUNT : FACTS["vertices"]]).max() < 1e-7  # hair and collar


@given(st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_the_base_of_the_neck_stays_and_the_skull_is_rigid(angles):
    roll, pitch, yaw = angles
    turned = BALD.vertices(motion(roll=roll, pitch=pitch, yaw=yaw))
    fixed = BALD.share == 0
    assert fixed.any() and np.abs(turned - BALD.rest)[fixed].max() < 1e-6
    skull = np.flatnonzero(BALD.share == 1)[::400]
    apart = np.linalg.norm(BALD.rest[skull][:, None] - BALD.rest[skull][None], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(turned[skull][:, None] - turned[skull][None], axis=-1), apart, atol=1e-5)


def test_the_file_holds_parts_that_hang_together():
    triangles = ARRAYS["triangles"].reshape(-1, 3)
    assert triangles.max() < FACTS["vertices"] == len(PART)
    assert [morph["name"] for morph in FACTS["morphs"]] == list(BLENDSHAPES)
    assert (PART[triangles] == PART[triangles][:, :1]).all() and set(np.unique(PART)) == set(range(len(PARTS)))
    assert np.isfinite(HEAD.rest).all() and HEAD.triangles.max() == len(HEAD.rest) - 1
    assert len(HEAD.rest) == len(HEAD.colors) == len(HEAD.share)


def test_brows_and_hair_go_with_the_head_and_the_collar_stays():
    brows = slice(FACTS["vertices"], None)
    assert moved(BALD, browInnerUp=1)[brows, 2].max() > 0.002
    assert moved(BALD, browDownLeft=1)[brows, 2].min() < -0.002
    assert (BALD.share[: len(PART)][PART == PARTS.index("cloth")] == 0).all()
    assert HEAD.rest[HAIR, 2].max() > REST[:, 2].max() + 0.005
    top = HEAD.rest[:, 2] > 0.10
    assert (np.linalg.norm(moved(HEAD, pitch=0.3)[top], axis=1) > 0.02).all()
