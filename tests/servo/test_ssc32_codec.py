import pytest
from hypothesis import given
from hypothesis import strategies as st
from published import byte_by_byte, rows

from sfms_robot.servo.codecs import ssc32
from sfms_robot.servo.codecs.ssc32 import Group, Move, Query, maybe_command

PUBLISHED = {
    row["name"]: row["bytes"].replace("<CR>", "\r").encode()
    for row in rows("board_commands.csv")
    if row["protocol"] == "ssc32"
}
BUILT = {
    "group move": ssc32.group_move({5: Move(1600), 10: Move(750)}, 2500),
    "single with speed": ssc32.group_move({5: Move(1600, 750)}),
    "query movement": ssc32.query_moving(),
}
MEANT = {
    "group move": Group({5: Move(1600), 10: Move(750)}, 2500),
    "single with speed": Group({5: Move(1600, 750)}),
    "outputs": Group({}, levels={3: True, 4: False}),
    "query movement": Query("Q"),
    "query pulse": Query("QP", (5,)),
}

move = st.builds(Move, st.integers(500, 2500), st.integers(0, 65535))
moves = st.dictionaries(st.integers(0, 31), move, min_size=1, max_size=32)


@pytest.mark.parametrize("name", BUILT)
def test_builders_make_the_published_command_without_its_spaces(name):
    assert BUILT[name] == PUBLISHED[name].replace(b" ", b"")


@pytest.mark.parametrize("name", MEANT)
@pytest.mark.parametrize("change", [bytes, bytes.lower, lambda line: line.replace(b"#", b"  # ")])
def test_published_command_is_understood_in_either_case_and_with_spaces(name, change):
    assert maybe_command(bytearray(change(PUBLISHED[name]))) == MEANT[name]


@given(moves, st.integers(0, 65535))
def test_reader_gives_back_what_the_builder_made(moves, time_ms):
    line = ssc32.group_move(moves, time_ms)
    assert byte_by_byte(maybe_command, line) == Group(moves, time_ms)
    buffer = bytearray(line + b"Q")
    assert maybe_command(buffer) == Group(moves, time_ms) and buffer == b"Q"


def test_escape_throws_away_what_came_before_it_and_several_pulses_are_asked_for_at_once():
    assert maybe_command(bytearray(b"#5P2000\x1b#5P1500\r")) == Group({5: Move(1500)})
    assert maybe_command(bytearray(b"QP 5 31\r")) == Query("QP", (5, 31))
    assert maybe_command(bytearray(ssc32.outputs_low([3, 4]))) == Group({}, levels={3: False, 4: False})


@pytest.mark.parametrize("line", [b"", b"#32P1500", b"QP 40", b"hello", b"#5", b"P1500", b"#5P1500T99999999"])
def test_line_that_is_not_a_command_is_dropped(line):
    assert maybe_command(bytearray(line + b"\rQ\r")) == Query("Q")


@pytest.mark.parametrize("pulse_us", [0, 499, 2501])
def test_pulse_that_the_board_cannot_make_is_refused(pulse_us):
    with pytest.raises(ValueError, match=f"channel 4: {pulse_us} us is outside 500..2500"):
        ssc32.group_move({4: Move(pulse_us)})
