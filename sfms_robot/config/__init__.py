"""Frozen, validated models of every YAML file, and the loader that names file, key, value and valid choices."""

from sfms_robot.config.arig import Arig, Diffusion
from sfms_robot.config.arig_training import (
    ArigPhase,
    ArigTraining,
    GroupWeights,
    Stage,
    load_training,
    parse_training,
)
from sfms_robot.config.base import Model, load, parse
from sfms_robot.config.calmness import Calmness
from sfms_robot.config.camera_mount import CameraMount
from sfms_robot.config.drives import drives
from sfms_robot.config.firmware import FirmwareMap, Register, load_firmware_map, map_files, variant
from sfms_robot.config.head import Head, load_head
from sfms_robot.config.joint import Joint, JointDefaults, LimitClass
from sfms_robot.config.life import Gaze, Idle, Life, Person
from sfms_robot.config.listener import (
    ChannelGroup,
    Listener,
    Sampling,
    Sfms,
)
from sfms_robot.config.listener_kinds import load_listener, parse_listener
from sfms_robot.config.mapping import Coupling, Expression, Fold, Region
from sfms_robot.config.named_bus import Bus
from sfms_robot.config.recipe import Baseline, Dense, Grouped, Recipe
from sfms_robot.config.robot_description import FollowingJoint, RobotDescription
from sfms_robot.config.safety_rules import Faults, LoadRule, Safety, Threshold
from sfms_robot.config.training import Phase, PredictorTraining, TokenizerTraining, Training
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
    "Fold",
    "FollowingJoint",
    "Gaze",
    "GroupWeights",
    "Grouped",
    "Head",
    "Idle",
    "Joint",
    "JointDefaults",
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
    "Register",
    "RobotDescription",
    "Safety",
    "Sampling",
    "Sfms",
    "Stage",
    "Threshold",
    "TokenizerTraining",
    "Training",
    "drives",
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
