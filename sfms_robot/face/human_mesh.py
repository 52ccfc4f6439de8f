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
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.face.hair_and_collar import above_hairline, collar, hair
from sfms_robot.face.human import PARTS, HumanHead, parts_of, share_of_rotation
from sfms_robot.frames import BLENDSHAPES

FORMAT_VERSION: Final = 1
_MOVED_M: Final = 2e-5
_STEP_M: Final = 1e-5


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
    """What is told of each morph, and two arrays: the vertices that each moves, and by how much."""
    told: list[dict[str, object]] = []
    vertices, steps = [], []
    for name, delta in zip(BLENDSHAPES, head.deltas[:, :count], strict=True):
        moved = np.flatnonzero(np.abs(delta).max(axis=1) > _MOVED_M)
        step_m = float(np.abs(delta).max()) / 32767
        told.append({"name": name, "count": len(moved), "step_m": step_m})
        vertices.append(moved.astype("<u2"))
        steps.append(np.round(delta[moved] / step_m).astype("<i2").ravel())
    return told, [("moved", np.concatenate(vertices)), ("moves", np.concatenate(steps))]
