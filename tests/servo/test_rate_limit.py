from device_port import DevicePort, Time

from sfms_robot.servo.boards.rate_limit import RateLimitedPort


class Echo:
    """A device that answers with what it heard, as soon as it is told to."""

    def __init__(self):
        self.waiting = b""

    def receive(self, data, baud, now_s):
        self.waiting += data
        return b""


def wire_of(device, baud=9600, patience_s=0.02):
    clock = Time()
    port = DevicePort(device, baud, clock)
    return RateLimitedPort(port, baud, patience_s), port, clock


def test_wire_is_busy_until_its_bytes_have_left():
    wire, _, clock = wire_of(Echo())
    assert wire.free
    assert wire.send(bytes(96)) == 0.0
    assert wire.send(bytes(96)) == 0.1
    clock.t = 0.19
    assert not wire.free
    clock.t = 0.2
    assert wire.free


def test_answer_is_taken_when_it_is_whole_and_nobody_waits_for_it():
    wire, port, clock = wire_of(Echo())
    wire.request(b"?", 2)
    assert wire.awaiting and wire.answer() is None
    port.inbox += b"a"
    assert wire.answer() is None
    port.inbox += b"b"
    assert wire.answer() == b"ab" and not wire.awaiting
    assert all(deadline_s == clock.t for deadline_s in port.waits)


def test_answer_that_is_late_or_too_long_is_none():
    wire, port, clock = wire_of(Echo())
    wire.request(b"?", 2)
    clock.t = 1.0
    assert wire.answer() == b""
    wire.request(b"?", 2)
    port.inbox += b"abc"
    assert wire.answer() == b""


def test_what_was_there_before_the_question_is_no_answer():
    wire, port, _ = wire_of(Echo())
    port.inbox += b"ab"
    assert wire.exchange(b"?", 2) is None
