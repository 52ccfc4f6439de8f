"""One emulated servo of Dynamixel 1.0 or Feetech: a register file with the rules of the firmware, a plant behind it.

The servo is as unkind as the worst real one: at power-up its goal is the middle of its range, wherever it stands; a
written goal switches its torque on; a locked EEPROM takes what is written and forgets it at the next power-up
(Feetech), or does not take it and says nothing (Dynamixel).

Where the sources are silent it does the least helpful thing. Not modelled: wheel and multi-turn modes, PWM, and any
Feetech mode but position: in these the motor has no drive. A frame with a wrong sum is not heard at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from sfms_robot.emulator.plant import MotorCommand, Plant
from sfms_robot.servo.codecs import dxl1, feetech
from sfms_robot.servo.registers import Field, Table

_CHECK_S: Final = 0.1  # how often it looks whether its motor is overloaded
_BAUD_TOLERANCE: Final = 0.03  # what a UART forgives
_BITS: Final = {"overload": 0x20, "overheating": 0x04}  # of the status byte, in both families
_VOLTAGE: Final = 0x01
_FULL_TORQUE: Final = 1000
_BROWN_OUT: Final = 0.7  # of the lowest supply it allows: below that the controller itself stops
_CENTER_ON_STS: Final = 2048
_EVERYTHING: Final = 256


class Protocol1Servo:
    """A servo that answers instructions. All times are seconds of the wire's clock.

    Attributes:
        dead: True while its cable is out; its motor keeps doing what it was told.
        fault_status: bits that every answer carries.
    """

    def __init__(
        self,
        servo_id: int,
        table: Table,
        baud: int,
        start_ticks: int,
        firmware: int,
        registers: Mapping[str, int] | None = None,
        supply_v: float | None = None,
    ) -> None:
        self.table = table
        self.dead = False
        self.fault_status = 0
        self._feetech = table.family == "feetech"
        self._memory = bytearray(_EVERYTHING if self._feetech else table.size)
        self._firmware = firmware
        self._registered: tuple[int, bytes] | None = None
        self._checks = 0
        self._drive: MotorCommand | None = None
        for field in table.fields.values():
            self._put(field, field.initial)
        self._identify()
        self._put_role("id", servo_id)
        self._put_role("baud_rate", next(code for code, rate in table.baud_codes.items() if rate == baud))
        for name, value in (registers or {}).items():
            self._put(table[name], value)
        self._stored = bytes(self._memory)
        self.plant = Plant(0.0)
        self.plant.position = self.plant.reference = float(start_ticks + self._offset())
        self.supply_v = self._content_v() if supply_v is None else supply_v
        self._powered = True
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
        return self._role("status_level") >= (1 if self._feetech else 2)

    @property
    def answers_reads(self) -> bool:
        return self._feetech or self._role("status_level") >= 1

    @property
    def return_delay_s(self) -> float:
        return 2e-6 * self._role("return_delay")

    def hears(self, baud: int | None) -> bool:
        if self.dead or not self._powered or baud is None or self.baud is None:
            return False
        return abs(baud - self.baud) <= _BAUD_TOLERANCE * self.baud

    def read(self, address: int, length: int, now_s: float) -> tuple[int, bytes]:
        """(error, data)."""
        self.advance(now_s)
        end = address + length
        if length == 0 or end > len(self._memory):
            return (0 if self._feetech else dxl1.RANGE), b""
        self._look()
        return 0, bytes(self._memory[address:end])

    def write(self, address: int, data: bytes, now_s: float) -> int:
        """Error bits, 0 when it was taken. A Dynamixel changes nothing unless all of it is allowed."""
        self.advance(now_s)
        end = address + len(data)
        touched = [f for f in self.table.fields.values() if f.address < end and f.address + f.size > address]
        wanted: dict[str, int] = {}
        error = 0 if touched or self._feetech else dxl1.RANGE
        for field in touched:
            at = field.address - address
            whole = at >= 0 and at + field.size <= len(data)
            value = field.from_bytes(data[at : at + field.size]) if whole else 0
            bad = dxl1.RANGE if not whole or not field.writable else self._refusal(field, value)
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
        return 0

    def action(self, now_s: float) -> int:
        kept, self._registered = self._registered, None
        if kept is None:
            return 0 if self._feetech else dxl1.INSTRUCTION
        return self.write(*kept, now_s)

    def factory_reset(self, now_s: float) -> None:
        """Everything, id and baud rate included; then as at power-up."""
        self.advance(now_s)
        for field in self.table.fields.values():
            self._put(field, field.initial)
        self._identify()
        self._stored = bytes(self._memory)
        self.power_cycle(now_s)

    # --- what happens to it -------------------------------------------------------------------------------------

    def power_cycle(self, now_s: float) -> None:
        """Supply off and on: RAM and whatever a locked EEPROM did not keep are gone; the shaft stays."""
        self.advance(now_s)
        self._memory[:] = self._stored
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

    def clear(self, status: int) -> None:
        """What caused these faults is over."""
        self.fault_status &= ~status

    def fail_named(self, fault: str, now_s: float) -> None:
        """The same by name: overheating, overload."""
        self.fail(_BITS[fault], now_s)

    def set_supply(self, volts: float, now_s: float) -> None:
        """Too low stops the controller; when it comes back the servo starts anew."""
        self.advance(now_s)
        self.supply_v = volts
        powered = volts >= _BROWN_OUT * self._volts("min_voltage_limit")
        if powered and not self._powered:
            self.power_cycle(now_s)
        elif not powered:
            self._drive = None
        self._powered = powered
        self._watch_supply()

    def turn(self, ticks: float, now_s: float) -> None:
        """Somebody turns the shaft by hand, to where its position reads `ticks`."""
        self.advance(now_s)
        self.plant.position = ticks + self._offset()

    def state(self, now_s: float) -> dict[str, Any]:
        """What an onlooker sees, whatever the wire says."""
        self.advance(now_s)
        return {
            "position": self.plant.position - self._offset(),
            "speed": self.plant.speed,
            "goal": self._get("goal_position"),
            "torque": self._powered and self._role("torque_enable") == 1,
            "faults": self.table.status_fault_names(self.fault_status),
            "temperature_C": self.plant.temperature_C,
        }

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
        if not field.low <= value <= field.high:
            return dxl1.RANGE
        if field.name == "goal_position" and not self._feetech:
            lowest, highest = self._limits()
            return 0 if lowest == highest or lowest <= value <= highest else dxl1.ANGLE_LIMIT
        return 0

    def _apply(self, wanted: dict[str, int]) -> None:
        table = self.table
        lock = table.fields.get("lock")
        locked = lock is not None and self._get(lock.name) == 1
        for name, value in wanted.items():
            field = table[name]
            if field.eeprom and locked and not self._feetech:
                continue
            if lock is not None and name == lock.name and locked and not self._feetech:
                continue  # once locked, until the supply is switched off
            if name == "goal_position" and self._feetech:
                lowest, highest = self._limits()
                value = min(max(value, lowest), highest) if lowest < highest else value
            self._put(field, value)
            if field.eeprom and not locked:
                self._keep(field)
        if self._drive is not None and wanted.keys() == {"goal_position"}:  # what comes in every tick
            self._drive = self._drive._replace(goal=float(self._get("goal_position") + self._offset()))
            return
        torque = table.role("torque_enable")
        if torque is not None and torque.name in wanted:
            self._torque_written(wanted[torque.name], locked)
        elif "goal_position" in wanted and not self._role("torque_enable") and not self._shut_down():
            self._put_role("torque_enable", 1)
        self._settings()

    def _keep(self, field: Field) -> None:
        """In the EEPROM, over the next power-up."""
        end = field.address + field.size
        self._stored = self._stored[: field.address] + bytes(self._memory[field.address : end]) + self._stored[end:]

    def _torque_written(self, value: int, locked: bool) -> None:
        if value == feetech.CALIBRATE_HERE and "homing_offset" in self.table.fields:
            offset = self.table["homing_offset"]
            self._put(offset, round(self.plant.position) - _CENTER_ON_STS)
            if not locked:
                self._keep(offset)
            self._put_role("torque_enable", 0)
        elif value == 1 and self._role("torque_limit"):
            self.fault_status &= ~_BITS["overload"]
            if self._shut_down():
                self._put_role("torque_enable", 0)

    def _shut_down(self) -> bool:
        name = "unloading_condition" if self._feetech else "shutdown"
        return bool(self.fault_status & self._get(name)) if name in self.table.fields else False

    def _limits(self) -> tuple[int, int]:
        names = ("min_position_limit", "max_position_limit") if self._feetech else ("cw_angle_limit", "ccw_angle_limit")
        return self._get(names[0]), self._get(names[1])

    def _offset(self) -> int:
        return self._get("homing_offset") if "homing_offset" in self.table.fields else 0

    def _power_up(self) -> None:
        torque, goal = self.table.role("torque_enable"), self.table["goal_position"]
        for field in self.table.fields.values():
            if not field.eeprom:
                self._put(field, field.initial)
        if torque is not None:
            self._put(torque, 0)
        self._put(goal, self.table.center_ticks)
        self._put_role("torque_limit", self._get("max_torque") or _FULL_TORQUE)
        self._settings()
        self._watch_supply()

    def _settings(self) -> None:
        """Take over what the registers say now."""
        table = self.table
        self.id: int = self._role("id")
        self.baud: int | None = table.baud_codes.get(self._role("baud_rate"))
        self._drive = None
        mode = table.role("operating_mode")
        positioning = mode is None or table.position_mode in (None, self._get(mode.name))
        if not self._feetech:
            lowest, highest = self._limits()
            positioning = lowest < highest
        strength = table.role("torque_limit")
        share = 1.0 if strength is None else min(1.0, self._get(strength.name) / 1000.0)
        if self._role("torque_enable") == 1 and positioning and share:
            self._drive = MotorCommand(
                float(self._get("goal_position") + self._offset()),
                table.top_speed_ticks_s,
                self._rate(table.role("moving_speed")),
                self._rate(table.fields.get("acceleration") or table.fields.get("goal_acceleration")),
                torque=share,
            )

    def _rate(self, field: Field | None) -> float:
        """A speed or acceleration register in ticks and seconds; 0 where there is none."""
        if field is None:
            return 0.0
        per_turn = 60.0 if field.unit == "rpm" else 360.0
        return abs(field.to_unit(self._get(field.name))) * self.table.ticks_per_revolution / per_turn

    def _look(self) -> None:
        """Put what is measured into the registers that show it."""
        plant, table = self.plant, self.table
        speed = table.role("present_speed")
        per_turn = 60.0 if speed is not None and speed.unit == "rpm" else 360.0
        current_mA = plant.current_mA(table.top_speed_ticks_s)
        scale = speed.scale if speed is not None else 1.0
        measured = {
            "present_position": round(plant.position) - self._offset(),
            "present_speed": round(plant.speed * per_turn / (table.ticks_per_revolution * scale)),
            "present_load": round(1000.0 * plant.effort),
            "voltage": round(10.0 * self.supply_v),
            "temperature": round(plant.temperature_C),
            "error_status": self.fault_status,
        }
        current = table.role("present_current")
        if current is not None:
            measured["present_current"] = round(current_mA / (current.scale or 1.0))
        for role, value in measured.items():
            self._put_role(role, value)
        if "moving" in table.fields:
            self._put(table["moving"], int(plant.speed != 0.0))

    def _volts(self, name: str) -> float:
        return self.table[name].to_unit(self._get(name))

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

    def _identify(self) -> None:
        values = {
            "model_number": self.table.model_number or 0,
            "firmware_version": self._firmware,
            "firmware_major": self._firmware,
            "endianness_flag": int(self.table.byte_order == "big"),
        }
        for name, value in values.items():
            if name in self.table.fields:
                self._put(self.table[name], value)

    def _role(self, role: str) -> int:
        """Value of a role's register; a role that the model does not have reads as 1: it limits nothing."""
        field = self.table.role(role)
        return 1 if field is None else self._get(field.name)

    def _put_role(self, role: str, value: int) -> None:
        field = self.table.role(role)
        if field is not None:
            self._put(field, value)

    def _get(self, name: str) -> int:
        field = self.table.fields[name]
        return field.from_bytes(self._memory[field.address : field.address + field.size])

    def _put(self, field: Field, value: int) -> None:
        """Store a value, at most what the register can show."""
        bits = int(field.sign[9:]) if field.sign.startswith("sign_bit_") else 8 * field.size - field.signed
        most = (1 << bits) - 1 if field.sign != "offset_2048" else 2047
        least = -most if field.signed else 0
        self._memory[field.address : field.address + field.size] = field.to_bytes(min(max(value, least), most))
