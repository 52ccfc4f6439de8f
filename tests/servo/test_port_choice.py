import pytest

from sfms_robot.errors import ConfigError, PortError
from sfms_robot.servo.discovery import SerialDevice, choose_ports, parse_ports

USB0, USB1 = SerialDevice("/dev/ttyUSB0", vendor="0403"), SerialDevice("/dev/ttyUSB1", vendor="1a86")
BUILT_IN = SerialDevice("/dev/ttyS0")


@pytest.mark.parametrize(
    ("buses", "text", "devices"),
    [
        (["main"], "/dev/ttyUSB0", {"main": "/dev/ttyUSB0"}),
        (["main"], "main=/dev/ttyUSB0", {"main": "/dev/ttyUSB0"}),
        (["main"], "socket://robot:4000?a=b", {"main": "socket://robot:4000?a=b"}),
        (["neck", "face"], "face=COM4,neck=COM3", {"neck": "COM3", "face": "COM4"}),
    ],
)
def test_every_bus_gets_its_device(buses, text, devices):
    assert parse_ports(buses, text) == devices


@pytest.mark.parametrize(
    ("buses", "text", "problem"),
    [
        (["main"], "main=A,main=B", "bus main is given twice"),
        (["main"], "foo=/dev/ttyS0", "one device per bus is needed"),
        (["main"], "main=A,face=B", "one device per bus is needed"),
        (["main"], "", "one device per bus is needed"),
        (["main"], "main=", "one device per bus is needed"),
        (["main"], "A,B", "one device per bus is needed"),
        (["neck", "face"], "/dev/ttyUSB0", "one device per bus is needed"),
        (["neck", "face"], "neck=A", "bus face has no device"),
        (["neck", "face"], "neck=A,face=A", "A is given to two buses"),
        (["neck", "face"], "neck=A,face=B,neck=C", "bus neck is given twice"),
    ],
)
def test_what_leaves_a_bus_in_doubt_is_refused(buses, text, problem):
    with pytest.raises(ConfigError, match=rf"^--port {text!r}: {problem} \(sim, auto, .*DEVICE\)$"):
        parse_ports(buses, text)


def test_auto_takes_the_only_adapter_without_a_question():
    def never(bus: str, device: str) -> bool:
        raise AssertionError("asked")

    assert choose_ports(["main"], [BUILT_IN, USB0], never) == {"main": "/dev/ttyUSB0"}


def test_auto_asks_each_adapter_for_the_servos_of_each_bus():
    there = {("neck", "/dev/ttyUSB1"), ("face", "/dev/ttyUSB0")}
    chosen = choose_ports(["neck", "face"], [USB0, USB1], lambda bus, device: (bus, device) in there)
    assert chosen == {"neck": "/dev/ttyUSB1", "face": "/dev/ttyUSB0"}


@pytest.mark.parametrize("probe", [None, lambda bus, device: True])
def test_auto_does_not_guess_between_two(probe):
    with pytest.raises(ConfigError, match="2 adapters may be bus main .*/dev/ttyUSB0, /dev/ttyUSB1"):
        choose_ports(["main"], [USB0, USB1], probe)
    with pytest.raises(ConfigError, match="auto: .* bus face"):
        choose_ports(["neck", "face"], [USB0], lambda bus, device: True)


def test_auto_says_when_nothing_is_there():
    with pytest.raises(PortError, match="no USB serial adapter is plugged in"):
        choose_ports(["main"], [BUILT_IN])
    with pytest.raises(ConfigError, match="no adapter has the servos of bus main .*/dev/ttyUSB0, /dev/ttyUSB1"):
        choose_ports(["main"], [USB0, USB1], lambda bus, device: False)
