"""The sampler of motion: a small MLP that removes noise from one frame, conditioned on z (3.4, figure 9, A.2).

Training: noise prediction, equation (3). Sampling: equation (4) over evenly spread noise levels (the spacing of
Nichol and Dhariwal 2021, as the paper trains and samples with different step counts), or DDIM (Song et al. 2021).
The sampler draws no random numbers: noise is an argument, so one seed leads to one motion wherever it is drawn.

Ours: the schedule is a cosine that ends at a signal amplitude of 0.03 instead of 0, because at 0 a prediction of the
noise has no information about motion, and the first of 15 steps would be wasted.

N samples, C channels, D width of the condition, W width of the blocks, K steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.listeners.layers import Modulation, Tensors, mlp, modulated, sinusoidal, weighted_mean
from sfms_robot.listeners.sfms.quantizer import Grid

Parts = Sequence[Tensor]  # shift, scale, gate of each block, then shift and scale before the last layer
BEYOND_ALL = 1e4  # deviations: the range of estimates without `clamp`, which 16 bits hold
COSINE_END = 0.98  # share of the quarter circle that the schedule covers
FINEST = 0.01  # deviations of noise at the first logarithmic level: most motion from frame to frame is larger


def noise_levels(settings: config.Diffusion) -> Tensor:
    """Return alpha-bar of every noise level (levels,), float64, falling from nearly 1."""
    # Nichol and Dhariwal 2021: ab = cos^2 of an angle that grows evenly with the level.
    share = torch.arange(1, settings.train_steps + 1, dtype=torch.float64) / settings.train_steps
    if settings.schedule == "cosine":
        return torch.cos(share * COSINE_END * math.pi / 2) ** 2
    # Ours: noise over motion n = sqrt((1 - ab) / ab) grows by the same factor each level, up to the end of the cosine.
    most = math.tan(COSINE_END * math.pi / 2)
    return 1 / (1 + (FINEST * (most / FINEST) ** share) ** 2)


class Denoiser(nn.Module):
    """epsilon_theta(M_t | t, z): MLP blocks modulated by noise level and condition (figure 9)."""

    def __init__(self, names: Sequence[str], condition: int, settings: config.Diffusion) -> None:
        super().__init__()
        channels, width = len(names), settings.width
        self.settings = settings
        most = 8.0 if settings.clamp else BEYOND_ALL
        self.low = nn.Buffer(torch.full((channels,), -most))  # range of standardised motion in the data
        self.high = nn.Buffer(torch.full((channels,), most))
        self.alpha_bar = nn.Buffer(noise_levels(settings).float(), persistent=False)
        self.places = nn.Buffer(sinusoidal(settings.train_steps, width), persistent=False)  # places of noise levels
        # Figure 9: noise level and z, projected to the width of the blocks (A.2), modulate three MLP blocks by adaLN.
        self.time = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.condition = nn.Linear(condition, width)
        self.modulation = Modulation(width, "scg" * settings.blocks + "sc")  # modulation of every block in one product
        self.enter = nn.Linear(channels, width)
        self.up = nn.ModuleList(nn.Linear(width, width) for _ in range(settings.blocks))
        self.down = nn.ModuleList(nn.Linear(width, width) for _ in range(settings.blocks))
        self.leave = nn.Linear(width, channels)
        self.levels = torch.linspace(0, settings.train_steps - 1, settings.steps).round().long().tolist()
        self.level_places = nn.Buffer(self.places[self.levels], persistent=False)
        self.table = steps_of(self.levels, settings)
        # sigma of each step times the temperature of each channel, (K, C); the first row is the initial noise. Ours:
        # early noise decides what happens, late noise is jitter, so the temperature may change from first to last step.
        first, last = torch.tensor([settings.temperature_of(name) for name in names]).unbind(-1)
        temperature = first + torch.linspace(0, 1, max(1, settings.steps - 1))[:, None] * (last - first)  # (K - 1, C)
        spread = torch.tensor([step.spread for step in self.table[:-1]])[:, None]
        spreads = torch.cat([torch.ones(1, channels), spread * temperature[: len(spread)]])
        self.spreads = nn.Buffer(spreads, persistent=False)

    def level(self, t: Tensor) -> Tensor:
        """Return embeddings (K, W) of noise levels (K,): constant if the weights are."""
        out: Tensor = self.time(self.places[t])
        return out

    def modulate(self, z: Tensor, level: Tensor) -> Tensors:
        """Return shift, scale and gate of every block, (N, W) each, of z (N, D) and level embeddings (N, W)."""
        parts: Tensors = self.modulation(F.silu(self.condition(z) + level))
        return parts

    def forward(self, noisy: Tensor, parts: Parts) -> Tensor:
        """Return the noise (N, C) in noisy (N, C); `parts`: `modulate` of its level and condition."""
        x = self.enter(noisy)
        for block, (up, down) in enumerate(zip(self.up, self.down, strict=True)):
            shift, scale, gate = parts[3 * block : 3 * block + 3]
            x = torch.addcmul(x, gate, down(F.silu(up(modulated(x, shift, scale)))))
        out: Tensor = self.leave(modulated(x, parts[-2], parts[-1]))
        return out

    def loss(
        self, z: Tensor, motion: Tensor, generator: torch.Generator | None = None, weights: Tensor | None = None
    ) -> Tensor:
        """Return equation (3), the squared error of the noise, per sample (N,).

        Args:
            z: (N, D) conditions.
            motion: (N, C) standardised.
            generator: draws levels and noise, on its own device; None: torch's generator on the device of the motion.
            weights: (C,) of the channels, which add up to 1. Ours, because by number most channels are of the mouth.
        """
        n = len(motion)
        place = motion.device if generator is None else generator.device
        t = torch.randint(0, self.settings.train_steps, (n,), generator=generator, device=place).to(motion.device)
        noise = torch.randn(motion.shape, generator=generator, device=place).to(motion.device)
        alpha_bar = self.alpha_bar[t][:, None]
        # M_t = sqrt(ab_t) M_0 + sqrt(1 - ab_t) eps
        noisy = alpha_bar.sqrt() * motion + (1 - alpha_bar).sqrt() * noise
        # eps_theta(M_t | t, z)
        return weighted_mean((noise - self(noisy, self.modulate(z, self.level(t)))).square(), weights)

    def sample(self, z: Tensor, noise: Tensor) -> Tensor:
        """Return standardised motion (N, C) of conditions, equation (4).

        Args:
            z: (N, D) conditions.
            noise: (N, K, C) standard normal: the start, then the noise added after each step but the last.
        """
        k = noise.shape[1]
        if k != len(self.levels):
            raise ValueError(f"noise for {k} steps, the sampler takes {len(self.levels)}")
        levels = self.time(self.level_places)  # (K, W)
        # Ours, for speed: the modulation of all steps in one product, the noisiest last.
        parts = self.modulation.linear(F.silu(self.condition(z)[:, None] + levels)).flatten(1)
        kinds = self.modulation.parts
        parts = parts.chunk(k * kinds, dim=-1)
        x, *added = (noise * self.spreads).flatten(1).chunk(k, dim=-1)
        for index, step in enumerate(self.table):
            level = kinds * (k - 1 - index)
            found = self(x, parts[level : level + kinds])
            # Ours: the clean motion is clamped to the range of the data; (4) does not do that (`clamp: false`).
            clean = found.mul_(step.denoise[1]).add_(x, alpha=step.denoise[0]).clamp_(self.low, self.high)
            x = clean.mul_(step.motion).add_(x, alpha=step.stay)  # the mean of M_s, `steps_of`
            if step.spread:  # sigma_t eps
                x.add_(added[index])
        return x


@dataclass(frozen=True)
class Step:
    """Coefficients of one step from level t to the next lower level s.

    Attributes:
        denoise: M_0 = denoise[0] M_t + denoise[1] eps.
        motion, stay: M_s = motion M_0 + stay M_t; DDIM adds no noise to that.
        spread: sigma_t, the factor of the added noise (times the temperature); 0 for the last step.
    """

    denoise: tuple[float, float]
    motion: float
    stay: float
    spread: float


def steps_of(levels: Sequence[int], settings: config.Diffusion) -> list[Step]:
    """Return the steps over ascending `levels`, noisiest first.

    Equation (4) written through the clean motion M_0 = (M_t - sqrt(1 - ab_t) eps) / sqrt(ab_t): its mean is
    sqrt(ab_s) (1 - alpha) / (1 - ab_t) M_0 + sqrt(alpha) (1 - ab_s) / (1 - ab_t) M_t, alpha = ab_t / ab_s. If M_0 is
    not clamped, both forms are the same. sigma^2 = (1 - alpha) (1 - ab_s) / (1 - ab_t).
    DDIM keeps the noise: M_s = sqrt(ab_s) M_0 + stay (M_t - sqrt(ab_t) M_0), stay^2 = (1 - ab_s) / (1 - ab_t).
    """
    alpha_bars = noise_levels(settings)[list(levels)].tolist()
    out = []
    for index in reversed(range(len(alpha_bars))):
        now, after = alpha_bars[index], alpha_bars[index - 1] if index else 1.0
        alpha = now / after
        denoise = (now**-0.5, -(((1 - now) / now) ** 0.5))
        if settings.sampler == "ddim":
            stay = ((1 - after) / (1 - now)) ** 0.5
            out.append(Step(denoise, after**0.5 - stay * now**0.5, stay, 0.0))
        else:
            motion, stay = after**0.5 * (1 - alpha) / (1 - now), alpha**0.5 * (1 - after) / (1 - now)
            spread = ((1 - alpha) * (1 - after) / (1 - now)) ** 0.5
            out.append(Step(denoise, motion, stay, spread))
    return out


# --- Codes of motion (B.1, table 4) -----------------------------------------------------------------------------------
#
# The discrete ablation: motion as one of N codes, drawn from a softmax, in place of diffusion. The codebook is that
# of finite scalar quantization (`listeners.sfms.quantizer`), one for the whole face. It is learned together with the
# model, by its own loss, the error of motion that went through it; no gradient of the softmax reaches it.


class CodeHead(nn.Module):
    """A sampler with the interface of `Denoiser`: a loss, and a sample from given noise."""

    def __init__(self, channels: int, width: int, condition: int, levels: tuple[int, ...]) -> None:
        super().__init__()
        self.grid = Grid([levels])
        self.encode = mlp(channels, width, len(levels))
        self.decode = mlp(len(levels), width, channels)
        self.classify = nn.Linear(condition, math.prod(levels))

    def loss(
        self, z: Tensor, motion: Tensor, generator: torch.Generator | None = None, weights: Tensor | None = None
    ) -> Tensor:
        """Return cross-entropy of the code plus squared error of its motion, (N,); arguments as in `Denoiser.loss`."""
        # B.1: the softmax learns the code; encoder and decoder learn from the motion that the code decodes to.
        code = self.grid.nearest(self.encode(motion)[:, None])  # (N, 1, dims)
        rebuilt = weighted_mean((self.decode(code[:, 0]) - motion).square(), weights)
        wrong: Tensor = F.cross_entropy(self.classify(z), self.grid.indices(code.detach())[:, 0], reduction="none")
        return rebuilt + wrong

    def sample(self, z: Tensor, noise: Tensor) -> Tensor:
        """Return the motion (N, C) of a code drawn by the softmax; z (N, D), noise (N, 1, 1) standard normal."""
        # Inverse transform: the code at which the cumulated softmax passes a uniform number.
        share = torch.special.ndtr(noise[:, 0].double())  # standard normal -> uniform
        mass = torch.softmax(self.classify(z).double(), dim=-1).cumsum(-1)
        index = (mass <= share * mass[:, -1:]).sum(-1, keepdim=True).clamp(max=mass.shape[-1] - 1)
        out: Tensor = self.decode(self.grid.codes(index)[:, 0])
        return out
