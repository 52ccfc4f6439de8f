"""The virtual human head: motion in, vertices out.

The mesh (`sim/heads/human`) is y up and faces +z; it is turned once, on load, to x forward, y left, z up. A face is

    vertices = rest + sum over the 52 channels of weight * delta,

then the head turns about a pivot in the neck: every vertex by its own share of the rotation, 1 from the jaw line up
and 0 at the base of the neck, which stays where it is. Two brows, which the mesh lacks, are ribbons that hang on the
skin: each of their points is a fixed mix of the three corners of the triangle under it, so they are ordinary vertices
after loading.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, POSE, SHAPES, Floats

_TO_ROBOT_AXES: Final = (2, 0, 1)  # their z (forward), x (own left), y (up)
_PIVOT_M: Final = np.array([-0.012, 0.0, -0.065])
_SKIN: Final = (219, 173, 147)
_BROW: Final = (74, 50, 38)
_DARK_IRIS: Final = (71, 45, 25)
_IRIS: Final = (122, 84, 48)
_LASH: Final = (38, 25, 20)
PARTS: Final = ("skin", "eye", "hair", "cloth", "teeth", "mouth", "lash")
_PART_COLORS: Final = {
    (242, 242, 242): "eye", _IRIS: "eye", (7, 7, 7): "eye", _BROW: "hair",
    (242, 239, 229): "teeth", (204, 107, 107): "mouth", _LASH: "lash",
}  # fmt: skip
_EYE_LINE_M: Final = 0.0325
_LIP: Final = (190, 112, 100)
_LIP_LINE_M, _LIP_HALF_WIDTH_M, _UPPER_LIP_M, _LOWER_LIP_M = -0.0345, 0.0255, 0.0095, 0.0135
_LIP_SOFT_M, _LIP_DEPTH_M = 0.003, 0.09
# Where the share of the rotation rises from 0 to 1: height plus half the distance forward, so that the border runs
# from the nape, under the ears, to below the chin.
_SHARE_FROM_M: Final = -0.088
_SHARE_TO_M: Final = -0.032
_BROW_POINTS: Final = 14
_BROW_LIFT_M: Final = 0.0012


@dataclass(frozen=True)
class HumanHead:
    """A head with 52 morphs, in robot axes.

    Attributes:
        rest: (V, 3) metres.
        deltas: (52, V, 3) metres, in the order of `frames.BLENDSHAPES`.
        share: (V,) 0..1, how much of the head's rotation a vertex takes part in.
        triangles: (T, 3) vertex numbers.
        colors: (V, 3) uint8.
    """

    rest: Floats
    deltas: Floats
    share: Floats
    triangles: NDArray[np.int64]
    colors: NDArray[np.uint8]

    def vertices(self, motion: Floats) -> Floats:
        """Motion (58,) -> vertices (V, 3), metres, robot axes."""
        shaped = self.rest + np.tensordot(motion[SHAPES], self.deltas, axes=1)
        turn, move = motion[POSE][:3], motion[POSE][3:]
        turned = _rotated(shaped - _PIVOT_M, np.outer(self.share, turn)) + _PIVOT_M
        out: Floats = (turned + self.share[:, None] * move).astype(np.float32)
        return out


def load_human(folder: Path | None = None) -> HumanHead:
    """The shipped head, or the one in `folder`. Raises ConfigError when the file is not such a mesh."""
    file = (folder or data_dir("sim") / "heads" / "human") / "head_arkit52.npz"
    try:
        with np.load(file, allow_pickle=False) as arrays:
            rest = arrays["vertices"][:, _TO_ROBOT_AXES].astype(np.float32)
            names = [str(name) for name in arrays["names"]]
            order = [names.index(name) for name in BLENDSHAPES]
            deltas = arrays["deltas"][order][:, :, _TO_ROBOT_AXES].astype(np.float32)
            triangles, colors = arrays["triangles"].astype(np.int64), arrays["colors"].astype(np.uint8)
    except (OSError, KeyError, ValueError, IndexError) as error:
        raise ConfigError(f"{file}: not a head with the 52 ARKit morphs: {error}") from error
    shown = triangles[~_lower_lashes(rest, colors)[triangles].any(axis=1)]
    head = HumanHead(rest, deltas, share_of_rotation(rest), shown, _painted(rest, colors))
    for side in (1.0, -1.0):
        head = _with_ribbon(head, *_brow_outline(side))
    return head


def parts_of(colors: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Colors (V, 3) of a loaded head -> (V,) what each vertex belongs to, as a number in `PARTS`."""
    out = np.zeros(len(colors), dtype=np.int64)
    for color, name in _PART_COLORS.items():
        out[(colors == color).all(axis=1)] = PARTS.index(name)
    return out


def share_of_rotation(rest: Floats) -> Floats:
    """(V, 3) -> (V,), see `HumanHead.share`."""
    along = (rest[:, 2] + 0.5 * rest[:, 0] - _SHARE_FROM_M) / (_SHARE_TO_M - _SHARE_FROM_M)
    t = np.clip(along, 0.0, 1.0)
    out: Floats = (t * t * (3 - 2 * t)).astype(np.float32)
    return out


def _painted(rest: Floats, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The file's plain colours with red lips and a lighter iris: mouth and gaze read from a distance."""
    out = colors.astype(np.float64)
    out[(colors == _DARK_IRIS).all(axis=1)] = _IRIS
    across = np.abs(rest[:, 1]) / _LIP_HALF_WIDTH_M
    above = rest[:, 2] - _LIP_LINE_M
    reach = np.where(above > 0, _UPPER_LIP_M * (1 - across**1.5), _LOWER_LIP_M * (1 - across**2))
    red = np.clip((reach - np.abs(above)) / _LIP_SOFT_M, 0.0, 1.0)
    red *= (across < 1) & (rest[:, 0] > _LIP_DEPTH_M) & (colors == _SKIN).all(axis=1)
    out += red[:, None] * (np.array(_LIP) - out)
    return np.round(out).astype(np.uint8)


def _lower_lashes(rest: Floats, colors: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """(V,) the lower lashes: plain-coloured, they would read as a dark ring under the eye, and are left out."""
    below: NDArray[np.bool_] = (colors == _LASH).all(axis=1) & (rest[:, 2] < _EYE_LINE_M)
    return below


def _rotated(points: NDArray[np.floating], turns: NDArray[np.floating]) -> NDArray[np.floating]:
    """Each point (V, 3) by its own roll, pitch, yaw (V, 3): R = Rz(yaw) Ry(pitch) Rx(roll)."""
    x, y, z = points.T
    (sr, sp, sy), (cr, cp, cy) = np.sin(turns.T), np.cos(turns.T)
    y, z = cr * y - sr * z, sr * y + cr * z
    x, z = cp * x + sp * z, -sp * x + cp * z
    x, y = cy * x - sy * y, sy * x + cy * y
    return np.stack([x, y, z], axis=1)


def grid_triangles(rings: int, spokes: int) -> NDArray[np.int64]:
    """Rings from the top down, spokes counterclockwise seen from above -> triangles that face outward."""
    ring, spoke = np.meshgrid(np.arange(rings - 1), np.arange(spokes), indexing="ij")
    a, b = ring * spokes + spoke, ring * spokes + (spoke + 1) % spokes
    c, d = a + spokes, b + spokes
    return np.concatenate([np.stack([a, c, d], axis=-1).reshape(-1, 3), np.stack([a, d, b], axis=-1).reshape(-1, 3)])


# --- brows ------------------------------------------------------------------------------------------------------


def _brow_outline(side: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper edge (n, 2) as y, z: from beside the nose outward, thick inside, thin and lower at the tail."""
    t = np.linspace(0.0, 1.0, _BROW_POINTS)
    y = 0.0115 + 0.040 * t
    z = 0.0485 + 0.0075 * np.sin(np.pi * (0.12 + 0.70 * t)) - 0.0045 * t**2
    thick = 0.0036 * np.minimum(1.0, 0.55 + 3 * t) * (1 - 0.75 * t**1.6)
    return np.stack([side * y, z - thick], axis=1), np.stack([side * y, z + thick], axis=1)


def _with_ribbon(head: HumanHead, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> HumanHead:
    count, first = len(lower), len(head.rest)
    corners, weights = _on_skin(head, np.concatenate([lower, upper]))
    rest = np.einsum("pc,pcd->pd", weights, head.rest[corners])
    rest[:, 0] += _BROW_LIFT_M
    deltas = np.einsum("pc,kpcd->kpd", weights, head.deltas[:, corners])
    near, far = np.arange(count - 1), np.arange(1, count)
    strips = np.concatenate(
        [np.stack([near, far, far + count], axis=1), np.stack([near, far + count, near + count], axis=1)]
    )
    return HumanHead(
        np.concatenate([head.rest, rest]).astype(np.float32),
        np.concatenate([head.deltas, deltas], axis=1).astype(np.float32),
        np.concatenate([head.share, np.ones(2 * count, dtype=np.float32)]),
        np.concatenate([head.triangles, strips + first]),
        np.concatenate([head.colors, np.full((2 * count, 3), _BROW, dtype=np.uint8)]),
    )


def _on_skin(head: HumanHead, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The foremost skin triangle at each point (P, 2) of the face plane: its corners (P, 3), their weights (P, 3)."""
    skin = (head.colors == _SKIN).all(axis=1)
    triangles = head.triangles[skin[head.triangles].all(axis=1)]
    a, b, c = (head.rest[triangles[:, k], 1:].astype(np.float64) for k in range(3))
    area = _cross(b - a, c - a)
    area = np.where(np.abs(area) < 1e-12, np.inf, area)
    corners, weights = [], []
    for point in points:
        inner = np.stack([_cross(c - b, point - b), _cross(a - c, point - c), _cross(b - a, point - a)], axis=1)
        inner /= area[:, None]
        depth = (inner * head.rest[triangles, 0]).sum(axis=1)
        best = int(np.argmax(np.where((inner >= -1e-9).all(axis=1) & np.isfinite(area), depth, -np.inf)))
        corners.append(triangles[best])
        weights.append(inner[best])
    return np.array(corners), np.array(weights)


def _cross(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    out: NDArray[np.float64] = u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
    return out
