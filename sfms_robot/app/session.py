"""A head's file -> its parts: the bus that drives it, and what turns motion into safe joint angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from sfms_robot.app.safety_settings import check_safety
from sfms_robot.config import FirmwareMap, Head, Joint, load_firmware_map, load_head
from sfms_robot.config.emulate import load_stored
from sfms_robot.data import data_dir, shipped_names
from sfms_robot.emulator.launch import Chain, EmulatedServo
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles
from sfms_robot.motion.audit import Audit
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.motion.timeline import PlanTimeline
from sfms_robot.ports import Bus, Clock
from sfms_robot.retarget.head import HeadRetargeter
from sfms_robot.servo.composite import CompositeBus
from sfms_robot.servo.discovery import list_ports, stable_name
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port, SerialPort, VirtualTimePort
from sfms_robot.servo.port_choice import AUTO, choose_ports, parse_ports
from sfms_robot.servo.serial_io import Rs485

SIM = "sim"
SIM_READ_DEADLINE_S = 0.02  # an emulator shares the computer's cores: it may be late without being silent
# The class of each bus family; only those of the head are imported.
FAMILIES = {
    "dynamixel2": "sfms_robot.servo.chain.dynamixel2_bus:DynamixelBus",
    "dynamixel1": "sfms_robot.servo.chain.dynamixel1_bus:Dynamixel1Bus",
    "feetech": "sfms_robot.servo.chain.feetech_bus:FeetechBus",
    "maestro": "sfms_robot.servo.boards.maestro_bus:MaestroBus",
    "ssc32": "sfms_robot.servo.boards.ssc32_bus:Ssc32Bus",
}
BOARDS = ("maestro", "ssc32")
HANGING = 0.3  # where an emulated joint stands at power-up: this share of the way from rest to its lower end


Opened = dict[str, Chain | str]  # per named bus: an emulated chain, or a serial device


@dataclass(frozen=True)
class Motion:
    """What lies between a plan and the bus."""

    timeline: PlanTimeline
    retargeter: HeadRetargeter
    limiter: JerkLimiter
    audit: Audit
    leads_s: Doubles
    rest_rad: Doubles


def shipped_heads() -> list[dict[str, Any]]:
    """What `head list` shows."""
    names = shipped_names(data_dir("configs") / "heads", "head.yaml")
    heads = [load_head(name) for name in names]
    return [
        {
            "name": head.name,
            "description": head.description,
            "joints": len(head.joints),
            "neck": head.kinematics.kind if head.kinematics else None,
            "buses": {name: bus.family for name, bus in head.buses.items()},
        }
        for head in heads
    ]


def build_motion(head: Head, rate_hz: float) -> Motion:
    """Timeline, retargeter, limiter and audit at the rate of the loop, which is that of the head's fastest bus."""
    limits = JointLimits.of(head)
    retargeter = HeadRetargeter(head, 1.0 / rate_hz)
    leads_s = np.array([joint.lag_ms / 1e3 for joint in head.joints.values()])
    if len(neck := retargeter.neck_columns):
        leads_s[neck] = leads_s[neck].max()  # its joints show one pose together
    return Motion(
        PlanTimeline(1.0 / rate_hz),
        retargeter,
        JerkLimiter(limits, 1.0 / rate_hz),
        Audit(limits, _calibration(head.joints), 1.0 / rate_hz),
        leads_s,
        np.array([joint.rest_rad for joint in head.joints.values()]),
    )


def _maps(joints: dict[str, Joint]) -> dict[str, FirmwareMap]:
    return {model: load_firmware_map(model) for model in {joint.model for joint in joints.values()}}


def _calibration(joints: dict[str, Joint]) -> Calibration:
    maps = _maps(joints)
    turns = np.array([maps[joint.model].ticks_per_revolution for joint in joints.values()])
    return Calibration(joints, turns)


def emulated(head: Head) -> dict[str, list[EmulatedServo]]:
    """Per bus, the servos of a head that was switched off: hanging a little from rest, torque off."""
    by_bus: dict[str, list[EmulatedServo]] = {}
    for name, joint in head.joints.items():
        hanging = np.array([joint.rest_rad + HANGING * (joint.min_rad - joint.rest_rad)])
        ticks = int(_calibration({name: joint}).to_ticks(hanging)[0])
        baud = head.buses[joint.bus].baud
        servo = EmulatedServo(joint.id, joint.model, baud, ticks, registers=head.safety_of(name).stored)
        by_bus.setdefault(joint.bus, []).append(servo)
    return by_bus


def plugged_in(name: str, head: Head) -> dict[str, list[EmulatedServo]]:
    """As `emulated`, with what somebody has stored in the servos of head `name` and the supply that they run on.

    Raises ConfigError for stored values of a joint that the head does not have.
    """
    stored = load_stored(name)
    for joint in stored.joints:
        if joint not in head.joints:
            raise ConfigError.at(f"{name}: emulate.yaml", "joints", joint, "is no joint of this head", head.joints)
    joints = {(joint.bus, joint.id): key for key, joint in head.joints.items()}
    return {
        bus: [
            replace(
                servo,
                registers={**servo.registers, **stored.of(joints[bus, servo.id])},
                supply_v=stored.supply_v,
            )
            for servo in servos
        ]
        for bus, servos in emulated(head).items()
    }


def on_boards(head: Head) -> list[str]:
    """Joints whose servos report no position, so that they jump when they come on."""
    return [name for name, joint in head.joints.items() if head.buses[joint.bus].family in BOARDS]


def devices(head: Head, port: str) -> dict[str, str]:
    """What `--port` says -> device per named bus. Raises ConfigError, and PortError for `auto` without an adapter."""
    return choose_ports(head.buses, list_ports()) if port == AUTO else parse_ports(head.buses, port)


def build_bus(head: Head, opened: Opened, clock: Clock, confirmed: bool = False) -> Bus:
    """The head's bus, not yet connected. `confirmed`: hobby servos may jump when their pulses come on."""
    buses: dict[str, Bus] = {}
    for name, where in opened.items():
        joints = {key: joint for key, joint in head.joints.items() if joint.bus == name}
        buses[name] = _build_one(head, name, joints, where, clock, confirmed)
    real = not any(isinstance(where, Chain) and where.virtual for where in opened.values())
    rates = {name: head.buses[name].rate_hz for name in buses} if real and len(buses) > 1 else None
    return CompositeBus(buses, list(head.joints), rates)


def _build_one(
    head: Head, name: str, joints: dict[str, Joint], where: Chain | str, clock: Clock, confirmed: bool
) -> Bus:
    config = head.buses[name]
    maps = _maps(joints)
    check_safety(head, joints, maps)
    servos = [
        BusServo(key, j.id, maps[j.model], j.min_rad, j.max_rad, head.safety_of(key)) for key, j in joints.items()
    ]
    if config.family in BOARDS:
        rest_rad = np.array([joint.rest_rad for joint in joints.values()])
        more: dict[str, Any] = {"confirmed": confirmed or isinstance(where, Chain), "rest_rad": rest_rad}
    else:
        more = {"faults": head.faults}
    module, kind = FAMILIES[config.family].split(":")
    build = getattr(import_module(module), kind)
    deadline_s = config.read_deadline_ms / 1e3
    if isinstance(where, Chain):
        deadline_s = max(deadline_s, SIM_READ_DEADLINE_S)
    bus: Bus = build(
        name,
        servos,
        _calibration(joints),
        _port(where, config.baud, clock, config.rs485),
        config.baud,
        deadline_s,
        config=config,
        **more,
    )
    return bus


def _port(where: Chain | str, baud: int, clock: Clock, rs485: Rs485 | None) -> Callable[[], Port]:
    if isinstance(where, str):
        return partial(SerialPort, stable_name(where), baud, clock, rs485)
    if where.virtual:
        return partial(VirtualTimePort, where.device, where.control, baud, clock)
    return partial(SerialPort, where.device, baud, clock)
