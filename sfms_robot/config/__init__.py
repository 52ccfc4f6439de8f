"""Frozen, validated models of every YAML file, and the loader that names file, key, value and valid choices."""

from sfms_robot.config.base import Model, find, load, parse
from sfms_robot.config.drives import drives
from sfms_robot.config.firmware import FirmwareMap, Register, load_firmware_map, map_files, variant
from sfms_robot.config.head import (
    Bus,
    Faults,
    Head,
    Joint,
    JointDefaults,
    LimitClass,
    LoadRule,
    Safety,
    Threshold,
    load_head,
)
from sfms_robot.config.life import Gaze, Idle, Life
from sfms_robot.config.listener import (
    ChannelGroup,
    Listener,
    PredictorTraining,
    Sampling,
    TokenizerTraining,
    Training,
)
from sfms_robot.config.mapping import Coupling, Expression, Fold, Region

__all__ = [
    "Bus",
    "ChannelGroup",
    "Coupling",
    "Expression",
    "Faults",
    "FirmwareMap",
    "Fold",
    "Gaze",
    "Head",
    "Idle",
    "Joint",
    "JointDefaults",
    "Life",
    "LimitClass",
    "Listener",
    "LoadRule",
    "Model",
    "PredictorTraining",
    "Region",
    "Register",
    "Safety",
    "Sampling",
    "Threshold",
    "TokenizerTraining",
    "Training",
    "drives",
    "find",
    "load",
    "load_firmware_map",
    "load_head",
    "map_files",
    "parse",
    "variant",
]
