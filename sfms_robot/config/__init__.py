"""Frozen, validated models of every YAML file, and the loader that names file, key, value and valid choices."""

from sfms_robot.config.base import Model, find, load, parse
from sfms_robot.config.firmware import FirmwareMap, Register, load_firmware_map
from sfms_robot.config.head import Bus, Expression, Head, Joint, LimitClass, load_head
from sfms_robot.config.listener import (
    ChannelGroup,
    Listener,
    PredictorTraining,
    Sampling,
    TokenizerTraining,
    Training,
)

__all__ = [
    "Bus",
    "ChannelGroup",
    "Expression",
    "FirmwareMap",
    "Head",
    "Joint",
    "LimitClass",
    "Listener",
    "Model",
    "PredictorTraining",
    "Register",
    "Sampling",
    "TokenizerTraining",
    "Training",
    "find",
    "load",
    "load_firmware_map",
    "load_head",
    "parse",
]
