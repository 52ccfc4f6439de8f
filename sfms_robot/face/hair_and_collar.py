"""What the virtual human has beside its mesh: short hair, and on the page a collar over the cut edge of its neck."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator
from scipy.spatial import cKDTree

from sfms_robot.face.human import PARTS, HumanHead, parts_of, share_of_rotation
from sfms_robot.frames import Floats

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
    return Surface(grid.reshape(-1, 3), _grid_triangles(_RINGS, _SPOKES), np.round(open_sky * 255).astype("u1").ravel())


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
    return Surface(np.concatenate(rows), _grid_triangles(len(rows), _COLLAR_SPOKES), sky.astype("u1").ravel())


def _grid_triangles(rings: int, spokes: int) -> NDArray[np.int64]:
    """Rings from the top down, spokes counterclockwise seen from above -> triangles that face outward."""
    ring, spoke = np.meshgrid(np.arange(rings - 1), np.arange(spokes), indexing="ij")
    a, b = ring * spokes + spoke, ring * spokes + (spoke + 1) % spokes
    c, d = a + spokes, b + spokes
    return np.concatenate([np.stack([a, c, d], axis=-1).reshape(-1, 3), np.stack([a, d, b], axis=-1).reshape(-1, 3)])
