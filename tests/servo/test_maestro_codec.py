import csv
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.servo.codecs import maestro
from sfms_robot.servo.codecs.maestro import Command, maybe_command

ASSET = Path(__file__).parents[1] / "assets" / "board_commands.csv"
ROWS = csv.DictReader(line for line in ASSET.read_text().splitlines() if not line.startswith("#"))
PUBLISHED = {row["name"]: bytes.fromhex(row["bytes"]) for row in ROWS if row["protocol"] == "maestro"}
BUILT = {
    "set target channel 0 1500 us": maestro.set_target(0, 6000),
    "set target channel 0 1500 us device 12": maestro.addressed(maestro.set_target(0, 6000), 12),
    "set speed channel 5 140": maestro.set_speed(5, 140),
    "set acceleration channel 5 5": maestro.set_acceleration(5, 5),
    "set targets channels 3 and 4 0 and 6000": maestro.set_targets(3, [0, 6000]),
    "get position channel 2": maestro.get_position(2),
    "get errors": maestro.get_errors(),
    "go home": maestro.go_home(),
    "mini ssc channel 0 neutral": maestro.mini_ssc(0, 127),
}

words = st.integers(0, maestro.MAX_WORD)
channels = st.integers(0, 23)
commands = st.one_of(
    st.builds(maestro.set_target, channels, words),
    st.builds(maestro.set_speed, channels, words),
    st.builds(maestro.set_targets, channels, st.lists(words, min_size=1, max_size=24)),
    st.builds(maestro.get_position, channels),
    st.builds(maestro.mini_ssc, channels, st.integers(0, 254)),
    st.sampled_from([maestro.get_moving(), maestro.get_errors(), maestro.go_home()]),
)


def test_every_published_command_is_built_here():
    assert BUILT == PUBLISHED


def test_crc_is_the_published_one():
    assert maestro.crc7(b"\x83\x01") == 0x17
    assert maestro.with_crc(b"\x83\x01") == b"\x83\x01\x17"


@given(words)
def test_word_round_trip(value):
    assert maestro.from_word(maestro.word(value)) == value
    assert max(maestro.word(value)) < 0x80


@pytest.mark.parametrize("value", [-1, maestro.MAX_WORD + 1])
def test_value_beyond_14_bits_is_refused(value):
    with pytest.raises(ValueError, match="14 bits"):
        maestro.set_target(0, value)


@given(commands, st.booleans(), st.booleans())
def test_reader_gives_back_what_the_builders_made(command, addressed, crc):
    sent = maestro.addressed(command, 7) if addressed else command
    buffer = bytearray(maestro.with_crc(sent) if crc else sent)
    assert maybe_command(buffer, 7, crc) == Command(command[0], command[1:])
    assert not buffer


@given(commands, st.booleans())
def test_command_arriving_one_byte_at_a_time(command, addressed):
    buffer = bytearray()
    sent = maestro.addressed(command) if addressed else command
    for byte in sent[:-1]:
        buffer.append(byte)
        assert maybe_command(buffer) is None
    buffer.append(sent[-1])
    assert maybe_command(buffer) == Command(command[0], command[1:])


@given(st.lists(commands, max_size=5))
def test_commands_in_a_row_stay_apart(row):
    buffer = bytearray(b"".join(row))
    assert [maybe_command(buffer) for _ in row] == [Command(c[0], c[1:]) for c in row]


def test_commands_to_another_board_are_passed_over():
    buffer = bytearray(maestro.addressed(maestro.go_home(), 3) + maestro.get_errors())
    assert maybe_command(buffer, device=4) == Command(maestro.GET_ERRORS)


def test_interrupted_command_is_an_error_and_the_next_one_counts():
    buffer = bytearray(maestro.set_target(0, 6000)[:2] + maestro.set_target(1, 5000))
    assert maybe_command(buffer) == Command(maestro.SET_TARGET, error=maestro.PROTOCOL_ERROR)
    assert maybe_command(buffer) == Command(maestro.SET_TARGET, bytes([1]) + maestro.word(5000))


def test_damaged_command_is_named_by_its_crc():
    damaged = bytearray(maestro.with_crc(maestro.set_target(0, 6000)))
    damaged[2] ^= 1
    assert maybe_command(damaged, crc=True) == Command(maestro.SET_TARGET, error=maestro.CRC_ERROR)


@given(st.binary(max_size=300), st.booleans())
def test_rubbish_neither_hangs_nor_piles_up(rubbish, crc):
    buffer = bytearray(rubbish)
    for _ in range(len(rubbish) + 1):
        if maybe_command(buffer, crc=crc) is None:
            break
    assert len(buffer) < 3 + 2 + 2 * 127 + 1
    assert maybe_command(buffer, crc=crc) is None
