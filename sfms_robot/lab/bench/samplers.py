"""What a shorter or noiseless way of drawing motion costs in quality: ARIG's sampler against 50 steps of equation (4).

For the same conditions, many draws of each sampler: how far their mean and spread lie from those of the 50 steps, as a
share of the motion's standard deviation. The same 50 steps drawn anew show how much of that is chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from sfms_robot.frames import SpeakerFrame

if TYPE_CHECKING:
    from sfms_robot.listeners.arig.stream import ArigListener

REFERENCE_STEPS: Final = 50
WAYS: Final = (
    ("ddpm", 50),
    ("ddpm", 15),
    ("ddpm", 12),
    ("ddpm", 10),
    ("ddpm", 8),
    ("ddim", 15),
    ("ddim", 8),
    ("ddim", 4),
)
DRAWS: Final = 32
EVERY: Final = 4  # frames between the conditions that are looked at


def samplers(listener: ArigListener, speaker: Sequence[SpeakerFrame]) -> dict[str, float]:
    """Quality lost by each way of sampling (`ddim-8`: DDIM, 8 steps), on what the listener makes of `speaker`."""
    import torch

    from sfms_robot.listeners.arig.sampler import Denoiser

    head = listener.model.head
    if not isinstance(head, Denoiser):
        return {}
    memory, conditions = listener.start(0), []
    for index, frame in enumerate(speaker):
        if index % EVERY == EVERY - 1:
            conditions.append(listener.condition(frame, memory)[0])
        _, memory = listener.step(frame, memory)
    told = torch.from_numpy(np.concatenate(conditions)).repeat_interleave(DRAWS, dim=0)

    @torch.inference_mode()
    def drawn(sampler: str, steps: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
        plain = {"temperature": (1.0, 1.0), "temperatures": {}}
        settings = head.settings.model_copy(update={"sampler": sampler, "steps": steps} | plain)
        other = Denoiser(listener.settings.channels, head.condition.in_features, settings)
        other.load_state_dict(head.state_dict())
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(len(told), steps, listener.model.channels, generator=generator)
        motion = other.sample(told, noise).view(len(conditions), DRAWS, -1)
        return motion.mean(1), motion.std(1)

    mean, spread = drawn("ddpm", REFERENCE_STEPS, seed=1)
    lost = {}
    for sampler, steps in WAYS:
        of_mean, of_spread = drawn(sampler, steps, seed=2)
        squared = (of_mean - mean).square().mean() + (of_spread - spread).square().mean()
        lost[f"{sampler}-{steps}"] = float(squared.sqrt())  # standardised motion: its deviation is 1
    return lost
