"""The tokenizers that the tables compare, by name, at two sizes.

small    width 64, about a fifth of a million parameters, one to two minutes each on one core
paper    about the parameters of table IV; for a GPU

Names say what is in them: sparse-all-k10 has a keyframe set for each channel and 10 keyframes a window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from sfms_robot import config
from sfms_robot.config import parse

SizeName = Literal["small", "paper"]

KEYFRAMES: Final = (3, 7, 10)  # of table III
FSQ_256: Final = (4, 4, 4, 4)  # of many channels
FSQ_256_SCALAR: Final = (256,)  # of one: four coarse digits of one number are harder to learn, and end twice as far off
FSQ_1024: Final = (8, 5, 5, 5)
MOST_KEYFRAMES: Final = 12  # of the adaptive tokenizer


@dataclass(frozen=True)
class Size:
    """`layers`: of each of the sparse inpainter's three parts; `baseline_layers`: on either side of the codes."""

    width: int
    layers: int
    baseline_layers: int
    score_width: int
    training: dict[str, Any]


SIZES: Final[dict[str, Size]] = {
    "small": Size(64, 1, 2, 32, {"steps": 1000, "batch": 16, "learning_rate": 2e-3, "score_tracks": 16}),
    "paper": Size(
        256, 4, 12, 128, {"steps": 20_000, "batch": 128, "learning_rate": 3e-4, "precision": "bf16", "score_tracks": 64}
    ),
}


def recipes(size: SizeName = "small", steps: int | None = None) -> dict[str, config.Recipe]:
    """Every tokenizer of every table."""
    chosen = SIZES[size]
    training = {**chosen.training, "evaluate_every": 0, **({} if steps is None else {"steps": steps})}
    found: dict[str, config.Recipe] = {}

    def sparse(name: str, preset: str, levels: Sequence[int], k: int, placement: str = "learned", **more: Any) -> None:
        listener = {
            "kind": "sfms",
            "placement": placement,
            "groups": {"preset": preset, "levels": list(levels), "keyframes": k},
            "tokenizer_width": chosen.width,
            "tokenizer_layers": chosen.layers,
            "scores": {"width": chosen.score_width},
            "quantizer": more.pop("quantizer", "fsq"),
        }
        found[name] = _recipe(name, listener, training | more)

    def baseline(name: str, kind: str, quantizer: str, levels: Sequence[int], at_once: int = 1) -> None:
        settings = {"kind": kind, "quantizer": quantizer, "levels": list(levels), "codes_at_once": at_once,
                    "width": chosen.width, "layers": chosen.baseline_layers}  # fmt: skip
        # The encoder term of Learning2Listen's published configuration weighs a quarter.
        found[name] = _recipe(name, settings, training | {"commitment": 0.25})

    for k in KEYFRAMES:  # table III
        sparse(f"sparse-all-k{k}", "all", FSQ_256_SCALAR, k)
        sparse(f"sparse-all-k{k}-static", "all", FSQ_256_SCALAR, k, "static")
        sparse(f"sparse-all-k{k}-static_paper", "all", FSQ_256_SCALAR, k, "static_paper")
    for preset in ("one", "four"):
        sparse(f"sparse-{preset}-k10", preset, FSQ_256, 10)
        sparse(f"sparse-{preset}-k10-static_paper", preset, FSQ_256, 10, "static_paper")
    baseline("dense-vq-1024", "dense", "vq", (1024,))
    baseline("l2l-vq-256", "grouped", "vq", (256,))  # table IV
    baseline("l2l-vq-200", "grouped", "vq", (200,))
    baseline("dense-fsq-1024", "dense", "fsq", FSQ_1024)
    sparse("sparse-all-k10-vq-256", "all", FSQ_256_SCALAR, 10, quantizer="vq")
    sparse("sparse-all-adaptive", "all", FSQ_256_SCALAR, 10, "nested", keyframes_drawn=[1, MOST_KEYFRAMES])
    for name, levels, k, placement in SPARSE_AT_BITS:
        sparse(name, "all", (levels,), k, placement)
    for n in (2, 4, 8):
        baseline(f"dense-fsq-1024x{n}", "dense", "fsq", FSQ_1024, n)
    for n in (4, 8, 16, 32, 64):
        baseline(f"l2l-vq-256x{n}", "grouped", "vq", (256,), n)
    return found


# Levels of a channel's code, keyframes, placement: chosen so that together they span 180 to 3,100 bits. Below about
# 1,000 the places of keyframes cost more bits than they bring: evenly placed ones are known to the reader.
SPARSE_AT_BITS: Final[tuple[tuple[str, int, int, str], ...]] = (
    ("bits-all-3-k2-static", 3, 2, "static"),
    ("bits-all-4-k3-static", 4, 3, "static"),
    ("bits-all-8-k4-static", 8, 4, "static"),
    ("bits-all-8-k6-static", 8, 6, "static"),
    ("bits-all-8-k3", 8, 3, "exact"),
    ("bits-all-32-k6", 32, 6, "exact"),
)


def _recipe(name: str, model: dict[str, Any], training: dict[str, Any]) -> config.Recipe:
    return parse(config.Recipe, {"model": model, "training": training}, name)
