"""The training loop both phases share: one loss function, any number of optimizers, cosine rates, a progress bar."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn

from sfms_robot.errors import ModelError

WARM_UP_STEPS = 100
SMOOTHING = 0.98  # of the loss that is shown


def optimizer(parameters: Iterable[nn.Parameter], rate: float, decay: float) -> torch.optim.Optimizer:
    """AdamW with the paper's betas (V-A)."""
    return torch.optim.AdamW(parameters, lr=rate, betas=(0.9, 0.98), weight_decay=decay)


def fit(
    title: str,
    steps: int,
    loss_of: Callable[[int], Tensor],
    optimizers: Sequence[torch.optim.Optimizer],
    clip_norm: float,
    frames_per_step: int,
    each_step: Callable[[int, float], None] | None = None,
) -> float:
    """Run `steps` steps of `loss_of(step)`; returns the smoothed loss at the end. `each_step(step, loss)` looks on.

    Raises ModelError as soon as a loss or gradient is not finite. KeyboardInterrupt passes through: the caller saves.
    """
    base = [optimizer.param_groups[0]["lr"] for optimizer in optimizers]
    smooth, speed = math.nan, 0.0
    with _progress() as progress:
        task = progress.add_task(title, total=steps, loss=math.nan, speed=0.0)
        for step in range(steps):
            for one, rate in zip(optimizers, base, strict=True):
                one.param_groups[0]["lr"] = rate * _schedule(step, steps)
                one.zero_grad(set_to_none=True)
            loss = loss_of(step)
            loss.backward()  # type: ignore[no-untyped-call]
            norms = [_clip(one, clip_norm) for one in optimizers]
            value = loss.item()
            if not math.isfinite(value) or not all(map(math.isfinite, norms)):
                raise ModelError(f"{title}: loss {value:g}, gradient norm {max(norms):g} at step {step}: not finite")
            for one in optimizers:
                one.step()
            smooth = value if step == 0 else SMOOTHING * smooth + (1 - SMOOTHING) * value
            speed = frames_per_step * (progress.tasks[0].speed or 0.0)
            if each_step is not None:
                each_step(step, value)
            progress.update(task, advance=1, loss=smooth, speed=speed)
    return smooth


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("loss {task.fields[loss]:.4f}  {task.fields[speed]:,.0f} frames/s"),
        TimeRemainingColumn(),
        console=Console(stderr=True),  # stdout is for figures
    )


def _schedule(step: int, steps: int) -> float:
    """Linear warm-up, then cosine to zero."""
    warm = min(WARM_UP_STEPS, max(1, steps // 10))
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1 + math.cos(math.pi * (step - warm) / max(1, steps - warm)))


def _clip(one: torch.optim.Optimizer, norm: float) -> float:
    parameters = [p for group in one.param_groups for p in group["params"] if p.grad is not None]
    return float(nn.utils.clip_grad_norm_(parameters, norm)) if parameters else 0.0
