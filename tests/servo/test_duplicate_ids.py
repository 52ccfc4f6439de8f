"""Two servos with one id are noticed by what a ping brings; one servo, however it is set, is not."""

import pytest
from emulated_port import ScriptedPort

from sfms_robot.servo.chain.link import ping_replies
from sfms_robot.servo.codecs import dxl2, protocol1

ONE = dxl2.encode_status(3, 0, bytes([0xB0, 0x04, 53]))
OTHER = dxl2.encode_status(3, 0, bytes([0xA6, 0x04, 52]))


def heard(*pieces: bytes, echo: bool = False, protocol: int = 2):
    return ping_replies(ScriptedPort(*pieces, echo=echo), protocol, 3, 0.02)


def test_one_servo_is_one_answer_also_in_pieces_and_behind_an_echo():
    assert not heard(ONE).duplicate and heard(ONE).answers == 1
    assert not heard(ONE[:5], ONE[5:]).duplicate
    assert not heard(ONE, echo=True).duplicate


def test_an_empty_wire_holds_no_duplicate_id():
    assert heard().answers == 0 and not heard().duplicate


def test_two_answers_one_after_the_other_are_a_duplicate_id():
    assert heard(ONE, OTHER).answers == 2 and heard(ONE, OTHER).duplicate


def test_two_answers_on_top_of_each_other_are_a_duplicate_id():
    garbled = bytes(a & b for a, b in zip(ONE, OTHER, strict=True))
    assert heard(garbled).answers == 0 and heard(garbled).duplicate


@pytest.mark.parametrize("shift", range(1, len(ONE)))
def test_an_answer_that_begins_inside_the_other_is_a_duplicate_id(shift):
    overlap = bytes(a & b for a, b in zip(ONE[shift:] + b"\xff" * shift, OTHER, strict=True))
    assert heard(ONE[:shift] + overlap + OTHER[len(OTHER) - shift :]).duplicate


def test_the_older_frame_is_judged_the_same_way():
    answer = protocol1.encode(3, 0)
    assert not heard(answer, protocol=1).duplicate
    assert heard(answer, answer, protocol=1).answers == 2
    assert heard(answer, b"\x00", protocol=1).duplicate


def test_a_wire_that_never_falls_silent_is_left_alone():
    assert heard(*[b"\x55" * 100] * 1000).stray == 6400
