"""Neck of a head, which converts a pose to joint angles: a section of its file, `kind: serial` or `kind: stewart`."""

from __future__ import annotations

from itertools import chain
from typing import Annotated, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag

from sfms_robot.config.base import Finite, Model, Name, NonNegative, Positive, Problems, Share
from sfms_robot.data import Names

AxisName = Literal["roll", "pitch", "yaw"]
Triple = tuple[Finite, Finite, Finite]
Row = tuple[Finite, Finite, Finite, Finite]


class Split(Model):
    """An axis shared by two joints in series, by a fixed share or by frequency.

    `lower_share` is the lower joint's part, 0..1. With `crossover_hz` the angle after a one-pole low-pass goes to the
    lower joint and the rest to the upper joint. The part beyond the limits of one joint goes to the other.
    """

    lower: Name
    upper: Name
    lower_share: Share | None = None
    crossover_hz: Positive | None = None

    def contradictions(self) -> Problems:
        if (self.lower_share is None) == (self.crossover_hz is None):
            yield "needs exactly one of lower_share, crossover_hz"


class Differential(Model):
    """Two servos that pitch together and roll against each other.

    left = pitch_gain x pitch + roll_gain x roll, right = pitch_gain x pitch - roll_gain x roll.
    """

    left: Name
    right: Name
    pitch_gain: Finite = 1.0
    roll_gain: Finite = 1.0

    def contradictions(self) -> Problems:
        for key in ("pitch_gain", "roll_gain"):
            if getattr(self, key) == 0:
                yield f"{key} is 0: no servo angle would move that axis"


AxisJoints = Annotated[
    Annotated[Name, Tag("joint")] | Annotated[Split, Tag("split")],
    Discriminator(lambda value: "joint" if isinstance(value, str) else "split"),
]


class SerialNeck(Model):
    """A neck of axes in series, with `order` from the base to the head; an axis has the angle of its joint."""

    kind: Literal["serial"]
    order: tuple[AxisName, ...] = Field(min_length=1, max_length=3)
    axes: dict[AxisName, AxisJoints] = {}
    differential: Differential | None = None

    def contradictions(self) -> Problems:
        if len(set(self.order)) != len(self.order):
            yield f"order {list(self.order)} has an axis twice; two joints of one axis are a split"
        geared: tuple[AxisName, ...] = ("pitch", "roll") if self.differential else ()
        for axis in self.order:
            if (axis in self.axes) == (axis in geared):
                yield f"axis {axis!r} of order needs a joint under axes, or the differential, not both"
        for axis in (*self.axes, *geared):
            if axis not in self.order:
                yield f"axis {axis!r} has a joint but is not in order ({', '.join(self.order)})"
        yield from _distinct(self.joints())

    def joints(self) -> Names:
        """Return every joint that the neck moves, from the base up; both joints of a differential at its first axis."""
        geared = next((axis for axis in self.order if axis not in self.axes), None)
        turning = [self.joints_of(axis) for axis in self.order if axis in self.axes or axis == geared]
        return tuple(chain.from_iterable(turning))

    def joints_of(self, axis: str) -> Names:
        """Return the joints that turn about one axis; empty for an axis that the neck does not have."""
        pair = self.differential
        place = next((place for name, place in self.axes.items() if name == axis), None)
        if isinstance(place, str):
            return (place,)
        if place is not None:
            return place.lower, place.upper
        return (pair.left, pair.right) if pair is not None and axis != "yaw" else ()


class Leg(Model):
    """One crank and rod. `servo_from_body` (3 x 4) maps body coordinates [m] to those of the servo, whose axis is z."""

    joint: Name
    side: Literal[1, -1]
    servo_from_body: tuple[Row, Row, Row]
    rod_end_m: Triple


class PoseLimits(Model):
    """Largest angles between head and body, even where the legs could reach farther."""

    roll_deg: Positive = 180.0
    pitch_deg: float = Field(default=89.0, gt=0, lt=90)
    yaw_deg: Positive = 180.0


class BodyYaw(Model):
    """A joint that turns the whole platform by the yaw beyond `beyond_deg`, which is the most that the legs turn.

    With `low_pass_hz` it turns by the low-passed yaw instead, and farther where the legs would exceed `beyond_deg`.
    """

    joint: Name
    beyond_deg: NonNegative = 40.0
    low_pass_hz: Positive | None = None


class StewartPlatform(Model):
    """A neck on six cranks and rods of equal size; the head's home is `home_height_m` above the body's origin."""

    kind: Literal["stewart"]
    crank_m: Positive
    rod_m: Positive
    home_height_m: Finite
    legs: tuple[Leg, ...] = Field(min_length=6, max_length=6)
    limits: PoseLimits = PoseLimits()
    body_yaw: BodyYaw | None = None

    def contradictions(self) -> Problems:
        yield from _distinct(self.joints())
        for number, leg in enumerate(self.legs):
            turn = np.array(leg.servo_from_body)[:, :3]
            if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-6:
                yield f"legs.{number}.servo_from_body is not a rotation and a shift"

    def joints(self) -> Names:
        """Return the joint of the body yaw, if there is one, and then those of the legs in order."""
        return self.joints_of("yaw")

    def joints_of(self, axis: str) -> Names:
        """Return the joints that move the head about or along one axis: all legs, and for yaw first the body's."""
        body = (self.body_yaw.joint,) if self.body_yaw and axis == "yaw" else ()
        return (*body, *(leg.joint for leg in self.legs))


Kinematics = Annotated[SerialNeck | StewartPlatform, Field(discriminator="kind")]


def _distinct(joints: Names) -> Problems:
    for joint in joints:
        if joints.count(joint) > 1:
            yield f"joint {joint!r} is used twice"
