"""A listener and how it is trained."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sfms_robot.config.base import Finite, Model, Name, NonNegative, Positive
from sfms_robot.frames import CHANNEL_INDEX

Count = Annotated[int, Field(ge=1)]
Share = Annotated[float, Field(ge=0, le=1)]


class ChannelGroup(Model):
    """Channels that share one keyframe track: at most one code per frame, from `levels[0] * levels[1] * ...`."""

    channels: Annotated[tuple[str, ...], Field(min_length=1)]
    levels: Annotated[tuple[Annotated[int, Field(ge=2)], ...], Field(min_length=1)]
    keyframes: Count
    transition_bias: Finite = 0.0
    nucleus: Annotated[float, Field(gt=0, le=1)] | None = None

    @model_validator(mode="after")
    def _known(self) -> ChannelGroup:
        for name in self.channels:
            if name not in CHANNEL_INDEX:
                raise ValueError(f"channels: {name!r} is not a channel ({', '.join(CHANNEL_INDEX)})")
        return self

    @property
    def codes(self) -> int:
        return math.prod(self.levels)


class Sampling(Model):
    """How tokens are drawn. `frames_per_pass`: future frames decided by one pass of the decoder."""

    temperature: Positive = 1.0
    nucleus: Annotated[float, Field(gt=0, le=1)] = 1.0
    frames_per_pass: Count = 1
    seam_frames: Count = 4


class Listener(Model):
    """A listener: `configs/listeners/NAME/config.yaml`."""

    kind: Literal["sfms"]
    description: str = ""
    motion_space: Literal["arkit58"] = "arkit58"
    past_frames: Count = 40
    future_frames: Count = 8
    hop: Count = 4
    placement: Literal["exact", "static", "static_paper", "learned"] = "exact"
    max_gap_frames: Count = 24
    groups: Annotated[dict[Name, ChannelGroup], Field(min_length=1)]
    tokenizer_width: Count = 96
    predictor_width: Count = 96
    predictor_layers: Count = 2
    heads: Count = 4
    sampling: Sampling = Sampling()

    @model_validator(mode="after")
    def _consistent(self) -> Listener:
        owner: dict[str, str] = {}
        for name, group in self.groups.items():
            for channel in group.channels:
                if owner.setdefault(channel, name) != name:
                    raise ValueError(f"groups.{name}.channels: {channel!r} is already in group {owner[channel]}")
        missing = [channel for channel in CHANNEL_INDEX if channel not in owner]
        if missing:
            raise ValueError(f"groups: no group holds {', '.join(missing)}")
        if len({len(group.levels) for group in self.groups.values()}) != 1:
            raise ValueError("groups: every group needs the same number of levels")
        if self.hop > self.future_frames:
            raise ValueError(f"hop {self.hop} is above future_frames {self.future_frames}")
        for key, width in (("tokenizer_width", self.tokenizer_width), ("predictor_width", self.predictor_width)):
            if width % (2 * self.heads):
                raise ValueError(f"{key} {width} is not a multiple of twice heads ({self.heads})")
        return self

    @property
    def window_frames(self) -> int:
        return self.past_frames + self.future_frames


class TokenizerTraining(Model):
    """Phase 1: scores, quantizer, inpainter."""

    steps: Count
    batch: Count
    learning_rate: Positive
    score_learning_rate: Positive = 1e-3
    weight_decay: NonNegative = 0.01
    clip_norm: Positive = 1.0
    mask_loss: NonNegative = 0.1
    velocity_loss: NonNegative = 0.0
    temperature: tuple[Positive, Positive] = (2.0, 0.1)


class PredictorTraining(Model):
    """Phase 2: the next-token predictor."""

    steps: Count
    batch: Count
    learning_rate: Positive
    weight_decay: NonNegative = 0.01
    clip_norm: Positive = 1.0
    transition_weight: Positive = 0.5
    neutral_prefix: Share = 0.1
    drop_audio: Share = 0.1
    drop_face: Share = 0.3
    history_noise: Share = 0.05
    gain_db: NonNegative = 6.0
    group_weights: dict[Name, Positive] = {}
    calibration_rounds: Annotated[int, Field(ge=0)] = 2


class Training(Model):
    """How a listener is trained: `configs/training/NAME.yaml`."""

    seed: int = 1
    listener: Listener
    tokenizer: TokenizerTraining
    predictor: PredictorTraining
