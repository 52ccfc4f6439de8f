"""An emulated phone sends what a real one sent, at its pace, without end."""

import socket

import pytest

from sfms_robot.emulator.phone import EmulatedPhone, main, recorded_packets, renumbered
from sfms_robot.errors import ConfigError
from sfms_robot.sources.live_link import parse_packet


@pytest.fixture
def receiver():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(("127.0.0.1", 0))
        yield listening


@pytest.fixture
def phone(receiver):
    emulated = EmulatedPhone(*receiver.getsockname())
    yield emulated
    emulated.close()


def test_the_shipped_packets_are_one_phones_and_a_number_is_all_that_changes():
    packets = recorded_packets()
    assert len(packets) == 180 and {parse_packet(each).subject for each in packets} == {"LLV Default Device"}
    first = recorded_packets()[0]
    again = renumbered(first, 7)
    assert parse_packet(again).number == 7 and renumbered(again, parse_packet(first).number) == first


def test_the_stream_goes_on_without_a_jump(phone):
    parsed = [parse_packet(phone.packet(number)) for number in range(1000)]
    assert [each.number for each in parsed] == list(range(1000))
    largest = max(abs(b.values - a.values).max() for a, b in zip(parsed, parsed[1:], strict=False))
    recorded = [parse_packet(each).values for each in recorded_packets()]
    assert largest == max(abs(b - a).max() for a, b in zip(recorded, recorded[1:], strict=False))


def test_packets_go_out_when_they_are_due(phone, receiver):
    assert [phone.send_until(now_s) for now_s in (0.0, 0.01, 1 / 60, 0.1, 0.1)] == [1, 0, 1, 5, 0]
    assert [parse_packet(receiver.recv(1000)).number for _ in range(7)] == list(range(7))


def test_playing_keeps_the_pace(phone):
    slept_s: list[float] = []  # time passes only then
    phone.play(2.0, lambda: sum(slept_s), slept_s.append)
    assert phone.sent == len(slept_s) == 120


@pytest.mark.parametrize("target", ["phone", "0", "host:", "70000"])
def test_a_place_that_is_none_is_one_line(target):
    with pytest.raises(ConfigError, match="is not an address to send to"):
        main([target])
    with pytest.raises(ConfigError, match=r"'no\.such\.machine\.invalid:1': "):
        main(["no.such.machine.invalid:1"])


def test_a_file_that_is_none_is_one_line(tmp_path):
    file = tmp_path / "x.gesichter"
    file.write_bytes(b"hello")
    with pytest.raises(ConfigError, match="not recorded packets of a phone"):
        recorded_packets(file)
