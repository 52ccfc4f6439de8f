import pytest
from emulated_devices import chain_of
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.servo.codecs import protocol1
from sfms_robot.servo.codecs.protocol1 import BROADCAST, Frame, encode, maybe_frame

BAUD = 1_000_000


def ask(device, servo, code, params=b"", now_s=0.0, baud=BAUD) -> list[Frame]:
    buffer = bytearray(device.receive(encode(servo, code, params), baud, now_s))
    frames = []
    while (frame := maybe_frame(buffer)) is not None:
        frames.append(frame)
    assert not buffer
    return frames


def get(device, servo, name, now_s=0.0) -> int:
    field = device.servo(servo).table[name]
    (answer,) = ask(device, servo, protocol1.READ, bytes([field.address, field.size]), now_s)
    return field.from_bytes(answer.params)


def put(device, servo, name, value, now_s=0.0) -> int:
    """Error byte of the acknowledgement."""
    field = device.servo(servo).table[name]
    (answer,) = ask(device, servo, protocol1.WRITE, bytes([field.address]) + field.to_bytes(value), now_s)
    return answer.code


@pytest.mark.parametrize("model", ["ax-12a", "sts3215"])
def test_goal_before_torque_switches_the_torque_on(model):
    device = chain_of(model)
    put(device, 1, "goal_position", 600)
    assert get(device, 1, "torque_enable") == 1


def test_dynamixel_says_what_it_refuses_and_changes_nothing():
    device = chain_of("ax-12a")
    put(device, 1, "cw_angle_limit", 200)
    assert put(device, 1, "goal_position", 100) == protocol1.ANGLE_LIMIT
    assert ask(device, 1, protocol1.WRITE, bytes([36, 0, 0]))[0].code == protocol1.RANGE  # read-only
    assert ask(device, 1, protocol1.WRITE, bytes([24, 7]))[0].code == protocol1.RANGE
    assert ask(device, 1, protocol1.READ, bytes([48, 20]))[0] == Frame(1, protocol1.RANGE, b"")
    assert ask(device, 1, 0x77)[0].code == protocol1.INSTRUCTION
    assert ask(device, 1, protocol1.ACTION)[0].code == protocol1.INSTRUCTION  # nothing was registered
    assert (get(device, 1, "goal_position"), get(device, 1, "torque_enable")) == (512, 0)


def test_feetech_takes_what_it_can_and_says_nothing():
    device = chain_of("scs0009")
    assert put(device, 1, "goal_position", 5) == 0
    assert get(device, 1, "goal_position") == 20  # its own limit
    assert ask(device, 1, protocol1.WRITE, bytes([56, 0, 0]))[0].code == 0 and ask(device, 1, 0x77) == []


def test_locked_eeprom_forgets_on_feetech():
    device = chain_of("sts3215")
    for lock, kept in ((1, 0), (0, 5)):
        put(device, 1, "lock", lock)
        put(device, 1, "return_delay_time", 5)
        assert get(device, 1, "return_delay_time") == 5
        device.servo(1).power_cycle(0.0)
        assert get(device, 1, "return_delay_time") == kept


def test_locked_eeprom_takes_nothing_on_dynamixel_and_the_lock_holds():
    device = chain_of("ax-12a")
    assert put(device, 1, "lock", 1) == 0 and put(device, 1, "alarm_led", 4) == 0 and put(device, 1, "lock", 0) == 0
    assert (get(device, 1, "alarm_led"), get(device, 1, "lock")) == (36, 1)
    device.servo(1).power_cycle(0.0)
    assert get(device, 1, "lock") == 0


def test_status_level_decides_who_is_answered():
    device = chain_of("ax-12a", "sts3215")
    put(device, 1, "status_return_level", 0)
    put(device, 2, "response_level", 0)
    assert ask(device, 1, protocol1.READ, bytes([3, 1])) == [] and len(ask(device, 1, protocol1.PING)) == 1
    assert len(ask(device, 2, protocol1.READ, bytes([5, 1]))) == 1  # reads are answered whatever the level
    assert ask(device, 2, protocol1.WRITE, bytes([40, 0])) == []


def test_what_a_protocol_lacks_is_silence():
    device = chain_of("scs0009", "ax-12a", "mx-28-1.0")
    assert ask(device, BROADCAST, protocol1.SYNC_READ, protocol1.sync_read_params(56, 2, [1])) == []
    assert ask(device, BROADCAST, protocol1.BULK_READ, protocol1.bulk_read_params([(2, 36, 2)])) == []
    (answer,) = ask(device, BROADCAST, protocol1.BULK_READ, protocol1.bulk_read_params([(3, 36, 2)]))
    assert answer == Frame(3, 0, b"\x00\x08")
    device = chain_of("sts3215", "ax-12a", "scs0009")
    assert [frame.servo for frame in ask(device, BROADCAST, protocol1.PING)] == [1, 3]


def test_overload_comes_from_the_motor_and_takes_the_torque():
    device = chain_of("ax-12a")
    device.servo(1).plant.stuck = True
    put(device, 1, "goal_position", 900)
    (answer,) = ask(device, 1, protocol1.PING, now_s=3.0)
    assert answer.code == 1 << 5  # overload
    assert (get(device, 1, "torque_enable", 3.0), get(device, 1, "torque_limit", 3.0)) == (0, 0)
    device.servo(1).plant.stuck = False
    put(device, 1, "torque_limit", 1023, 3.0)
    put(device, 1, "torque_enable", 1, 3.0)
    assert ask(device, 1, protocol1.PING, now_s=3.0)[0].code == 0


@pytest.mark.parametrize("how", ["torque_enable := 128", "instruction 0x0B"])
def test_sts_is_calibrated_where_it_stands(how):
    device = chain_of("sts3215", start_ticks=3000)
    if how.startswith("torque"):
        put(device, 1, "torque_enable", protocol1.CALIBRATE_HERE)
    else:
        ask(device, 1, protocol1.CALIBRATE_OFFSET)
    assert (get(device, 1, "present_position"), get(device, 1, "homing_offset")) == (2048, 952)
    put(device, 1, "goal_position", 2148)
    assert get(device, 1, "present_position", 2.0) == 2148 and device.servo(1).plant.position == 3100


@given(st.lists(st.binary(max_size=80), max_size=10))
def test_any_bytes_are_survived(chunks):
    device = chain_of("ax-12a", "sts3215", "scs0009")
    for k, chunk in enumerate(chunks):
        device.receive(b"\xff\xff" + chunk, BAUD, 0.01 * k)
    device.advance(1.0)
    assert device.servo(1) is None or device.servo(1).state(1.0)["position"] >= -2048
