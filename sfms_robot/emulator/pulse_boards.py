"""Emulated hobby-servo boards: bytes of the host in, bytes of the board out. Opens nothing.

A board sends pulses; its servos only follow them and report nothing. So each channel has two parts: the pulse, which
the board stores and moves under its speed limits, and a shaft, which a plant moves and only a test can read. The state
of the shaft never reaches the wire.

A servo of the description is one channel with a servo on it. A board is unplugged if all its channels are dead. It
obeys and never answers if all its channels are mute.

Not modelled: the script, serial timeout, PWM output and daisy chain of a Maestro; the inputs, sequencer and offsets
of an SSC-32.

Sources: Pololu Maestro User's Guide, sections 4 and 5; Lynxmotion SSC-32 manual, "Command Formatting for the SSC-32".
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Final

from sfms_robot.data import Report
from sfms_robot.emulator.emulated_wire import EmulatedDevice, EmulatedServo, Reply
from sfms_robot.emulator.plant import MotorCommand, Plant
from sfms_robot.emulator.register_servo import USUAL_BITS
from sfms_robot.servo.codecs import maestro, ssc32
from sfms_robot.servo.registers import Table

_NO_LIMIT: Final = 1e9  # ticks/s; speed of a profile with only an acceleration, which has no effect without a speed
_MICRO: Final = 6  # channels of the Micro Maestro, the only model without Set Multiple Targets
_MINI_SSC_NEUTRAL: Final = 127
_MINI_SSC_STEP: Final = 15  # quarter microseconds: 476.25 us / 127
_NEUTRAL: Final = 6000


class Channel:
    """One output: its pulse in ticks, and the shaft of the servo on it, which starts at `start_ticks`."""

    fault_bits: Final = USUAL_BITS  # a board does not report faults of servos; these bits represent them

    def __init__(self, number: int, board: EmulatedBoard, start_ticks: int) -> None:
        self.id = number
        self.dead = self.mute = self.on = False
        self.goal = 0.0
        self.speed = 0.0  # ticks/s, 0 = no limit
        self.acceleration = 0.0  # ticks/s^2, 0 = no limit
        self.plant = Plant(float(start_ticks), reference=float(start_ticks))
        self._board = board

    def send(self, goal: float, now_s: float) -> None:
        """Send pulses of `goal` ticks. If there were none, the pulse jumps: the speed limit has no start."""
        self.advance(now_s)
        if not self.on:
            self.plant.reference = goal
        self.on, self.goal = True, goal

    def off(self, now_s: float) -> None:
        """End the pulses."""
        self.advance(now_s)
        self.on = False

    def advance(self, now_s: float) -> None:
        """Advance pulse and shaft to `now_s`."""
        speed = self.speed or (_NO_LIMIT if self.acceleration else 0.0)
        drive = MotorCommand(self.goal, self._board.table.top_speed_ticks_s, speed, self.acceleration)
        self.plant.advance(now_s, drive if self.on else None)

    def fail(self, bits: int, now_s: float) -> None:
        """Latch bits in the error word of the board."""
        self._board.fail(bits, now_s)

    def turn(self, ticks: float, now_s: float) -> None:
        """Turn the shaft by hand."""
        self.advance(now_s)
        self.plant.position = ticks

    def state(self, now_s: float) -> Report:
        """Return the true state of the channel, independent of the wire."""
        self.advance(now_s)
        return {
            "position": self.plant.position,
            "goal": self.goal if self.on else None,
            "pulse": self.pulse,
            "torque": self.on,
            "faults": ", ".join(self._board.table.faults_in(self._board.errors)),
        }

    @property
    def pulse(self) -> int:
        """Ticks of the pulse sent now; 0 when there is none."""
        if not self.on:
            return 0
        return round(self.plant.reference if self.speed or self.acceleration else self.goal)

    @property
    def moving(self) -> bool:
        """True while a limit still delays the pulse."""
        return self.on and bool(self.speed or self.acceleration) and self.plant.reference != self.goal


class EmulatedBoard(EmulatedDevice):
    """The common part of all boards. The id of a servo is its channel.

    Attributes:
        servos: Channels with a servo plugged in.
        limits: Shortest and longest pulse of every channel, ticks.
    """

    def __init__(self, table: Table, servos: Sequence[EmulatedServo]) -> None:
        assert table.channels is not None and table.pulse_us is not None
        self.table = table
        self.errors = 0
        starts = {servo.id: servo.start_ticks for servo in servos}
        self.channels = [Channel(i, self, starts.get(i, table.center_ticks)) for i in range(table.channels)]
        self.servos = [channel for channel in self.channels if channel.id in starts]
        self.limits = self._ticks(*table.pulse_us)
        self._buffer = bytearray()
        self._now_s = 0.0  # time, while it executes commands

    def advance(self, now_s: float) -> None:
        for channel in self.channels:
            channel.advance(now_s)

    def fail(self, bits: int, now_s: float) -> None:
        """Latch bits in the error word."""
        self.errors |= bits

    def restart(self, now_s: float) -> None:
        """Restart after a loss of supply, without pulses and with all state reset."""
        self._buffer.clear()
        self.errors = 0
        for channel in self.channels:
            channel.off(now_s)
            channel.speed = channel.acceleration = 0.0

    def replies(self, data: bytes, baud: int | None, now_s: float) -> list[Reply]:
        if not data or baud is None or (self.servos and all(channel.dead for channel in self.servos)):
            return []
        self._now_s = now_s
        answer = self._obey_all(data, baud)
        mute = self.servos and all(channel.mute for channel in self.servos)
        return [Reply((), answer)] if answer and not mute else []

    @abstractmethod
    def _obey_all(self, data: bytes, baud: int) -> bytes: ...

    def _ticks(self, shortest_us: float, longest_us: float) -> tuple[float, float]:
        tick_us = self.table.tick_us or 1.0
        return shortest_us / tick_us, longest_us / tick_us

    def _send(self, channel: Channel, goal: float) -> None:
        """Send a target, clipped to the limits of the channel; 0 ends the pulses."""
        if goal == 0:
            channel.off(self._now_s)
        else:
            shortest, longest = self.limits
            channel.send(min(max(goal, shortest), longest), self._now_s)


class MaestroBoard(EmulatedBoard):
    """A Pololu Maestro with factory settings: it detects its baud rate, home is off, an error sends all channels home.

    "Enable CRC" is on if it is stored: value `crc` of any of its servos.
    """

    def __init__(self, table: Table, servos: Sequence[EmulatedServo]) -> None:
        super().__init__(table, servos)
        self.baud: int | None = None
        self.crc = any(servo.registers.get("crc") for servo in servos)
        self.limits = self._ticks(*maestro.FACTORY_PULSE_US)

    def _obey_all(self, data: bytes, baud: int) -> bytes:
        if self.baud is None:
            start = data.find(maestro.BAUD_INDICATION)
            if start < 0:
                return b""
            self.baud, data = baud, data[start:]
        if baud != self.baud:
            self.fail(maestro.SIGNAL_ERROR, self._now_s)
            return b""
        self._buffer += data
        out = b""
        while (command := maestro.maybe_command(self._buffer, crc=self.crc)) is not None:
            out += self._obey(command)
        return out

    def restart(self, now_s: float) -> None:
        super().restart(now_s)
        self.baud = None

    def fail(self, bits: int, now_s: float) -> None:
        """Latch error bits; every error sends all channels home, which is off."""
        super().fail(bits, now_s)
        self._home(now_s)

    def _home(self, now_s: float) -> None:
        for channel in self.channels:
            if channel.on:
                channel.off(now_s)

    def _obey(self, command: maestro.MaestroCommand) -> bytes:
        (code, data, error), now_s = command, self._now_s
        if error:
            self.fail(error, now_s)
        elif code == maestro.GET_ERRORS:
            errors, self.errors = self.errors, 0
            return errors.to_bytes(2, "little")
        elif code == maestro.GET_MOVING:
            self.advance(now_s)
            return bytes([any(channel.moving for channel in self.channels)])
        elif code == maestro.GO_HOME:
            self._home(now_s)
        elif code == maestro.SET_TARGETS:
            self._targets(data)
        elif data[0] >= len(self.channels):
            self.fail(maestro.PROTOCOL_ERROR, now_s)
        else:
            return self._to_channel(self.channels[data[0]], code, data[1:])
        return b""

    def _to_channel(self, channel: Channel, code: int, data: bytes) -> bytes:
        channel.advance(self._now_s)
        if code == maestro.GET_POSITION:
            return channel.pulse.to_bytes(2, "little")
        if code == maestro.SET_TARGET:
            self._send(channel, maestro.from_word(data))
        elif code == maestro.MINI_SSC:
            self._send(channel, _NEUTRAL + (data[0] - _MINI_SSC_NEUTRAL) * _MINI_SSC_STEP)
        elif code == maestro.SET_SPEED:
            channel.speed = maestro.from_word(data) * 100.0  # per 10 ms
        elif code == maestro.SET_ACCELERATION:
            channel.acceleration = maestro.from_word(data) * 1250.0  # per 10 ms per 80 ms
        return b""

    def _targets(self, data: bytes) -> None:
        count, first = data[0], data[1]
        if len(self.channels) <= _MICRO or first + count > len(self.channels):
            self.fail(maestro.PROTOCOL_ERROR, self._now_s)
            return
        for i in range(count):
            self._send(self.channels[first + i], maestro.from_word(data[2 + 2 * i : 4 + 2 * i]))


class Ssc32Board(EmulatedBoard):
    """A Lynxmotion SSC-32. Its rate, set by jumpers, is the rate of the first servo."""

    def __init__(self, table: Table, servos: Sequence[EmulatedServo]) -> None:
        super().__init__(table, servos)
        self.baud = servos[0].baud

    def _obey_all(self, data: bytes, baud: int) -> bytes:
        if baud != self.baud:
            return b""
        self._buffer += data
        out = b""
        while (command := ssc32.maybe_command(self._buffer)) is not None:
            if isinstance(command, ssc32.Group):
                self._group(command)
            else:
                out += self._answer(command)
        return out

    def _group(self, group: ssc32.Group) -> None:
        for number, move in group.moves.items():
            channel = self.channels[number]
            channel.advance(self._now_s)
            gap = abs(move.pulse_us - channel.plant.reference)
            limits = (float(move.speed_us_s), gap * 1e3 / group.time_ms if group.time_ms else 0.0)
            channel.speed = min((limit for limit in limits if limit > 0.0), default=0.0)
            self._send(channel, move.pulse_us)
        for number in group.levels:
            self.channels[number].off(self._now_s)

    def _answer(self, query: ssc32.Query) -> bytes:
        self.advance(self._now_s)
        if query.kind == "Q":
            return ssc32.MOVING if any(channel.moving for channel in self.channels) else ssc32.DONE
        if query.kind == "QP":
            return bytes(min(255, round(self.channels[number].pulse / 10)) for number in query.channels)
        return b"SSC32 EMULATED\r"
