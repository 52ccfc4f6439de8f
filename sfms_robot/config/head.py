"""A head: joints, the servos that move them, how far and fast they may go, and what drives them."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, PrivateAttr, model_validator

from sfms_robot.config.base import Model, Name, parse
from sfms_robot.config.camera_mount import CameraMount
from sfms_robot.config.consistency import problems, rates, wiring
from sfms_robot.config.inheritance import expanded
from sfms_robot.config.joint import Joint, JointDefaults, LimitClass
from sfms_robot.config.kinematics import Kinematics
from sfms_robot.config.kinematics import problems as neck_problems
from sfms_robot.config.life import Life
from sfms_robot.config.mapping import Coupling, Expression, Fold, Region
from sfms_robot.config.migration import VERSION, former_words, migrated
from sfms_robot.config.named_bus import Bus
from sfms_robot.config.robot_description import RobotDescription
from sfms_robot.config.robot_description import problems as description_problems
from sfms_robot.config.safety_rules import Faults, Safety
from sfms_robot.config.yaml_file import read
from sfms_robot.data import find

logger = logging.getLogger(__name__)


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
        return expanded(migrated(value))

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
    """A head by shipped name or folder. Words of an older version are taken, and each is told in the log."""
    folder = find("heads", name, "head.yaml")
    file = folder / "head.yaml"
    raw = read(file)
    for line in former_words(raw):
        logger.warning("%s: %s", file, line)
    head = parse(Head, raw, file)
    head._folder = folder
    return head
