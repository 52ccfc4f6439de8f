"""A head: joints, the servos that move them, their ranges and limits, and the channels that drive them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from pydantic import Field, ModelWrapValidatorHandler, PrivateAttr, model_validator

from sfms_robot.config.base import Finite, Model, Name, NonNegative, Positive, Share, all_of, load
from sfms_robot.config.consistency import JOINT, problems
from sfms_robot.config.joint import (
    BusConfig,
    Coupling,
    Expression,
    Faults,
    Fold,
    Joint,
    JointDefaults,
    LimitClass,
    Region,
    Safety,
)
from sfms_robot.config.kinematics import Kinematics, Triple
from sfms_robot.data import NO_HEAD, Report, head_file
from sfms_robot.errors import not_one_of
from sfms_robot.frames import LATERAL_POSE, Doubles
from sfms_robot.ranges import Range

VERSION: Final = 1  # version of the format of head files
IN_OPPOSITE: Final = {"min_deg": "max_deg", "max_deg": "min_deg", "rest_deg": "rest_deg"}  # key of the twin, negated
NOT_SHARED: Final = ("id", "note", "drive", "mirror_of", "mirror_sense")  # keys that a twin does not pass on
TRAVEL: Final = 0.2  # share of its travel, around rest, that a joint may use before it is calibrated
PACE: Final = 0.3
_SUFFIX: Final = "_calibrate_first"


class CameraMount(Model):
    """Place and direction of the camera that sees people; the axes are the head's: x forward, y left, z up.

    Attributes:
        on: `head`: the camera moves with the neck; `base`: it stays.
        at_m: place of the camera, from the middle of the head at home.
        rpy_deg: rotation of the camera: roll, pitch (+ down) and yaw (+ left); at zero it looks ahead.
    """

    on: Literal["head", "base"]
    at_m: Triple = (0.0, 0.0, 0.0)
    rpy_deg: Triple = (0.0, 0.0, 0.0)


class Gaze(Model):
    """Eyes that hold a point while the head moves, and jump to the next one.

    Attributes:
        neck_gain: share of the head's yaw and pitch that the eyes compensate for (vestibulo-ocular reflex).
        dead_zone_deg: the eyes hold their point until the listener's gaze is this far away from it.
        recentre_deg: largest angle from the listener's gaze that compensation may cause; beyond it the eyes jump back.
        settle_ms: time that the listener's gaze has to be away before the eyes follow.
        pause_ms: shortest time between two jumps.
        full_yaw_deg, full_pitch_deg: angle of the eye at a value of 1 of its eyeLook channel.
    """

    neck_gain: Share = 1.0
    dead_zone_deg: Positive = 1.5
    recentre_deg: Positive = 12.0
    settle_ms: NonNegative = 40.0
    pause_ms: NonNegative = 120.0
    full_yaw_deg: Positive = 30.0
    full_pitch_deg: Positive = 20.0

    @property
    def full_rad(self) -> Doubles:
        """Yaw and pitch (2,) of the eye for a channel of 1."""
        return np.radians([self.full_yaw_deg, self.full_pitch_deg])


class Idle(Model):
    """Blinks, sway and glances where the listener makes none. 0 switches a kind off.

    Attributes:
        blinks_per_minute: wanted number of blinks, including those of the listener.
        head_deg: half the swing of the yaw; pitch and roll swing less.
        glance_deg: largest turn of the eyes to the side in a glance, while the listener does not move them.
        still_deg_s: head or eyes that the listener turns more slowly than this count as still.
        fade_s: time that the listener has to be still until idle motion is back in full.
    """

    blinks_per_minute: float = Field(default=14.0, ge=0, le=60)
    head_deg: float = Field(default=1.2, ge=0, le=10)
    glance_deg: float = Field(default=3.0, ge=0, le=15)
    still_deg_s: Positive = 3.0
    fade_s: Positive = 3.0


class Person(Model):
    """Looking at the person that the head listens to, and looking away as people do.

    Attributes:
        head_share: share of the direction to the person that the neck turns; the eyes turn the rest. A head without a
            `gaze` section turns its neck all the way.
        look_away: rate of looks away from the person: 1 is as often as people, 0 is never.
    """

    head_share: Share = 0.6
    look_away: float = Field(default=1.0, ge=0, le=2)


class Life(Model):
    """Spontaneous motion of a head. All sections are optional; a section that is left out adds no motion."""

    gaze: Gaze | None = None
    idle: Idle | None = None
    person: Person | None = None


class FollowingJoint(Model):
    """A joint of the URDF that follows a joint of the head: its value is `offset` + `scale` x that joint's angle [rad].

    `scale` is 1 or -1 for a joint that turns like the head's joint, and metres per radian for a sliding joint.
    """

    joint: str = Field(min_length=1)
    scale: Finite = 1.0
    offset: Finite = 0.0


class RobotDescription(Model):
    """Appearance of a head: a URDF file, or the name of a shipped head that looks the same.

    Attributes:
        packages: folder of each package in `package://NAME/...`, relative to the head's folder.
        joints: joint of the head -> joint of the URDF; a joint that is not named here moves the URDF joint of its name.
    """

    file: str = Field(min_length=1)
    packages: dict[str, str] = {}
    joints: dict[Name, FollowingJoint] = {}

    @model_validator(mode="before")
    @classmethod
    def _short(cls, value: Any) -> Any:
        """Accept `urdf: FILE`, and `jaw: JawJoint` under joints."""
        if isinstance(value, str):
            return {"file": value}
        if isinstance(value, dict) and isinstance(joints := value.get("joints"), dict):
            long = {name: {"joint": given} if isinstance(given, str) else given for name, given in joints.items()}
            return {**value, "joints": long}
        return value


class Head(Model):
    """A head: `configs/heads/NAME/head.yaml`.

    `calibrate_first`: true for a head whose zeros and ranges differ from build to build. On real servos it moves little
    and slowly until they have been measured.
    """

    version: int = Field(default=VERSION, ge=1, le=VERSION)
    name: Name
    description: str
    calibrate_first: bool = False
    buses: dict[Name, BusConfig] = Field(min_length=1)
    limits: dict[Name, LimitClass]
    safety: Safety = Safety()
    faults: Faults = Faults()
    joint_defaults: JointDefaults = JointDefaults()
    joints: dict[Name, Joint] = Field(min_length=1)
    expressions: dict[Name, Expression] = {}
    couplings: tuple[Coupling, ...] = ()
    folds: tuple[Fold, ...] = ()
    regions: dict[Name, Region] = {}
    kinematics: Kinematics | None = None
    camera: CameraMount | None = None
    life: Life = Life()
    urdf: RobotDescription | None = None
    _folder: Path | None = PrivateAttr(None)

    @property
    def folder(self) -> Path | None:
        """Folder of the head's file; None for a head that was not loaded from a file."""
        return self._folder

    @model_validator(mode="wrap")
    @classmethod
    def _expanded(cls, value: Any, handler: ModelWrapValidatorHandler[Head]) -> Head:
        return handler(expanded(value))

    @model_validator(mode="after")
    def _consistent(self) -> Head:
        if found := problems(self):
            raise all_of(found)
        return self

    @property
    def rest_rad(self) -> Doubles:
        """Angles (J,) of all joints at rest."""
        return np.array([joint.rest_rad for joint in self.joints.values()])

    @property
    def range(self) -> Range:
        """Lowest and highest angles (J,) of all joints."""
        return Range(*np.array([(joint.min_rad, joint.max_rad) for joint in self.joints.values()]).reshape(-1, 2).T)

    def on_bus(self, bus: str) -> dict[str, Joint]:
        """Return the joints of one bus, by name."""
        return {name: joint for name, joint in self.joints.items() if joint.bus == bus}

    def safety_of(self, joint: str) -> Safety:
        return self.safety.merged(self.joints[joint].safety)

    def limit(self, joint: str) -> LimitClass:
        return self.limits[self.joints[joint].limits]


def load_head(name: str, *, servos: bool = True) -> Head:
    """Return a head by shipped name or folder. Raises ConfigError.

    If `servos` is False, `NO_HEAD`, a head without servos, is accepted too.
    """
    if name == NO_HEAD and not servos:
        return Head.model_construct(name=NO_HEAD, description="No servos", buses={}, limits={}, joints={})
    file = head_file(name)
    head = load(Head, file)
    head._folder = file.parent
    return head


def expanded(raw: Any) -> Any:
    """Return a head's plain data with `joint_defaults` and `mirror_of` filled into its joints.

    A mirrored drive is the same drive with left and right exchanged. Channels that end in Left or Right change places;
    roll, yaw and y, which have one channel for both sides, change sign. A joint whose plus points to the same side of
    the head as the plus of its twin (pan, for example) has `mirror_sense: opposite`: its drive and range are negated
    as well.

    A value of the wrong type stays unchanged, and the models refuse it. Raises ValueError for a newer version, and for
    a twin that does not exist.
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
        if isinstance(named, str) and named not in written:
            raise ValueError(f"joints.{name}.mirror_of = {not_one_of(named, JOINT, written)}")
        if isinstance(named, str) and isinstance(twin := written[named], dict):
            joints[name] = {**_seen_in_mirror({**shared, **twin}, joint.get("mirror_sense")), **joint}
    return {**raw, "joints": joints}


def _seen_in_mirror(twin: Report, sense: Any) -> Report:
    out = {key: value for key, value in twin.items() if key not in NOT_SHARED}
    if sense != "opposite":  # a servo on the other side of the head turns the other way for the same motion
        return {**out, "sign": -1 if out.get("sign", 1) == 1 else 1}
    for key, other in IN_OPPOSITE.items():
        if isinstance(twin.get(other), (int, float)):
            out[key] = -twin[other]
    return out


def held_back(head: Head, joints: Iterable[str]) -> Head:
    """Return the head with `joints` at 20 % of their travel and 0.3 of their limits.

    Servo horns sit differently on every build, so a face that moves as its file says may drive a lip into the teeth.
    A joint whose zero and range have not been measured therefore stays near its rest and moves slowly.
    """
    limits, held = dict(head.limits), dict(head.joints)
    for name in joints:
        joint = head.joints[name]
        rest, slow = joint.rest_deg, joint.limits + _SUFFIX
        limits[slow] = LimitClass(**{key: PACE * value for key, value in head.limit(name)})
        low, high = (rest + TRAVEL * (end - rest) for end in (joint.min_deg, joint.max_deg))
        held[name] = joint.replaced(min_deg=low, max_deg=high, limits=slow)
    return head.replaced(limits=limits, joints=held)


# --- Drives: one plain expression for each joint, with sharing, mirrors and folds worked out ------------------------


def drives(head: Head) -> dict[str, Expression | None]:
    """Return the drive of every joint in terms of channels alone; None for a joint without a drive."""
    # A mirror with a learnt drive of its own does not use the drive of its twin.
    mirrors = {name for name, joint in head.joints.items() if joint.mirror_of is not None and joint.drive is None}
    found = {name: _own(name, joint.drive, head) for name, joint in head.joints.items() if name not in mirrors}
    for name in mirrors:
        joint = head.joints[name]
        twin = found[joint.mirror_of or ""]
        seen = mirrored(twin) if twin else None
        if seen and joint.mirror_sense == "opposite":
            seen = Expression(sum=(seen,), gain=-1)
        found[name] = _own(name, seen, head)
    return {name: found[name] for name in head.joints}


def _own(name: str, drive: Expression | None, head: Head) -> Expression | None:
    folds = tuple(Expression(channel=fold.channel, gain=fold.gain) for fold in head.folds if fold.into == name)
    terms = ((_inlined(drive, head.expressions),) if drive else ()) + folds
    return Expression(sum=terms) if folds else terms[0] if terms else None


def _inlined(node: Expression, expressions: Mapping[str, Expression]) -> Expression:
    """Return the expression with every shared expression in place of its name."""
    if node.use is not None:
        shared = _inlined(expressions[node.use], expressions)
        return shared if node == Expression(use=node.use) else node.replaced(use=None, sum=(shared,))
    if node.group is None:
        return node
    return node.replaced(**{node.group: tuple(_inlined(part, expressions) for part in node.parts)})


def mirrored(node: Expression) -> Expression:
    """Return the expression of the other side of the face."""
    if node.channel in LATERAL_POSE:
        return node.replaced(channel=None, sum=(Expression(channel=node.channel, gain=-1),))
    if node.channel is not None:
        return node.replaced(channel=other_side(node.channel))
    assert node.group is not None
    return node.replaced(**{node.group: tuple(map(mirrored, node.parts))})


def other_side(channel: str) -> str:
    """Return the channel with left and right exchanged."""
    for side, other in (("Left", "Right"), ("Right", "Left")):
        if channel.endswith(side):
            return channel.removesuffix(side) + other
    return channel


class StoredRegisters(Model):
    """The registers and supply of an emulated head's servos: `configs/heads/NAME/emulate.yaml`.

    The servos of a real head already store homing offsets, limits and the like; emulated servos get them from this
    file. `registers` applies to every servo, `joints` to the servo of one joint; raw values by register name.
    """

    source: str = ""
    supply_v: Positive | None = None
    registers: dict[Name, int] = {}
    joints: dict[Name, dict[Name, int]] = {}

    def of(self, joint: str) -> dict[str, int]:
        """Return all registers stored in a joint's servo."""
        return {**self.registers, **self.joints.get(joint, {})}


def load_stored(head: Head) -> StoredRegisters:
    """Return the stored registers of a head from its folder; without such a file, those of new servos."""
    file = head.folder and head.folder / "emulate.yaml"
    return load(StoredRegisters, file) if file and file.is_file() else StoredRegisters()
