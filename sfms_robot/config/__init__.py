"""Frozen, validated models of every YAML file, and the loader, whose errors name file, key, value and valid choices."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

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
    Diffusion,
    ListenerSettings,
    NodCourse,
    Sfms,
    SmileCourse,
    load_listener,
)
from sfms_robot.data import find

if TYPE_CHECKING:
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

__all__ = [
    "Arig",
    "ArigPhase",
    "ArigTraining",
    "Baseline",
    "BusConfig",
    "Calmness",
    "CameraMount",
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
    "parse_training",
    "variant",
]


def __getattr__(name: str) -> Any:
    """Load a name of `config.training` when it is first used, because only the lab needs them (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.training"), name)
