"""Devices, faults and the line between, without a terminal."""

import pytest
from emulated_devices import device_of, servos_of

from sfms_robot.emulator.emulated_wire import EmulatedWire
from sfms_robot.emulator.faults import parse_fault
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.codecs import dxl2
from sfms_robot.servo.codecs.dxl2 import encode_instruction, maybe_packet

BAUD = 1_000_000
POSITIONS = (132).to_bytes(2, "little") + (4).to_bytes(2, "little")


def xl330(*ids, chain_break=True, **more):
    """Servos that stand at 2000 and their id."""
    return device_of(*(EmulatedServo(i, start_ticks=2000 + i, **more) for i in ids), chain_break=chain_break)


def wire_of(*ids: int, timing="instant", faults=(), seed=0) -> EmulatedWire:
    chain = xl330(*ids, registers={"return_delay_time": 50})
    return EmulatedWire([chain], timing, [parse_fault(text) for text in faults], seed)


def sync_read(*ids: int) -> bytes:
    return encode_instruction(dxl2.BROADCAST, dxl2.SYNC_READ, POSITIONS + bytes(ids))


def ids_in(outs) -> list[int]:
    buffer, found = bytearray(b"".join(out.data for out in outs)), []
    while (packet := maybe_packet(buffer)) is not None:
        found.append(packet.servo)
    return found


def test_on_the_wire_a_byte_takes_ten_bits_and_a_servo_its_delay():
    wire, request = wire_of(1, 2, timing="wire"), sync_read(1, 2)
    wire.receive(request, BAUD, 1.0)
    assert wire.take(1.0) == []
    first, second = wire.take(2.0)
    byte_s, delay_s, answer = 10 / BAUD, 100e-6, 15
    assert first.due_s == pytest.approx(1.0 + len(request) * byte_s + delay_s + answer * byte_s)
    assert second.due_s == pytest.approx(first.due_s + delay_s + answer * byte_s)
    assert wire.statistics()["busy_s"] == pytest.approx((len(request) + 2 * answer) * byte_s)


def test_a_request_waits_until_the_line_is_free():
    wire = wire_of(1, timing="wire")
    for _ in range(2):
        wire.receive(sync_read(1), BAUD, 1.0)
    first, second = wire.take(2.0)
    assert second.due_s == pytest.approx(1.0 + 2 * (first.due_s - 1.0))


def test_what_leaves_late_is_the_emulators_own_doing():
    wire = wire_of(1, timing="wire")
    for sent_s in (0.0, 0.01):
        wire.receive(sync_read(1), BAUD, 1.0)
        outs = wire.take(2.0)
        wire.sent(outs, outs[0].due_s + sent_s)
    assert wire.statistics()["emulator_late"] == 1 and wire.statistics()["replies"] == 2
    assert [stamp["sent_s"] - stamp["due_s"] for stamp in wire.stamps()] == pytest.approx([0.0, 0.01])


def test_delayed_reply_comes_after_the_next_one():
    wire = wire_of(1, 2, faults=["delay:1=0.005"])
    wire.receive(sync_read(1, 2), BAUD, 0.0)
    assert ids_in(wire.take(0.0)) == [2] and wire.next_s == pytest.approx(0.005)
    wire.receive(sync_read(2), BAUD, 0.01)
    assert ids_in(wire.take(0.01)) == [1, 2]


def write_led(servo: int, value: int) -> bytes:
    return encode_instruction(servo, dxl2.WRITE, b"\x41\x00" + bytes([value]))  # register 65


def test_request_that_is_dropped_or_corrupted_is_not_obeyed():
    wire = wire_of(1, faults=["request-drop@1-2", "request-corrupt@2-3"])
    for now_s, obeyed in ((0.5, True), (1.5, False), (2.5, False), (3.5, True)):
        wire.receive(write_led(1, 1), BAUD, now_s)
        assert bool(wire.take(now_s)) == obeyed and wire.servo(1).read(65, 1, now_s)[1] == bytes([obeyed])
        wire.servo(1).write(65, b"\x00", now_s)
    assert wire.digest()[1] == 4 * len(write_led(1, 1))  # the host has sent them all


def test_requests_that_come_late_keep_their_order():
    wire = wire_of(1, faults=["request-delay@0-1=0.02"])
    wire.receive(write_led(1, 1), BAUD, 0.99)
    wire.receive(write_led(1, 0), BAUD, 1.0)  # not delayed, and still behind the other
    assert wire.take(1.0) == [] and wire.next_s == pytest.approx(1.01)
    wire.advance(1.01)
    assert ids_in(wire.take(1.01)) == [1, 1] and wire.servo(1).read(65, 1, 1.01)[1] == b"\x00"


def test_answer_to_a_late_request_is_there_by_the_time_it_is_due():
    wire = wire_of(1, faults=["request-delay=0.002"])
    wire.receive(sync_read(1), BAUD, 0.0)
    assert ids_in(wire.take(0.003)) == [1]


def test_unplugging_the_adapter_loses_requests_on_their_way():
    wire = wire_of(1, faults=["request-delay=0.02", "hangup@1-1.01"])
    wire.receive(write_led(1, 1), BAUD, 0.99)
    wire.advance(1.005)
    assert wire.next_s == pytest.approx(1.01)  # the end of the fault, and nothing else
    wire.advance(2.0)
    assert wire.take(2.0) == [] and wire.servo(1).read(65, 1, 2.0)[1] == b"\x00"


def test_echo_comes_before_the_answer_and_noise_behind():
    wire, request = wire_of(1, faults=["echo", "noise"]), sync_read(1)
    wire.receive(request, BAUD, 0.0)
    sent = b"".join(out.data for out in wire.take(0.0))
    assert sent.startswith(request) and len(sent) > len(request) + 15


def test_brown_out_silences_everybody_and_lets_them_start_anew():
    wire = wire_of(1, 2, faults=["brownout@1-1.5"])
    for servo in (1, 2):
        assert wire.servo(servo).write(64, b"\x01", 0.5) == 0
    for now_s, count in ((0.9, 2), (1.2, 0), (1.6, 0), (1.9, 2)):
        wire.receive(sync_read(1, 2), BAUD, now_s)
        assert len(ids_in(wire.take(now_s))) == count
    assert [wire.servo(i).torque for i in (1, 2)] == [0, 0]


def test_overload_overheat_and_voltage_are_latched():
    wire = wire_of(1, 2, 3, faults=["overload:1@1", "overheat:2@1", "voltage@1-2=7.5"])
    wire.advance(3.0)
    assert [wire.servo(i).fault_status for i in (1, 2, 3)] == [1 << 5 | 1, 1 << 2 | 1, 1]
    assert wire.servo(3).supply_v == 5.0


def test_unplugged_wire_hears_nothing_but_counts():
    wire = wire_of(1, faults=["hangup@1-2"])
    wire.receive(sync_read(1), BAUD, 1.5)
    assert wire.hung and wire.take(9.0) == [] and wire.digest()[1] == len(sync_read(1))
    wire.advance(2.0)
    assert not wire.hung


@pytest.mark.parametrize("chain_break", [True, False])
def test_mute_servo_obeys_and_never_answers(chain_break):
    chain = xl330(1, 2, 3, chain_break=chain_break)
    wire = EmulatedWire([chain], "instant", [parse_fault("mute:2@1-3")], 0)
    torque_on = encode_instruction(2, dxl2.WRITE, bytes([64, 0, 1]))
    behind = [1] if chain_break else [1, 3]
    for now_s, answers, order in ((0.5, [2], [1, 2, 3]), (2.0, [], behind), (3.5, [2], [1, 2, 3])):
        chain.servo(2).write(64, b"\0", now_s)
        wire.receive(torque_on, BAUD, now_s)
        assert ids_in(wire.take(now_s)) == answers and chain.servo(2).state(now_s)["torque"]
        wire.receive(sync_read(1, 2, 3), BAUD, now_s)
        assert ids_in(wire.take(now_s)) == order
        wire.receive(encode_instruction(dxl2.BROADCAST, dxl2.PING), BAUD, now_s)
        assert ids_in(wire.take(now_s)) == [i for i in (1, 2, 3) if i != 2 or answers]


def test_board_is_mute_when_all_its_channels_are():
    board = device_of(*servos_of("ssc-32", 0, 1, baud=9600))
    wire = EmulatedWire([board], "instant", [parse_fault("mute@1-2")], 0)
    for now_s, answers in ((0.5, 1), (1.5, 0), (2.5, 1)):
        wire.receive(f"#0P{1500 + round(now_s)}\rQ\r".encode(), 9600, now_s)
        assert len(wire.take(now_s)) == answers and board.channels[0].goal == 1500 + round(now_s)
