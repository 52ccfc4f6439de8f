"""URDF files: links, joints and visuals, and the place of every link for given joint values.

The format is described at http://wiki.ros.org/urdf/XML. Read: visuals (box, cylinder, sphere, mesh), materials with a
colour, joints of every type (floating and planar ones stay at their origin), mimic. Not read: inertia, collision,
transmissions, textures. A visual or a colour that cannot be drawn is left out and listed; a link or a joint that cannot
be read is an error, since places depend on it.
"""

from __future__ import annotations

import io
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
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
_TYPES: Final = (*MOVING, "fixed", "floating", "planar")
_GREY: Final = (0.7, 0.7, 0.7, 1.0)
_MOST_NAMED: Final = 3
_ROUND: Final = {"cylinder": ("radius", "length"), "sphere": ("radius",)}  # names of their sizes

Color = tuple[float, float, float, float]


@dataclass(frozen=True, kw_only=True)
class Visual:
    """A shape on a link.

    Attributes:
        place: (4, 4) shape -> link.
        shape, size: box (x, y, z), cylinder (radius, length along z), sphere (radius,), mesh (scale x, y, z); metres.
        mesh: its file name as the URDF has it; empty for other shapes.
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
    mimic: Mimic | None

    def motion(self, value: float) -> Doubles:
        """Return the transform (4, 4) from the child to the child at value 0."""
        out = np.eye(4)
        if self.kind in TURNING:
            out[:3, :3] = from_vector(self.axis * value)
        elif self.kind == "prismatic":
            out[:3, 3] = self.axis * value
        return out


@dataclass(frozen=True, kw_only=True)
class Urdf:
    """A robot.

    Attributes:
        joints: by name, parents before children.
        left_out: one line for each visual or colour that is not drawn, and for angles that look like degrees.
        text: content of the file, without the elements that are left out and without its namespace, if it had any.
    """

    name: str
    root: str
    joints: Mapping[str, JointElement]
    visuals: tuple[Visual, ...]
    left_out: tuple[str, ...]
    text: bytes

    def link_places(self, values: Mapping[str, float]) -> dict[str, Doubles]:
        """Return every link's place (4, 4) in the root's axes, for joint values [rad, m]; a missing value is 0."""
        places = {self.root: np.eye(4)}
        for joint in self.joints.values():
            places[joint.child] = places[joint.parent] @ joint.place @ joint.motion(self._value(joint, values))
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
        data = file.read_bytes() if text is None else text
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}") from error
    try:
        parsed = list(ElementTree.iterparse(io.BytesIO(data), events=("start-ns", "start")))
    except ElementTree.ParseError as error:
        undeclared = "; it is a xacro file without xmlns:xacro" if b"<xacro:" in data else ""
        raise ConfigError(f"{file}: not XML: {error}{undeclared}") from error
    spaces = [space for event, space in parsed if event == "start-ns"]
    root: Element = next(element for event, element in parsed if event == "start")
    if found := _unresolved(root, {uri for prefix, uri in spaces if prefix == "xacro" or uri.endswith("xacro")}):
        more = ", ..." if len(found) > _MOST_NAMED else ""
        raise ConfigError(
            f"{file}: expected a URDF, got a xacro file with {', '.join(found[:_MOST_NAMED])}{more}: make a URDF of it "
            f"(xacro {file.name} > resolved.urdf)"
        )
    space, _, tag = root.tag.rpartition("}")
    if tag != "robot":
        raise ConfigError(f"{file}: not a URDF: its first element is <{tag}>, not <robot>")
    for element in root.iter() if space else ():
        element.tag = element.tag.removeprefix(f"{space}}}")
    return _UrdfReader(file, root, None if space else data).robot()


def _unresolved(root: Element, spaces: Collection[str]) -> list[str]:
    """Return the remains of xacro in a file: elements of its namespaces, and attributes with ${...} or $(...)."""
    found = []
    for element in root.iter():
        space, _, name = str(element.tag).removeprefix("{").rpartition("}")
        found += [f"<xacro:{name}>"] if space in spaces else []
        found += [value for value in element.attrib.values() if "${" in value or "$(" in value]
    return list(dict.fromkeys(found))


class _UrdfReader:
    """A reader of one file, whose errors name the file and the element."""

    def __init__(self, file: Path, root: Element, text: bytes | None) -> None:
        """Read the materials. `text`: text of these elements; None if they differ from the file's already."""
        self._file, self._root, self._text = file, root, text
        self._left_out: list[str] = []
        self._degrees: dict[str, str] = {}  # element with angles beyond a turn -> its angles
        self._colors: dict[str, Color] = {}
        for material in list(root.iter("material")):
            if (color := material.find("color")) is not None:
                with self._left_out_if_wrong(material, color, "drawn grey"):
                    self._colors[material.get("name", "")] = self._color(material, color)

    @contextmanager
    def _left_out_if_wrong(self, parent: Element, element: Element, then: str) -> Iterator[None]:
        """List and remove an element that cannot be used."""
        try:
            yield
        except ConfigError as error:
            parent.remove(element)
            self._left_out.append(f"{error}: {then}")
            self._text = None

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
        visuals: list[Visual] = []
        for link in self._root.findall("link"):
            for visual in link.findall("visual"):
                with self._left_out_if_wrong(link, visual, "not drawn"):
                    visuals.append(self._visual(self._name(link), visual))
        if self._degrees:
            where, angles = next(iter(self._degrees.items()))
            count = f", in {len(self._degrees)} elements" if len(self._degrees) > 1 else ""
            self._left_out.append(
                f"{self._file}: {where}: rpy: expected radians, got {angles!r}{count} (degrees?): drawn as radians"
            )
        return Urdf(
            name=self._root.get("name", self._file.stem),
            root=root,
            joints=ordered,
            visuals=tuple(visuals),
            left_out=tuple(self._left_out),
            text=self._text or ElementTree.tostring(self._root),
        )

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
        for key in ("lower", "upper"):  # not used here, but by others that read the file
            self._floats(element.find("limit"), key, where, 1, (math.nan,))
        mimic = None
        if (copied := element.find("mimic")) is not None:
            mimic = Mimic(
                copied.get("joint", ""),
                *self._floats(copied, "multiplier", where, 1, (1.0,)),
                *self._floats(copied, "offset", where, 1, (0.0,)),
            )
        return JointElement(
            name=name,
            kind=kind,
            parent=ends[0],
            child=ends[1],
            place=self._origin(element, where),
            axis=axis / max(length, 1e-9),
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
            raise ConfigError(f"{self._file}: link {roots[1]!r} has no parent joint; the root is {roots[0]!r}")
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

    def _visual(self, name: str, visual: Element) -> Visual:
        geometry, where = visual.find("geometry"), f"link {name}"
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
        return Visual(link=name, place=place, shape=shape.tag, size=size, color=color, mesh=mesh)

    def _material(self, visual: Element) -> Color:
        material = visual.find("material")
        if material is None:
            return _GREY
        color = material.find("color")
        return self._colors.get(material.get("name", ""), _GREY) if color is None else self._color(material, color)

    def _color(self, material: Element, element: Element) -> Color:
        if len((text := element.get("rgba", "")).split()) == 3:  # only red, green and blue: opaque in all readers
            element.set("rgba", f"{text} 1")
        red, green, blue, opacity = self._floats(element, "rgba", f"material {material.get('name', '')}", 4)
        return red, green, blue, opacity

    def _origin(self, element: Element, where: str) -> Doubles:
        origin, out = element.find("origin"), np.eye(4)
        angles = self._floats(origin, "rpy", where, 3, (0.0, 0.0, 0.0))
        if max(map(abs, angles)) > math.tau:
            self._degrees[where] = " ".join(f"{angle:g}" for angle in angles)
        out[:3, :3] = rotation(np.array(angles))
        out[:3, 3] = self._floats(origin, "xyz", where, 3, (0.0, 0.0, 0.0))
        return out

    def _floats(
        self, element: Element | None, key: str, where: str, count: int = 1, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """Return `count` finite numbers of an attribute; `default` if it is missing."""
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
