"""Models the virtual human that ships in `sim/heads/human`: paints the mesh, adds brows, hair and a collar.

    .venv/bin/python page/human/model_human.py

Reads `head_arkit52.npz` and `open_sky.npy` beside this file (`sim/heads/human/README.md` says where they come from) and
writes `head.bin.xz`, which Python and browsers draw, and `brows.npz`, which only Python needs: browsers paint brows.

The mesh is y up and faces +z; it is turned to x forward, y left, z up. Two brows, which the mesh lacks, are ribbons
that hang on the skin: each of their points is a fixed mix of the three corners of the triangle under it, so they follow
every morph. No morph moves hair and collar.
"""

from __future__ import annotations

import json
import lzma
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from sfms_robot.face.human import FOLDER
from sfms_robot.frames import BLENDSHAPES, Floats

HERE = Path(__file__).parent

_TO_ROBOT_AXES: Final = (2, 0, 1)  # their z (forward), x (own left), y (up)
_SKIN: Final = (219, 173, 147)
_BROW: Final = (74, 50, 38)
_DARK_IRIS: Final = (71, 45, 25)
_IRIS: Final = (122, 84, 48)
_LASH: Final = (38, 25, 20)
PARTS: Final = ("skin", "eye", "hair", "cloth", "teeth", "mouth", "lash")
_PART_COLORS: Final = {
    (242, 242, 242): "eye",
    _IRIS: "eye",
    (7, 7, 7): "eye",
    _BROW: "hair",
    (242, 239, 229): "teeth",
    (204, 107, 107): "mouth",
    _LASH: "lash",
}
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

FORMAT_VERSION: Final = 1
_MOVED_M: Final = 2e-5
_STEP_M: Final = 1e-5

# Hair: a surface around the skull, seen from _CENTRE, whose rays lie on _RINGS rings about an axis that leans back.
_CENTRE: Final = np.array([0.012, 0.0, 0.052])
_AXIS: Final = np.array([-0.42, 0.0, 0.91])
_RINGS, _SPOKES = 56, 96
_EAR: Final = ((-0.02, 0.06), 0.071, (-0.03, 0.075))  # x from, to; |y| beyond; z from, to: left out of the skull
_SUNK_M: Final = -0.007

_COLLAR_RINGS: Final = (  # z, centre x, half depth, half width [m], power of the superellipse
    (-0.0880, -0.0100, 0.0540, 0.0525, 2.4),
    (-0.0860, -0.0100, 0.0565, 0.0555, 2.4),
    (-0.0885, -0.0105, 0.0590, 0.0585, 2.4),
    (-0.0990, -0.0115, 0.0612, 0.0625, 2.3),
    (-0.1060, -0.0115, 0.0622, 0.0645, 2.3),
    (-0.1110, -0.0110, 0.0640, 0.0750, 2.2),
    (-0.1290, -0.0110, 0.0740, 0.1180, 2.3),
    (-0.1540, -0.0150, 0.0870, 0.1700, 2.5),
    (-0.2000, -0.0160, 0.0970, 0.2000, 2.5),
    (-0.2700, -0.0140, 0.1040, 0.2080, 2.5),
)
_COLLAR_SPOKES: Final = 72
_COLLAR: Final = (59, 74, 92)
_HAIR: Final = (26, 18, 14), (66, 46, 34)  # at its roots, at its ends


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """The head with its brows, in robot axes; fields as of `sfms_robot.face.human.HumanHead`."""

    rest: Floats
    deltas: Floats
    share: Floats
    triangles: NDArray[np.int64]
    colors: NDArray[np.uint8]

    def joined(
        self, rest: Floats, deltas: Floats, share: Floats, triangles: NDArray[np.int64], colors: NDArray[np.uint8]
    ) -> Mesh:
        """Return the head with more vertices; `triangles` count from the first of them."""
        return Mesh(
            rest=np.concatenate([self.rest, rest]).astype(np.float32),
            deltas=np.concatenate([self.deltas, deltas], axis=1).astype(np.float32),
            share=np.concatenate([self.share, share]),
            triangles=np.concatenate([self.triangles, triangles + len(self.rest)]),
            colors=np.concatenate([self.colors, colors]),
        )


def painted_head() -> Mesh:
    """Return the mesh with painted lips and irises and two brows, without the lower lashes."""
    with np.load(HERE / "head_arkit52.npz", allow_pickle=False) as arrays:
        rest = arrays["vertices"][:, _TO_ROBOT_AXES].astype(np.float32)
        names = [str(name) for name in arrays["names"]]
        order = [names.index(name) for name in BLENDSHAPES]
        deltas = arrays["deltas"][order][:, :, _TO_ROBOT_AXES].astype(np.float32)
        triangles, colors = arrays["triangles"].astype(np.int64), arrays["colors"].astype(np.uint8)
    shown = triangles[~_lower_lashes(rest, colors)[triangles].any(axis=1)]
    head = Mesh(rest=rest, deltas=deltas, share=share_of_rotation(rest), triangles=shown, colors=_painted(rest, colors))
    for side in (1.0, -1.0):
        head = _with_ribbon(head, *_brow_outline(side))
    return head


def parts_of(colors: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the part of each vertex (V,), as an index into `PARTS`, by the colors (V, 3) of a loaded head."""
    out = np.zeros(len(colors), dtype=np.int64)
    for color, name in _PART_COLORS.items():
        out[(colors == color).all(axis=1)] = PARTS.index(name)
    return out


def share_of_rotation(rest: Floats) -> Floats:
    """Return the share (V,) of vertices (V, 3), see `Mesh.share`."""
    along = (rest[:, 2] + 0.5 * rest[:, 0] - _SHARE_FROM_M) / (_SHARE_TO_M - _SHARE_FROM_M)
    t = np.clip(along, 0.0, 1.0)
    out: Floats = (t * t * (3 - 2 * t)).astype(np.float32)
    return out


def _painted(rest: Floats, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the file's colours with red lips and a lighter iris, which can be seen from a distance."""
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
    """Return (V,) the lower lashes, which are left out: they look like a dark ring under the eye."""
    below: NDArray[np.bool_] = (colors == _LASH).all(axis=1) & (rest[:, 2] < _EYE_LINE_M)
    return below


def grid_triangles(rings: int, spokes: int) -> NDArray[np.int64]:
    """Return triangles that face outward: rings from the top down, spokes counterclockwise seen from above."""
    ring, spoke = np.meshgrid(np.arange(rings - 1), np.arange(spokes), indexing="ij")
    a, b = ring * spokes + spoke, ring * spokes + (spoke + 1) % spokes
    c, d = a + spokes, b + spokes
    return np.concatenate([np.stack([a, c, d], axis=-1).reshape(-1, 3), np.stack([a, d, b], axis=-1).reshape(-1, 3)])


# --- brows ------------------------------------------------------------------------------------------------------


def _brow_outline(side: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return lower and upper edge (n, 2), y and z: from beside the nose outward, thick inside, thin at the tail."""
    t = np.linspace(0.0, 1.0, _BROW_POINTS)
    y = 0.0115 + 0.040 * t
    z = 0.0485 + 0.0075 * np.sin(np.pi * (0.12 + 0.70 * t)) - 0.0045 * t**2
    thick = 0.0036 * np.minimum(1.0, 0.55 + 3 * t) * (1 - 0.75 * t**1.6)
    return np.stack([side * y, z - thick], axis=1), np.stack([side * y, z + thick], axis=1)


def _with_ribbon(head: Mesh, lower: NDArray[np.float64], upper: NDArray[np.float64]) -> Mesh:
    count = len(lower)
    corners, weights = _on_skin(head, np.concatenate([lower, upper]))
    rest = np.einsum("pc,pcd->pd", weights, head.rest[corners])
    rest[:, 0] += _BROW_LIFT_M
    deltas = np.einsum("pc,kpcd->kpd", weights, head.deltas[:, corners])
    near, far = np.arange(count - 1), np.arange(1, count)
    strips = np.concatenate(
        [np.stack([near, far, far + count], axis=1), np.stack([near, far + count, near + count], axis=1)]
    )
    share, colors = np.ones(2 * count, np.float32), np.full((2 * count, 3), _BROW, np.uint8)
    return head.joined(rest, deltas, share, strips, colors)


def _on_skin(head: Mesh, points: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return corners (P, 3) and weights (P, 3) of the foremost skin triangle at each point (P, 2) of the face plane."""
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


# --- the file that a browser draws ------------------------------------------------------------------------------------


def packed_human(head: Mesh) -> bytes:
    """Return the file that a browser draws.

    Little-endian: uint32 length of the JSON, the JSON, then arrays, each at a multiple of 4 bytes, in the order of
    `arrays` ([name, type, count]). Lengths are int16 steps of `step_m`; a morph's are int16 steps of its own `step_m`,
    only for the vertices that it moves. Axes are the robot's. The first `skinned` vertices are those of the mesh,
    before the brows, which the browser paints; hair and collar follow, and no morph moves them.
    """
    open_sky: NDArray[np.uint8] = np.load(HERE / "open_sky.npy", allow_pickle=False)
    count = len(open_sky)
    skin = head.triangles[(head.triangles < count).all(axis=1)]
    parts = parts_of(head.colors[:count])
    grown, worn = hair(head.rest[:count][parts == 0]), collar()
    rest = np.concatenate([head.rest[:count], grown.vertices, worn.vertices])
    last = count + len(grown.vertices)
    share = np.concatenate(
        [head.share[:count], share_of_rotation(grown.vertices.astype(np.float32)), 0 * worn.open_sky]
    )
    part = np.concatenate([parts, np.full(len(grown.vertices), 2), np.full(len(worn.vertices), 3)])
    scalp = np.zeros(len(rest))
    scalp[:count] = np.clip(above_hairline(rest[:count])[1] / 0.014 + 0.75, 0, 1) * (np.abs(rest[:count, 1]) < 0.0755)
    arrays: list[tuple[str, NDArray[np.generic]]] = [
        ("rest", np.round(rest / _STEP_M).astype("<i2")),
        ("share", np.round(share * 255).astype("u1")),
        ("part", part.astype("u1")),
        ("open_sky", np.concatenate([open_sky, grown.open_sky, worn.open_sky])),
        ("scalp", np.round(scalp * 255).astype("u1")),
        ("triangles", np.concatenate([skin, grown.triangles + count, worn.triangles + last]).astype("<u2")),
    ]
    morphs, moved = _morphs(head, count)
    facts = {"version": FORMAT_VERSION, "vertices": len(rest), "skinned": count, "step_m": _STEP_M, "parts": PARTS}
    return _packed(facts | {"morphs": morphs}, arrays + moved)


def _packed(facts: dict[str, object], arrays: list[tuple[str, NDArray[np.generic]]]) -> bytes:
    listed = [[name, array.dtype.name, array.size] for name, array in arrays]
    text = json.dumps(facts | {"arrays": listed}, separators=(",", ":")).encode()
    out = bytearray(struct.pack("<I", len(text)) + text)
    for _, array in arrays:
        out += bytes(-len(out) % 4) + array.tobytes()
    return bytes(out)


def _morphs(head: Mesh, count: int) -> tuple[list[dict[str, object]], list[tuple[str, NDArray[np.generic]]]]:
    """Return the facts of each morph, and two arrays: the vertices that each moves, and by how much."""
    facts: list[dict[str, object]] = []
    vertices, steps = [], []
    for name, delta in zip(BLENDSHAPES, head.deltas[:, :count], strict=True):
        moved = np.flatnonzero(np.abs(delta).max(axis=1) > _MOVED_M)
        step_m = float(np.abs(delta).max()) / 32767
        facts.append({"name": name, "count": len(moved), "step_m": step_m})
        vertices.append(moved.astype("<u2"))
        steps.append(np.round(delta[moved] / step_m).astype("<i2").ravel())
    return facts, [("moved", np.concatenate(vertices)), ("moves", np.concatenate(steps))]


# --- short hair, and a collar over the cut edge of the neck ----------------------------------------------------------


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3) metres, triangles (T, 3), 0..255 how much of the sky each vertex sees."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    open_sky: NDArray[np.uint8]


def python_extras(head: Mesh, count: int) -> dict[str, NDArray[np.generic]]:
    """Return the arrays of brows.npz: the brows, and the colors of all vertices, brows last."""
    grown, worn = hair(head.rest[parts_of(head.colors) == PARTS.index("skin")]), collar()
    light = grown.open_sky[:, None] / 255
    colors = np.round((1 - light) * np.array(_HAIR[0]) + light * np.array(_HAIR[1])).astype(np.uint8)
    of_collar = np.full(worn.vertices.shape, _COLLAR, np.uint8)
    return {
        "rest": head.rest[count:],
        "deltas": head.deltas[:, count:],
        "triangles": (head.triangles[(head.triangles >= count).all(axis=1)] - count).astype(np.uint16),
        "colors": np.concatenate([head.colors[:count], colors, of_collar, head.colors[count:]]),
    }


def hair(skin: Floats) -> Surface:
    """Return short hair: the skull, smoothed, plus `_hair_depth`; beyond the hairline it is below the skin."""
    (x0, x1), y, (z0, z1) = _EAR
    ear = (skin[:, 0] > x0) & (skin[:, 0] < x1) & (np.abs(skin[:, 1]) > y) & (skin[:, 2] > z0) & (skin[:, 2] < z1)
    away = skin[~ear] - _CENTRE
    radius = np.linalg.norm(away, axis=1)
    rays = _rays()
    distance, nearest = cKDTree(away / radius[:, None]).query(rays.reshape(-1, 3), k=8)
    weight = 1 / (distance + 0.02) ** 3
    skull = ((weight * radius[nearest]).sum(axis=1) / weight.sum(axis=1)).reshape(rays.shape[:2])
    for _ in range(3):
        skull = _smoothed(skull)
    on_skull = _CENTRE + rays * skull[..., None]
    depth = _hair_depth(on_skull)
    for _ in range(2):
        depth = _smoothed(depth)
    grid = _CENTRE + rays * (skull + depth)[..., None]
    open_sky = np.clip(0.3 + depth / 0.016 * 0.7, 0.0, 1)
    return Surface(grid.reshape(-1, 3), grid_triangles(_RINGS, _SPOKES), np.round(open_sky * 255).astype("u1").ravel())


def _rays() -> NDArray[np.float64]:
    """Return (rings, spokes, 3) directions about the crown's axis, from it down to 160 degrees."""
    axis = _AXIS / np.linalg.norm(_AXIS)
    side = np.array([0.0, 1.0, 0.0])
    front = np.cross(side, axis)
    angle = np.linspace(0.0, np.radians(160), _RINGS)[:, None, None]
    around = np.linspace(0, 2 * np.pi, _SPOKES, endpoint=False)[None, :, None]
    out: NDArray[np.float64] = np.cos(angle) * axis + np.sin(angle) * (np.cos(around) * front + np.sin(around) * side)
    return out


def above_hairline(at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the direction of points (..., 3) about the vertical [deg], and metres above the hairline there."""
    azimuth = np.degrees(np.arctan2(at[..., 1], at[..., 0] - 0.01))
    line = np.interp(
        np.abs(azimuth),
        [0, 25, 42, 55, 66, 74, 84, 96, 108, 122, 150, 180],
        [0.104, 0.107, 0.100, 0.083, 0.052, 0.024, 0.030, 0.046, 0.026, -0.020, -0.052, -0.058],
    )
    line = line - 0.004 * np.exp(-(((azimuth + 14) / 16) ** 2)) + 0.0022 * np.sin(np.radians(azimuth) * 13)
    return azimuth, at[..., 2] - line


def _hair_depth(at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return metres of hair above the skull at points (..., 3): full on top, swept to the side, thin at the nape."""
    azimuth, above = above_hairline(at)
    full = np.interp(at[..., 2], [-0.06, 0.02, 0.09, 0.13, 0.17], [0.003, 0.006, 0.010, 0.015, 0.017])
    quiff = 0.006 * np.exp(-(((azimuth + 14) / 34) ** 2)) * np.exp(-(((at[..., 2] - 0.140) / 0.020) ** 2))
    locks = 0.0011 * np.sin(np.radians(azimuth) * 17 + 60 * at[..., 2]) + 0.0008 * np.sin(np.radians(azimuth) * 31 + 2)
    grown = np.clip(above / 0.034, -1, 1)
    rise = 1 - (1 - np.maximum(grown, 0)) ** 2.4
    depth = np.where(grown > 0, 0.0006 + rise * (full + quiff + locks), grown * -_SUNK_M * 3)
    out: NDArray[np.float64] = np.maximum(depth, 2 * _SUNK_M)
    return out


def _smoothed(grid: NDArray[np.float64]) -> NDArray[np.float64]:
    """Average each value with its four neighbours; periodic along the spokes, held at the first and last ring."""
    rings = np.concatenate([grid[:1], grid, grid[-1:]])
    around = np.roll(grid, 1, axis=1) + np.roll(grid, -1, axis=1)
    out: NDArray[np.float64] = (2 * grid + rings[:-2] + rings[2:] + around) / 6
    out[0] = out[0].mean()
    return out


def collar() -> Surface:
    """Return a collar that hides the cut edge of the neck."""
    angle = np.linspace(0, 2 * np.pi, _COLLAR_SPOKES, endpoint=False)
    rows = []
    knots = np.arange(len(_COLLAR_RINGS))
    rings = PchipInterpolator(knots, np.array(_COLLAR_RINGS))(np.linspace(0, knots[-1], 3 * knots[-1] + 1))
    for z, x, depth, width, power in rings:
        c, s = np.cos(angle), np.sin(angle)
        across, along = np.sign(s) * np.abs(s) ** (2 / power) * width, np.sign(c) * np.abs(c) ** (2 / power) * depth
        lower = np.clip((z + 0.130) / 0.03, 0, 1) * -0.003 * np.clip(c, 0, 1) ** 2  # under the chin
        rows.append(np.stack([x + along, across, z + lower], axis=1))
    sky = np.full((len(rows), _COLLAR_SPOKES), 235.0)
    sky[:5], sky[10:15] = 90, 150
    return Surface(np.concatenate(rows), grid_triangles(len(rows), _COLLAR_SPOKES), sky.astype("u1").ravel())


if __name__ == "__main__":
    human = painted_head()
    skinned = len(np.load(HERE / "open_sky.npy"))
    (FOLDER / "head.bin.xz").write_bytes(lzma.compress(packed_human(human), preset=9))
    np.savez_compressed(FOLDER / "brows.npz", **python_extras(human, skinned))
