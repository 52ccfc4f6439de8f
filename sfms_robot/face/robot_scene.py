"""The picture of a robot: its URDF, and the values of that URDF's joints for the angles that the servos report.

A joint of the URDF follows the head's joint of the same name, or the one that `urdf.joints` of the head's file assigns
to it; its value is that angle [rad]. Parts that slide, or that move together, are `mimic` joints of the file.
A neck whose servos do not turn the head's axes themselves (a platform, a differential) moves the joints

    pose_x, pose_y, pose_z [m], pose_roll, pose_pitch, pose_yaw [rad]     the head's pose against the base
    LEG_rod_swing, LEG_rod_lean [rad]                                     the rod of a platform's leg

by forward kinematics, if the URDF has joints of these names. All other joints stay at 0.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np

from sfms_robot.config import FollowingJoint, Head, RobotDescription
from sfms_robot.config.kinematics import StewartPlatform
from sfms_robot.data import data_dir, shipped_names
from sfms_robot.errors import ConfigError
from sfms_robot.face.generic_robot import generic_urdf
from sfms_robot.face.urdf import MOVING, Urdf, Visual, read_urdf
from sfms_robot.frames import POSE_CHANNELS, Doubles
from sfms_robot.signals.rotations import rotation, seen_from

URDF_FILE: Final = "robot.urdf"
MESHES: Final = (".stl", ".obj", ".ply", ".dae")
MOST_MESH_BYTES: Final = 64 * 2**20
_LFS: Final = b"version https://git-lfs"
_POSE: Final = tuple(f"pose_{channel}" for channel in POSE_CHANNELS)


class ForwardNeck(Protocol):
    """The part of a neck (`retarget.head_retargeter.Neck`) that a scene uses."""

    @property
    def joints(self) -> Sequence[str]: ...

    @property
    def turns_body(self) -> bool: ...

    def forward(self, angles_rad: Doubles, start: Doubles) -> Doubles:
        """Return poses (..., 6) for angles (..., J) of `joints`, NaN if none fits. `start`: a pose nearby (..., 6)."""


class RobotScene:
    """A head as a URDF.

    Attributes:
        urdf: the file. generic: whether it is made of the joints of a head without a URDF.
        text: the URDF that the page shows: that of the file, if nothing is left out.
        robot: the content of the URDF, without the visuals of `left_out`.
        meshes: file name of a mesh as the URDF has it -> the file, links followed; empty for primitive shapes.
        left_out: one line for each part that is not drawn, or is probably wrong.
        joints: the URDF joints of `values`, in its order; mimic joints follow from them.
        follows: joint of the head -> the URDF joint that it moves.
        undriven: joints of the head that move nothing in the picture.
    """

    def __init__(self, head: Head, file: Path | None, neck: ForwardNeck | None, packages: Sequence[str]) -> None:
        """Read a URDF; `file` None: make a generic one. See `of`.

        Raises ConfigError, in one line, if it is broken, or lacks a joint that the head's file names.
        """
        description = head.urdf or RobotDescription(file=URDF_FILE)
        text, urdf = (generic_urdf(head), Path("generic.urdf")) if file is None else (None, file)
        self.urdf, self.generic, self.robot = urdf, file is None, read_urdf(urdf, text)
        self.text = self.robot.text
        self.meshes: dict[str, Path] = {}
        self.left_out = list(self.robot.left_out)
        self._find_meshes(head.folder or Path(), description.packages, packages)
        self._names = tuple(head.joints)
        self._rest = head.rest_rad
        self._read = self._rest.copy()  # the last angles that were finite
        follows = _following(head, self.robot, urdf, description)
        self.follows = {name: each.joint for name, each in follows.items()}
        self.undriven = tuple(name for name in self._names if name not in follows)
        self._columns = np.array([self._names.index(name) for name in follows], dtype=np.intp)
        self._scale = np.array([each.scale for each in follows.values()])
        self._offset = np.array([each.offset for each in follows.values()])
        self.joints = tuple(self.follows.values())
        self._pose = None if neck is None else _NeckPose(head, neck, self.robot, self.joints)
        if neck is not None and self._pose is not None and self._pose.joints:
            self.joints += self._pose.joints
            self.undriven = tuple(name for name in self.undriven if name not in neck.joints)
        if not self.joints and self._names:
            ours, theirs = ", ".join(self._names), ", ".join(_free(self.robot)) or "none"
            raise ConfigError(
                f"{urdf}: none of its joints ({theirs}) follows a joint of this head ({ours}): urdf.joints"
            )

    @classmethod
    def of(cls, head: Head, neck: ForwardNeck | None = None, packages: Sequence[str] = ()) -> RobotScene:
        """Return the scene of a head, a generic one if it is not shipped and has no `urdf`. Raises ConfigError.

        Args:
            neck: the head's forward kinematics, for a platform or a differential.
            packages: folders, besides the head's own, that meshes may come from.
        """
        return cls(head, urdf_file(head), neck, packages)

    def _find_meshes(self, own: Path, named: Mapping[str, str], folders: Sequence[str]) -> None:
        """Fill `meshes` and `left_out`. `own`: the head's folder; `named`: folders of packages, relative to it."""
        inside = [Path(os.path.realpath(each)) for each in (own, *map(Path, folders))]
        packages = {folder.name: folder for folder in inside[1:]} | {name: own / path for name, path in named.items()}
        for visual in self.robot.visuals:
            if visual.shape == "mesh":
                file = Path(os.path.realpath(_mesh_file(visual.mesh, self.urdf.parent, packages)))
                if expected := mesh_problem(file, inside):
                    self.leave_out(visual, f"expected {expected}, got {visual.mesh!r}")
                else:
                    self.meshes[visual.mesh] = file

    def leave_out(self, visual: Visual, problem: str) -> None:
        """Remove a mesh from the picture, and add a line about it to `left_out`."""
        self.left_out.append(f"{self.urdf}: link {visual.link}: mesh filename: {problem}: not drawn")
        self.robot = replace(self.robot, visuals=tuple(each for each in self.robot.visuals if each is not visual))

    def values(self, read_rad: Doubles) -> Doubles:
        """Return values (U,) of `joints` for angles (J,) in the head's order.

        An angle that is not finite keeps its last value. A platform keeps its last pose if no pose fits the angles.
        """
        read = np.asarray(read_rad, dtype=np.float64)
        if read.shape != self._read.shape:
            raise ValueError(f"angles are ({len(self._read)},), not {read.shape}")
        self._read = np.where(np.isfinite(read), read, self._read)
        values = self._offset + self._scale * self._read[self._columns]
        return values if self._pose is None else np.concatenate([values, self._pose.values(self._read)])

    def rest(self) -> Doubles:
        """Return the values (U,) of the head at rest."""
        return self.values(self._rest)


def urdf_file(head: Head) -> Path | None:
    """Return the URDF that the head's file names, else the shipped one of its name, else None. Raises ConfigError."""
    shipped = data_dir("sim") / "heads"
    if head.urdf is None:
        file = shipped / head.name / URDF_FILE
        return file if file.is_file() else None
    named = head.urdf.file
    for file in (shipped / named / URDF_FILE, (head.folder or Path()) / named):
        if file.is_file():
            return file
    where, names = (head.folder or Path()) / "head.yaml", shipped_names(shipped, URDF_FILE)
    raise ConfigError.at(where, "urdf.file", named, "is neither a file nor a shipped head", names)


def _free(robot: Urdf) -> list[str]:
    """Return the joints that move and mimic no other joint."""
    return [joint.name for joint in robot.joints.values() if joint.kind in MOVING and joint.mimic is None]


def _following(head: Head, robot: Urdf, file: Path, description: RobotDescription) -> dict[str, FollowingJoint]:
    """Return the URDF joint that follows each joint of the head. Raises ConfigError for one that cannot."""
    free = _free(robot)
    for name, follows in description.joints.items():
        if follows.joint not in robot.joints:
            problem = f"is not a joint of {file}"
        elif follows.joint not in free:
            problem = f"does not move by itself in {file}: it is fixed, or mimics another"
        else:
            continue
        where = (head.folder or Path()) / "head.yaml"
        raise ConfigError.at(where, f"urdf.joints.{name}.joint", follows.joint, problem, free)
    taken = {follows.joint for follows in description.joints.values()}
    same = {name: FollowingJoint(joint=name) for name in head.joints if name in free and name not in taken}
    both = same | description.joints
    return {name: both[name] for name in head.joints if name in both}


class _NeckPose:
    """The URDF joints of the head's pose by forward kinematics, and of the rods of a platform below it."""

    def __init__(self, head: Head, neck: ForwardNeck, robot: Urdf, taken: Sequence[str]) -> None:
        self._platform = head.kinematics if isinstance(head.kinematics, StewartPlatform) else None
        legs = () if self._platform is None else neck.joints[-6:]
        table = _POSE + tuple(f"{leg}_rod_{part}" for leg in legs for part in ("swing", "lean"))
        self.joints = tuple(name for name in _free(robot) if name in table and name not in taken)
        self._order = np.array([table.index(name) for name in self.joints], dtype=np.intp)
        self._columns = np.array([list(head.joints).index(name) for name in neck.joints], dtype=np.intp)
        self._neck, self._pose = neck, np.zeros(6)

    def values(self, read: Doubles) -> Doubles:
        """Return the values of `joints`. The search for the pose starts at home on the turned body.

        Several poses fit the legs of a platform. After a gap in the readings, a search from the last pose may find one
        that the head can reach only by falling through, and later searches would never leave it.
        """
        angles = read[self._columns]
        body = angles[0] if self._neck.turns_body else 0.0
        pose = self._neck.forward(angles, np.array([0.0, 0.0, body, 0.0, 0.0, 0.0]))
        if np.isfinite(pose).all():
            self._pose = pose
        if self._platform is None:
            return self._pose[self._order]
        rods = rod_angles(self._platform, angles[-6:], seen_from(body, self._pose))
        return np.concatenate([self._pose, rods.ravel()])[self._order]


def rod_angles(platform: StewartPlatform, cranks_rad: Doubles, pose: Doubles) -> Doubles:
    """Return swing and lean (6, 2) of the rods, for crank angles (6,) and the head's pose (6,) seen from the body.

    In the frame of a leg's servo (x, y in the plane of the crank, z its axis; see `config.kinematics.Leg`) the crank's
    tip is (c cos a, c sin a, 0), and the rod's head end is q = T H b with T = `servo_from_body`, H the head's pose,
    and b = `rod_end_m`. Seen from the turned crank the rod points along d = Rz(-a) (q - tip) / l: it swings about z by
    atan2(dy, dx) and leans out of the crank's plane, about -y, by asin(dz).
    """
    servo = np.array([leg.servo_from_body for leg in platform.legs])  # (6, 3, 4)
    ends = np.array([leg.rod_end_m for leg in platform.legs]) @ rotation(pose[:3]).T  # (6, 3)
    ends += pose[3:] + [0.0, 0.0, platform.home_height_m]
    q = np.einsum("lij,lj->li", servo[..., :3], ends) + servo[..., 3]
    cosine, sine = np.cos(cranks_rad), np.sin(cranks_rad)
    x = cosine * q[:, 0] + sine * q[:, 1] - platform.crank_m
    y = cosine * q[:, 1] - sine * q[:, 0]
    return np.stack([np.arctan2(y, x), np.arctan2(q[:, 2], np.hypot(x, y))], axis=-1)


def mesh_problem(file: Path, folders: Sequence[Path]) -> str | None:
    """Return the requirement that a mesh fails, so that it must not be served or drawn; None for a mesh that may be.

    A head's folder is data that people pass on: its URDF must not make other files of this machine public. `file` and
    `folders` are without links (`os.path.realpath`).
    """
    if not any(file.is_relative_to(folder) for folder in folders):
        return f"a file in {' or '.join(map(str, folders))} (--package names another folder)"
    if not os.path.isfile(file):
        return f"a file ({file} is not there; urdf.packages says where packages lie)"
    if file.suffix.lower() not in MESHES or file.stat().st_size > MOST_MESH_BYTES:
        return f"one of {', '.join(MESHES)}, of at most {MOST_MESH_BYTES >> 20} MiB"
    with file.open("rb") as content:
        if content.read(len(_LFS)) == _LFS:
            return "a mesh, not a pointer of git-LFS (git lfs pull gets the file)"
    return None


def _mesh_file(name: str, folder: Path, packages: Mapping[str, Path]) -> Path:
    """Return the file of a mesh; a package not in `packages` is `folder`, a folder above it, or inside one of these."""
    if name.startswith("package://"):
        package, _, inside = name.removeprefix("package://").partition("/")
        above = (folder, *folder.absolute().parents)
        around = (each if each.name == package else each / package for each in above)
        found = packages.get(package) or next((each for each in around if each.is_dir()), folder / package)
        return found / inside
    return folder / name.removeprefix("file://")
