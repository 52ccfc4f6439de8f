"""Requests to one servo: verified writes, two servos with one id."""

import pytest
from emulated_devices import chain_of, table_of
from emulated_port import SILENCE_S, LossyPort, ScriptedPort, link_on
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.errors import ServoError
from sfms_robot.servo.chain.link import Silent, finish, looks_double, verified_write
from sfms_robot.servo.codecs import dxl2, protocol1

MODELS = ("xl330-m288", "xl-320", "ax-12a", "mx-28-1.0", "sts3215", "scs0009")
FATES = st.lists(st.sampled_from(["", "", "request", "answer"]), max_size=24)


def rig(model, fate=()):
    table, device = table_of(model), chain_of(model)
    port = LossyPort(device, fate=iter(fate))
    return table, device.servo(1), port, link_on(port, table)


def held(servo, field, now_s):
    return field.from_bytes(servo.read(field.address, field.size, now_s)[1])


@pytest.mark.parametrize("model", MODELS)
@given(fate=FATES)
def test_what_was_written_is_there_or_an_error_says_that_it_may_not_be(model, fate):
    table, servo, port, link = rig(model, fate)
    field = table.role("goal_position")
    try:
        finish(verified_write(link, 1, field, table.center_ticks + 7))
    except ServoError:
        assert "request" in fate or "answer" in fate
    else:
        assert held(servo, field, port.clock.t) == table.center_ticks + 7


@pytest.mark.parametrize("lost", ["answer", "request"])
@pytest.mark.parametrize("model", MODELS)
def test_a_lost_request_is_repeated_and_a_lost_acknowledgement_costs_its_silence_and_nothing_else(model, lost):
    table, servo, port, link = rig(model, [lost])
    field = table.role("goal_position")
    finish(verified_write(link, 1, field, table.center_ticks - 5))
    assert held(servo, field, port.clock.t) == table.center_ticks - 5
    if lost == "answer":
        assert len(port.sent) == 2  # written once: the value read back is what counts
        assert SILENCE_S < port.clock.t < 2 * SILENCE_S


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("tries", [1, 2, 3])
def test_a_silent_servo_is_named_and_costs_a_bounded_time(model, tries):
    table, servo, port, link = rig(model, ["request"] * 99)
    with pytest.raises(Silent, match="joint_a .* does not answer to"):
        finish(verified_write(link, 1, table.role("goal_position"), 5, tries=tries, about="joint_a (id 1)"))
    assert port.clock.t <= 3 * tries * (SILENCE_S + 0.0005)  # a write, a read back, and what the link asks to be sure


def test_what_is_not_written_is_told_in_words():
    """A servo of the old frame acknowledges what it does not take: torque after a shutdown."""
    table, servo, port, link = rig("sts3215")
    servo.fail(servo.fault_bits["overheating"], port.clock.t)
    with pytest.raises(ServoError, match="id 1: torque_enable was set to 1 and reads 0"):
        finish(verified_write(link, 1, table.role("torque_enable"), 1))
    table, _, _, link = rig("xl330-m288")
    finish(verified_write(link, 1, table["torque_enable"], 1))
    with pytest.raises(ServoError, match="id 1 refuses min_position_limit := 100: .*access"):
        finish(verified_write(link, 1, table["min_position_limit"], 100))
    table, _, port, link = rig("xl330-m288")
    with pytest.raises(ServoError, match="torque_enable = 300 does not fit"):
        finish(verified_write(link, 1, table["torque_enable"], 300))
    assert len(port.sent) == 0


@pytest.mark.parametrize("model", ["sts3215", "scs0009"])
@given(fate=FATES)
def test_eeprom_behind_a_lock_is_kept_for_good_and_the_lock_is_closed(model, fate):
    table, servo, port, link = rig(model, fate)
    field, lock = table.role("return_delay"), table.role("lock")
    try:
        finish(verified_write(link, 1, field, 7, lock=lock))
    except ServoError:
        assert fate
        return
    assert held(servo, lock, port.clock.t) == 1
    servo.power_cycle(port.clock.t)
    assert held(servo, field, port.clock.t) == 7


@pytest.mark.parametrize("exchanges", [1, 3])  # the lock alone, or the value, too
def test_a_write_that_is_dropped_half_way_closes_the_lock(exchanges):
    table, servo, port, link = rig("sts3215")
    lock = table.role("lock")
    steps = verified_write(link, 1, table.role("return_delay"), 7, lock=lock)
    while held(servo, lock, port.clock.t) or len(port.sent) < exchanges:
        next(steps)
    steps.close()
    assert held(servo, lock, port.clock.t) == 1


ONE = dxl2.encode_status(3, 0, bytes([0xB0, 0x04, 53]))
OTHER = dxl2.encode_status(3, 0, bytes([0xA6, 0x04, 52]))


def heard(*pieces: bytes, echo: bool = False, protocol: int = 2):
    return looks_double(ScriptedPort(*pieces, echo=echo), protocol, 3, 0.02)


GARBLED = bytes(a & b for a, b in zip(ONE, OTHER, strict=True))
OLDER = protocol1.encode(3, 0)
HEARD = [  # protocol, pieces that come, whether two servos have the id
    (2, [], False),
    (2, [ONE], False),
    (2, [ONE[:5], ONE[5:]], False),
    (2, [ONE, OTHER], True),
    (2, [GARBLED], True),  # one on top of the other
    (1, [OLDER], False),
    (1, [OLDER, OLDER], True),
    (1, [OLDER, b"\x00"], True),
]


@pytest.mark.parametrize(("protocol", "pieces", "double"), HEARD)
def test_two_servos_with_one_id_are_told_from_one(protocol, pieces, double):
    assert heard(*pieces, protocol=protocol) == double


def test_an_echo_is_no_second_servo_and_a_wire_that_never_falls_silent_is_not_read_for_ever():
    assert not heard(ONE, echo=True) and heard(*[b"\x55" * 100] * 1000)


@pytest.mark.parametrize("shift", range(1, len(ONE)))
def test_an_answer_that_begins_inside_the_other_is_a_duplicate_id(shift):
    overlap = bytes(a & b for a, b in zip(ONE[shift:] + b"\xff" * shift, OTHER, strict=True))
    assert heard(ONE[:shift] + overlap + OTHER[len(OTHER) - shift :])
