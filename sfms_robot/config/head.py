"""A head: joints, the servos that move them, how far and fast they may go, and what drives them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final

from pydantic import Field, PrivateAttr, model_validator

from sfms_robot.config.base import Model, Name, load
from sfms_robot.config.camera_mount import CameraMount
from sfms_robot.config.consistency import problems, rates, wiring
from sfms_robot.config.joint import Joint, JointDefaults, LimitClass
from sfms_robot.config.kinematics import Kinematics
from sfms_robot.config.kinematics import problems as neck_problems
from sfms_robot.config.life import Life
from sfms_robot.config.mapping import Coupling, Expression, Fold, Region
from sfms_robot.config.named_bus import Bus
from sfms_robot.config.robot_description import RobotDescription
from sfms_robot.config.robot_description import problems as description_problems
from sfms_robot.config.safety_rules import Faults, Safety
from sfms_robot.data import find

VERSION: Final = 1  # of a head's file
NOT_SHARED: Final = ("id", "note", "drive", "mirror_of", "mirror_sense")  # what a twin does not take over


class Head(Model):
    """A head: `configs/heads/NAME/head.yaml`.

    `calibrate_first`: zeros and ranges differ from build to build, so that on real servos the head moves little and
    slowly until somebody has measured them.
    """

    version: Annotated[int, Field(ge=1, le=VERSION)] = VERSION
    name: Name
    description: str
    calibrate_first: bool = False
    buses: Annotated[dict[Name, Bus], Field(min_length=1)]
    limits: dict[Name, LimitClass]
    safety: Safety = Safety()
    faults: Faults = Faults()
    joint_defaults: JointDefaults = JointDefaults()
    joints: Annotated[dict[Name, Joint], Field(min_length=1)]
    expressions: dict[Name, Expression] = Field(default_factory=dict)
    couplings: tuple[Coupling, ...] = ()
    folds: tuple[Fold, ...] = ()
    regions: dict[Name, Region] = Field(default_factory=dict)
    kinematics: Kinematics | None = None
    camera: CameraMount | None = None
    life: Life = Life()
    urdf: RobotDescription | None = None
    _folder: Path | None = PrivateAttr(None)

    @property
    def folder(self) -> Path | None:
        """Where its file lies; None for a head that was made otherwise."""
        return self._folder

    @model_validator(mode="before")
    @classmethod
    def _expanded(cls, value: Any) -> Any:
        return expanded(value)

    @model_validator(mode="after")
    def _consistent(self) -> Head:
        found = wiring(self.joints, self.buses, self.limits) + rates(self.joints, self.buses)
        found += problems(self.joints, self.expressions, self.couplings, self.folds, self.regions)
        if self.kinematics is not None:
            found += neck_problems(self.kinematics, self.joints, self.folds)
        found += description_problems(self.urdf, self.joints)
        if found:
            more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
            raise ValueError(found[0] + more)
        return self

    def safety_of(self, joint: str) -> Safety:
        return self.safety.merged(self.joints[joint].safety)

    def limit(self, joint: str) -> LimitClass:
        return self.limits[self.joints[joint].limits]


def load_head(name: str) -> Head:
    """Return a head by shipped name or folder. Raises ConfigError."""
    folder = find("heads", name, "head.yaml")
    file = folder / "head.yaml"
    head = load(Head, file)
    head._folder = folder
    return head


def expanded(raw: Any) -> Any:
    """Return a head's plain data with `joint_defaults` and `mirror_of` filled into its joints.

    A mirrored drive is the same drive with left and right exchanged. Channels that end in Left or Right change places;
    roll, yaw and y, which have one channel for both sides, change sign. A joint whose plus points to the same side of
    the head as that of its twin (pan, say) is of the opposite sense: its drive, and its range, are negated as well.

    A value of the wrong type stays as it is, for the models to refuse. Raises ValueError for a newer version.
    """
    if not isinstance(raw, dict):
        return raw
    version = raw.get("version")
    if isinstance(version, int) and version > VERSION:
        raise ValueError(f"version = {version} is of a newer sfms-robot; this one reads version {VERSION}")
    if not isinstance(raw.get("joints"), dict):
        return raw
    defaults = raw.get("joint_defaults")
    shared = defaults if isinstance(defaults, dict) else {}
    written = raw["joints"]
    joints = {name: {**shared, **joint} if isinstance(joint, dict) else joint for name, joint in written.items()}
    for name, joint in written.items():
        named = joint.get("mirror_of") if isinstance(joint, dict) else None
        if isinstance(named, str) and isinstance(twin := written.get(named), dict):
            joints[name] = {**_seen_in_mirror({**shared, **twin}, joint.get("mirror_sense")), **joint}
    return {**raw, "joints": joints}


def _seen_in_mirror(twin: dict[str, Any], sense: Any) -> dict[str, Any]:
    out = {key: value for key, value in twin.items() if key not in NOT_SHARED}
    if sense != "opposite":  # a servo on the other side of the head turns the other way for the same motion
        return {**out, "sign": -1 if out.get("sign", 1) == 1 else 1}
    for key, other in (("min_deg", "max_deg"), ("max_deg", "min_deg"), ("rest_deg", "rest_deg")):
        if isinstance(twin.get(other), (int, float)):
            out[key] = -twin[other]
    return out
