import itertools
from functools import partial

import pytest
from emulated_devices import addressed
from hypothesis import given
from hypothesis import strategies as st
from published import byte_by_byte, rows

from sfms_robot.servo.codecs import maestro
from sfms_robot.servo.codecs.maestro import MaestroCommand, maybe_command

PUBLISHED = {
    row["name"]: bytes.fromhex(row["bytes"]) for row in rows("board_commands.csv") if row["protocol"] == "maestro"
}
BUILT = {
    "set target channel 0 1500 us": maestro.set_target(0, 6000),
    "set target channel 0 1500 us device 12": addressed(maestro.set_target(0, 6000), 12),
    "set targets channels 3 and 4 0 and 6000": maestro.set_targets(3, [0, 6000]),
    "get position channel 2": maestro.get_position(2),
    "get errors": maestro.get_errors(),
}

CRC_PUBLISHED = bytes.fromhex("83 01 17")  # section 5.d of the guide
to_seven = partial(addressed, device=7)
words = st.integers(0, maestro.MAX_WORD)
channels = st.integers(0, 23)
commands = st.one_of(
    st.builds(maestro.set_target, channels, words),
    st.builds(maestro.set_targets, channels, st.lists(words, min_size=1, max_size=24)),
    st.builds(maestro.get_position, channels),
    st.builds(lambda channel, target: bytes([maestro.MINI_SSC, channel, target]), channels, st.integers(0, 254)),
    st.sampled_from([maestro.get_errors(), bytes([maestro.GO_HOME])]),
)


def test_commands_and_their_crc_are_those_published():
    assert BUILT.items() <= PUBLISHED.items()
    assert maestro.sealed(CRC_PUBLISHED[:2]) == CRC_PUBLISHED and maestro.crc7(CRC_PUBLISHED) == 0


@given(words)
def test_word_round_trip(value):
    assert maestro.from_word(maestro.word(value)) == value and max(maestro.word(value)) < 0x80


@pytest.mark.parametrize("value", [-1, maestro.MAX_WORD + 1])
def test_value_beyond_14_bits_is_refused(value):
    with pytest.raises(ValueError, match="14 bits"):
        maestro.set_target(0, value)


@pytest.mark.parametrize("crc", [False, True])
@given(commands, st.sampled_from([bytes, to_seven]))
def test_reader_gives_back_what_the_builders_made_byte_by_byte(crc, command, form):
    sent = form(command)
    if crc and command[0] != maestro.MINI_SSC:
        sent = maestro.sealed(sent)
    taken = byte_by_byte(lambda buffer: maybe_command(buffer, 7, crc=crc), sent)
    assert taken == MaestroCommand(command[0], command[1:])


@pytest.mark.parametrize("form", [bytes, to_seven])
def test_no_target_changed_in_one_byte_gets_past_the_crc(form):
    sent = maestro.sealed(form(maestro.set_target(3, 6000)))
    for at, change in itertools.product(range(len(sent)), range(1, 256)):
        wrong = bytearray(sent)
        wrong[at] ^= change
        while (taken := maybe_command(wrong, 7, crc=True)) is not None:
            assert taken.error or taken.code not in (maestro.SET_TARGET, maestro.SET_TARGETS), (at, change)


def test_damaged_interrupted_and_foreign_commands_leave_the_next_one_whole():
    wrong = bytearray(maestro.sealed(maestro.set_target(3, 2)))
    wrong[1] = maestro.MINI_SSC
    assert maybe_command(wrong, crc=True).error
    assert maybe_command(wrong, crc=True) == MaestroCommand(maestro.MINI_SSC, bytes([2, 0]))
    buffer = bytearray(addressed(bytes([maestro.GO_HOME]), 3) + maestro.get_errors())
    assert maybe_command(buffer, device=4) == MaestroCommand(maestro.GET_ERRORS)
    buffer = bytearray(maestro.set_target(0, 6000)[:2] + maestro.set_target(1, 5000))
    assert maybe_command(buffer) == MaestroCommand(maestro.SET_TARGET, error=maestro.PROTOCOL_ERROR)
    assert maybe_command(buffer) == MaestroCommand(maestro.SET_TARGET, bytes([1]) + maestro.word(5000))


@given(st.lists(commands, max_size=5))
def test_commands_in_a_row_stay_apart(row):
    buffer = bytearray(b"".join(row))
    assert [maybe_command(buffer) for _ in row] == [MaestroCommand(c[0], c[1:]) for c in row]
