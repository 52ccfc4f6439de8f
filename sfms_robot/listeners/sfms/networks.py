"""What a stream of SFMS asks its model, as modules of tensors alone: they run as they are, as graphs, or exported.

B streams, P past and H future frames, G groups, W width.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.listeners.sfms.audio_frontend import SHAPES
from sfms_robot.listeners.sfms.keyframes import KEYS_STEP, UNDECIDED, around, neutral_mask
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.neighbours import Around
from sfms_robot.listeners.sfms.predictor import Context, LastKeyframes
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.control import COLUMNS
from sfms_robot.signals.phase import FEATURES


class Network(nn.Module):
    """Of one model: its weights keep their names in model.safetensors, behind "model.".

    Attributes:
        free: inputs of (B, K, ...), K any number but the same for all of them.
    """

    free: tuple[str, ...] = ()

    def __init__(self, model: SfmsModel, settings: config.Sfms) -> None:
        super().__init__()
        self.model = model
        self.future = settings.future_frames
        self.codes = [group.codes for group in settings.groups.values()]


class Rest(Network):
    """A still face as tokens, and every code as motion: asked once, when a listener is loaded."""

    def forward(self, still: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """still (1, P, C) standardised, its keyframes mask (1, P, G) -> tokens (1, P, G), motion (1, V, C) of codes."""
        quantizer = self.model.tokenizer.quantizer
        indices = torch.arange(max(self.codes))[:, None] % torch.tensor(self.codes)
        return self.model.tokenizer.encode(still, mask), quantizer.decode(quantizer.codes(indices)[None])


class Hear(Network):
    """Sound of a frame, and of the one before it."""

    def forward(self, rows: Tensor) -> tuple[Tensor]:
        """rows (B, 2R, bins) standardised -> what the predictor is told of the newer frame (B, W)."""
        return (self.model.predictor.speaker.listen(rows)[:, 0],)


class Ahead(Network):
    """What is known of every future frame before any of them is drawn."""

    def forward(
        self,
        face: Tensor,
        face_known: Tensor,
        voice: Tensor,
        heard: Tensor,
        phase: Tensor,
        tokens: Tensor,
        control: Tensor,
        last: Tensor,
        at: Tensor,
    ) -> tuple[Tensor]:
        """The parts of a `Context`, and its last keyframes (B, P + H, G, 2) and their frames -> slots (B, H, W)."""
        context = Context(face, face_known, voice, heard, phase, tokens, control)
        return (self.model.predictor(context, LastKeyframes(last, at)),)


class Next(Network):
    """The classes of one future frame, given the keyframes before it."""

    def forward(self, slots: Tensor, last: Tensor, at: Tensor, frame: Tensor) -> tuple[Tensor]:
        """slots (B, W) of the frame, last keyframes (B, G, 2) up to the frame before, and its number (B,) -> logits
        (B, all classes of all groups).
        """
        return (self.model.predictor.flat_logits(slots, LastKeyframes(last, at), frame[:, None, None]),)


class Decode(Network):
    """Tokens as motion."""

    free = ("rows", "seen")

    def forward(
        self, tokens: Tensor, before: Tensor, after: Tensor, rows: Tensor, seen: Tensor, places: Tensor
    ) -> tuple[Tensor]:
        """tokens (B, P + H, G) and the parts of their `Around` -> motion (B, 2 + H, C), standardised: two frames up to
        now, and the future.
        """
        found = Around(before, after, rows, seen, places)
        return (self.model.tokenizer.decode(tokens, last=self.future + 2, around=found),)


@torch.no_grad()
def neutral_tokens(model: SfmsModel, space: MotionSpace, frames: int) -> Tensor:
    """(frames, G): a still, neutral face up to now, as tokens."""
    still = torch.tensor(space.neutral, dtype=torch.float32).expand(1, frames, -1)
    mask = torch.from_numpy(neutral_mask(frames, len(model.tokenizer.member)))
    return model.tokenizer.encode(model.standardise(still), mask[None])[0]


def networks(model: SfmsModel, settings: config.Sfms) -> dict[str, Network]:
    """All of them, by name."""
    kinds = {"rest": Rest, "hear": Hear, "ahead": Ahead, "next": Next, "decode": Decode}
    return {name: kind(model, settings).eval() for name, kind in kinds.items()}


def examples(settings: config.Sfms, streams: int) -> Mapping[str, dict[str, Tensor]]:
    """Inputs of every network by its name and theirs, of as many streams."""
    p, window, width, channels = (
        settings.past_frames,
        settings.window_frames,
        settings.predictor_width,
        settings.channels,
    )
    groups, (rows, bins) = len(settings.groups), SHAPES[settings.audio]
    b, flags = streams, torch.ones(streams, p, dtype=torch.bool)
    tokens = torch.zeros(b, window, groups, dtype=torch.long)
    undecided = torch.full((b, settings.future_frames, groups), UNDECIDED)
    recent = torch.zeros(b, window, groups, 2, dtype=torch.long)
    return {
        "rest": {"still": torch.zeros(1, p, len(channels)), "mask": torch.zeros(1, p, groups)},
        "hear": {"rows": torch.zeros(b, 2 * rows, bins)},
        "ahead": {
            "face": torch.zeros(b, p, len(channels)),
            "face_known": flags,
            "voice": torch.zeros(b, p, width),
            "heard": flags.clone(),
            "phase": torch.zeros(b, p, FEATURES if settings.phase else 0),
            "tokens": torch.cat([tokens[:, :p], undecided], dim=1),
            "control": torch.zeros(b, window, len(COLUMNS) if settings.events else 0),
            "last": recent,
            "at": recent - 1,
        },
        "next": {
            "slots": torch.zeros(b, width),
            "last": recent[:, 0],
            "at": recent[:, 0] - 1,
            "frame": torch.full((b,), p - 1),
        },
        "decode": dict(zip(("tokens", *Around._fields), (tokens, *_blank(b, window, groups)), strict=True)),
    }


def _blank(streams: int, window: int, groups: int) -> Around:
    """Of tokens that are some keyframes, for an example."""
    tokens = np.ones((streams, window, groups), np.int64)
    tokens[:, KEYS_STEP:] = 0
    return Around(*map(torch.from_numpy, around(tokens)))
