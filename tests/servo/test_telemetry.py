"""One bus class for every Dynamixel 2.0 table, and several models on one wire. In virtual time."""

from contextlib import contextmanager

import pytest
from chain_rig import bus_of
from emulated_port import BAUD
from virtual_time import Time

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch
from sfms_robot.servo.port import VirtualTimePort


@contextmanager
def bus_on(servos, maps):
    """The bus of a head that names `maps`, and the time."""
    clock = Time()
    with launch(servos, virtual=True) as chain:
        port = chain.device, chain.control, BAUD, clock
        ids = range(1, len(maps) + 1)
        bus = bus_of(maps, ids, lambda: VirtualTimePort(*port), 0.5)
        bus.connect()
        yield bus, clock
        bus.stop("release")
        bus.close()


@pytest.mark.parametrize(
    "models",
    [
        ["xl-320", "xl-320"],
        ["xl430-w250", "2xl430-w250"],
        ["mx-28-2.0", "xm430-w350", "xl330-m288"],
        ["xc330-m181_fw52", "xw540-t260"],
    ],
)
def test_servos_of_these_models_share_a_bus_and_follow(models):
    maps = [load_firmware_map(model) for model in models]
    servos = [
        EmulatedServo(
            i, each.variant_of or each.model, start_ticks=each.center_ticks, firmware=min(53, each.firmware.max)
        )
        for i, each in enumerate(maps, 1)
    ]
    with bus_on(servos, maps) as (bus, clock):
        held = bus.enable(bus.joints)
        for k in range(120):
            clock.t += 0.01
            bus.write(held + 0.3 * min(1.0, k / 60), clock.t)
            readings = bus.poll(clock.t)
    for each, (joint, reading) in zip(maps, readings.items(), strict=True):
        assert reading.position_rad == pytest.approx(0.3, abs=0.01) and reading.age_s == 0.0
        assert ("current_mA" in reading.extra) == ("current" in bus.capabilities[joint])
        assert "current" not in bus.capabilities[joint] or "present_current" in each.registers


def test_firmware_picks_the_layout_that_the_bus_goes_by():
    with bus_on([EmulatedServo(1, firmware=50)], [load_firmware_map("xl330-m288")]) as (bus, clock):
        held = bus.enable(bus.joints)
        for _ in range(3):
            clock.t += 0.01
            bus.write(held, clock.t)
            bus.poll(clock.t)
        assert bus._link.read(1, 98, 1).data == b"\x00"  # this firmware's watchdog does not stop the motor
