"""What only the bus of Dynamixel 2.0 does, on emulated servos in another process."""

import math

import pytest
from chain_rig import bus_of
from emulated_port import BAUD

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.launch import EmulatedServo, launch
from sfms_robot.errors import ServoError
from sfms_robot.runtime.clock import RealClock
from sfms_robot.servo.port import SerialPort

RAD_PER_TICK = 2 * math.pi / 4096


def test_servo_in_shutdown_is_named_at_torque_on(rig):
    rig.bus.connect()
    rig.chain.fault(2, 1 << 2)
    with pytest.raises(ServoError, match=r"joint2 \(id 2\) refuses torque_enable := 1.*hardware error"):
        rig.bus.enable(rig.bus.joints)


def test_mode_and_drive_mode_are_set_before_the_first_goal(rig):
    with rig.link() as link:
        # Extended position, torque on by goal, acknowledge nothing.
        for address, value in ((11, 4), (10, 0x08), (68, 0)):
            link.write(1, address, bytes([value]))
    rig.hold()
    rig.bus.close()
    with rig.link() as link:
        assert [link.read(1, address, 1).data[0] for address in (11, 10, 68, 9)] == [3, 0, 2, 0]


def test_servo_that_lost_its_torque_while_silent_is_named(rig):
    held = rig.hold()
    rig.chain.kill(2)
    rig.ticks(held, 3)
    rig.chain.fault(2, 1 << 5)
    rig.chain.revive(2)
    assert rig.ticks(held, 20)["joint2"].fault in ("torque lost", "overload")


def test_bus_works_in_real_time_on_the_serial_port_alone():
    maps = [load_firmware_map("xl330-m288")] * 28
    with launch([EmulatedServo(i, start_ticks=2000) for i in range(1, 29)]) as chain:
        port = chain.device, BAUD, RealClock()
        bus = bus_of(maps, range(1, 29), lambda: SerialPort(*port), read_deadline_s=1.0)
        bus.connect()
        held = bus.enable(bus.joints)
        for k in range(20):
            bus.write(held, 0.01 * k)
            readings = bus.poll(0.01 * k)
            assert [r.position_rad for r in readings.values()] == pytest.approx(held)
        bus.stop("release")
        bus.close()
        counts = bus.statistics()
        assert (counts["writes"], counts["retries"], counts["errors"], counts["silent"]) == (20, 0, 0, [])
