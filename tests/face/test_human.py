"""The virtual head: its laws, its hair, and the file of it that a browser reads."""

import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from motion_rows import motion

from sfms_robot.errors import ConfigError
from sfms_robot.face.human import PARTS, load_human, packed_human, with_hair
from sfms_robot.frames import BLENDSHAPES

BALD = load_human()
HEAD = with_hair(BALD)
COUNT = len(BALD.rest)


def moved(head, **channels):
    return head.vertices(motion(**channels)) - head.rest


def test_the_head_looks_along_x_with_its_left_at_plus_y():
    left_lid = np.abs(BALD.deltas[BLENDSHAPES.index("eyeBlinkLeft")]).sum(axis=1)
    middle = (left_lid @ BALD.rest) / left_lid.sum()
    assert middle[0] > 0.08 and middle[1] > 0.02 and abs(middle[2] - 0.03) < 0.02
    assert np.ptp(BALD.rest, axis=0).argmax() == 2


def test_rest_is_a_fixed_point_and_weights_add_up():
    np.testing.assert_allclose(BALD.vertices(motion()), BALD.rest, atol=1e-6)
    both = moved(BALD, eyeBlinkLeft=1, jawOpen=0.5)
    np.testing.assert_allclose(both, moved(BALD, eyeBlinkLeft=1) + moved(BALD, jawOpen=0.5), atol=1e-6)
    assert moved(BALD, jawOpen=1)[:, 2].min() < -0.01


def test_signs_of_the_pose_are_ours():
    nose = BALD.rest[:, 0].argmax()
    ear = BALD.rest[:, 1].argmin()  # the right one
    assert moved(BALD, pitch=0.2)[nose, 2] < -0.01
    assert moved(BALD, yaw=0.2)[nose, 1] > 0.01
    assert moved(BALD, roll=0.2)[ear, 2] < -0.01
    np.testing.assert_allclose(moved(BALD, z=0.01)[nose], [0, 0, 0.01], atol=1e-6)


@given(st.tuples(*[st.floats(-0.5, 0.5)] * 3))
def test_the_base_of_the_neck_stays_and_the_skull_is_rigid(angles):
    roll, pitch, yaw = angles
    turned = BALD.vertices(motion(roll=roll, pitch=pitch, yaw=yaw))
    fixed = BALD.share == 0
    assert fixed.any() and np.abs(turned - BALD.rest)[fixed].max() < 1e-6
    skull = np.flatnonzero(BALD.share == 1)[::400]
    apart = np.linalg.norm(BALD.rest[skull][:, None] - BALD.rest[skull][None], axis=-1)
    np.testing.assert_allclose(np.linalg.norm(turned[skull][:, None] - turned[skull][None], axis=-1), apart, atol=1e-5)


def test_brows_follow_the_skin():
    brows = slice(len(BALD.rest) - 56, None)
    assert moved(BALD, browInnerUp=1)[brows, 2].max() > 0.002
    assert moved(BALD, browDownLeft=1)[brows, 2].min() < -0.002
    assert np.isfinite(BALD.rest).all() and BALD.triangles.max() == len(BALD.rest) - 1


def test_a_file_that_is_no_head_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="not a head with the 52 ARKit morphs"):
        load_human(tmp_path)
    np.savez(tmp_path / "head_arkit52.npz", vertices=np.zeros((3, 3)), names=np.array(["jawOpen"]))
    with pytest.raises(ConfigError, match="head_arkit52.npz"):
        load_human(tmp_path)


# --- hair ---


def test_the_head_itself_stays_what_it_was():
    asked = motion(pitch=0.2, jawOpen=0.7)
    np.testing.assert_array_equal(HEAD.vertices(asked)[:COUNT], BALD.vertices(asked))
    assert HEAD.triangles.max() < len(HEAD.rest) == len(HEAD.colors) == len(HEAD.share)


@pytest.mark.parametrize("channel", BLENDSHAPES)
def test_no_morph_moves_hair(channel):
    assert np.abs(moved(HEAD, **{channel: 1.0})[COUNT:]).max() == 0.0


def test_hair_covers_the_top_of_the_skull_and_nods_with_it():
    shown = np.unique(HEAD.triangles[(HEAD.triangles >= COUNT).all(axis=1)])
    assert HEAD.rest[shown, 2].max() > BALD.rest[:, 2].max() + 0.005
    top = HEAD.rest[:, 2] > 0.10
    assert (np.linalg.norm(moved(HEAD, pitch=0.3)[top], axis=1) > 0.02).all()


def test_no_hair_comes_out_of_the_neck():
    neck = (HEAD.rest[:, 2] > -0.09) & (HEAD.rest[:, 2] < -0.045) & (HEAD.rest[:, 0] > 0.0)
    hair = HEAD.triangles[(HEAD.triangles >= COUNT).all(axis=1)]
    assert not neck[hair].any()


# --- the file for browsers: read back, it is the head ---

FILE = packed_human(BALD)


def read():
    (length,) = struct.unpack_from("<I", FILE)
    facts = json.loads(FILE[4 : 4 + length])
    at, arrays = 4 + length, {}
    for name, kind, count in facts["arrays"]:
        at += -at % 4
        arrays[name] = np.frombuffer(FILE, np.dtype(kind).newbyteorder("<"), count, at)
        at += arrays[name].nbytes
    assert at == len(FILE)
    return facts, arrays


FACTS, ARRAYS = read()


def test_rest_and_every_morph_are_those_of_the_head():
    count, first = FACTS["skinned"], 0
    rest = ARRAYS["rest"].reshape(-1, 3) * FACTS["step_m"]
    np.testing.assert_allclose(rest[:count], BALD.rest[:count], atol=FACTS["step_m"])
    assert [morph["name"] for morph in FACTS["morphs"]] == list(BLENDSHAPES)
    for morph, delta in zip(FACTS["morphs"], BALD.deltas[:, :count], strict=True):
        last = first + morph["count"]
        told = np.zeros_like(delta)
        told[ARRAYS["moved"][first:last]] = ARRAYS["moves"].reshape(-1, 3)[first:last] * morph["step_m"]
        np.testing.assert_allclose(told, delta, atol=2.1e-5)
        first = last


def test_triangles_name_vertices_and_parts_hang_together():
    triangles, part = ARRAYS["triangles"].reshape(-1, 3), ARRAYS["part"]
    assert triangles.max() < FACTS["vertices"] == len(part)
    of_corners = part[triangles]
    assert (of_corners == of_corners[:, :1]).all()
    assert set(np.unique(part)) == set(range(len(PARTS)))


def test_collar_stays_when_the_head_turns_and_hair_goes_along():
    share, part = ARRAYS["share"], ARRAYS["part"]
    assert (share[part == PARTS.index("cloth")] == 0).all()
    assert np.median(share[part == PARTS.index("hair")]) == 255


def test_it_is_small():
    assert len(FILE) < 900_000


@pytest.mark.parametrize("part", ["hair", "cloth"])
def test_surfaces_that_are_added_face_outward(part):
    rest = ARRAYS["rest"].reshape(-1, 3) * FACTS["step_m"]
    triangles = ARRAYS["triangles"].reshape(-1, 3)
    corners = rest[triangles[ARRAYS["part"][triangles[:, 0]] == PARTS.index(part)]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    outward = corners.mean(axis=1) - np.array([0.0, 0.0, 0.05 if part == "hair" else -0.3])
    assert ((normals * outward).sum(axis=1) > 0).mean() > 0.9
