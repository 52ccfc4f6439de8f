"""Both phases of SFMS as one model: tokenizer (IV-B), predictor of its tokens (IV-C), and the networks of a stream.

    Inpainter    sparse to dense (IV-B5): keyframes -> every frame
    Tokenizer    motion <-> tokens (IV-B): placement, codes, inpainter
    SfmsModel    tokenizer and predictor, with the scales of motion and sound: the weights of one listener
    networks     functions of tensors alone that `stream.SfmsListener` calls; they run as modules or as ONNX

Sections of the paper and the files of this folder that follow them:

    IV-A   features of sound                         audio_frontend.py (shared with ARIG)
    IV-B2  keyframe discovery                        placement.py, piecewise_linear.py
    IV-B4  codes of keyframes                        quantizer.py
    IV-B5  from keyframes to every frame             model.py
    IV-C   predictor of listening motion             predictor.py
    ours   drawing tokens, and running as a stream   draw.py, stream.py

B batch or streams, T frames, P past and H future frames, C channels, G groups, D digits of a code, W width.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.audio_frontend import SHAPES
from sfms_robot.listeners.layers import Block, ListenerModel, Network, sinusoidal
from sfms_robot.listeners.sfms.draw import Context, LastKeyframes, neutral_mask
from sfms_robot.listeners.sfms.piecewise_linear import POSITION_BITS, Around, Neighbours
from sfms_robot.listeners.sfms.placement import ConditionalScore, ScoreNetwork, Strategy, place
from sfms_robot.listeners.sfms.predictor import Predictor
from sfms_robot.listeners.sfms.quantizer import Quantizer
from sfms_robot.listeners.space import MotionSpace

UNMEASURED = 1e6  # deviations per frame: a speed that does not bound anything

# --- Sparse to dense (IV-B5) ------------------------------------------------------------------------------------------
#
# Keyframe codes and their places -> every frame, equations (9) and (10). A keyframe encoder reads the keyframes
# (z^kf), a transition encoder queries them from each frame's place between its neighbours (z^tf), a decoder joins both.
# Ours: the result is added to plain linear interpolation of the decoded keyframes, because then the network only has
# to learn how faces deviate from straight lines. The paper's (`inpainter: paper`) has to learn the lines as well: after
# 300 steps on recorded faces (k = 7, one set of keyframes per channel, exact masks, unseen takes) its error was 4.3
# times as large.


class Inpainter(nn.Module):
    """phi of equation (9), for the channels and groups of a quantizer."""

    def __init__(self, quantizer: Quantizer, settings: config.Sfms) -> None:
        super().__init__()
        groups, channels = quantizer.member.shape
        width, heads, layers = settings.tokenizer_width, settings.heads, settings.tokenizer_layers
        self.width = width
        self.residual = settings.inpainter == "residual"
        self.ramp = settings.ramp_frames
        # z^kf of equation (9): codes of all groups at a frame, and which groups have a keyframe there.
        self.keyframe_in = nn.Linear(groups * (quantizer.dims + 1), width)
        self.keyframe_encoder = nn.ModuleList(Block(width, heads) for _ in range(layers))
        # z^tf of equation (10): codes on the line between the neighbours, and T^tf as binary positions (IV-B5).
        self.transition_in = nn.Linear(groups * (quantizer.dims + 2 * POSITION_BITS + 3), width)
        self.transition_encoder = nn.ModuleList(Block(width, heads, cross=True) for _ in range(layers))
        # Phi^full of equation (10), the decoder.
        self.join = nn.Linear(2 * width, width)
        self.decoder = nn.ModuleList(Block(width, heads) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.out = nn.Linear(width, channels)
        if self.residual:  # training begins at the straight lines
            nn.init.zeros_(self.out.weight)
            nn.init.zeros_(self.out.bias)

    def forward(
        self, codes: Tensor, mask: Tensor, quantizer: Quantizer, last: int | None = None, around: Around | None = None
    ) -> Tensor:
        """Return standardised motion (B, T, C) of codes (B, T, G, D), which count where mask (B, T, G) is 1.

        `last`: return only this many frames at the end, (B, last, C). `around`: the places of keyframes in the mask,
        for a caller that has them.
        """
        if around is None:
            neighbours = Neighbours.in_mask(mask, self.ramp)
            seen = (mask > 0.5).any(-1)  # every frame is looked up, so that learned placement gets its gradient
            seen = seen | ~seen.any(-1, keepdim=True)  # a window without any keyframe attends to all its frames
        else:
            neighbours = Neighbours.at(around.before, around.after, self.ramp)
            seen = around.seen
        places = sinusoidal(mask.shape[1], self.width, codes.device).to(codes)  # (T, W)
        # Multiplying by the mask changes nothing going forward; it is where learned placement gets its gradient.
        keyed = codes * mask[..., None]
        z_kf = self.keyframe_in(torch.cat([keyed, mask[..., None]], dim=-1).flatten(2)) + places  # (B, T, W)
        # (B, K, W): the keyframes of each window, in a row; other frames are not attended to and not kept.
        z_keys = z_kf if around is None else F.embedding(around.rows, z_kf.flatten(0, 1))
        for block in self.keyframe_encoder:
            z_keys = block(z_keys, seen=seen)
        z_kf = z_keys if around is None else F.embedding(around.places, z_keys.flatten(0, 1))
        z_kf = z_kf * mask.amax(-1, keepdim=True)
        between = neighbours.interpolate(keyed)  # codes on straight lines, (B, T, G, D)
        query = torch.cat([between, neighbours.positions()], dim=-1).flatten(2)  # concatenated, not added (IV-B5)
        z_tf = self.transition_in(query) + places  # Phi^tf of equation (10): T^tf queries z^kf
        for block in self.transition_encoder:
            z_tf = block(z_tf, memory=z_keys, memory_seen=seen)
        joined = self.join(torch.cat([z_kf, z_tf], dim=-1))  # Phi^full of equation (10)
        *inner, outer = self.decoder
        for block in inner:
            joined = block(joined)
        out: Tensor = quantizer.drawn * self.out(self.norm(outer(joined, last=last)))
        if not self.residual:
            return out
        # Ours: lines between the decoded keyframes (B, T, C), each channel between those of its own group.
        lines = neighbours if last is None else neighbours.last(last)
        return out + quantizer.by_channel(lines.interpolate(quantizer.decoder(keyed)))


class Tokenizer(nn.Module):
    """A map of standardised motion <-> tokens (B, T, G): 0 at a transition frame, 1 + code index at a keyframe."""

    def __init__(self, settings: config.Sfms) -> None:
        super().__init__()
        groups = list(settings.groups.values())
        self.settings = settings
        self.strategy = settings.placement
        self.max_gap = settings.max_gap_frames
        self.window = settings.window_frames
        self.keyframes = [group.keyframes or 0 for group in groups]  # 0 where a keyframe has a cost instead
        self.costs = [group.keyframe_cost or 0.0 for group in groups]
        # Ours: groups of channels, each with its own mask and codebook; `preset: one` is the paper's single mask.
        member = [[float(name in group.channels) for name in settings.channels] for group in groups]
        self.member = nn.Buffer(torch.tensor(member), persistent=False)  # (G, C)
        self.quantizer = Quantizer(self.member, settings)
        self.inpainter = Inpainter(self.quantizer, settings)
        # Only learned placement has scores to learn; the other strategies have no unused weights.
        self.score: ScoreNetwork | ConditionalScore | None = None
        if settings.placement in ("learned_paper", "adaptive"):
            self.score = ScoreNetwork(len(settings.channels), len(groups), settings.scores)
        elif settings.placement == "learned":
            self.score = ConditionalScore(max(len(group.channels) for group in groups), settings.scores)

    def place(self, motion: Tensor, keyframes: Sequence[int] | None = None, strategy: Strategy | None = None) -> Tensor:
        """Return the mask (B, T, G) of motion (B, T, C).

        `keyframes` (per group) and `strategy` replace the configured ones; the configured keyframes are scaled to the
        length of the motion.
        """
        frames = motion.shape[1]
        # k of IV-B2 is for one window; a longer stretch gets as many per second.
        scaled = [max(1, round(count * frames / self.window)) for count in self.keyframes]
        return place(
            motion,
            keyframes or scaled,
            strategy or self.strategy,
            member=self.member,
            score=self.score,
            # The bound on gaps is for the configured rate; fewer keyframes could not keep it.
            max_gap=self.max_gap if frames >= self.window and keyframes is None else None,
            sweeps=self.settings.scores.sweeps,
            costs=self.costs,
            ramp=self.settings.ramp_frames,
        )

    def encode(self, motion: Tensor, mask: Tensor) -> Tensor:
        """Return the tokens (B, T, G) of motion (B, T, C) with keyframes at a mask (B, T, G)."""
        indices = self.quantizer.codebook.indices(self.quantizer.encode(motion))  # every frame as if it were a keyframe
        return torch.where(mask > 0.5, indices + 1, 0)

    def decode(self, tokens: Tensor, last: int | None = None, around: Around | None = None) -> Tensor:
        """Return the motion (B, T, C) of tokens (B, T, G); tokens below 0 count as transitions.

        `last`, `around`: see `Inpainter`.
        """
        # Class 0 is the transition frame, class 1 + i the code c_i of the codebook D (IV-C2).
        codes = self.quantizer.codebook.codes((tokens - 1).clamp(min=0))  # arbitrary for transitions
        out: Tensor = self.inpainter(codes, (tokens > 0).float(), self.quantizer, last, around)
        return out

    def inpaint(self, codes: Tensor, mask: Tensor) -> Tensor:
        """Return the motion (B, T, C) of codes (B, T, G, D) at a mask (B, T, G)."""
        out: Tensor = self.inpainter(codes, mask, self.quantizer)
        return out


class SfmsModel(ListenerModel):
    """Weights of one listener, with the scales of its motion and sound."""

    def __init__(self, settings: config.Sfms) -> None:
        super().__init__(settings, SHAPES[settings.audio][1])
        self.settings = settings
        # Fastest natural change of each channel from one frame to the next, standardised.
        self.motion_speed = nn.Buffer(torch.full((len(settings.channels),), UNMEASURED))
        self.tokenizer = Tokenizer(settings)
        self.predictor = Predictor(settings)


# --- Networks of a stream ---------------------------------------------------------------------------------------------


class Rest(Network[SfmsModel]):
    """A still face as tokens, and every code as motion: called once, when a listener is loaded."""

    def forward(self, still: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return tokens (1, P, G) of `still` (1, P, C) with keyframes `mask` (1, P, G), motion (1, V, C) of codes."""
        quantizer, place = self.model.tokenizer.quantizer, still.device
        codes = [group.codes for group in self.model.settings.groups.values()]
        indices = torch.arange(max(codes), device=place)[:, None] % torch.tensor(codes, device=place)
        return self.model.tokenizer.encode(still, mask), quantizer.decode(quantizer.codebook.codes(indices)[None])


class Hear(Network[SfmsModel]):
    """Sound of a frame and of the one before it, for the predictor."""

    def forward(self, rows: Tensor) -> tuple[Tensor]:
        """Return the vector (B, W) of the newer frame of standardised rows (B, 2R, bins)."""
        return (self.model.predictor.speaker.listen(rows)[:, 0],)


class Ahead(Network[SfmsModel]):
    """The predictor up to the point where the drawn keyframes matter."""

    further = (*Context._fields, "last", "at")

    def forward(self, *inputs: Tensor) -> tuple[Tensor]:
        """Return slots (B, H, W) of the parts of a `Context` and its last keyframes (B, P + H, G, 2)."""
        return (self.model.predictor(Context(*inputs[:-2]), LastKeyframes(*inputs[-2:])),)


class Next(Network[SfmsModel]):
    """The classes of one future frame, given the keyframes before it."""

    def forward(self, slots: Tensor, last: Tensor, at: Tensor, frame: Tensor) -> tuple[Tensor]:
        """Return logits (B, all classes of all groups) of a frame.

        slots (B, W) of the frame, last keyframes (B, G, 2) up to the frame before, and its number (B,).
        """
        return (self.model.predictor.flat_logits(slots, LastKeyframes(last, at), frame[:, None, None]),)


class Decode(Network[SfmsModel]):
    """Tokens as motion."""

    free = ("rows", "seen")
    further = Around._fields

    def forward(self, tokens: Tensor, *around: Tensor) -> tuple[Tensor]:
        """Return standardised motion (B, 2 + H, C), from the frame before now, of tokens (B, P + H, G) and `Around`."""
        return (self.model.tokenizer.decode(tokens, self.model.settings.future_frames + 2, Around(*around)),)


@torch.no_grad()
def neutral_tokens(model: SfmsModel, space: MotionSpace, frames: int) -> Tensor:
    """Return the tokens (frames, G) of a still, neutral face up to now."""
    still = torch.tensor(space.neutral, dtype=torch.float32).expand(1, frames, -1)
    mask = torch.from_numpy(neutral_mask(frames, len(model.tokenizer.member)))
    return model.tokenizer.encode(model.standardise(still), mask[None])[0]


def networks(model: SfmsModel) -> dict[str, Network[SfmsModel]]:
    """Return all networks by name."""
    kinds = {"rest": Rest, "hear": Hear, "ahead": Ahead, "next": Next, "decode": Decode}
    return {name: kind(model).eval() for name, kind in kinds.items()}
