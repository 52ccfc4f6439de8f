"""Tokens out of probabilities: frame by frame, every group at once, many streams at a time.

A group may be guided (Ho and Salimans 2022, classifier-free guidance, there for diffusion): training leaves voice and
face out now and then, so the predictor also knows what its classes are with nobody there, and

    guided = unheard + guidance * (heard - unheard),   logits, per group and class.

Above 1 what the speaker does weighs more than it did in training: movement that he makes likelier becomes more frequent
still, and restlessness that nobody called for rarer. The paper has none, which is guidance 1 and takes no time.

Listeners are trained while somebody speaks. When nobody has for a while (from 1.6 s of silence on, wholly from 3.2 s)
little was learned: guidance fades to 1 there, and a group may draw from a smaller nucleus, which keeps it still.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from sfms_robot import config
from sfms_robot.listeners.graphs import graph
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context, LastKeyframes, Predictor, last_keyframes
from sfms_robot.listeners.sfms.reachable import Reach
from sfms_robot.signals.phase import PHRASE_KNOTS_S, SILENCE_KNOTS_S, SPEECH_KNOTS_S

# 1 at the hats of `phase.features` that stand for silence up to 1.6 s: their sum falls from 1 there to 0 at 3.2 s.
SILENCE_LATELY = torch.tensor(
    [0.0] * len(SPEECH_KNOTS_S) + [float(knot <= 1.6) for knot in SILENCE_KNOTS_S] + [0.0] * len(PHRASE_KNOTS_S)
)
LIKELIEST = 128  # classes that are looked at: what is behind them weighs next to nothing, and sorting it takes time


class FutureEncoder(nn.Module):
    """What is known of every future frame before any of them is drawn."""

    def __init__(self, predictor: Predictor, absent: Tensor | None) -> None:
        super().__init__()
        self.predictor = predictor
        self.register_buffer("absent", absent, persistent=False)

    def forward(self, *seen: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The parts of a Context -> slots (B, H, W), or (2, B, H, W), also without the speaker, and last keyframes."""
        context = Context(*seen)
        past = last_keyframes(context.tokens)
        slots = self.predictor(context, past, self.absent)
        return (slots if self.absent is None else slots.unflatten(0, (2, -1))), past.tokens, past.at


class FrameSampler(nn.Module):
    """One future frame drawn after those before it."""

    bias: Tensor

    def __init__(self, settings: config.Sfms, model: SfmsModel) -> None:
        super().__init__()
        self.predictor = model.predictor
        self.temperature = settings.sampling.temperature
        bias = torch.tensor([group.transition_bias for group in settings.groups.values()])
        self.register_buffer("bias", bias, persistent=False)
        self.reach = Reach(model)

    def forward(
        self,
        slots: Tensor,
        known: Tensor,
        last: Tensor,
        at: Tensor,
        frame: Tensor,
        guidance: Tensor,
        nucleus: Tensor,
        chance: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One frame.

        Args:
            slots: (B, W) of this frame, or (2, B, W) where a group is guided.
            known: (B, G) its tokens where they are drawn already, which stay; UNDECIDED elsewhere.
            last, at: the last keyframes (B, G, 2) up to the frame before; frame: () its number.
            guidance: (1 or B, G, 1); nucleus, chance: (1 or B, G), as `sample` takes them.

        Returns:
            Tokens (B, G) and the last keyframes (B, G, 2) after them.
        """
        recent = LastKeyframes(last, at)
        logits = self.predictor.classes(slots, recent, frame)
        if slots.dim() == 3:
            logits = guided(logits[0], logits[1], guidance)  # (B, G, V)
        too_soon = self.reach.too_soon(last[..., 0], frame + 1 - at[..., 0])
        drawn = sample(logits.masked_fill(too_soon, -torch.inf) / self.temperature, self.bias, nucleus, chance)
        drawn = torch.where(known == UNDECIDED, drawn, known)
        after = recent.then(drawn, frame + 1)
        return drawn, after.tokens, after.at


class Sampler:
    """How the tokens of one listener are drawn: its predictor, and what its settings say of every group."""

    @torch.no_grad()
    def __init__(self, settings: config.Sfms, model: SfmsModel) -> None:
        groups, common = list(settings.groups.values()), settings.sampling
        self._nucleus = torch.tensor([group.nucleus or common.nucleus for group in groups])
        alone = [group.nucleus_in_silence or group.nucleus or common.nucleus for group in groups]
        self._nucleus_in_silence = torch.tensor(alone)
        self._guidance = torch.tensor([group.guidance for group in groups])[:, None]
        guided = any(group.guidance != 1.0 for group in groups)
        self._ahead = FutureEncoder(
            model.predictor, model.predictor.absent_speaker(settings.past_frames) if guided else None
        ).eval()
        self._next = FrameSampler(settings, model).eval()
        self._graphs: tuple[Callable[..., Any], Callable[..., Any]] | None = None

    @torch.inference_mode()
    def build_graphs(self, seen: Context) -> None:
        """The weights stay as they are: what a single stream such as `seen` draws is drawn by graphs from now on."""
        slots, last, at = self._ahead(*seen.parts)
        frame, chance = torch.tensor(0), torch.zeros(1, seen.tokens.shape[2])
        known = seen.tokens[:, -1]
        example = (
            slots[..., 0, :], known, last[:, 0], at[:, 0], frame, self._guidance[None], self._nucleus[None], chance
        )  # fmt: skip
        self._graphs = graph(self._ahead, seen.parts), graph(self._next, example)

    def draw(self, seen: Context, generators: Sequence[torch.Generator]) -> Tensor:
        """`seen.tokens` (B, P + H, G) with its undecided frames drawn; stream b by the numbers of generators[b].

        A stream's undecided frames are its last ones; how many may differ from stream to stream.
        """
        ahead, after = self._graphs if self._graphs and len(generators) == 1 else (self._ahead, self._next)
        tokens = seen.tokens.clone()
        left = (tokens[..., 0] == UNDECIDED).sum(1).tolist()  # frames of each stream
        first, groups = tokens.shape[1] - max(left), tokens.shape[2]
        slots, last, at = ahead(*seen.parts)
        last, at = last[:, first - 1], at[:, first - 1]
        chances = torch.zeros(max(left), len(tokens), groups)
        for row, (frames, generator) in enumerate(zip(left, generators, strict=True)):
            chances[max(left) - frames :, row] = torch.rand(frames, groups, generator=generator)
        lately = self._lately(seen)
        guidance = 1 + (self._guidance - 1) * lately[:, None, None]  # (1 or B, G, 1)
        nucleus = self._nucleus_in_silence + (self._nucleus - self._nucleus_in_silence) * lately[:, None]
        for frame, chance in enumerate(chances, first):
            slot = slots[..., frame - tokens.shape[1], :]
            tokens[:, frame], last, at = after(
                slot, tokens[:, frame], last, at, torch.tensor(frame - 1), guidance, nucleus, chance
            )
        return tokens

    def _lately(self, seen: Context) -> Tensor:
        """(1 or B,) 1 where somebody speaks or did 1.6 s ago, 0 from 3.2 s of silence on; 1 if that is unknown."""
        silence = seen.phase[:, -1] @ SILENCE_LATELY if seen.phase.shape[-1] else torch.ones(len(seen.heard))
        return torch.where(seen.heard[:, -1], silence, 1.0)


def guided(heard: Tensor, unheard: Tensor, guidance: Tensor) -> Tensor:
    """Logits (..., G, V) with the speaker and with nobody, guidance (..., G, 1) -> logits; `heard` where that is 1."""
    untouched = (guidance == 1) | heard.isinf()  # classes that a group lacks
    return torch.where(untouched, heard, unheard + guidance * (heard - unheard))


def sample(logits: Tensor, bias: Tensor, nucleus: Tensor, chance: Tensor) -> Tensor:
    """One class (..., G) of each logits (..., G, V): bias (G,) on class 0, then the likeliest that hold `nucleus`.

    `chance`, both (..., G) in 0..1, says where in that mass: a class is drawn as often as it is likely.
    """
    biased = logits.clone()
    biased[..., 0] += bias
    order = torch.softmax(biased, dim=-1).topk(min(LIKELIEST, logits.shape[-1]))
    mass = order.values.cumsum(-1)
    kept = ((mass - order.values) < nucleus[..., None]).sum(-1, keepdim=True)
    whole = mass.gather(-1, kept - 1)
    place = torch.minimum((mass <= chance[..., None] * whole).sum(-1, keepdim=True), kept - 1)
    return order.indices.gather(-1, place)[..., 0]
