"""Emulated servos and boards in this process, without a wire."""

from sfms_robot.config import load_firmware_map, variant
from sfms_robot.emulator.chain_process import plugged
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.codecs import maestro
from sfms_robot.servo.registers import Table


def table_of(model):
    return Table.of(load_firmware_map(model))


def servos_of(model, *ids, start_ticks=None, **more):
    """What is plugged in: servos of one model, in the middle of their range unless told otherwise."""
    start_ticks = load_firmware_map(model).center_ticks if start_ticks is None else start_ticks
    return [EmulatedServo(i, model, start_ticks=start_ticks, **more) for i in ids]


def addressed(command, device=maestro.DEFAULT_DEVICE):
    """A command in the Pololu protocol: AA, number of the board, the command without its top bit, its data."""
    return bytes([maestro.BAUD_INDICATION, device, command[0] & 0x7F]) + command[1:]


def device_of(*servos, chain_break=True):
    """The device of servos that share a protocol, or of one board's."""
    (device,) = plugged(servos, {each.model: table_of(each.model) for each in servos}, chain_break)
    return device


def chain_of(*models, **more):
    """The device of one servo of each model, with ids from 1 on."""
    return device_of(*(each for i, model in enumerate(models, 1) for each in servos_of(model, i, **more)))


class ServoBench:
    """One servo without a wire, and the time; registers by name or role."""

    def __init__(self, model="xl330-m288", firmware=53, start=None, supply_v=None, **registers):
        named = load_firmware_map(model)
        self.table = Table.of(variant(model, firmware) if named.protocol == 2 else named)
        stored = {"firmware": firmware, "registers": registers, "supply_v": supply_v}
        baud = 1_000_000 if 1_000_000 in named.baud_codes.values() else max(named.baud_codes.values())
        start = named.center_ticks if start is None else start
        servo = EmulatedServo(1, self.table.model, baud, start, **stored)
        (device,) = plugged([servo], {self.table.model: self.table})
        self.servo = device.servo(1)
        self.t = 0.0

    def put(self, **values):
        """Write registers; the last error."""
        for name, value in values.items():
            field = self.table.role(name)
            error = self.servo.write(field.address, field.to_bytes(value), self.t)
            self.servo.feed_watchdog(self.t)
        return error

    def get(self, name):
        field = self.table.role(name) or self.table[name]
        error, data = self.servo.read(field.address, field.size, self.t)
        assert error == 0
        return field.from_bytes(data)

    def after(self, seconds, name="present_position"):
        self.t += seconds
        return self.get(name)
