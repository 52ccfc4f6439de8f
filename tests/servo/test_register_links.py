import pytest
from chain_rig import rig_of
from emulated_port import Says, link_on
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import PacketError
from sfms_robot.servo.chain.link import Answer, Found, RegisterLink
from sfms_robot.servo.codecs.dxl2 import ACCESS_ERROR, encode_status
from sfms_robot.servo.codecs.protocol1 import encode


def link_of(model, starts, **more):
    rig = rig_of(model, starts, **more)
    return link_on(rig.port, rig.servo(1).table), rig


@pytest.mark.parametrize(
    ("model", "found"),
    [
        ("ax-12a", Found(12, 53)),
        ("mx-64-1.0", Found(310, 53)),
        ("sts3215", Found(777, 53, 0)),
        ("scs0009", Found(1284, 53, 0)),
    ],
)
def test_ping_tells_who_is_there_whatever_the_byte_order(model, found):
    link, _ = link_of(model, [500, 600])
    tool: RegisterLink = link
    assert tool.ping(1) == found and tool.ping(9) is None and tool.broadcast_ping() == {1: found, 2: found}


def test_refusal_is_an_answer():
    link, _ = link_of("ax-12a", [512])
    assert link.write(1, 36, b"\x00\x00") == Answer(0x08, b"") and link.read(1, 48, 20) == Answer(0x08, b"")
    newer, rig = link_of("xl330-m288", [2048])
    rig.port.device = Says(encode_status(1, ACCESS_ERROR))
    assert newer.read(1, 132, 4).error == ACCESS_ERROR


def test_what_the_protocol_cannot_do_is_said():
    link, _ = link_of("sts3215", [2048])
    with pytest.raises(PacketError, match="servo 1 speaks feetech and has no reboot instruction: switch its supply"):
        link.reboot(1)
    with pytest.raises(PacketError, match="resets everything"):
        link.factory_reset(1, 2)
    assert link.factory_reset(1, 0xFF) == Answer(0, b"")


@pytest.mark.parametrize(("model", "status"), [("ax-12a", encode), ("xl330-m288", encode_status)])
@pytest.mark.parametrize(("servo", "data"), [(2, b"\x01\x02"), (1, b"\x01"), (1, b"\x01\x02\x03")])
def test_answer_of_another_servo_or_length_is_left_alone(model, status, servo, data):
    link, rig = link_of(model, [500])
    rig.port.device = Says(status(servo, 0, data))
    assert link.read(1, 36, 2) is None


class Late:
    """A device whose answers come one request after the other, each a serial number."""

    def __init__(self, lags):
        self.lags, self.count, self.queue = list(lags), 0, []

    def receive(self, data, baud, now_s):
        self.count += 1
        length = data[6] if data[4] == 2 else 0
        body = bytes([self.count % 250] * length)
        lag = self.lags.pop(0) if self.lags else 0
        due = max([self.count + lag, *(when for when, _ in self.queue)])  # a servo answers in order
        self.queue.append((due, encode(1, 0, body)))
        out = b"".join(answer for when, answer in self.queue if when <= self.count)
        self.queue = [item for item in self.queue if item[0] > self.count]
        return out


@given(st.lists(st.sampled_from([0, 0, 0, 1, 2, 5]), max_size=30))
def test_no_answer_is_ever_that_of_an_earlier_request(lags):
    link, rig = link_of("ax-12a", [512])
    rig.port.device = device = Late(lags)
    for _ in range(40):
        rig.clock.t += 0.01
        answer = link.read(1, 36, 2)
        if answer is not None:
            assert answer.data == bytes([device.count % 250] * 2)
    assert link.read(1, 36, 2) is not None


def test_debt_is_forgotten_after_a_second():
    link, rig = link_of("ax-12a", [512])
    rig.kill(1)
    assert link.read(1, 36, 2) is None
    rig.revive(1)
    rig.clock.t = 5.0
    before = len(rig.port.sent)
    assert link.read(1, 36, 2) is not None
    assert len(rig.port.sent) - before == 1


@pytest.mark.parametrize("model", ["ax-12a", "sts3215", "xl330-m288"])
def test_own_words_heard_again_are_no_answer(model):
    link, rig = link_of(model, [500])
    rig.port.hears_itself = True
    position = rig.servo(1).table["present_position"]
    assert link.read(1, position.address, position.size) == Answer(0, position.to_bytes(500))
    rig.kill(1)
    assert link.ping(1) is None and link.read(1, 36, 2) is None


@pytest.mark.parametrize("hears_itself", [False, True])
@pytest.mark.parametrize("model", ["ax-12a", "sts3215"])
def test_servo_whose_answer_to_a_ping_is_the_ping_itself_is_there(model, hears_itself):
    link, rig = link_of(model, [500, 500])
    rig.port.hears_itself = hears_itself
    rig.servo(1).set_supply(20.0, 0.0)  # error byte 1 is the code of a ping
    assert link.read(1, 0, 1).error == 1
    number = rig.servo(1).table.model_number
    assert link.ping(1).model_number == number and set(link.broadcast_ping()) == {1, 2}
    rig.kill(1)
    assert link.ping(1) is None


@given(st.binary(max_size=40))
def test_rubbish_before_an_answer_does_not_hide_it(rubbish):
    for model in ("sts3215", "xl330-m288"):
        link, rig = link_of(model, [500])
        position = rig.servo(1).table["present_position"]
        rig.port.device = Says(rubbish.replace(b"\xff", b"\x00"), rig.device)
        assert link.read(1, position.address, 2) == Answer(0, b"\xf4\x01")
