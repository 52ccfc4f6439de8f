"""A port that knows when its bytes have left, and how long an answer may take."""

import pytest
from emulated_port import EmulatedPort, Says

from sfms_robot.config import load_firmware_map
from sfms_robot.servo.boards import RateLimitedPort, board_for, board_problem
from sfms_robot.servo.registers import Table


def wire_of(baud=9600, patience_s=0.02):
    port = EmulatedPort(Says(b""), baud)
    return RateLimitedPort(port, baud, patience_s), port, port.clock


def test_wire_is_busy_until_its_bytes_have_left():
    wire, _, clock = wire_of()
    assert wire.free and wire.send(bytes(96)) == 0.0 and wire.send(bytes(96)) == 0.1
    clock.t = 0.19
    assert not wire.free
    clock.t = 0.2
    assert wire.free


def test_answer_is_taken_when_it_is_whole_and_nobody_waits_for_it():
    wire, port, clock = wire_of()
    wire.request(b"?", 2)
    assert wire.awaiting and wire.answer() is None
    port.inbox += b"a"
    assert wire.answer() is None
    port.inbox += b"b"
    assert wire.answer() == b"ab" and not wire.awaiting
    assert all(deadline_s == clock.t for deadline_s in port.waits)


def test_answer_that_is_late_or_too_long_is_none():
    wire, port, clock = wire_of()
    wire.request(b"?", 2)
    clock.t = 1.0
    assert wire.answer() == b""
    wire.request(b"?", 2)
    port.inbox += b"abc"
    assert wire.answer() == b""


def test_what_was_there_before_the_question_is_no_answer():
    wire, port, _ = wire_of()
    port.inbox += b"ab"
    assert wire.exchange(b"?", 2) is None


class Echo:
    def receive(self, data, baud, now_s):
        return data


@pytest.mark.parametrize("device", [Echo(), Says(b"\r\nraspberrypi login: "), Says(b""), Says(b"\x10\x00")])
@pytest.mark.parametrize(("model", "crc"), [("maestro-24", False), ("maestro-24", True), ("ssc-32", False)])
def test_a_port_that_echoes_talks_or_only_reports_damaged_bytes_is_not_a_board(device, model, crc):
    table = Table.of(load_firmware_map(model))
    wire = RateLimitedPort(EmulatedPort(device, 115_200), 115_200, 0.02)
    problem = board_problem(table, board_for(table, crc), wire)
    assert problem is not None and model in problem
