"""One emulated servo of Dynamixel 1.0 or Feetech: a register file with the rules of the firmware, a plant behind it.

The servo is as unkind as the worst real one: at power-up its goal is the middle of its range, wherever it stands; a
written goal switches its torque on; a locked EEPROM takes what is written and forgets it at the next power-up
(Feetech), or does not take it and says nothing (Dynamixel).

Where the sources are silent it does the least helpful thing. A frame with a wrong sum is not heard at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from sfms_robot.emulator.device import EmulatedServo
from sfms_robot.emulator.protocol1_modes import POSITIONING, Mode, PositionFrame, angle_limits, mode_of, motor_command
from sfms_robot.emulator.register_servo import RegisterServo, same_baud
from sfms_robot.servo.codecs import protocol1
from sfms_robot.servo.registers import Field, Table

_CHECK_S: Final = 0.1  # how often it looks whether its motor is overloaded
_BITS: Final = {"overload": 0x20, "overheating": 0x04}  # of the status byte, in both families
_VOLTAGE: Final = 0x01
_FULL_TORQUE: Final = 1000
_CENTER_ON_STS: Final = 2048
_WHOLE_FILE: Final = 256  # a Feetech answers a read of any address
_PENDING: Final = ("registered", "async_write_flag")  # 1 from REG WRITE to ACTION; Dynamixel, Feetech


class Protocol1Servo(RegisterServo):
    """`fault_status` is what every answer carries."""

    _bits = _BITS
    _frame: PositionFrame

    def __init__(self, what: EmulatedServo, table: Table) -> None:
        self._feetech = table.family == "feetech"
        super().__init__(table, _WHOLE_FILE if self._feetech else None)
        self._firmware = what.firmware
        self._registered: tuple[int, bytes] | None = None
        self._checks = 0
        self._reset_registers()
        self._take_stored(what)
        self._stored = bytes(self._file.raw)
        self._mode = mode_of(self._file)
        self._frame = PositionFrame(self._file, self._mode)
        self.plant.position = self.plant.reference = self._frame.shaft(float(what.start_ticks))
        self.supply_v = self._content_v() if what.supply_v is None else what.supply_v
        self._power_up()

    # --- what the wire asks -------------------------------------------------------------------------------------

    @property
    def is_bulk_reader(self) -> bool:
        """The MX series knows bulk read, AX does not; their tables differ in the multi-turn registers."""
        return not self._feetech and "multi_turn_offset" in self.table.fields

    @property
    def is_sync_reader(self) -> bool:
        """Feetech's little-endian series knows sync read."""
        return self._feetech and self.table.byte_order == "little"

    @property
    def answers_writes(self) -> bool:
        return not self.mute and self._role("status_level") >= (1 if self._feetech else 2)

    @property
    def answers_reads(self) -> bool:
        return not self.mute and (self._feetech or self._role("status_level") >= 1)

    @property
    def return_delay_s(self) -> float:
        return 2e-6 * self._role("return_delay")

    def hears(self, baud: int | None) -> bool:
        return not self.dead and self._powered and same_baud(self.baud, baud)

    def read(self, address: int, length: int, now_s: float) -> tuple[int, bytes]:
        """(error, data)."""
        self.advance(now_s)
        end = address + length
        if length == 0 or end > len(self._file.raw):
            return (0 if self._feetech else protocol1.RANGE), b""
        self._measure()
        return 0, bytes(self._file.raw[address:end])

    def write(self, address: int, data: bytes, now_s: float) -> int:
        """Error bits, 0 when it was taken. A Dynamixel changes nothing unless all of it is allowed."""
        self.advance(now_s)
        touched = self._file.covered(address, len(data))
        wanted: dict[str, int] = {}
        error = 0 if touched or self._feetech else protocol1.RANGE
        for field in touched:
            at = field.address - address
            whole = at >= 0 and at + field.size <= len(data)
            value = field.from_bytes(data[at : at + field.size]) if whole else 0
            bad = protocol1.RANGE if not whole or not field.writable else self._refusal(field, value)
            error |= bad
            if not bad:
                wanted[field.name] = value
        if self._feetech:
            error = 0  # it drops what it does not take, and says nothing
        if not error:
            self._apply(wanted)
        return error

    def register(self, address: int, data: bytes) -> int:
        """Keep a write for `action`."""
        self._registered = (address, data)
        self._show_pending()
        return 0

    def action(self, now_s: float) -> int:
        kept, self._registered = self._registered, None
        self._show_pending()
        if kept is None:
            return 0 if self._feetech else protocol1.INSTRUCTION
        return self.write(*kept, now_s)

    def factory_reset(self, now_s: float) -> None:
        """Everything, id and baud rate included; then as at power-up."""
        self.advance(now_s)
        self._reset_registers()
        self._stored = bytes(self._file.raw)
        self.power_cycle(now_s)

    def reset_turns(self, now_s: float) -> None:
        """Whole turns are forgotten; it stays where it is."""
        self.advance(now_s)
        self.plant.position %= self.table.ticks_per_revolution
        self._put("goal_position", round(self._frame.reported(self.plant.position)))
        self._settings()

    # --- what happens to it -------------------------------------------------------------------------------------

    def power_cycle(self, now_s: float) -> None:
        """Supply off and on: RAM, whole turns and whatever a locked EEPROM did not keep are gone; the shaft stays."""
        self.advance(now_s)
        self._file.raw[:] = self._stored
        self.plant.position %= self.table.ticks_per_revolution
        self.fault_status, self._registered = 0, None
        self._power_up()

    def fail(self, status: int, now_s: float) -> None:
        """Faults appear in every answer from now on; those it is told to give way to take the torque away."""
        self.advance(now_s)
        self._fail(status)

    def _fail(self, status: int) -> None:
        self.fault_status |= status
        if self._shut_down():
            self._put_role("torque_enable", 0)
            if not self._feetech:
                self._put_role("torque_limit", 0)  # stays 0 when torque is switched on again
        self._settings()

    def _lose_power(self) -> None:
        self._drive = None

    def _start_anew(self, now_s: float) -> None:
        self.power_cycle(now_s)

    def _fault_names(self) -> str:
        return self.table.status_fault_names(self.fault_status)

    def advance(self, now_s: float) -> None:
        """Move the plant on; on a fixed grid of time, it notices that the motor is overloaded."""
        while self._drive is not None and self._checks * _CHECK_S <= now_s:
            self.plant.advance(self._checks * _CHECK_S, self._drive)
            self._checks += 1
            if self.plant.overloaded and not self.fault_status & _BITS["overload"]:
                self._fail(_BITS["overload"])
            if 0 < self._get("temperature_limit") < self.plant.temperature_C:
                self._fail(_BITS["overheating"])
        self._checks = max(self._checks, int(now_s / _CHECK_S) + 1)
        self.plant.advance(now_s, self._drive)

    # --- inside -------------------------------------------------------------------------------------------------

    def _refusal(self, field: Field, value: int) -> int:
        signed_duty = field.name == "goal_time" and self._mode is Mode.PWM
        if not (-field.high if signed_duty else field.low) <= value <= field.high:
            return protocol1.RANGE
        if field.name == "goal_position" and not self._feetech:
            lowest, highest = angle_limits(self._file)
            return 0 if lowest == highest or lowest <= value <= highest else protocol1.ANGLE_LIMIT
        return 0

    def _apply(self, wanted: dict[str, int]) -> None:
        lock = self.table.fields.get("lock")
        locked = lock is not None and self._get(lock.name) == 1
        for name, value in wanted.items():
            self._store(name, value, locked)
        torque = self.table.role("torque_enable")
        if torque is not None and torque.name in wanted:
            self._torque_written(wanted[torque.name], locked)
        elif "goal_position" in wanted and not self._role("torque_enable") and not self._shut_down():
            self._put_role("torque_enable", 1)
        if self._drive is not None and wanted.keys() == {"goal_position"}:  # what comes in every tick
            if self._mode in POSITIONING:
                told = self._frame.shaft(float(self._get("goal_position")))
                self._drive = self._drive._replace(goal=self._stepped(wanted) if self._mode is Mode.STEP else told)
            return
        self._settings(self._stepped(wanted))

    def _store(self, name: str, value: int, locked: bool) -> None:
        field = self.table[name]
        if locked and not self._feetech and (field.eeprom or name == "lock"):
            return  # once locked, until the supply is switched off
        if name == "goal_position" and self._feetech and self._mode is Mode.JOINT:
            lowest, highest = angle_limits(self._file)
            value = min(max(value, lowest), highest) if lowest < highest else value
        self._put(name, value)
        if field.eeprom and not locked:
            self._keep(field)

    def _stepped(self, wanted: Mapping[str, int]) -> float:
        """Return where the steps written so far lead in step mode, in shaft ticks."""
        drive = self._drive
        start = drive.goal if drive is not None and self._mode is Mode.STEP else self.plant.position
        return start + wanted.get("goal_position", 0)

    def _keep(self, field: Field) -> None:
        """In the EEPROM, over the next power-up."""
        end = field.address + field.size
        self._stored = self._stored[: field.address] + bytes(self._file.raw[field.address : end]) + self._stored[end:]

    def _torque_written(self, value: int, locked: bool) -> None:
        if value == protocol1.CALIBRATE_HERE and "homing_offset" in self.table.fields:
            one_turn = round(self.plant.position % self.table.ticks_per_revolution)
            self._put("homing_offset", one_turn - _CENTER_ON_STS)
            if not locked:
                self._keep(self.table["homing_offset"])
            self._put_role("torque_enable", 0)
        elif value == 1 and self._role("torque_limit"):
            self.fault_status &= ~_BITS["overload"]
            if self._shut_down():
                self._put_role("torque_enable", 0)

    def _shut_down(self) -> bool:
        name = "unloading_condition" if self._feetech else "shutdown"
        return bool(self.fault_status & self._get(name)) if name in self.table.fields else False

    def _power_up(self) -> None:
        for field in self.table.fields.values():
            if not field.eeprom:
                self._put(field.name, field.initial)
        self._put_role("torque_enable", 0)
        self._put("goal_position", self.table.center_ticks)
        self._put_role("torque_limit", self._get("max_torque") or _FULL_TORQUE)
        self._settings()
        self._watch_supply()

    def _settings(self, stepped: float | None = None) -> None:
        """Take over what the registers say now. `stepped`: as `_stepped`; None: no step was written."""
        self.id = self._role("id")
        self.baud = self.table.baud_codes.get(self._role("baud_rate"))
        stepped = self._stepped({}) if stepped is None else stepped
        self._mode = mode_of(self._file)
        self._frame = PositionFrame(self._file, self._mode)
        self._drive = None
        strength = self.table.role("torque_limit")
        torque = 1.0 if strength is None else min(1.0, self._get(strength.name) / 1000.0)
        if self._role("torque_enable") == 1 and torque:
            self._drive = motor_command(self._file, self._mode, self._frame, stepped, torque)

    def _show_pending(self) -> None:
        for name in _PENDING:
            self._put(name, int(self._registered is not None))

    def _measure(self) -> None:
        """Put what is measured into the registers that show it."""
        plant, table = self.plant, self.table
        speed = table.role("present_speed")
        per_turn = 60.0 if speed is not None and speed.unit == "rpm" else 360.0
        scale = speed.scale if speed is not None else 1.0
        measured = {
            "present_position": self._frame.shown(plant.position),
            "present_speed": round(plant.speed * per_turn / (table.ticks_per_revolution * scale)),
            "present_load": round(1000.0 * plant.effort),
            "voltage": round(10.0 * self.supply_v),
            "temperature": round(plant.temperature_C),
            "error_status": self.fault_status,
        }
        current = table.role("present_current")
        if current is not None:
            measured["present_current"] = round(plant.current_mA() / (current.scale or 1.0))
        for role, value in measured.items():
            self._put_role(role, value)
        self._put("moving", int(plant.speed != 0.0))

    def _content_v(self) -> float:
        """A supply that the model is content with."""
        return 7.4 if self._volts("max_voltage_limit") <= 9.0 else 12.0

    def _watch_supply(self) -> None:
        """The voltage bit is there as long as the voltage is wrong, and no longer."""
        low, high = self._volts("min_voltage_limit"), self._volts("max_voltage_limit")
        if low <= self.supply_v <= high or not high:
            self.fault_status &= ~_VOLTAGE
        else:
            self._fail(_VOLTAGE)

    def _reset_registers(self) -> None:
        """As it leaves the factory."""
        for field in self.table.fields.values():
            self._put(field.name, field.initial)
        self._put("model_number", self.table.model_number or 0)
        self._put("firmware_version", self._firmware)
        self._put("firmware_major", self._firmware)
        self._put("endianness_flag", int(self.table.byte_order == "big"))
