"""Which URDF draws a head, and which of its joints follow ours: `urdf` in a head's file."""

from __future__ import annotations

from collections.abc import Collection
from typing import Annotated, Any

from pydantic import Field, model_validator

from sfms_robot.config.base import Finite, Model, Name


class FollowingJoint(Model):
    """One joint of the URDF: its value is `offset` + `scale` x our joint's angle [rad].

    `scale` is 1 or -1 for a joint that turns as ours does, metres per radian for one that slides.
    """

    joint: Annotated[str, Field(min_length=1)]
    scale: Finite = 1.0
    offset: Finite = 0.0


class RobotDescription(Model):
    """A URDF file, beside the head's file or anywhere, or the name of a shipped head that looks the same.

    Attributes:
        packages: where the folders of `package://NAME/...` lie, from the head's folder on.
        joints: our joint -> joint of the URDF; one that is not named here drives the joint of its own name.
    """

    file: Annotated[str, Field(min_length=1)]
    packages: dict[str, str] = Field(default_factory=dict)
    joints: dict[Name, FollowingJoint] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _short(cls, value: Any) -> Any:
        """`urdf: FILE`, and `jaw: JawJoint` under joints."""
        if isinstance(value, str):
            return {"file": value}
        if isinstance(value, dict) and isinstance(joints := value.get("joints"), dict):
            long = {name: {"joint": given} if isinstance(given, str) else given for name, given in joints.items()}
            return {**value, "joints": long}
        return value


def problems(description: RobotDescription | None, joints: Collection[str]) -> list[str]:
    """Joints of the description that the head has not, and joints of the URDF that two of ours would move."""
    if description is None:
        return []
    known = ", ".join(joints)
    found = [
        f"urdf.joints: {name!r} is not a joint of this head ({known})"
        for name in description.joints
        if name not in joints
    ]
    owner: dict[str, str] = {}
    for name, follows in description.joints.items():
        if owner.setdefault(follows.joint, name) != name:
            found.append(f"urdf.joints.{name}.joint = {follows.joint!r} already follows {owner[follows.joint]}")
    return found
