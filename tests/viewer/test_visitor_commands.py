"""Only what has the form of a command is one; everything else is one line that says what is wrong."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import PacketError
from sfms_robot.viewer.visitor_commands import COMMANDS, LONGEST_COMMAND, parse_command


def parsed(**told):
    return parse_command(json.dumps(told))


def test_what_is_left_out_has_its_default() -> None:
    command = parsed(type="show", channels={"jawOpen": 1})
    assert command.name == "show" and command.values == {"channels": {"jawOpen": 1.0}, "seconds": 0.5}
    assert parsed(type="halt").values == {}
    assert parsed(type="knobs", style={"neck": 0.5}).values == {"intensity": {}, "style": {"neck": 0.5}}


def test_a_rate_may_be_left_to_people() -> None:
    assert parsed(type="calm", rates={"nod": 3, "smile": None}).values == {"rates": {"nod": 3.0, "smile": None}}


@pytest.mark.parametrize(
    ("told", "problem"),
    [
        ({}, r"^no command \(hello, ping"),
        ({"type": "dance"}, "^no command"),
        ({"type": ["halt"]}, "^no command"),
        ({"type": "halt", "now": True}, r"^halt: 'now' is no key of it \(it has none\)$"),
        ({"type": "show"}, "^show: channels is missing$"),
        ({"type": "show", "channels": {"jawOpen": "wide"}}, "^show: channels has a value that is no number$"),
        ({"type": "show", "channels": {"jawOpen": True}}, "^show: channels has a value that is no number$"),
        ({"type": "show", "channels": dict.fromkeys(map(str, range(200)), 0)}, "^show: channels is no object of up to"),
        ({"type": "look_at", "x_m": 1, "y_m": 0}, "^look_at: z_m is missing$"),
        ({"type": "seed", "seed": -1}, "^seed: seed is no whole number"),
        ({"type": "seed", "seed": 2**32}, "^seed: seed is no whole number"),
        ({"type": "listener", "name": "a\nb"}, "^listener: name is no text"),
        ({"type": "source", "feeds": ["speech"]}, "^source: feeds is no list of voice, face$"),
        ({"type": "record", "on": 1}, "^record: on is neither true nor false$"),
        ({"type": "ping", "id": "x" * 300}, "^ping: id is longer"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(told, problem) -> None:
    with pytest.raises(PacketError, match=problem):
        parse_command(json.dumps(told))


@pytest.mark.parametrize("text", ["", "{", "[1]", "null", "NaN", '{"type":"show","channels":{"a":NaN}}', "[" * 5000])
def test_what_is_no_json_object_is_no_command(text) -> None:
    with pytest.raises(PacketError):
        parse_command(text)


def test_a_long_text_is_not_even_looked_at() -> None:
    with pytest.raises(PacketError, match=f"more than {LONGEST_COMMAND}"):
        parse_command(" " * (LONGEST_COMMAND + 1))


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
def test_whatever_stands_in_a_command_it_is_one_or_is_refused(name, data) -> None:
    told = {key: data.draw(JSON) for key in COMMANDS[name]}
    try:
        assert set(parsed(type=name, **told).values) == set(COMMANDS[name])
    except PacketError as error:
        assert "\n" not in str(error)
