"""Frozen, validated models of every YAML file, and the loader that names file, key, value and valid choices.

Every name is loaded when it is first used, so that a program that reads a listener's file builds no models of a head.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sfms_robot.config.arig import Arig, Diffusion
    from sfms_robot.config.base import Model, load, parse
    from sfms_robot.config.calmness import Calmness
    from sfms_robot.config.firmware import FirmwareMap, load_firmware_map, map_files, variant
    from sfms_robot.config.head import (
        CameraMount,
        FollowingJoint,
        Gaze,
        Head,
        Idle,
        Life,
        Person,
        RobotDescription,
        load_head,
    )
    from sfms_robot.config.joint import Joint, LimitClass
    from sfms_robot.config.listener import (
        ChannelGroup,
        Listener,
        NodCourse,
        Sfms,
        SmileCourse,
    )
    from sfms_robot.config.listener_kinds import load_listener, parse_listener
    from sfms_robot.config.mapping import Coupling, Expression, Region
    from sfms_robot.config.named_bus import Bus
    from sfms_robot.config.safety_rules import Faults, LoadRule, Safety, Threshold
    from sfms_robot.config.training import (
        ArigPhase,
        ArigTraining,
        Baseline,
        Dense,
        Grouped,
        GroupWeights,
        Phase,
        PredictorTraining,
        Recipe,
        Stage,
        TokenizerTraining,
        Training,
        load_training,
        parse_training,
    )
    from sfms_robot.data import find

__all__ = [
    "Arig",
    "ArigPhase",
    "ArigTraining",
    "Baseline",
    "Bus",
    "Calmness",
    "CameraMount",
    "ChannelGroup",
    "Coupling",
    "Dense",
    "Diffusion",
    "Expression",
    "Faults",
    "FirmwareMap",
    "FollowingJoint",
    "Gaze",
    "GroupWeights",
    "Grouped",
    "Head",
    "Idle",
    "Joint",
    "Life",
    "LimitClass",
    "Listener",
    "LoadRule",
    "Model",
    "Person",
    "Phase",
    "PredictorTraining",
    "Recipe",
    "Region",
    "RobotDescription",
    "Safety",
    "Sfms",
    "NodCourse",
    "SmileCourse",
    "Stage",
    "Threshold",
    "TokenizerTraining",
    "Training",
    "find",
    "load",
    "load_firmware_map",
    "load_head",
    "load_listener",
    "load_training",
    "map_files",
    "parse",
    "parse_listener",
    "parse_training",
    "variant",
]

# Module -> what comes from there.
_NAMES: Final = {
    "config.arig": ("Arig", "Diffusion"),
    "config.base": ("Model", "load", "parse"),
    "config.calmness": ("Calmness",),
    "config.firmware": ("FirmwareMap", "load_firmware_map", "map_files", "variant"),
    "config.head": (
        "CameraMount",
        "FollowingJoint",
        "Gaze",
        "Head",
        "Idle",
        "Life",
        "Person",
        "RobotDescription",
        "load_head",
    ),
    "config.joint": ("Joint", "LimitClass"),
    "config.listener": ("ChannelGroup", "Listener", "NodCourse", "Sfms", "SmileCourse"),
    "config.listener_kinds": ("load_listener", "parse_listener"),
    "config.mapping": ("Coupling", "Expression", "Region"),
    "config.named_bus": ("Bus",),
    "config.safety_rules": ("Faults", "LoadRule", "Safety", "Threshold"),
    "config.training": (
        "ArigPhase",
        "ArigTraining",
        "Baseline",
        "Dense",
        "Grouped",
        "GroupWeights",
        "Phase",
        "PredictorTraining",
        "Recipe",
        "Stage",
        "TokenizerTraining",
        "Training",
        "load_training",
        "parse_training",
    ),
    "data": ("find",),
}
_MODULE_OF: Final = {name: module for module, names in _NAMES.items() for name in names}


def __getattr__(name: str) -> Any:
    """Load a name from its module (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"sfms_robot.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
