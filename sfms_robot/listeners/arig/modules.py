"""The modules of ARIG: interactive behaviours (3.2), conversation states (3.3) and progressive motion (3.4).

Interactive behaviour understanding: the motion and sound of both people, a chunk at a time, and over a long range.
Short range: the last c behaviours of both tracks, read again for every frame in the light of the newest sounds, become
one summary. Long range: summaries of whole chunks, and that of the chunk in progress, which every frame refreshes
until the chunk is full; a causal decoder makes the cis-token of them. A token sees the w - 1 chunks before its own, in
every layer, so what a stream keeps is w - 1 keys and values per layer: those of whole chunks never change.

N samples, c frames of a chunk, D width, h heads; B batch, T frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot.config.listener import EVENT_STATES, STATES
from sfms_robot.listeners.arig.parts import (
    CrossAttention,
    FeedForward,
    LayerNorm,
    Linear,
    Modulation,
    Part,
    attend,
    join_heads,
    modulated,
    split_heads,
)
from sfms_robot.listeners.arig.rotary import rotary
from sfms_robot.listeners.arig.sojourns import QUANTILES
from sfms_robot.listeners.layers import exported_attention


class Merge(Part):
    """Sound and motion of one frame of one track -> its behaviour; sound alone without the visual modality."""

    def __init__(self, width: int, visual: bool) -> None:
        super().__init__()
        self.visual = visual
        self.mlp = nn.Sequential(Linear((1 + visual) * width, width), nn.GELU(), Linear(width, width))

    def forward(self, sound: Tensor, motion: Tensor) -> Tensor:
        """(..., D) and (..., D) -> (..., D)."""
        out: Tensor = self.mlp(torch.cat([sound, motion], dim=-1) if self.visual else sound)
        return out


class Track(nn.Module):
    """One track's side of a block of bidirectional learning (figure 7): own weights, attention with the other."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.modulation = Modulation(width, width, "scgscg")
        self.qkv = Linear(width, 3 * width)
        self.out = Linear(width, width)
        self.ffn = FeedForward(width, hidden)

    def ask(self, x: Tensor, condition: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """x (N, c, D), condition (N, D) -> queries, keys and values (N, c, 3D), and the modulation."""
        parts = self.modulation.of_tokens(condition)
        return self.qkv(modulated(x, parts[0], parts[1])), parts

    def answer(self, x: Tensor, seen: Tensor, parts: tuple[Tensor, ...]) -> Tensor:
        """x (N, c, D) and what its queries saw (N, c, D) -> (N, c, D)."""
        x = torch.addcmul(x, parts[2], self.out(seen))
        return torch.addcmul(x, parts[5], self.ffn(modulated(x, parts[3], parts[4])))


class Bidirectional(Part):
    """Each track reads itself, and both see each other through one attention, as in MMDiT."""

    def __init__(self, width: int, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.agent = Track(width, hidden)
        self.user = Track(width, hidden)

    def forward(self, agent: Tensor, user: Tensor, agent_sound: Tensor, user_sound: Tensor) -> tuple[Tensor, Tensor]:
        """Tracks (N, c, D), newest sounds (N, D), SiLU applied -> tracks (N, c, D)."""
        agent_qkv, agent_parts = self.agent.ask(agent, agent_sound)
        user_qkv, user_parts = self.user.ask(user, user_sound)
        seen = _attend(torch.cat([agent_qkv, user_qkv], dim=1), self.heads)
        of_agent, of_user = seen.chunk(2, dim=1)
        return self.agent.answer(agent, of_agent, agent_parts), self.user.answer(user, of_user, user_parts)


class Integrated(Part):
    """Both tracks as one sequence; attention and feed-forward side by side (figure 8, Dehghani et al. 2023)."""

    def __init__(self, width: int, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.asked, self.hidden = 3 * width, hidden
        self.modulation = Modulation(width, width, "scg")
        self.wide = Linear(width, 3 * width + hidden)
        self.narrow = Linear(width + hidden, width)

    def forward(self, x: Tensor, condition: Tensor, wanted: int) -> Tensor:
        """x (N, 2c, D), condition (N, D), SiLU applied -> the first so many tokens (N, wanted, D)."""
        shift, scale, gate = self.modulation.of_tokens(condition)
        wide = self.wide(modulated(x, shift, scale))
        qkv, up = wide.narrow(-1, 0, self.asked), wide.narrow(-1, self.asked, self.hidden)[:, :wanted]
        both = torch.cat([_attend(qkv, self.heads, wanted), F.gelu(up)], dim=-1)
        return torch.addcmul(x[:, :wanted], gate, self.narrow(both))


def _attend(qkv: Tensor, heads: int, wanted: int | None = None) -> Tensor:
    """Full self-attention of (N, S, 3D) -> the first `wanted` of S tokens, or all (N, wanted, D)."""
    if torch.compiler.is_exporting():
        q, k, v = qkv.chunk(3, dim=-1)
        return exported_attention(q[:, :wanted], k, v, heads)
    q, k, v = split_heads(qkv, 3 * heads).chunk(3, dim=1)
    return join_heads(attend(q[:, :, :wanted], k, v))


class ShortRange(Part):
    """The last c behaviours of both tracks -> one summary, of the agent's part (A.1)."""

    def __init__(self, width: int, hidden: int, heads: int, chunk: int, depths: tuple[int, int], linear: bool) -> None:
        """`depths` of bidirectional and integrated learning; `linear`: plain layers in their place (table 4)."""
        super().__init__()
        self.places = nn.Parameter(torch.randn(2, chunk, width) * 0.02)
        self.plain = nn.ModuleList(Linear(width, width) for _ in range(2)) if linear else None
        self.plain_both = Linear(4 * width, width) if linear else None
        counts = (0, 0) if linear else depths
        self.bidirectional = nn.ModuleList(Bidirectional(width, hidden, heads) for _ in range(counts[0]))
        self.integrated = nn.ModuleList(Integrated(width, hidden, heads) for _ in range(counts[1]))
        self.norm = LayerNorm(width)
        self.compress = Linear(chunk * width, width)

    def forward(self, agent: Tensor, user: Tensor, agent_sound: Tensor, user_sound: Tensor) -> Tensor:
        """Behaviours (N, c, D), oldest first, and the newest sounds (N, D) -> summary (N, D)."""
        c = agent.shape[1]
        agent, user = agent + self.places[0], user + self.places[1]
        if self.plain is not None and self.plain_both is not None:
            sounds = [sound[:, None].expand(-1, c, -1) for sound in (agent_sound, user_sound)]
            both = torch.cat([self.plain[0](agent), self.plain[1](user), *sounds], dim=-1)
            summed: Tensor = self.compress(self.norm(self.plain_both(both)).flatten(1))
            return summed
        of_agent, of_user = F.silu(agent_sound), F.silu(user_sound)
        for block in self.bidirectional:
            agent, user = block(agent, user, of_agent, of_user)
        # Which sound modulates the two tracks as one is left open: both do.
        x, condition = torch.cat([agent, user], dim=1), F.silu(agent_sound + user_sound)
        for left, block in enumerate(self.integrated, 1 - len(self.integrated)):
            x = block(x, condition, 2 * c if left else c)
        out: Tensor = self.compress(self.norm(x[:, :c]).flatten(1))
        return out


class ContextLayer(Part):
    """One layer of the causal decoder: a summary looks at itself and at whole chunks before it."""

    def __init__(self, width: int, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = LayerNorm(width)
        self.qkv = Linear(width, 3 * width)
        self.out = Linear(width, width)
        self.ffn_norm = LayerNorm(width)
        self.ffn = FeedForward(width, hidden)

    def project(self, x: Tensor, rotary: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x (B, T, D), rotary (2, T, D/h) or (2, B, 1, 1, D/h) -> queries, keys, values (B, h, T, D/h), turned."""
        qkv = split_heads(self.qkv(self.norm(x)), 3 * self.heads)
        q, k = _rotated(qkv.narrow(1, 0, 2 * self.heads), rotary).chunk(2, dim=1)
        return q, k, qkv.narrow(1, 2 * self.heads, self.heads)

    def forward(
        self, x: Tensor, own: tuple[Tensor, Tensor, Tensor], past: tuple[Tensor, Tensor], seen: Tensor
    ) -> Tensor:
        """x (B, T, D), `own` of `project`, past (B, h, S, D/h) twice: keys and values of whole chunks -> (B, T, D).

        `seen` (T, S) or (B, 1, 1, S): which of them each token may look at.
        """
        q, k, v = own
        q = q * q.shape[-1] ** -0.5
        scores = q @ past[0].transpose(-1, -2)  # (B, h, T, S)
        scores = torch.where(seen, scores, -torch.inf)
        self_score = (q * k).sum(-1, keepdim=True)  # the token itself stands beside the cache: nothing is copied
        weights = torch.cat([scores, self_score], dim=-1).softmax(dim=-1)
        y = weights[..., :-1] @ past[1] + weights[..., -1:] * v
        x = x + self.out(join_heads(y))
        out: Tensor = x + self.ffn(self.ffn_norm(x))
        return out


class LongRange(nn.Module):
    """Causal decoder over the context cache -> cis-token."""

    def __init__(self, width: int, hidden: int, heads: int, layers: int, chunk: int, capacity: int) -> None:
        super().__init__()
        self.chunk, self.capacity, self.head_width = chunk, capacity, width // heads
        self.layers = nn.ModuleList(ContextLayer(width, hidden, heads) for _ in range(layers))
        self.norm = LayerNorm(width)

    def _layers(self) -> list[ContextLayer]:
        return [layer for layer in self.layers if isinstance(layer, ContextLayer)]

    def forward(self, summaries: Tensor) -> Tensor:
        """Summaries (B, T, D) of every frame from the start of a stream -> cis-tokens (B, T, D).

        Frame t belongs to chunk t // c, and the last of its frames makes the summary that stays.
        """
        t = summaries.shape[1]
        frame = torch.arange(t, device=summaries.device)
        of = frame // self.chunk
        whole = frame[self.chunk - 1 :: self.chunk]  # frames whose summaries stay
        behind = of[:, None] - of[whole]
        seen = (behind > 0) & (behind < self.capacity)  # (T, S)
        x, turned = summaries, torch.from_numpy(rotary(of.numpy(force=True), self.head_width))
        turned = turned.transpose(0, 1).to(x.device)
        for layer in self._layers():
            own = layer.project(x, turned)
            x = layer(x, own, (own[1][:, :, whole], own[2][:, :, whole]), seen)
        out: Tensor = self.norm(x)
        return out

    def step(self, summary: Tensor, past: Sequence[Tensor], seen: Tensor, rotary: Tensor) -> tuple[Tensor, Tensor]:
        """One frame of N streams.

        Args:
            summary: (N, D) of the chunk in progress.
            past: (N, h, S, D/h) keys and values of the last S whole chunks, oldest first, layer by layer: 2L of them.
            seen: (N, S) bool, which of them there have been.
            rotary: (N, 2, D/h) of this chunk.

        Returns:
            cis-token (N, D), and keys and values (N, 2L, h, D/h) of this summary, should it be the last of its chunk.
        """
        x, made = summary[:, None], []
        turned, view = rotary.transpose(0, 1)[:, :, None, None], seen[:, None, None]
        for layer, keys, values in zip(self._layers(), past[::2], past[1::2], strict=True):
            own = layer.project(x, turned)
            x = layer(x, own, (keys, values), view)
            made += [part[:, :, 0] for part in own[1:]]
        return self.norm(x)[:, 0], torch.stack(made, dim=1)


def _rotated(x: Tensor, rotary: Tensor) -> Tensor:
    """x (B, h, T, D/h) turned by (2, T, D/h) or (2, B, 1, 1, D/h): its halves are the two coordinates of each plane."""
    first, second = x.chunk(2, dim=-1)
    cosine, sine = rotary.unbind(0)
    return torch.addcmul(x * cosine, torch.cat([second, first], dim=-1), sine)


# --- Conversation states understanding (3.3) --------------------------------------------------------------------------
#
# Which of seven states the agent is in, and a feature of it. Voice activity alone has four patterns; which state a
# pattern means depends on the conversation (figure 3):
#
#     agent    user     states
#     speaks   silent   speaking
#     speaks   speaks   receiving feedback, interrupted
#     silent   speaks   listening, giving feedback
#     silent   silent   thinking (its own pause), waiting (the other's)
#
# The figure itself is not in the text at hand; giving feedback, where it is a word and not a nod, is speech of both.
# The paper's stream continues from its most probable state. A listener with events departs from it twice, see
# `sojourns`.


class StateUnderstanding(Part):
    """The previous state asks voice activity and cis-token what the state is now.

    With events its states are `EVENT_STATES`, and it also has what is known of them from the data: `durations` (7, 33),
    quantiles of how many frames each of `STATES` lasts, and `possible` (2, 2, 7), 1 for those that there are while
    agent and user are silent or speak.
    """

    durations: Tensor
    possible: Tensor

    def __init__(self, width: int, hidden: int, heads: int, events: bool = False) -> None:
        super().__init__()
        states = len(EVENT_STATES if events else STATES)
        if events:
            self.register_buffer("durations", torch.ones(len(STATES), QUANTILES))
            self.register_buffer("possible", torch.ones(2, 2, len(STATES)))
        self.previous = nn.Embedding(states, width)
        self.voices = nn.Parameter(torch.randn(2, 2, width) * 0.02)  # track, silent or speaking
        self.look = CrossAttention(width, hidden, heads, slots=3)
        self.norm = LayerNorm(width)
        self.classify = Linear(width, states)

    def condition(self, cis: Tensor, voiced: Tensor) -> Tensor:
        """cis (N, D), voiced (N, 2) bool: agent now, user one frame before -> keys (N, 3, 2D)."""
        told = torch.where(voiced[..., None], self.voices[:, 1], self.voices[:, 0])  # (N, 2, D)
        return self.look.keys(torch.cat([told, cis[:, None]], dim=1))

    def forward(self, keys: Tensor, previous: Tensor) -> tuple[Tensor, Tensor]:
        """`condition` (N, 3, 2D) and previous states (N,) -> state feature (N, D) and logits (N, S) of S states."""
        feature = self.norm(self.look(self.previous(previous), keys))
        return feature, self.classify(feature)

    def roll(self, keys: Tensor, first: Tensor) -> tuple[Tensor, Tensor]:
        """Every frame's own answer becomes the next one's question: as a stream runs.

        keys (B, T, 3, 2D), first (B,) -> features (B, T, D), logits (B, T, S).
        """
        features, logits, state = [], [], first
        for frame in keys.unbind(dim=1):
            feature, scores = self(frame, state)
            state = scores.argmax(-1)
            features.append(feature)
            logits.append(scores)
        return torch.stack(features, dim=1), torch.stack(logits, dim=1)


# --- Progressive motion prediction (3.4) ------------------------------------------------------------------------------
#
# Coarse motion from sound, fine motion from context and state, continuity. The outcome z conditions the sampler of
# the final motion (`sampler`).


class Progressive(Part):
    """Three looks: at the agent's last sounds, at (cis-token, state, sound of now), at its last motions.

    What happens (`events`, beyond the paper) is one token more of the second.
    """

    def __init__(
        self, width: int, hidden: int, heads: int, sounds: int, motions: int, states: bool, events: bool = False
    ) -> None:
        super().__init__()
        self.coarse = CrossAttention(width, hidden, heads, sounds)
        self.fine = CrossAttention(width, hidden, heads, 2 + states + events)
        self.temporal = CrossAttention(width, hidden, heads, motions)
        self.norm = LayerNorm(width)

    def forward(
        self,
        last: Tensor,
        sound_keys: Tensor,
        motion_keys: Tensor,
        sound: Tensor,
        cis: Tensor,
        state: Tensor | None,
        events: Tensor | None = None,
    ) -> Tensor:
        """`coarse` motion, then `refine`: everything of the frame to be made, N of them.

        `last` (N, D) is the embedded motion of the frame before: the query of the coarse motion. `sound_keys`
        (N, 3, 2D) are `coarse.keys` of the agent's sounds, the newest that of the frame itself. The rest: `refine`.
        """
        return self.refine(self.coarse(last, sound_keys), motion_keys, sound, cis, state, events)

    def refine(
        self,
        outline: Tensor,
        motion_keys: Tensor,
        sound: Tensor,
        cis: Tensor,
        state: Tensor | None,
        events: Tensor | None = None,
    ) -> Tensor:
        """Fine motion.

        Args:
            outline: (N, D) coarse motion.
            motion_keys: (N, 5, 2D) `temporal.keys` of the agent's motions before the frame.
            sound: (N, D) embedded sound of the agent in the frame itself.
            cis: (N, D).
            state: (N, D) feature, or None without state guidance.
            events: (N, D) embedded control rows, or None without events.

        Returns:
            z (N, D).
        """
        tokens = [token for token in (cis, state, sound, events) if token is not None]
        x = self.fine(outline, self.fine.keys(torch.stack(tokens, dim=1)))
        out: Tensor = self.norm(self.temporal(x, motion_keys))
        return out
