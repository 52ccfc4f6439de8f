"""The head's file for browsers: read back, it is the head."""

import json
import struct

import numpy as np
import pytest

from sfms_robot.face.human import PARTS, load_human, packed_human
from sfms_robot.frames import BLENDSHAPES

HEAD = load_human()
FILE = packed_human(HEAD)


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
    np.testing.assert_allclose(rest[:count], HEAD.rest[:count], atol=FACTS["step_m"])
    assert [morph["name"] for morph in FACTS["morphs"]] == list(BLENDSHAPES)
    for morph, delta in zip(FACTS["morphs"], HEAD.deltas[:, :count], strict=True):
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
