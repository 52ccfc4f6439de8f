"""Where the buses of a head are: emulated servos in a process of their own, or serial devices."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from math import radians
from typing import Final

import numpy as np

from sfms_robot.app.options import SIM, HeadOptions
from sfms_robot.config import BusConfig, FirmwareMap, Head, Joint, load_firmware_map
from sfms_robot.config.head import StoredRegisters, load_stored
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.errors import ConfigError
from sfms_robot.motion.calibration import Calibration
from sfms_robot.ports import Clock
from sfms_robot.servo.discovery import AUTO, choose_ports, list_ports, parse_ports, stable_name
from sfms_robot.servo.port import EmulatedPort, Port, SerialPort, VirtualTimePort
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import JointNeeds, home_ticks, multi_turn

_NEW: Final = StoredRegisters()
HANGING: Final = 0.3  # fraction of the way from rest to its lower end, where nothing pulls hard
BEYOND_RAD: Final = radians(2.0)  # how far a stop lies outside the range of the head's file

Opened = Mapping[str, Chain | str]  # per named bus: an emulated chain, or a serial device


def devices(head: Head, port: str) -> dict[str, str]:
    """Return the device of each named bus. Raises ConfigError, and PortError for `auto` without an adapter."""
    return choose_ports(head.buses, list_ports()) if port == AUTO else parse_ports(head.buses, port)


@contextmanager
def open_wires(head: Head, options: HeadOptions) -> Iterator[Opened]:
    """Give the place of each bus of the head: emulated servos, which live as long as this does, or devices."""
    with ExitStack() as stack:
        if options.port != SIM:
            yield devices(head, options.port)
            return
        chains = plugged_in(options.head, head)
        yield {name: stack.enter_context(launch(chains[name], options.fast)) for name in chains}


def port_of(where: Chain | str, bus: BusConfig, clock: Clock) -> Callable[[], Port]:
    """Return a function that opens the port of a bus, again after its device was unplugged. Raises PortError."""
    if isinstance(where, str):
        return partial(SerialPort, stable_name(where), bus.baud, clock, bus.rs485)
    if where.virtual:
        return partial(VirtualTimePort, where.device, where.control, bus.baud, clock)
    return partial(EmulatedPort, where.device, where.control, bus.baud, clock)


def firmware_maps(joints: Mapping[str, Joint]) -> dict[str, FirmwareMap]:
    return {model: load_firmware_map(model) for model in {joint.model for joint in joints.values()}}


def calibration_of(joints: dict[str, Joint]) -> Calibration:
    maps = firmware_maps(joints)
    turns = np.array([maps[joint.model].ticks_per_revolution for joint in joints.values()])
    return Calibration(joints, turns)


def emulated(head: Head, stored: StoredRegisters = _NEW) -> dict[str, list[EmulatedServo]]:
    """Return, by bus, the servos of a head that was switched off: sagged onto its stops, torque off.

    A geared joint hangs where its servo, which counts turns from power-up only, can be in one place of its range.
    `stored`: supply and registers. Raises ConfigError for those of a joint that the head does not have.
    """
    for unknown in stored.joints.keys() - head.joints.keys():
        raise ConfigError.at(
            f"{head.name}: emulate.yaml", "joints", unknown, "is not a joint of this head", head.joints
        )
    by_bus: dict[str, list[EmulatedServo]] = {}
    calibration, sagging = calibration_of(head.joints), sagging_joints(head)
    for index, (name, joint) in enumerate(head.joints.items()):
        table = Table.of(load_firmware_map(joint.model))
        angle_rad = sagged_rad(joint, name in sagging)
        found = calibration.zero_ticks[index] + calibration.ticks_per_rad[index] * angle_rad
        # Not held to the joint's limits, but to what a servo about its middle can read.
        ticks = round(min(max(found, 0.0), 2.0 * table.center_ticks - 1.0))
        needs = JointNeeds(int(calibration.low_ticks[index]), int(calibration.high_ticks[index]))
        if multi_turn(table, needs):
            first, last = home_ticks(table.ticks_per_revolution, needs)
            ticks = max(first, min(ticks, last))
        bus = head.buses[joint.bus]
        registers = ({"crc": 1} if bus.crc else head.safety_of(name).stored) | stored.of(name)
        servo = EmulatedServo(joint.id, joint.model, bus.baud, ticks, registers=registers, supply_v=stored.supply_v)
        by_bus.setdefault(joint.bus, []).append(servo)
    return by_bus


def plugged_in(name: str, head: Head) -> dict[str, list[EmulatedServo]]:
    """Return the servos of `emulated` with what the emulate.yaml of head `name` says. Raises ConfigError."""
    return emulated(head, load_stored(name))


# --- where the joints of a head stand that is switched off ----------------------------------------------------------


def sagging_joints(head: Head) -> frozenset[str]:
    """Return joints that bear the weight of the head, which falls forward: those that pitch a serial neck."""
    neck = head.kinematics
    if neck is None or neck.kind != "serial" or "pitch" not in neck.axes:
        return frozenset()
    pitch = neck.axes["pitch"]
    return frozenset([pitch] if isinstance(pitch, str) else [pitch.lower, pitch.upper])


def sagged_rad(joint: Joint, sags: bool) -> float:
    """Return the angle without torque: on the stop beyond its upper end (nose down), or hanging a little from rest."""
    return joint.max_rad + BEYOND_RAD if sags else joint.rest_rad + HANGING * (joint.min_rad - joint.rest_rad)
