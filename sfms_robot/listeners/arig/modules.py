"""The modules of ARIG: interactive behaviours (3.2), conversation states (3.3) and progressive motion (3.4).

Interactive behaviour understanding: the motion and sound of both people, a chunk at a time, and over a long range.
Short range: for every frame, the last c behaviours of both tracks are processed again with the newest sounds and become
one summary. Long range: a causal decoder makes the cis-token of the summaries of whole chunks and of the chunk in
progress, whose summary every frame replaces until the chunk is full. A token sees the w - 1 chunks before its own, in
every layer. So a stream keeps w - 1 keys and values per layer: those of whole chunks never change.

N samples, c frames of a chunk, D width, h heads; B batch, T frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.config.listener import STATES
from sfms_robot.listeners.arig.stream import FIRST, QUANTILES, rotary
from sfms_robot.listeners.layers import (
    CrossAttention,
    FeedForward,
    Modulation,
    Tensors,
    attention,
    join_heads,
    mlp,
    modulated,
    split_heads,
)

# --- Short range (3.2, A.1) -------------------------------------------------------------------------------------------


class Merge(nn.Module):
    """Sound and motion of one frame of one track -> its behaviour I_t; sound alone without the visual modality."""

    def __init__(self, width: int, visual: bool) -> None:
        super().__init__()
        self.visual = visual
        self.mlp = mlp((1 + visual) * width, width, width)

    def forward(self, sound: Tensor, motion: Tensor) -> Tensor:
        """Return the behaviour (..., D) of sound (..., D) and motion (..., D)."""
        out: Tensor = self.mlp(torch.cat([sound, motion], dim=-1) if self.visual else sound)
        return out


class TrackSide(nn.Module):
    """One track's side of a block of bidirectional learning (figure 7): own weights, joint attention with the other."""

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.modulation = Modulation(width, "scgscg")
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.ffn = FeedForward(width, hidden)

    def ask(self, x: Tensor, condition: Tensor) -> tuple[Tensor, Tensors]:
        """Return queries, keys and values (N, c, 3D) of x (N, c, D), and the modulation by a condition (N, D)."""
        parts = self.modulation.of_tokens(condition)
        return self.qkv(modulated(x, parts[0], parts[1])), parts

    def answer(self, x: Tensor, seen: Tensor, parts: Tensors) -> Tensor:
        """Return the output (N, c, D) of x (N, c, D) and the attention (N, c, D) of its queries."""
        # adaLN (A.1): gates of the attention and of the feed-forward, both modulated by the newest sound of the track.
        x = torch.addcmul(x, parts[2], self.out(seen))
        return torch.addcmul(x, parts[5], self.ffn(modulated(x, parts[3], parts[4])))


class Bidirectional(nn.Module):
    """A block in which both tracks attend to themselves and to each other in one attention, as in MMDiT (figure 7)."""

    def __init__(self, width: int, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.agent = TrackSide(width, hidden)
        self.user = TrackSide(width, hidden)

    def forward(self, agent: Tensor, user: Tensor, agent_sound: Tensor, user_sound: Tensor) -> tuple[Tensor, Tensor]:
        """Return both tracks (N, c, D); SiLU was applied to the newest sounds (N, D)."""
        # One attention over the 2c tokens of both: each track's queries see both tracks' keys.
        agent_qkv, agent_parts = self.agent.ask(agent, agent_sound)
        user_qkv, user_parts = self.user.ask(user, user_sound)
        of_agent, of_user = _attend(torch.cat([agent_qkv, user_qkv], dim=1), self.heads).chunk(2, dim=1)
        return self.agent.answer(agent, of_agent, agent_parts), self.user.answer(user, of_user, user_parts)


class Integrated(nn.Module):
    """A block over both tracks as one sequence, attention parallel to feed-forward (figure 8, Dehghani et al. 2023)."""

    def __init__(self, width: int, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.asked, self.hidden = 3 * width, hidden
        self.modulation = Modulation(width, "scg")
        self.wide = nn.Linear(width, 3 * width + hidden)
        self.narrow = nn.Linear(width + hidden, width)

    def forward(self, x: Tensor, condition: Tensor, wanted: int) -> Tensor:
        """Return the first `wanted` tokens (N, wanted, D) of x (N, 2c, D); SiLU was applied to condition (N, D)."""
        # One product makes queries, keys, values and the hidden layer; another one joins attention and hidden layer.
        shift, scale, gate = self.modulation.of_tokens(condition)
        wide = self.wide(modulated(x, shift, scale))
        qkv, up = wide.narrow(-1, 0, self.asked), wide.narrow(-1, self.asked, self.hidden)[:, :wanted]
        both = torch.cat([_attend(qkv, self.heads, wanted), F.gelu(up)], dim=-1)
        return torch.addcmul(x[:, :wanted], gate, self.narrow(both))


def _attend(qkv: Tensor, heads: int, wanted: int | None = None) -> Tensor:
    """Return full self-attention (N, wanted, D) of (N, S, 3D) for the first `wanted` of S tokens, or for all."""
    q, k, v = qkv.chunk(3, dim=-1)
    return attention(q[:, :wanted], k, v, heads)


class ShortRange(nn.Module):
    """The last c behaviours of both tracks -> one summary, of the agent's part (A.1)."""

    def __init__(self, settings: config.Arig) -> None:
        super().__init__()
        width, hidden, heads, chunk = settings.width, settings.feedforward, settings.heads, settings.chunk_frames
        linear = settings.interaction == "linear"  # ablation of table 4: plain layers in place of the blocks
        depths = (0, 0) if linear else (settings.bidirectional_layers, settings.integrated_layers)
        self.places = nn.Parameter(torch.randn(2, chunk, width) * 0.02)
        self.plain = nn.ModuleList(nn.Linear(width, width) for _ in range(2)) if linear else None
        self.plain_both = nn.Linear(4 * width, width) if linear else None
        self.bidirectional = nn.ModuleList(Bidirectional(width, hidden, heads) for _ in range(depths[0]))
        self.integrated = nn.ModuleList(Integrated(width, hidden, heads) for _ in range(depths[1]))
        self.norm = nn.LayerNorm(width)
        self.compress = nn.Linear(chunk * width, width)

    def forward(self, agent: Tensor, user: Tensor, agent_sound: Tensor, user_sound: Tensor) -> Tensor:
        """Return the summary (N, D) of behaviours (N, c, D), oldest first, and the newest sounds (N, D)."""
        c = agent.shape[1]
        agent, user = agent + self.places[0], user + self.places[1]  # ours: learned places in the chunk
        if self.plain is not None and self.plain_both is not None:
            sounds = [sound[:, None].expand(-1, c, -1) for sound in (agent_sound, user_sound)]
            both = torch.cat([self.plain[0](agent), self.plain[1](user), *sounds], dim=-1)
            summed: Tensor = self.compress(self.norm(self.plain_both(both)).flatten(1))
            return summed
        of_agent, of_user = F.silu(agent_sound), F.silu(user_sound)  # the updated audio modulates each track (A.1)
        for block in self.bidirectional:
            agent, user = block(agent, user, of_agent, of_user)
        # The paper does not state which sound modulates the two tracks as one sequence. Ours: both do.
        x, condition = torch.cat([agent, user], dim=1), F.silu(agent_sound + user_sound)
        for left, block in enumerate(self.integrated, 1 - len(self.integrated)):
            x = block(x, condition, 2 * c if left else c)
        out: Tensor = self.compress(self.norm(x[:, :c]).flatten(1))  # the agent's part (A.1), c frames -> one vector
        return out


# --- Long range (3.2) -------------------------------------------------------------------------------------------------


class ContextLayer(nn.Module):
    """One layer of the causal decoder: a summary looks at itself and at whole chunks before it."""

    def __init__(self, width: int, hidden: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.ffn_norm = nn.LayerNorm(width)
        self.ffn = FeedForward(width, hidden)

    def project(self, x: Tensor, rotary: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return queries, keys, values (B, h, T, D/h) of x (B, T, D); queries and keys are rotated.

        `rotary`: (2, T, D/h) or (2, B, 1, 1, D/h).
        """
        qkv = split_heads(self.qkv(self.norm(x)), 3 * self.heads)
        both = qkv.narrow(1, 0, 2 * self.heads)
        first, second = both.chunk(2, dim=-1)  # the two coordinates of each plane
        cosine, sine = rotary.unbind(0)
        q, k = torch.addcmul(both * cosine, torch.cat([second, first], dim=-1), sine).chunk(2, dim=1)
        return q, k, qkv.narrow(1, 2 * self.heads, self.heads)

    def forward(
        self, x: Tensor, own: tuple[Tensor, Tensor, Tensor], past: tuple[Tensor, Tensor], seen: Tensor
    ) -> Tensor:
        """Return (B, T, D) of x (B, T, D).

        Args:
            x: summaries.
            own: `project` of the summaries.
            past: keys and values (B, h, S, D/h) of whole chunks.
            seen: (T, S) or (B, 1, 1, S), which of the whole chunks each token may attend to.
        """
        q, k, v = own
        q = q * q.shape[-1] ** -0.5
        scores = q @ past[0].transpose(-1, -2)  # (B, h, T, S)
        scores = torch.where(seen, scores, -torch.inf)
        self_score = (q * k).sum(-1, keepdim=True)  # the token's score of itself is separate: the cache is not copied
        weights = torch.cat([scores, self_score], dim=-1).softmax(dim=-1)
        x = x + self.out(join_heads(weights[..., :-1] @ past[1] + weights[..., -1:] * v))
        out: Tensor = x + self.ffn(self.ffn_norm(x))
        return out


@lru_cache(maxsize=16)
@torch.inference_mode(False)  # the cached tensor serves training as well
def _turned(frames: int, chunk: int, width: int, device: torch.device) -> Tensor:
    """Return the rotary places (2, frames, width) of the chunk of every frame."""
    return torch.from_numpy(rotary(np.arange(frames) // chunk, width)).transpose(0, 1).to(device)


class LongRange(nn.Module):
    """Causal decoder over the context cache of capacity w -> cis-token."""

    def __init__(self, settings: config.Arig) -> None:
        super().__init__()
        width, hidden, heads = settings.width, settings.feedforward, settings.heads
        self.chunk, self.capacity, self.head_width = settings.chunk_frames, settings.context_chunks, width // heads
        self.layers = nn.ModuleList(ContextLayer(width, hidden, heads) for _ in range(settings.context_layers))
        self.norm = nn.LayerNorm(width)

    def _layers(self) -> list[ContextLayer]:
        return [layer for layer in self.layers if isinstance(layer, ContextLayer)]

    def forward(self, summaries: Tensor) -> Tensor:
        """Return cis-tokens (B, T, D) of the summaries (B, T, D) of every frame from the start of a stream.

        Frame t belongs to chunk t // c, and the last frame of a chunk makes the summary that stays.
        """
        # Chunk i holds frames ci to c(i + 1) - 1 (3.2). While it is in progress, each frame makes a new summary, as in
        # a stream; later chunks see only the summary of its last frame.
        t = summaries.shape[1]
        frame = torch.arange(t, device=summaries.device)
        of = frame // self.chunk
        whole = frame[self.chunk - 1 :: self.chunk]  # frames whose summaries stay
        behind = of[:, None] - of[whole]  # number of chunks from a kept summary to the chunk of each frame, (T, S)
        seen = (behind > 0) & (behind < self.capacity)  # (T, S)
        x, turned = summaries, _turned(t, self.chunk, self.head_width, summaries.device)
        for layer in self._layers():
            own = layer.project(x, turned)
            x = layer(x, own, (own[1][:, :, whole], own[2][:, :, whole]), seen)
        out: Tensor = self.norm(x)
        return out

    def step(self, summary: Tensor, past: Sequence[Tensor], seen: Tensor, rotary: Tensor) -> tuple[Tensor, Tensor]:
        """Process one frame of N streams.

        Args:
            summary: (N, D) of the chunk in progress.
            past: (N, h, S, D/h) keys and values of the last S whole chunks, oldest first, layer by layer: 2L of them.
            seen: (N, S) bool, which of these chunks there have been.
            rotary: (N, 2, D/h) rotary place of this chunk.

        Returns:
            cis-token (N, D), and keys and values (N, 2L, h, D/h) of this summary, in case it is the last of its chunk.
        """
        # 3.2: the chunk in progress is one token; keys and values of whole chunks never change.
        x, made = summary[:, None], []
        turned, view = rotary.transpose(0, 1)[:, :, None, None], seen[:, None, None]
        for layer, keys, values in zip(self._layers(), past[::2], past[1::2], strict=True):
            own = layer.project(x, turned)
            x = layer(x, own, (keys, values), view)
            made += [part[:, :, 0] for part in own[1:]]
        return self.norm(x)[:, 0], torch.stack(made, dim=1)


# --- Conversation states understanding (3.3) --------------------------------------------------------------------------
#
# The module finds which of seven states the agent is in, and a feature of that state. Voice activity alone has four
# patterns; the state that a pattern means depends on the conversation (figure 3):
#
#     agent    user     states
#     speaks   silent   speaking
#     speaks   speaks   receiving feedback, interrupted
#     silent   speaks   listening, giving feedback
#     silent   silent   thinking (its own pause), waiting (the other's)
#
# The figure itself is missing in the text that we have; giving feedback by a word, not by a nod, is speech of both.
# The paper's stream continues from its most probable state. Ours, with events: it draws states and their durations
# (`stream.draw_sojourn`), and visible feedback (a nod, a smile) is a separate state.


class StateUnderstanding(nn.Module):
    """Cross attention of the previous state over voice activity and cis-token -> the state feature and the state.

    With events its states are `EVENT_STATES`, and it also has statistics of the data: `durations` (7, 33), quantiles of
    the duration of each of `STATES` in frames, and `possible` (2, 2, 7), 1 for the states that occur while agent and
    user are silent or speak.
    """

    def __init__(self, settings: config.Arig) -> None:
        super().__init__()
        width, states = settings.width, len(settings.states)
        if settings.events:
            self.durations = nn.Buffer(torch.ones(len(STATES), QUANTILES))
            self.possible = nn.Buffer(torch.ones(2, 2, len(STATES)))
        self.previous = nn.Embedding(states, width)
        self.voices = nn.Parameter(torch.randn(2, 2, width) * 0.02)  # track, silent or speaking
        self.look = CrossAttention(width, settings.feedforward, settings.heads, slots=3)
        self.norm = nn.LayerNorm(width)
        self.classify = nn.Linear(width, states)

    def condition(self, cis: Tensor, voiced: Tensor) -> Tensor:
        """Return the state condition (N, 3, 2D) of cis (N, D) and voiced (N, 2): agent now, user one frame before."""
        # 3.3: C^s_T, the voices of both and the cis-token.
        told = torch.where(voiced[..., None], self.voices[:, 1], self.voices[:, 0])  # (N, 2, D)
        return self.look.keys(torch.cat([told, cis[:, None]], dim=1))

    def forward(self, keys: Tensor, previous: Tensor) -> tuple[Tensor, Tensor]:
        """Return state feature (N, D) and logits (N, S) of `condition` (N, 3, 2D) and previous states (N,)."""
        feature = self.norm(self.look(self.previous(previous), keys))  # s_(T-1) is the query, its condition the keys
        return feature, self.classify(feature)

    @torch.no_grad()
    def follow(self, keys: Tensor, dyads: int) -> Tensor:
        """Return the state before each frame, (B, T), where every frame continues from the most probable state.

        `keys`: (B * T, 3, 2D) `condition` of the frames of B dyads.
        """
        # The state after each possible state, of all frames at once; then one frame after the other only looks it up.
        every = torch.arange(self.classify.out_features, device=keys.device)
        after = torch.stack([self(keys, state.expand(len(keys)))[1].argmax(-1) for state in every], 1)
        states = [torch.full((dyads, 1), FIRST, device=keys.device)]
        for frame in after.view(dyads, -1, len(every)).unbind(1):
            states.append(frame.gather(1, states[-1]))
        return torch.cat(states[:-1], 1)


# --- Progressive motion prediction (3.4) ------------------------------------------------------------------------------
#
# Coarse motion from sound, then fine motion from context and state, then continuity. The result z conditions the
# sampler of the final motion (`sampler`).


class Progressive(nn.Module):
    """Three cross attentions: over the agent's last sounds, (cis-token, state, current sound), and its last motions.

    Ours: the second one has one more token, the events.
    """

    def __init__(self, settings: config.Arig) -> None:
        super().__init__()
        sizes = settings.width, settings.feedforward, settings.heads
        self.coarse = CrossAttention(*sizes, settings.sound_frames)
        self.fine = CrossAttention(*sizes, 2 + settings.state_guidance + settings.events)
        self.temporal = CrossAttention(*sizes, settings.motion_frames)
        self.norm = nn.LayerNorm(settings.width)

    def refine(
        self,
        outline: Tensor,
        motion_keys: Tensor,
        sound: Tensor,
        cis: Tensor,
        state: Tensor | None,
        events: Tensor | None,
    ) -> Tensor:
        """Return z (N, D) of a coarse motion.

        Args:
            outline: (N, D) coarse motion: `coarse` of the embedded motion of the frame before, over the keys of the
                agent's sounds; the newest sound is that of the frame itself.
            motion_keys: (N, 5, 2D) `temporal.keys` of the agent's motions before the frame.
            sound: (N, D) embedded sound of the agent in the frame itself.
            cis: (N, D) cis-token.
            state: (N, D) state feature, or None without state guidance.
            events: (N, D) embedded control rows, or None without events.
        """
        # A.1: cis-token, state feature and A^a_T condition the fine motion; then five motions, for continuity.
        tokens = [token for token in (cis, state, sound, events) if token is not None]
        x = self.fine(outline, self.fine.keys(torch.stack(tokens, dim=1)))
        out: Tensor = self.norm(self.temporal(x, motion_keys))
        return out
