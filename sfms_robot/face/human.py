"""The virtual human head: motion in, vertices out.

The mesh (`sim/heads/human`) has x forward, y left, z up. A face is

    vertices = rest + sum over the 52 channels of weight * delta,

then the head turns about a pivot in the neck: each vertex by its own share of the rotation, 1 from the jaw line up
and 0 at the base of the neck and in the collar, which stay in place.
"""

from __future__ import annotations

import json
import lzma
import struct
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.data import data_dir
from sfms_robot.frames import POSE, SHAPES, Doubles, Floats, Ints
from sfms_robot.signals.rotations import rotation

FOLDER: Final = data_dir("sim") / "heads" / "human"
_PIVOT_M: Final = np.array([-0.012, 0.0, -0.065])
_UNDER_SKIN: Final = round(0.3 * 255)  # hair up to this `open_sky` is left out: it would come out at the thin neck


@dataclass(frozen=True, kw_only=True)
class HumanHead:
    """A head with 52 morphs, in robot axes.

    Attributes:
        rest: (V, 3) metres.
        deltas: (52, V, 3) metres, in the order of `frames.BLENDSHAPES`.
        share: (V,) 0..1, the share of the head's rotation that a vertex makes.
        triangles: (T, 3) vertex numbers.
        colors: (V, 3) uint8.
    """

    rest: Floats
    deltas: Floats
    share: Floats
    triangles: Ints
    colors: NDArray[np.uint8]

    def vertices(self, motion: Floats) -> Floats:
        """Return the vertices (V, 3) of motion (58,), metres, robot axes."""
        shaped: Floats = self.rest + np.tensordot(motion[SHAPES], self.deltas, axes=1)
        pose: Doubles = np.outer(self.share, motion[POSE]).astype(np.float64)
        turned = (rotation(pose[:, :3]) @ (shaped - _PIVOT_M)[..., None])[..., 0] + _PIVOT_M
        vertices: Floats = (turned + pose[:, 3:]).astype(np.float32)
        return vertices


def load_human(hair: bool = False) -> HumanHead:
    """Load the shipped head with its brows and collar, with or without hair."""
    facts, arrays = _read_arrays(lzma.decompress((FOLDER / "head.bin.xz").read_bytes()))
    with np.load(FOLDER / "brows.npz", allow_pickle=False) as brows:
        count, step_m = facts["vertices"], facts["step_m"]
        rest = np.concatenate([arrays["rest"].reshape(-1, 3) * step_m, brows["rest"]]).astype(np.float32)
        deltas = np.zeros((len(facts["morphs"]), *rest.shape), dtype=np.float32)
        deltas[:, count:] = brows["deltas"]
        first, moves = 0, arrays["moves"].reshape(-1, 3)
        for delta, morph in zip(deltas, facts["morphs"], strict=True):
            last = first + morph["count"]
            delta[arrays["moved"][first:last]] = moves[first:last] * morph["step_m"]
            first = last
        triangles = arrays["triangles"].reshape(-1, 3).astype(np.int64)
        is_hair = arrays["part"][triangles[:, 0]] == facts["parts"].index("hair")
        grown = (arrays["open_sky"][triangles] > _UNDER_SKIN).any(axis=1) if hair else False
        return HumanHead(
            rest=rest,
            deltas=deltas,
            share=np.concatenate([arrays["share"] / np.float32(255), np.ones(len(brows["rest"]), np.float32)]),
            triangles=np.concatenate([triangles[~is_hair | grown], brows["triangles"] + count]),
            colors=brows["colors"],
        )


def _read_arrays(data: bytes) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    """Return the facts and the arrays of a mesh file (see `sim/heads/human/README.md`)."""
    (length,) = struct.unpack_from("<I", data)
    facts, at = json.loads(data[4 : 4 + length]), 4 + length
    arrays = {}
    for name, kind, count in facts["arrays"]:
        at += -at % 4
        arrays[name] = np.frombuffer(data, np.dtype(kind).newbyteorder("<"), count, at)
        at += arrays[name].nbytes
    return facts, arrays
