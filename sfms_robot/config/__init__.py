"""Frozen, validated models of every YAML file, and the loader that names file, key, value and valid choices.

Every name is loaded at its first use, so that a program that reads a listener's file builds no models of a head.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sfms_robot.config.base import Model, load, parse
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
    from sfms_robot.config.joint import (
        BusConfig,
        Coupling,
        Expression,
        Faults,
        Joint,
        LimitClass,
        LoadRule,
        Region,
        Safety,
        Threshold,
    )
    from sfms_robot.config.listener import (
        Arig,
        Calmness,
        ChannelGroup,
        Diffusion,
        ListenerSettings,
        NodCourse,
        Sfms,
        SmileCourse,
        load_listener,
        parse_listener,
    )
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
    "BusConfig",
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
    "ListenerSettings",
    "LoadRule",
    "Model",
    "NodCourse",
    "Person",
    "Phase",
    "PredictorTraining",
    "Recipe",
    "Region",
    "RobotDescription",
    "Safety",
    "Sfms",
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

# Modules and the names they hold; every other name is of config.training.
_HOMES: Final = {
    "config.base": ("Model", "load", "parse"),
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
    "config.joint": (
        "BusConfig",
        "Coupling",
        "Expression",
        "Faults",
        "Joint",
        "LimitClass",
        "LoadRule",
        "Region",
        "Safety",
        "Threshold",
    ),
    "config.listener": (
        "Arig",
        "Calmness",
        "ChannelGroup",
        "Diffusion",
        "ListenerSettings",
        "NodCourse",
        "Sfms",
        "SmileCourse",
        "load_listener",
        "parse_listener",
    ),
    "data": ("find",),
}


def __getattr__(name: str) -> Any:
    """Load a name from its module (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = next((module for module, names in _HOMES.items() if name in names), "config.training")
    value = getattr(import_module(f"sfms_robot.{home}"), name)
    globals()[name] = value
    return value
