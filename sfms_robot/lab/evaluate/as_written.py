"""Each paper's listener as its paper has it, trained where it is missing: what the tables lay beside ours.

How it is trained is `configs/training/KIND-as-written.yaml`: the size, steps and data of the shipped listener, and
nothing that the paper does not have. Weights are for tables alone and not shipped.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from sfms_robot.data import data_dir
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.learning.resume import checkpoint_file
from sfms_robot.lab.learning.sfms.tokenizer_trainer import WEIGHTS as TOKENIZER_WEIGHTS
from sfms_robot.lab.learning.train_runs import TrainOptions, train_listener, train_tokenizer
from sfms_robot.listeners import checkpoint

Kind = Literal["sfms", "arig"]
LABELS: Final = {"sfms": "SFMS, as written", "arig": "ARIG, as written"}


def training_file(kind: Kind) -> Path:
    """How it is trained."""
    return data_dir("configs") / "training" / f"{kind}-as-written.yaml"


def as_written(
    kind: Kind, data: Path, models: Path, steps: int | None = None, order: Order | None = None
) -> dict[str, Path]:
    """Its label and folder in `models`, trained on `data` if it is not there yet: half an hour or more of one core.

    An interrupted training goes on. `steps`: of every phase, not the file's. Raises ConfigError.
    """
    out = models / f"{kind}-as-written"
    if not (out / checkpoint.WEIGHTS).is_file():
        if kind == "sfms":
            if not (out / TOKENIZER_WEIGHTS).is_file():
                train_tokenizer(_options(kind, "tokenizer", data, out, steps, order))
            train_listener(_options(kind, "listener", data, out, steps, order))
        else:
            train_listener(_options(kind, "arig", data, out, steps, None))
    return {LABELS[kind]: out}


def _options(kind: Kind, job: str, data: Path, out: Path, steps: int | None, order: Order | None) -> TrainOptions:
    begun = checkpoint_file(out, job).is_file()
    return TrainOptions(training_file(kind), data, out, resume=begun, steps=steps, tensorboard=False, order=order)
