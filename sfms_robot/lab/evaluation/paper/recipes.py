"""The tokenizers that the tables compare, by name, at two sizes.

small    width 64, about a fifth of a million parameters, one to two minutes each on one core
paper    about the parameters of table IV; for a GPU

Names say what is in them: sparse-all-k10 has a keyframe set for each channel and 10 keyframes a window; as-written ones
have the paper's scores, learned by Algorithm 1, and its inpainter, which is not added to straight lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from sfms_robot import config
from sfms_robot.config import parse

SizeName = Literal["small", "paper"]

KEYFRAMES: Final = (3, 7, 10)  # of table III
AS_WRITTEN: Final = "as-written"
FSQ_256: Final = (4, 4, 4, 4)  # of all channels
FSQ_256_SCALAR: Final = (256,)  # of one: four coarse digits of one number are harder to learn, and end twice as far off
FSQ_1024: Final = (8, 5, 5, 5)


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
            "inpainter": more.pop("inpainter", "residual"),
        }
        found[name] = _recipe(name, listener, training | more)

    def baseline(name: str, kind: str, quantizer: str, levels: Sequence[int]) -> None:
        settings = {"kind": kind, "quantizer": quantizer, "levels": list(levels),
                    "width": chosen.width, "layers": chosen.baseline_layers}  # fmt: skip
        # The encoder term of Learning2Listen's published configuration weighs a quarter.
        found[name] = _recipe(name, settings, training | {"commitment": 0.25})

    for k in KEYFRAMES:  # table III
        sparse(f"sparse-all-k{k}", "all", FSQ_256_SCALAR, k)
        sparse(f"sparse-all-k{k}-static", "all", FSQ_256_SCALAR, k, "static")
        sparse(f"sparse-all-k{k}-static_paper", "all", FSQ_256_SCALAR, k, "static_paper")
    sparse("sparse-one-k10", "one", FSQ_256, 10)
    sparse("sparse-one-k10-static_paper", "one", FSQ_256, 10, "static_paper")
    baseline("dense-vq-1024", "dense", "vq", (1024,))
    baseline("l2l-vq-256", "grouped", "vq", (256,))  # table IV
    baseline("dense-fsq-1024", "dense", "fsq", FSQ_1024)
    sparse("sparse-all-k10-vq-256", "all", FSQ_256_SCALAR, 10, quantizer="vq")
    for k in KEYFRAMES:
        sparse(f"sparse-all-k{k}-{AS_WRITTEN}", "all", FSQ_256_SCALAR, k, "learned_paper", inpainter="paper")
    sparse(
        f"sparse-all-k10-vq-256-{AS_WRITTEN}", "all", FSQ_256_SCALAR, 10, "learned_paper",
        quantizer="vq", inpainter="paper",
    )  # fmt: skip
    return found


def _recipe(name: str, model: dict[str, Any], training: dict[str, Any]) -> config.Recipe:
    return parse(config.Recipe, {"model": model, "training": training}, name)
