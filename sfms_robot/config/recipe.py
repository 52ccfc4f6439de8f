"""A tokenizer of the comparison tables: what its folder's config.yaml holds."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sfms_robot.config.base import Model
from sfms_robot.config.listener import Count, Sfms, check_heads
from sfms_robot.config.training import TokenizerTraining

HALVINGS = 3  # of time, in a grouped tokenizer: 8 frames to a code


class Baseline(Model):
    """What the dense and the grouped tokenizer share: transformer encoder, codes, transformer decoder.

    Attributes:
        quantizer: a fixed grid (fsq), or as many learned vectors of `code_dims` dimensions (vq).
        levels: multiply to the codes of a codebook.
        layers: transformer blocks of the encoder, and as many of the decoder.
    """

    window_frames: Annotated[int, Field(ge=1)] = 48
    quantizer: Literal["fsq", "vq"]
    levels: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)]
    code_dims: Count = 8
    width: Count = 64
    layers: Count = 2
    heads: Count = 4

    @property
    def codes(self) -> int:
        return math.prod(self.levels)

    @model_validator(mode="after")
    def _heads_fit(self) -> Baseline:
        check_heads(self.heads, width=self.width)
        return self


class Dense(Baseline):
    """Every frame has its code (Dense-FSQ, VQ-only)."""

    kind: Literal["dense"] = "dense"


class Grouped(Baseline):
    """Every 8 frames have one code (Learning2Listen)."""

    kind: Literal["grouped"] = "grouped"

    @model_validator(mode="after")
    def _whole_groups(self) -> Grouped:
        if self.window_frames % 2**HALVINGS:
            raise ValueError(f"window_frames {self.window_frames} is not a multiple of {2**HALVINGS}")
        return self


class Recipe(Model):
    """One tokenizer and how it is trained. What `training` says of keyframes only an sfms tokenizer heeds."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    model: Annotated[Sfms | Dense | Grouped, Field(discriminator="kind")]
    training: TokenizerTraining
