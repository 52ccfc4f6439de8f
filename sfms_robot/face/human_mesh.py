"""The virtual head as one small file that a browser draws: skin, eyes, teeth, tongue, lashes, hair and a collar.

Little-endian: uint32 length of the JSON, the JSON, then arrays, each from a multiple of 4 bytes on, in the order of
`arrays` ([name, type, count]). Lengths are int16 steps of `step_m`; a morph's are int16 steps of its own `step_m`,
told only for the vertices that it moves. Axes are the robot's (x forward, y left, z up). The first `skinned` vertices
are those of `face.human` before its brows, which the browser paints; hair and collar come behind them and no morph
moves them.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.face.human import PARTS, HumanHead, grid_triangles, parts_of, share_of_rotation
from sfms_robot.frames import BLENDSHAPES, Floats

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


_UNDER_SKIN: Final = round(0.3 * 255)  # of `open_sky`: hair that comes out again where the neck is thin is left out
_HAIR: Final = (26, 18, 14), (66, 46, 34)  # at its roots, at its ends


def packed_human(head: HumanHead) -> bytes:
    """The file for `head`. Raises ConfigError where the vertices' light, which ships with the mesh, is not its own."""
    open_sky = _open_sky()
    count = len(open_sky)
    if count > len(head.rest):
        raise ConfigError(f"open_sky.npy is of {count} vertices, the head has {len(head.rest)}")
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


def _open_sky() -> NDArray[np.uint8]:
    file = data_dir("sim") / "heads" / "human" / "open_sky.npy"
    try:
        loaded: NDArray[np.uint8] = np.load(file, allow_pickle=False)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: {error}") from error
    return loaded


def _packed(facts: dict[str, object], arrays: list[tuple[str, NDArray[np.generic]]]) -> bytes:
    listed = [[name, array.dtype.name, array.size] for name, array in arrays]
    text = json.dumps(facts | {"arrays": listed}, separators=(",", ":")).encode()
    out = bytearray(struct.pack("<I", len(text)) + text)
    for _, array in arrays:
        out += bytes(-len(out) % 4) + array.tobytes()
    return bytes(out)


def _morphs(head: HumanHead, count: int) -> tuple[list[dict[str, object]], list[tuple[str, NDArray[np.generic]]]]:
    """Return the facts of each morph, and two arrays: the vertices that each moves, and by how much."""
    told: list[dict[str, object]] = []
    vertices, steps = [], []
    for name, delta in zip(BLENDSHAPES, head.deltas[:, :count], strict=True):
        moved = np.flatnonzero(np.abs(delta).max(axis=1) > _MOVED_M)
        step_m = float(np.abs(delta).max()) / 32767
        told.append({"name": name, "count": len(moved), "step_m": step_m})
        vertices.append(moved.astype("<u2"))
        steps.append(np.round(delta[moved] / step_m).astype("<i2").ravel())
    return told, [("moved", np.concatenate(vertices)), ("moves", np.concatenate(steps))]


# --- beside the mesh: short hair, and on the page a collar over the cut edge of the neck ---------------------------


@dataclass(frozen=True)
class Surface:
    """Vertices (V, 3) metres, triangles (T, 3), 0..255 how much of the sky each vertex sees."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.int64]
    open_sky: NDArray[np.uint8]


def with_hair(head: HumanHead) -> HumanHead:
    """The head of `load_human` as people see it: hair goes along with the skull, and no morph moves it."""
    grown = hair(head.rest[parts_of(head.colors) == PARTS.index("skin")])
    shown = grown.triangles[(grown.open_sky[grown.triangles] > _UNDER_SKIN).any(axis=1)]
    vertices, light = grown.vertices.astype(np.float32), grown.open_sky[:, None] / 255
    colors = (1 - light) * np.array(_HAIR[0]) + light * np.array(_HAIR[1])
    return HumanHead(
        np.concatenate([head.rest, vertices]),
        np.pad(head.deltas, ((0, 0), (0, len(vertices)), (0, 0))),
        np.concatenate([head.share, share_of_rotation(vertices)]),
        np.concatenate([head.triangles, shown + len(head.rest)]),
        np.concatenate([head.colors, np.round(colors)]).astype(np.uint8),
    )


# --- hair ---------------------------------------------------------------------------------------------------------


def hair(skin: Floats) -> Surface:
    """Short hair: the skull, smoothed, and above it as much as `_hair_depth` says; beyond the hairline it dives in."""
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
    """(rings, spokes, 3) directions about the crown's axis, from it down to 160 degrees."""
    axis = _AXIS / np.linalg.norm(_AXIS)
    side = np.array([0.0, 1.0, 0.0])
    front = np.cross(side, axis)
    angle = np.linspace(0.0, np.radians(160), _RINGS)[:, None, None]
    around = np.linspace(0, 2 * np.pi, _SPOKES, endpoint=False)[None, :, None]
    out: NDArray[np.float64] = np.cos(angle) * axis + np.sin(angle) * (np.cos(around) * front + np.sin(around) * side)
    return out


def above_hairline(at: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points (..., 3) -> their direction about the vertical [deg], and metres above the hairline there."""
    azimuth = np.degrees(np.arctan2(at[..., 1], at[..., 0] - 0.01))
    line = np.interp(
        np.abs(azimuth),
        [0, 25, 42, 55, 66, 74, 84, 96, 108, 122, 150, 180],
        [0.104, 0.107, 0.100, 0.083, 0.052, 0.024, 0.030, 0.046, 0.026, -0.020, -0.052, -0.058],
    )
    line = line - 0.004 * np.exp(-(((azimuth + 14) / 16) ** 2)) + 0.0022 * np.sin(np.radians(azimuth) * 13)
    return azimuth, at[..., 2] - line


def _hair_depth(at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Metres of hair above the skull at points (..., 3): full on top and swept to the side, thin at sides and nape."""
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
    """Each value with its four neighbours; round along the spokes, held at the first and last ring."""
    rings = np.concatenate([grid[:1], grid, grid[-1:]])
    out: NDArray[np.float64] = (
        2 * grid + rings[:-2] + rings[2:] + np.roll(grid, 1, axis=1) + np.roll(grid, -1, axis=1)
    ) / 6
    out[0] = out[0].mean()
    return out


# --- collar -------------------------------------------------------------------------------------------------------


def collar() -> Surface:
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
