"""Emulated servos and boards in this process, without a wire."""

from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.chain_process import plugged
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.servo.registers import Table


def table_of(model):
    return Table.of(load_firmware_map(model))


def servos_of(model, *ids, start_ticks=None, **more):
    """What is plugged in: servos of one model, in the middle of their range unless told otherwise."""
    start_ticks = load_firmware_map(model).center_ticks if start_ticks is None else start_ticks
    return [EmulatedServo(i, model, start_ticks=start_ticks, **more) for i in ids]


def device_of(*servos, chain_break=True):
    """The device of servos that share a protocol, or of one board's."""
    (device,) = plugged(servos, {each.model: table_of(each.model) for each in servos}, chain_break)
    return device


def chain_of(*models, **more):
    """The device of one servo of each model, with ids from 1 on."""
    return device_of(*(each for i, model in enumerate(models, 1) for each in servos_of(model, i, **more)))
