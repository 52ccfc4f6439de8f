"""A head's file -> its parts: the bus that drives it, and what turns motion into safe joint angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sfms_robot.config import FirmwareMap, Head, Joint, load_firmware_map, load_head
from sfms_robot.data import data_dir, shipped_names
from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles
from sfms_robot.motion.audit import Audit
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.motion.timeline import PlanTimeline
from sfms_robot.ports import Bus, Clock
from sfms_robot.retarget.mapping import Mapping
from sfms_robot.servo.composite import CompositeBus
from sfms_robot.servo.dynamixel import READ_DEADLINE_S, BusServo, DynamixelBus
from sfms_robot.servo.port import Port, SerialPort, VirtualTimePort
from sfms_robot.simulator.launch import Chain, EmulatedServo

SIM = "sim"
SIM_READ_DEADLINE_S = 0.02  # an emulator shares the computer's cores: it may be late without being silent
HANGING = 0.3  # where an emulated joint stands at power-up: this share of the way from rest to its lower end


Opened = dict[str, Chain | str]  # per named bus: an emulated chain, or a serial device


@dataclass(frozen=True)
class Motion:
    """What lies between a plan and the bus."""

    timeline: PlanTimeline
    mapping: Mapping
    limiter: JerkLimiter
    audit: Audit
    leads_s: Doubles
    rest_rad: Doubles


def shipped_heads() -> list[dict[str, Any]]:
    """What `head list` shows."""
    names = shipped_names(data_dir("configs") / "heads", "head.yaml")
    heads = [load_head(name) for name in names]
    return [
        {"name": head.name, "description": head.description, "joints": len(head.joints), "buses": list(head.buses)}
        for head in heads
    ]


def build_motion(head: Head, rate_hz: float) -> Motion:
    """Timeline, mapping, limiter and audit at one tick rate."""
    limits = JointLimits.of(head)
    joints = head.joints.values()
    return Motion(
        PlanTimeline(1.0 / rate_hz),
        Mapping(head),
        JerkLimiter(limits, 1.0 / rate_hz),
        Audit(limits, _calibration(head.joints), 1.0 / rate_hz),
        np.array([joint.lag_ms / 1e3 for joint in joints]),
        np.array([joint.rest_rad for joint in joints]),
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
        by_bus.setdefault(joint.bus, []).append(EmulatedServo(joint.id, joint.model, baud, ticks))
    return by_bus


def devices(head: Head, port: str) -> dict[str, str]:
    """`--port DEVICE` or `NAME=DEVICE[,NAME=DEVICE]` -> device per named bus. Raises ConfigError."""
    names = list(head.buses)
    parts = dict(part.split("=", 1) for part in port.split(",") if "=" in part)
    if not parts and len(names) == 1:
        return {names[0]: port}
    if set(parts) != set(names):
        wanted = ",".join(f"{name}=DEVICE" for name in names)
        raise ConfigError(f"--port {port!r}: head {head.name!r} needs one device per bus (sim, {wanted})")
    return parts


def build_bus(head: Head, opened: Opened, clock: Clock) -> Bus:
    """The head's bus, not yet connected."""
    buses: dict[str, Bus] = {}
    for name, where in opened.items():
        joints = {key: joint for key, joint in head.joints.items() if joint.bus == name}
        maps = _maps(joints)
        servos = [BusServo(key, j.id, maps[j.model], j.min_rad, j.max_rad) for key, j in joints.items()]
        baud = head.buses[name].baud
        deadline_s = SIM_READ_DEADLINE_S if isinstance(where, Chain) else READ_DEADLINE_S
        port = _port(where, baud, clock)
        buses[name] = DynamixelBus(name, servos, _calibration(joints), port, baud, deadline_s)
    return CompositeBus(buses, list(head.joints))


def _port(where: Chain | str, baud: int, clock: Clock) -> Callable[[], Port]:
    if isinstance(where, str):
        return partial(SerialPort, where, baud, clock)
    if where.virtual:
        return partial(VirtualTimePort, where.device, where.control, baud, clock)
    return partial(SerialPort, where.device, baud, clock)
