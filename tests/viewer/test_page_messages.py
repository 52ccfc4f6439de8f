"""Pictures come out of a packed record as they went in; only text of a command's form is a command."""

import json
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import PacketError
from sfms_robot.viewer.page_messages import (
    COMMANDS,
    LONGEST_COMMAND,
    frame_json,
    pack_picture,
    parse_command,
    rare_json,
)

MOTION = np.linspace(-0.5, 0.5, 58, dtype=np.float32)
ASKED_RAD = np.array([0.1, -0.2, 0.3])
READ_RAD = np.array([0.11, math.nan, 0.31], np.float32)
RARE = rare_json("degraded", ("jaw",), {"jaw": "silent"}, {"nod": 0.123456})


def frame(shown=None, **more):
    return json.loads(frame_json(pack_picture(12.34, MOTION, ASKED_RAD, READ_RAD, RARE, **more), shown))


def test_a_picture_comes_out_as_it_went_in_with_null_for_what_is_not_there():
    told = frame(voice_db=-31.27, own_voice_db=-20.0, attention=0.75, place_m=(1.0, 0.5, -0.25), talking=True)
    assert told["type"] == "frame" and told["t"] == 12.34 and told["talk"] is True
    assert np.allclose(told["m"], MOTION, atol=6e-5) and told["j"] == [0.1, -0.2, 0.3]
    assert told["r"] == [0.11, None, 0.31] and told["u"] == [0.11, -0.2, 0.31]  # never read: shown where it was asked
    assert (told["db"], told["own"], told["at"], told["o"]) == (-31.3, -20.0, 0.75, [1.0, 0.5, -0.25])
    assert (told["s"], told["w"], told["f"], told["h"]) == ("degraded", ["jaw"], {"jaw": "silent"}, {"nod": 0.1235})
    told = frame()
    assert [told[key] for key in ("db", "own", "at", "o")] == [None, None, None, None] and told["talk"] is False
    assert json.loads(b"{" + rare_json("idle", (), {}, {}) + b"}")["h"] is None
    told = frame(lambda angles_rad: 2 * angles_rad[:2])
    assert told["u"] == [0.22, -0.4] and told["j"] == [0.1, -0.2, 0.3]


def parsed(**told):
    return parse_command(json.dumps(told))


def test_what_is_left_out_has_its_default():
    assert parsed(type="show", channels={"jawOpen": 1}) == ("show", {"channels": {"jawOpen": 1.0}, "seconds": 0.5})
    assert parsed(type="halt") == ("halt", {})
    assert parsed(type="knobs", style={"neck": 0.5}) == ("knobs", {"intensity": {}, "style": {"neck": 0.5}})
    assert parsed(type="calm", rates={"nod": 3, "smile": None}) == ("calm", {"rates": {"nod": 3.0, "smile": None}})


@pytest.mark.parametrize(
    ("told", "problem"),
    [
        ({}, r"^type: expected a command \(valid: hello, ping"),
        ({"type": "dance"}, "^type: expected a command"),
        ({"type": ["halt"]}, "^type: expected a command"),
        ({"type": "halt", "now": True}, "^halt: 'now' is not a known key"),
        ({"type": "show"}, "^show: channels: Field required$"),
        ({"type": "show", "channels": {"jawOpen": "1"}}, "^show: channels.jawOpen = '1': .* valid number"),
        ({"type": "show", "channels": {"jawOpen": True}}, "^show: channels.jawOpen = True: .* valid number"),
        ({"type": "show", "channels": {"a\nb": "1"}}, "^show: channels.a b = "),
        ({"type": "show", "channels": dict.fromkeys(map(str, range(200)), 0)}, "at most 128"),
        ({"type": "look_at", "x_m": 1, "y_m": 0}, "^look_at: z_m: Field required$"),
        ({"type": "seed", "seed": -1}, "^seed: seed = -1: "),
        ({"type": "seed", "seed": 2**32}, "^seed: seed = 4294967296: "),
        ({"type": "seed", "seed": 1.0}, "^seed: seed = 1.0: "),
        ({"type": "listener", "name": "a\nb"}, "^listener: name = .* printable"),
        ({"type": "listener", "name": "a" * 257}, "^listener: name = .* at most 256"),
        ({"type": "source", "feeds": ["speech"]}, "^source: feeds.0 = 'speech': .*'voice' or 'face'$"),
        ({"type": "record", "on": 1}, "^record: on = 1: .* valid boolean"),
        ({"type": "ping", "id": "x" * 300}, "^ping: id = .* up to 256"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(told, problem):
    with pytest.raises(PacketError, match=problem):
        parsed(**told)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[1]", "null", "NaN", '{"type":"show","channels":{"a":NaN}}', "[" * 5000, " " * (LONGEST_COMMAND + 1)],
)
def test_what_is_no_json_object_is_no_command(text):
    with pytest.raises(PacketError):
        parse_command(text)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**40), 2**40)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(sorted(COMMANDS)), st.data())
def test_whatever_stands_in_a_command_it_is_one_or_is_refused(name, data):
    told = {key: data.draw(JSON) for key in COMMANDS[name].model_fields}
    try:
        assert set(parsed(type=name, **told)[1]) == set(COMMANDS[name].model_fields)
    except PacketError as error:
        assert "\n" not in str(error)
