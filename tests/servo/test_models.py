"""One bus class for every Dynamixel 2.0 table, and several models on one wire. In virtual time."""

import numpy as np
import pytest

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch
from sfms_robot.errors import ConfigError
from sfms_robot.servo.chain.dynamixel2_bus import Dynamixel2Bus
from sfms_robot.servo.chain.telemetry import common
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import VirtualTimePort
from sfms_robot.servo.registers import Table


class Time:
    t = 0.0

    def now_s(self):
        return self.t


class Ticks:
    """Centre of each servo is 0 rad."""

    def __init__(self, maps):
        self.turn = np.array([each.ticks_per_revolution for each in maps])
        self.center = np.array([each.center_ticks for each in maps])

    def to_ticks(self, angles_rad):
        return np.rint(self.center + np.clip(angles_rad, -0.5, 0.5) * self.turn / (2 * np.pi)).astype(np.int64)

    def to_rad(self, ticks):
        return (ticks - self.center) * 2 * np.pi / self.turn


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
    clock = Time()
    with launch(servos, virtual=True) as chain:
        bus = Dynamixel2Bus(
            "mixed",
            [BusServo(f"joint{i}", i, each, -0.5, 0.5) for i, each in enumerate(maps, 1)],
            Ticks(maps),
            lambda: VirtualTimePort(chain.device, chain.control, 1_000_000, clock),
            1_000_000,
        )
        bus.connect()
        held = bus.enable(bus.joints)
        for k in range(120):
            clock.t += 0.01
            bus.write(held + 0.3 * min(1.0, k / 60), clock.t)
            readings = bus.poll(clock.t)
        bus.stop("release")
        bus.close()
    for each, (joint, reading) in zip(maps, readings.items(), strict=True):
        assert reading.position_rad == pytest.approx(0.3, abs=0.01) and reading.age_s == 0.0
        assert ("current_mA" in reading.extra) == ("current" in bus.capabilities[joint])
        assert "current" not in bus.capabilities[joint] or "present_current" in each.registers


def test_models_with_other_tables_cannot_share_a_bus():
    tables = [Table.of(load_firmware_map(model)) for model in ("xl330-m288", "xl-320")]
    with pytest.raises(ConfigError, match="xl-320 and xl330-m288 have goal_position at different places"):
        common("face", tables, "goal_position")


def test_firmware_picks_the_layout_that_the_bus_goes_by():
    base = load_firmware_map("xl330-m288")
    clock = Time()
    with launch([EmulatedServo(1, firmware=50)], virtual=True) as chain:
        bus = Dynamixel2Bus(
            "old",
            [BusServo("jaw", 1, base, -0.5, 0.5)],
            Ticks([base]),
            lambda: VirtualTimePort(chain.device, chain.control, 1_000_000, clock),
            1_000_000,
        )
        bus.connect()
        held = bus.enable(["jaw"])
        for _ in range(3):
            clock.t += 0.01
            bus.write(held, clock.t)
            bus.poll(clock.t)
        watchdog = bus._link.read(1, 98, 1).data
        bus.stop("release")
        bus.close()
    assert watchdog == b"\x00"  # this firmware's watchdog does not stop the motor
