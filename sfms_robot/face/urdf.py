"""URDF files: links, joints and what is drawn of them; and where every link is for given joint values.

What the format says is at http://wiki.ros.org/urdf/XML. Read: visuals (box, cylinder, sphere, mesh), materials with a
colour, joints of every type but floating and planar, mimic. Not read: inertia, collision, transmissions, textures.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Doubles
from sfms_robot.signals.rotations import from_vector, rotation

TURNING: Final = ("revolute", "continuous")
MOVING: Final = (*TURNING, "prismatic")
_TYPES: Final = (*MOVING, "fixed")
_XACRO: Final = ("{http://www.ros.org/wiki/xacro}", "{http://ros.org/wiki/xacro}")
_GREY: Final = (0.7, 0.7, 0.7, 1.0)
_ROUND: Final = {"cylinder": ("radius", "length"), "sphere": ("radius",)}  # their sizes

Color = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Visual:
    """A shape on a link.

    Attributes:
        place: (4, 4) shape -> link.
        shape, size: box (x, y, z), cylinder (radius, length along z), sphere (radius,), mesh (scale x, y, z); metres.
        mesh: its file name as the URDF has it; empty for the others.
    """

    link: str
    place: Doubles
    shape: str
    size: tuple[float, ...]
    color: Color
    mesh: str = ""


@dataclass(frozen=True)
class Mimic:
    """A joint whose value is `offset` + `multiplier` x that of another."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, kw_only=True)
class JointElement:
    """A joint: `place` (4, 4) child at value 0 -> parent, `axis` (3,) of unit length in the child's frame."""

    name: str
    kind: str
    parent: str
    child: str
    place: Doubles
    axis: Doubles
    lower: float
    upper: float
    mimic: Mimic | None

    def motion(self, value: float) -> Doubles:
        """Return the transform (4, 4) from the child to the child at value 0."""
        out = np.eye(4)
        if self.kind in TURNING:
            out[:3, :3] = from_vector(self.axis * value)
        elif self.kind == "prismatic":
            out[:3, 3] = self.axis * value
        return out


@dataclass(frozen=True)
class Urdf:
    """A robot. `joints` by name, parents before children."""

    name: str
    root: str
    joints: Mapping[str, JointElement]
    visuals: tuple[Visual, ...]

    def link_places(self, values: Mapping[str, float]) -> dict[str, Doubles]:
        """Return every link's place (4, 4) in the root's axes, for joint values [rad, m]; 0 where none is given."""
        places = {self.root: np.eye(4)}
        for joint in self.joints.values():
            value = self._value(joint, values)
            places[joint.child] = places[joint.parent] @ joint.place @ joint.motion(value)
        return places

    def _value(self, joint: JointElement, values: Mapping[str, float]) -> float:
        if joint.mimic is None:
            return values.get(joint.name, 0.0)
        return joint.mimic.offset + joint.mimic.multiplier * self._value(self.joints[joint.mimic.joint], values)


def read_urdf(file: Path, text: bytes | None = None) -> Urdf:
    """Read a URDF, or `text` in place of the file's.

    Raises ConfigError of one line that names the file and the link or joint that is wrong.
    """
    try:
        root = ElementTree.fromstring(file.read_bytes() if text is None else text)
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from error
    except ElementTree.ParseError as error:
        raise ConfigError(f"{file}: not XML: {error}") from error
    if any(str(element.tag).startswith(_XACRO) for element in root.iter()):
        raise ConfigError(f"{file}: a xacro file: make a URDF of it (xacro {file.name} > robot.urdf)")
    if root.tag != "robot":
        raise ConfigError(f"{file}: not a URDF: its first element is <{root.tag}>, not <robot>")
    return _UrdfReader(file, root).robot()


class _UrdfReader:
    """A reader of one file, whose errors name the file and the element."""

    def __init__(self, file: Path, root: Element) -> None:
        self._file, self._root = file, root
        self._colors: dict[str, Color] = {}
        for material in root.iter("material"):
            if (color := material.find("color")) is not None:
                self._colors[material.get("name", "")] = self._color(color)

    def robot(self) -> Urdf:
        links = [self._name(link) for link in self._root.findall("link")]
        if not links:
            raise ConfigError(f"{self._file}: a URDF without a <link>")
        joints = {}
        for element in self._root.findall("joint"):
            joint = self._joint(element, links)
            if joint.name in joints:
                raise self._wrong("joint", joint.name, "is there twice")
            joints[joint.name] = joint
        root, ordered = self._tree(links, joints)
        for joint in ordered.values():
            self._check_mimic(joint, ordered)
        visuals = [v for link in self._root.findall("link") for v in self._visuals(link)]
        return Urdf(self._root.get("name", self._file.stem), root, ordered, tuple(visuals))

    def _joint(self, element: Element, links: list[str]) -> JointElement:
        name, kind = self._name(element), element.get("type", "")
        if kind not in _TYPES:
            raise self._wrong("joint", name, f"has the type {kind!r}; one of {', '.join(_TYPES)} can be drawn")
        ends = []
        for tag in ("parent", "child"):
            end = element.find(tag)
            link = "" if end is None else end.get("link", "")
            if link not in links:
                raise self._wrong("joint", name, f"has as its {tag} {link!r}, which is not a link of this file")
            ends.append(link)
        where = f"joint {name}"
        axis = np.array(self._floats(element.find("axis"), "xyz", where, 3, (1.0, 0.0, 0.0)))
        length = float(np.linalg.norm(axis))
        if kind in MOVING and length < 1e-9:
            raise self._wrong("joint", name, "has an axis of length 0")
        limit, copied = element.find("limit"), element.find("mimic")
        lower, upper = (self._floats(limit, key, where, 1, (math.nan,))[0] for key in ("lower", "upper"))
        mimic = None
        if copied is not None:
            multiplier, offset = (
                self._floats(copied, key, where, 1, (value,))[0]
                for key, value in (("multiplier", 1.0), ("offset", 0.0))
            )
            mimic = Mimic(copied.get("joint", ""), multiplier, offset)
        return JointElement(
            name=name,
            kind=kind,
            parent=ends[0],
            child=ends[1],
            place=self._origin(element, where),
            axis=axis / max(length, 1e-9),
            lower=lower,
            upper=upper,
            mimic=mimic,
        )

    def _tree(self, links: list[str], joints: dict[str, JointElement]) -> tuple[str, dict[str, JointElement]]:
        """Return the root link, and the joints from there on, parents first."""
        above: dict[str, str] = {}
        for joint in joints.values():
            if above.setdefault(joint.child, joint.name) != joint.name:
                other = above[joint.child]
                raise self._wrong("joint", joint.name, f"has the child {joint.child!r}, which is that of {other} too")
        roots = [link for link in links if link not in above]
        ordered: dict[str, JointElement] = {}
        if roots:
            reached, left = {roots[0]}, dict(joints)
            while ready := [joint for joint in left.values() if joint.parent in reached]:
                for joint in ready:
                    reached.add(joint.child)
                    ordered[joint.name] = left.pop(joint.name)
        for name in joints:
            if name not in ordered:
                raise self._wrong("joint", name, "does not hang on the robot's first link")
        if len(roots) != 1:
            raise ConfigError(f"{self._file}: link {roots[1]!r} hangs on nothing; {roots[0]!r} is the robot's root")
        return roots[0], ordered

    def _check_mimic(self, joint: JointElement, joints: Mapping[str, JointElement]) -> None:
        seen, at = {joint.name}, joint
        while at.mimic is not None:
            if at.mimic.joint not in joints:
                raise self._wrong("joint", at.name, f"mimics {at.mimic.joint!r}, which is not a joint of this file")
            at = joints[at.mimic.joint]
            if at.name in seen:
                raise self._wrong("joint", joint.name, "mimics itself")
            seen.add(at.name)

    def _visuals(self, link: Element) -> list[Visual]:
        found, name = [], self._name(link)
        where = f"link {name}"
        for visual in link.findall("visual"):
            geometry = visual.find("geometry")
            shape = None if geometry is None else next(iter(geometry), None)
            if shape is None:
                raise self._wrong("link", name, "has a visual without a geometry")
            place, color = self._origin(visual, where), self._material(visual)
            if shape.tag == "box":
                size = self._floats(shape, "size", where, 3)
            elif shape.tag == "mesh":
                size = self._floats(shape, "scale", where, 3, (1.0, 1.0, 1.0))
            elif shape.tag in _ROUND:
                size = tuple(self._floats(shape, key, where)[0] for key in _ROUND[shape.tag])
            else:
                raise self._wrong("link", name, f"has the shape <{shape.tag}>, not box, cylinder, sphere or mesh")
            mesh = shape.get("filename", "") if shape.tag == "mesh" else ""
            found.append(Visual(link=name, place=place, shape=shape.tag, size=size, color=color, mesh=mesh))
        return found

    def _material(self, visual: Element) -> Color:
        material = visual.find("material")
        if material is None:
            return _GREY
        color = material.find("color")
        return self._colors.get(material.get("name", ""), _GREY) if color is None else self._color(color)

    def _color(self, element: Element) -> Color:
        red, green, blue, opacity = self._floats(element, "rgba", "a colour", 4)
        return red, green, blue, opacity

    def _origin(self, element: Element, where: str) -> Doubles:
        origin, out = element.find("origin"), np.eye(4)
        out[:3, :3] = rotation(np.array(self._floats(origin, "rpy", where, 3, (0.0, 0.0, 0.0))))
        out[:3, 3] = self._floats(origin, "xyz", where, 3, (0.0, 0.0, 0.0))
        return out

    def _floats(
        self, element: Element | None, key: str, where: str, count: int = 1, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """Return `count` finite numbers of an attribute; `default` where it is missing."""
        text = None if element is None else element.get(key)
        if text is None and default is not None:
            return default
        try:
            values = tuple(float(part) for part in (text or "").split())
        except ValueError:
            values = ()
        if len(values) != count or not all(map(math.isfinite, values)):
            wanted = "a finite number" if count == 1 else f"{count} finite numbers"
            raise ConfigError(f"{self._file}: {where}: {key} = {text or ''!r} is not {wanted}")
        return values

    def _name(self, element: Element) -> str:
        name = element.get("name")
        if not name:
            raise ConfigError(f"{self._file}: a <{element.tag}> without a name")
        return name

    def _wrong(self, kind: str, name: str, problem: str) -> ConfigError:
        return ConfigError(f"{self._file}: {kind} {name!r} {problem}")
