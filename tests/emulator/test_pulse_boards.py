import pytest
from emulated_devices import addressed, device_of, servos_of
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.servo.codecs import maestro, ssc32
from sfms_robot.servo.codecs.ssc32 import Move

AA = bytes([maestro.BAUD_INDICATION])


def maestro_board(model="maestro-24", channels=range(6), **more):
    """One that has detected its baud rate."""
    board = device_of(*servos_of(model, *channels, **more))
    board.receive(AA, 115200, 0.0)
    return board


def position(board, channel, now_s):
    return int.from_bytes(board.receive(maestro.get_position(channel), 115200, now_s), "little")


def errors(board):
    return int.from_bytes(board.receive(maestro.get_errors(), 115200, 0.0), "little")


def test_boards_hear_their_own_baud_rate_alone():
    board = device_of(*servos_of("maestro-24", 0))
    assert board.receive(maestro.get_errors(), 115200, 0.0) == b""
    assert board.receive(AA + maestro.get_errors(), 115200, 0.0) == b"\x00\x00"
    assert board.receive(maestro.get_errors(), 115200, 0.0) == b"\x00\x00"
    board = device_of(*servos_of("maestro-24", 0))
    assert board.receive(addressed(maestro.get_errors()), 57600, 0.0) == b"\x00\x00" and board.baud == 57600
    board = maestro_board()
    board.receive(maestro.set_target(0, 6000), 115200, 0.0)
    assert board.receive(maestro.get_errors(), 9600, 0.0) == b"" and errors(board) == maestro.SIGNAL_ERROR
    assert position(board, 0, 0.0) == 0  # an error sends all home, and home is off
    assert ssc_board().receive(ssc32.query_moving(), 9600, 0.0) == b""


def test_target_without_a_speed_limit_is_there_at_once_and_the_shaft_follows():
    board = maestro_board(start_ticks=6000)
    board.receive(maestro.set_target(2, 7000), 115200, 1.0)
    assert position(board, 2, 1.0) == 7000 and board.servo(2).plant.position == 6000
    board.advance(2.0)
    assert board.servo(2).plant.position == 7000


def test_speed_limit_holds_once_pulses_are_on():
    board = maestro_board()
    board.receive(bytes([maestro.SET_SPEED, 0]) + maestro.word(20) + maestro.set_target(0, 5000), 115200, 0.0)
    assert position(board, 0, 0.0) == 5000
    board.receive(maestro.set_target(0, 7000), 115200, 0.0)
    assert board.receive(bytes([maestro.GET_MOVING]), 115200, 0.1) == b"\x01"
    assert position(board, 0, 0.5) == pytest.approx(6000, abs=10)  # 20 x 0.25 us per 10 ms = 2000 ticks/s
    assert position(board, 0, 1.5) == 7000 and board.receive(bytes([maestro.GET_MOVING]), 115200, 1.5) == b"\x00"


def test_targets_are_held_inside_the_limits_of_a_channel_and_a_micro_maestro_knows_no_multiple_ones():
    board = maestro_board()
    board.receive(maestro.set_targets(0, [100, 16000]), 115200, 0.0)
    assert (position(board, 0, 0.0), position(board, 1, 0.0)) == (992 * 4, 2000 * 4)
    board = maestro_board("maestro-6")
    board.receive(maestro.set_targets(0, [6000, 6000]), 115200, 0.0)
    assert errors(board) == maestro.PROTOCOL_ERROR


@pytest.mark.parametrize("command", [maestro.set_target(24, 6000), maestro.set_targets(23, [6000, 6000]), b"\xb0"])
def test_nonsense_is_a_protocol_error_and_reading_it_clears_it(command):
    board = maestro_board()
    board.receive(command, 115200, 0.0)
    assert errors(board) == maestro.PROTOCOL_ERROR and errors(board) == 0


def test_a_channel_without_pulses_stays_where_it_is_and_one_without_a_servo_is_none():
    board = maestro_board(start_ticks=5000)
    board.advance(10.0)
    assert board.servo(0).plant.position == 5000
    board = maestro_board(channels=[4])
    assert board.servo(4).id == 4 and board.servo(5) is None


CRC_CASES = [
    (maestro.sealed(maestro.set_target(0, 6000)), 6000, 0),
    (maestro.sealed(addressed(maestro.set_target(0, 6000))), 6000, 0),
    (bytes([maestro.MINI_SSC, 0, 127]), 6000, 0),
    (maestro.set_target(0, 6000) + b"\x00", 0, maestro.CRC_ERROR),
    (maestro.set_target(0, 6000), 0, maestro.PROTOCOL_ERROR),  # the next command interrupts it
]


@pytest.mark.parametrize(("sent", "pulse", "error"), CRC_CASES)
def test_board_with_crc_obeys_what_has_one_and_answers_without(sent, pulse, error):
    board = maestro_board(channels=[0], registers={"crc": 1})
    board.receive(sent, 115200, 0.0)
    answer = board.receive(maestro.sealed(maestro.get_errors()), 115200, 0.0)
    assert answer == error.to_bytes(2, "little") and board.servo(0).pulse == pulse


def ssc_board(baud=115200):
    return device_of(*servos_of("ssc-32", *range(8), baud=baud))


def pulses(board, channels, now_s):
    return list(board.receive(b"QP " + b" ".join(b"%d" % c for c in channels) + b"\r", 115200, now_s))


def test_group_starts_and_stops_together():
    board = ssc_board()
    board.receive(ssc32.group_move({0: Move(1000), 1: Move(1400)}), 115200, 0.0)
    board.receive(ssc32.group_move({0: Move(2000), 1: Move(1600)}, 1000), 115200, 0.0)
    assert pulses(board, [0, 1], 0.5) == [150, 150]
    assert board.receive(ssc32.query_moving(), 115200, 0.9) == ssc32.MOVING
    assert pulses(board, [0, 1], 1.01) == [200, 160]
    assert board.receive(ssc32.query_moving(), 115200, 1.01) == ssc32.DONE


def test_slower_of_speed_and_time_counts():
    board = ssc_board()
    board.receive(ssc32.group_move({0: Move(1000)}), 115200, 0.0)
    board.receive(ssc32.group_move({0: Move(2000, 500)}, 100), 115200, 0.0)
    assert pulses(board, [0], 1.0) == [150]


@given(st.lists(st.binary(max_size=64), max_size=20), st.sampled_from(["maestro-24", "maestro-6", "ssc-32"]))
def test_rubbish_moves_no_channel_out_of_its_limits(chunks, model):
    board, now_s = device_of(*servos_of(model, *range(6), baud=9600)), 0.0
    for chunk in [AA, *chunks]:
        now_s += 0.01
        board.receive(chunk, 9600, now_s)
    board.advance(now_s + 1.0)
    assert all(each.pulse == 0 or board.limits[0] <= each.pulse <= board.limits[1] for each in board.channels)
