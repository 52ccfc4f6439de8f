"""Codes of keyframes (IV-B4): motion of one frame -> one code per channel group -> motion of that frame.

Two kinds of codebook with one interface. Finite scalar quantization (Mentzer et al. 2023, arXiv:2309.15505): a code is
a point on a small fixed grid; dimension d of group g has L[g, d] levels, spread evenly over -1..1, and the index of a
code counts the levels in mixed radix, first dimension fastest. Vector quantization (van den Oord et al. 2017,
arXiv:1711.00937): a code is the nearest of a list of learned vectors, each the running mean of its keyframes.

B batch, T frames, C channels, G groups, D dimensions of a code, V codes of the largest group.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config

DECAY = 0.99  # decay of a vector's running mean, per step
DEAD = 0.05  # a vector used less than this share of the average starts again at a keyframe
HIDDEN = 48  # width of the network of one group


class Grid(nn.Module):
    """The fixed codebook of finite scalar quantization, which has no parameters; `levels` (G, D)."""

    def __init__(self, levels: Sequence[Sequence[int]]) -> None:
        super().__init__()
        self.levels = nn.Buffer(torch.tensor(levels, dtype=torch.float32), persistent=False)
        below = torch.cat([torch.ones_like(self.levels[:, :1]), self.levels[:, :-1]], dim=-1)
        self.radix = nn.Buffer(below.cumprod(-1).long(), persistent=False)  # (G, D)
        digits = torch.arange(max(map(math.prod, levels)))[:, None, None] // self.radix % self.levels.long()
        table = (digits / (self.levels - 1) * 2 - 1).transpose(0, 1)  # (G, V, D)
        self.table = nn.Buffer(table.flatten(0, 1), persistent=False)
        self.first = nn.Buffer(torch.arange(len(levels)) * len(digits), persistent=False)  # row of each group
        self.dims = len(levels[0])

    def nearest(self, latent: Tensor) -> Tensor:
        """Return the grid point nearest to tanh(latent), (..., G, D) in -1..1; the gradient skips the rounding."""
        # FSQ, section 3.1: bound, then round. Ours: tanh straight to -1..1, and an even number of levels needs no
        # offset.
        bounded = torch.tanh(latent)  # -1..1
        position = (bounded + 1) / 2 * (self.levels - 1)  # 0..L - 1
        code = torch.round(position) / (self.levels - 1) * 2 - 1
        return bounded + (code - bounded).detach()  # straight through: d code / d bounded = 1

    def indices(self, codes: Tensor) -> Tensor:
        """Return the indices (..., G), 0 to prod(levels) - 1, of codes (..., G, D)."""
        return (torch.round((codes + 1) / 2 * (self.levels - 1)).long() * self.radix).sum(-1)

    def codes(self, indices: Tensor) -> Tensor:
        """Return the codes (..., G, D) of indices (..., G)."""
        return F.embedding(indices + self.first, self.table)

    def commitment(self, latent: Tensor, mask: Tensor) -> Tensor:
        """Return 0 for the stop-gradient terms of equation (13): a grid cannot move, and rounding errors are small."""
        return latent.new_zeros(())


class Codebook(nn.Module):
    """V learned vectors per group. Only `learn`, which training calls, moves them; encoding never changes them."""

    def __init__(self, sizes: Sequence[int], dims: int) -> None:
        super().__init__()
        self.dims = dims
        self.vectors = nn.Buffer(torch.randn(len(sizes), max(sizes), dims))
        self.counts = nn.Buffer(torch.zeros(len(sizes), max(sizes)))  # keyframes a step, running mean
        self.sizes = nn.Buffer(torch.tensor(sizes), persistent=False)

    def nearest(self, latent: Tensor) -> Tensor:
        """Return the codes (..., G, D) nearest to a latent; the gradient passes to the latent alone."""
        code = self.codes(self.indices(latent))
        return latent + (code - latent).detach()

    @torch.no_grad()
    def indices(self, codes: Tensor) -> Tensor:
        """Return the indices (..., G) of the vectors nearest to `codes` (..., G, D), which may be any vectors."""
        # argmin |z - c|^2 of equation (3) = argmin |c|^2 - 2 <z, c>
        flat = codes.detach().float().flatten(0, -3).transpose(0, 1)  # (G, N, D)
        with torch.autocast(codes.device.type, enabled=False):  # nearest is a matter of small differences
            distance = self.vectors.square().sum(-1)[:, None] - 2 * flat @ self.vectors.transpose(1, 2)
        absent = torch.arange(self.vectors.shape[1], device=codes.device) >= self.sizes[:, None]
        return distance.masked_fill(absent[:, None], torch.inf).argmin(-1).transpose(0, 1).view(codes.shape[:-1])

    def codes(self, indices: Tensor) -> Tensor:
        """Return the codes (..., G, D) of indices (..., G)."""
        return self.vectors[torch.arange(len(self.sizes), device=indices.device), indices]

    def commitment(self, latent: Tensor, mask: Tensor) -> Tensor:
        """Return ||sg[z_q] - E(z)||^2 of equation (13) at keyframes; `learn` minimises ||sg[E(z)] - z_q||^2."""
        # sg stops gradients: only the encoder moves toward its vectors here.
        away = (latent - self.codes(self.indices(latent)).detach()).square().mean(-1)
        return (away * mask).sum() / mask.sum().clamp(min=1.0)

    @torch.no_grad()
    def learn(self, latent: Tensor, mask: Tensor, generator: torch.Generator) -> None:
        """Move every vector toward the mean of the keyframes it stands for, and idle ones to a keyframe.

        Args:
            latent: (B, T, G, D) encoded motion.
            mask: (B, T, G); only keyframes are learned from (IV-B4).
            generator: draws, on the CPU, the keyframes at which idle vectors start again.
        """
        # The term ||sg[E(z)] - z_q||^2 of equation (13), minimised exactly: each vector is a running mean.
        groups, most = self.counts.shape
        key = (mask > 0.5).flatten(0, 1)  # (N, G)
        flat = latent.float().flatten(0, 1)
        chosen = (F.one_hot(self.indices(latent).flatten(0, 1), most) * key[..., None]).float()  # (N, G, V)
        now = chosen.sum(0)
        with torch.autocast(latent.device.type, enabled=False):
            mean = torch.einsum("ngv,ngd->gvd", chosen, flat) / now.clamp(min=1.0)[..., None]
        # Running sums of keyframes and of their vectors, as in VQ-VAE-2: c = sums / counts.
        counts = DECAY * self.counts + (1 - DECAY) * now
        share = ((1 - DECAY) * now / counts.clamp(min=1e-9))[..., None]  # weight of this step in the running mean
        self.vectors.lerp_(mean, share.clamp(max=1.0))
        for group in range(groups):
            seen = flat[key[:, group], group]
            average = counts[group].sum() / self.sizes[group]
            idle = (counts[group, : int(self.sizes[group])] < DEAD * average).nonzero()[:, 0]
            if len(seen) == 0 or len(idle) == 0:
                continue
            drawn = torch.randint(len(seen), (len(idle),), generator=generator).to(seen.device)
            self.vectors[group, idle] = seen[drawn]
            counts[group, idle] = average  # as if it had been used, so that it is not idle again at once
        self.counts.copy_(counts)


class GroupMLP(nn.Module):
    """One two-layer network per group, all groups at once; a group does not see the input of another."""

    def __init__(self, groups: int, inputs: int, outputs: int) -> None:
        super().__init__()
        self.w1 = nn.Parameter(torch.randn(groups, inputs, HIDDEN) / math.sqrt(inputs))
        self.b1 = nn.Parameter(torch.zeros(groups, HIDDEN))
        self.w2 = nn.Parameter(torch.randn(groups, HIDDEN, outputs) / math.sqrt(HIDDEN))
        self.b2 = nn.Parameter(torch.zeros(groups, outputs))

    def forward(self, x: Tensor) -> Tensor:
        """Return (B, T, G, outputs) of (B, T, G, inputs)."""
        b, t, g, _ = x.shape
        rows = x.permute(2, 0, 1, 3).flatten(1, 2)  # (G, B * T, inputs): a product of matrices for each group
        y = F.gelu(rows @ self.w1 + self.b1[:, None]) @ self.w2 + self.b2[:, None]
        return y.view(g, b, t, -1).permute(1, 2, 0, 3)


class Quantizer(nn.Module):
    """Encoder, codebook and decoder of single frames: E, D and VQ of equation (3). Frames and groups are independent.

    Ours: channels are cut into groups, each with separate keyframes and codes; the paper has one code per frame.
    """

    def __init__(self, member: Tensor, settings: config.Sfms) -> None:
        """Create a quantizer for the groups of the settings: `member` (G, C), 1 where a channel belongs to a group.

        A channel of no group is not drawn: it stays 0.
        """
        super().__init__()
        groups, learned = list(settings.groups.values()), settings.quantizer == "vq"
        own = [row.nonzero()[:, 0] for row in member]
        most = max(map(len, own))
        self.member = nn.Buffer(member, persistent=False)
        self.drawn = nn.Buffer(member.amax(0), persistent=False)
        # Each group's channels are in slots 0..: with a group per channel, only 1/C of a full (G, C) matrix is not 0.
        slots = torch.stack([F.pad(channels, (0, most - len(channels))) for channels in own])
        filled = torch.stack([(torch.arange(most) < len(channels)).float() for channels in own])
        self.slots, self.filled = nn.Buffer(slots, persistent=False), nn.Buffer(filled, persistent=False)  # (G, most)
        slot = ((member.cumsum(-1) * member).amax(0).long() - 1).clamp(min=0)
        self.owner = nn.Buffer(member.argmax(0), persistent=False)  # (C,) group of a channel
        self.place = nn.Buffer(self.owner * most + slot, persistent=False)  # (C,) place of a channel among all slots
        self.codebook: Grid | Codebook = (
            Codebook([group.codes for group in groups], settings.code_dims)
            if learned
            else Grid([group.levels for group in groups])
        )
        self.dims, self.squashed = self.codebook.dims, settings.squashed and learned
        self.encoder = GroupMLP(len(groups), most, self.dims)
        self.decoder = GroupMLP(len(groups), self.dims, most)

    def latent(self, motion: Tensor) -> Tensor:
        """Return latents (B, T, G, D), not yet codes, of standardised motion (B, T, C)."""
        # E of equation (3), of every frame: keyframes are chosen separately.
        out: Tensor = self.encoder(motion[..., self.slots] * self.filled)
        return torch.tanh(out) if self.squashed else out

    def encode(self, motion: Tensor) -> Tensor:
        """Return codes (B, T, G, D) of the codebook of standardised motion (B, T, C)."""
        return self.codebook.nearest(self.latent(motion))

    def decode(self, codes: Tensor) -> Tensor:
        """Return motion (B, T, C) of codes (B, T, G, D): each channel from the code of its group."""
        return self.by_channel(self.decoder(codes))

    def by_channel(self, slots: Tensor) -> Tensor:
        """Return the output of `decoder`, (..., G, slots of a group), in the order of channels (..., C)."""
        return slots.flatten(-2).index_select(-1, self.place) * self.drawn
