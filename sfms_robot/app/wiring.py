"""The buses of a head: emulated servos in a separate process, or serial devices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from math import radians
from typing import Final

import numpy as np

from sfms_robot.app.options import SIM
from sfms_robot.config import BusConfig, Head, Joint, load_firmware_map
from sfms_robot.config.head import StoredRegisters, load_stored
from sfms_robot.emulator.launch import Chain, EmulatedServo, launch
from sfms_robot.errors import ConfigError
from sfms_robot.motion.calibration import Calibration
from sfms_robot.ports import Clock
from sfms_robot.servo.discovery import AUTO, choose_ports, list_ports, parse_ports, stable_name
from sfms_robot.servo.port import OpenPort, SerialPort, VirtualTimePort, emulator_control
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import JointNeeds, home_ticks, multi_turn

_NEW: Final = StoredRegisters()
_PATIENCE_S: Final = 1.0  # longest wait of a port for an emulator in real time
_CHUNK: Final = 4096
HANGING: Final = 0.3  # fraction of the way from rest to its lower end, of a joint that bears little load
BEYOND_RAD: Final = radians(2.0)  # distance of a mechanical stop from the range of the head's file

Opened = Mapping[str, Chain | str]  # per named bus: an emulated chain, or a serial device


def devices(head: Head, port: str) -> dict[str, str]:
    """Return the device of each named bus. Raises ConfigError, and PortError for `auto` without an adapter."""
    return choose_ports(head.buses, list_ports()) if port == AUTO else parse_ports(head.buses, port)


@contextmanager
def open_wires(head: Head, port: str, fast: bool = False) -> Iterator[Opened]:
    """Yield the place of each bus of the head: emulated servos, which run while inside, or devices.

    `fast`: virtual time.
    """
    with ExitStack() as stack:
        if port != SIM:
            yield devices(head, port)
        else:
            yield {name: stack.enter_context(launch(servos, fast)) for name, servos in plugged_in(head).items()}


def port_of(where: Chain | str, bus: BusConfig, clock: Clock) -> OpenPort:
    """Return a function that opens the port of a bus, also again after an unplugging. It raises PortError."""
    if isinstance(where, str):
        return partial(SerialPort, stable_name(where), bus.baud, clock, bus.rs485)
    if where.virtual:
        return partial(VirtualTimePort, where.device, where.control, bus.baud, clock)
    return partial(EmulatedPort, where.device, where.control, bus.baud, clock)


class EmulatedPort(SerialPort):
    """A port to emulated servos in real time. Silence counts only if the emulator confirms it.

    The emulator shares the computer's processors, so an answer may be late although its servo is there. If no byte came
    by a deadline, the port requests, on the emulator's control socket, the number of bytes that it has sent, and waits
    for the missing ones. Meanwhile the port's clock stands still, since the delay is caused by this computer.
    """

    def __init__(self, device: str, control: str, baud: int, clock: Clock) -> None:
        self._late_s = self._written_s = 0.0
        self._written = self._got = 0
        self._settled = True  # the emulator has confirmed that no more bytes will come
        self._owed = 0  # answers of the emulator that are still missing
        self._control = emulator_control(control)
        self._ask()  # the emulator counts bytes from here on
        try:
            super().__init__(device, baud, clock)
        except BaseException:
            self._control.close()
            raise

    def write(self, data: bytes) -> None:
        self._settled = False
        super().write(data)
        self._written += len(data)
        self._written_s = self.now_s()

    def read(self, n: int, deadline_s: float) -> bytes:
        data = super().read(n, deadline_s)
        if not data and not self._settled:
            began_s = self.now_s()
            data = self._late_bytes(n, min(max(0.0, deadline_s - self._written_s), _PATIENCE_S))
            self._late_s += self.now_s() - began_s
        self._got += len(data)
        return data

    def discard_input(self) -> None:
        while data := SerialPort.read(self, _CHUNK, 0.0):  # read, since a reset of the driver would not count them
            self._got += len(data)

    def now_s(self) -> float:
        return self._clock.now_s() - self._late_s

    def wait_until(self, time_s: float) -> None:
        self._clock.wait_until(time_s + self._late_s)

    def close(self) -> None:
        super().close()
        self._control.close()

    def _late_bytes(self, n: int, patience_s: float) -> bytes:
        """Return bytes that the emulator has sent and that were not read; empty if there are none.

        `patience_s`: time from the last write to the deadline. The emulator has the same time from receiving the bytes.
        """
        sent = self._ask(patience_s)
        self._settled = sent is not None and sent <= self._got
        if sent is None or self._settled:
            return b""
        data = SerialPort.read(self, n, self.now_s() + _PATIENCE_S)
        if not data:  # the bytes are lost: a full terminal accepts no more
            self._got, self._settled = sent, True
        return data

    def _ask(self, patience_s: float = 0.0) -> int | None:
        """Return the number of bytes that the emulator has sent so far; None if it does not answer in time."""
        answers = b""
        try:
            self._control.settimeout(_PATIENCE_S if not self._owed else 0.0)  # a hung emulator is waited for once
            while self._owed:
                self._owed -= self._control.recv(_CHUNK).count(b"\n") or self._owed
            self._control.settimeout(_PATIENCE_S + patience_s)
            self._control.sendall(b"quiet %d %.6f\n" % (self._written, patience_s))
            self._owed = 1
            while not answers.endswith(b"\n"):
                if not (part := self._control.recv(_CHUNK)):
                    return None  # the emulator has ended, which the device shows
                answers += part
            self._owed = 0
            return int(answers.removeprefix(b"quiet "))
        except (OSError, ValueError):
            return None


def calibration_of(joints: dict[str, Joint]) -> Calibration:
    turns = [load_firmware_map(joint.model).ticks_per_revolution for joint in joints.values()]
    return Calibration(joints, np.array(turns))


def emulated(head: Head, stored: StoredRegisters = _NEW) -> dict[str, list[EmulatedServo]]:
    """Return, by bus, the servos of a head that was switched off: sagged onto its stops, torque off.

    A servo counts turns only from power-up, so a geared joint hangs where its position in the range is unambiguous.
    `stored`: supply and registers. Raises ConfigError for registers of a joint that the head does not have.
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
        # Limited not to the joint's range, but to the positions that a servo around its middle can report.
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


def plugged_in(head: Head) -> dict[str, list[EmulatedServo]]:
    """Return the servos of `emulated` with the settings of the head's emulate.yaml. Raises ConfigError."""
    return emulated(head, load_stored(head))


# --- joint angles of a head that is switched off --------------------------------------------------------------------


def sagging_joints(head: Head) -> frozenset[str]:
    """Return the joints that bear the weight of the head, which falls forward: those that pitch a serial neck."""
    neck = head.kinematics
    if neck is None or neck.kind != "serial" or "pitch" not in neck.axes:
        return frozenset()
    return frozenset(neck.joints_of("pitch"))


def sagged_rad(joint: Joint, sags: bool) -> float:
    """Return the angle without torque: on the stop beyond its upper end (nose down), or hanging a little from rest."""
    return joint.max_rad + BEYOND_RAD if sags else joint.rest_rad + HANGING * (joint.min_rad - joint.rest_rad)
