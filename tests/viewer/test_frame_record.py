"""What the run's process packs is what the page is told, in JSON that any parser reads."""

import json
import math

import numpy as np

from sfms_robot.viewer.frame_record import Picture, frame_json, pack_picture, rare_json

MOTION = np.linspace(-0.5, 0.5, 58, dtype=np.float32)
ASKED_RAD = np.array([0.1, -0.2, 0.3])
READ_RAD = np.array([0.11, math.nan, 0.31], np.float32)
RARE = rare_json("degraded", ("jaw",), {"jaw": "silent"}, {"nod": 0.123456})


def frame(**more):
    return json.loads(frame_json(pack_picture(Picture(12.34, MOTION, ASKED_RAD, READ_RAD, RARE, **more))))


def test_a_picture_comes_out_as_it_went_in() -> None:
    told = frame(voice_db=-31.27, own_voice_db=-20.0, attention=0.75, place_m=(1.0, 0.5, -0.25), talking=True)
    assert told["type"] == "frame" and told["t"] == 12.34
    assert np.allclose(told["m"], MOTION, atol=6e-5) and told["j"] == [0.1, -0.2, 0.3]
    assert told["r"] == [0.11, None, 0.31]
    assert (told["db"], told["own"], told["at"], told["o"]) == (-31.3, -20.0, 0.75, [1.0, 0.5, -0.25])
    assert told["talk"] is True
    assert (told["s"], told["w"], told["f"], told["h"]) == ("degraded", ["jaw"], {"jaw": "silent"}, {"nod": 0.1235})


def test_what_is_not_there_is_null_and_not_nan() -> None:
    told = frame()
    assert [told[key] for key in ("db", "own", "at", "o")] == [None, None, None, None] and told["talk"] is False
    assert json.loads(b"{" + rare_json("idle", (), {}, {}) + b"}")["h"] is None


def test_a_joint_that_was_never_read_is_shown_where_it_was_asked_to_be() -> None:
    assert frame()["u"] == [0.11, -0.2, 0.31]


def test_a_scene_turns_joints_into_those_of_its_urdf() -> None:
    record = pack_picture(Picture(1.0, MOTION, ASKED_RAD, READ_RAD, RARE))
    told = json.loads(frame_json(record, lambda angles_rad: 2 * angles_rad[:2]))
    assert told["u"] == [0.22, -0.4] and told["j"] == [0.1, -0.2, 0.3]
