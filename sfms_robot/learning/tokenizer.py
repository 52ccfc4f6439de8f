"""Phase 1 (IV-D): keyframe scores, quantizer and inpainter, trained together by what they reconstruct."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.learning.corpus import Corpus, fit_scales, gather, place_all, windows
from sfms_robot.learning.datasets import clips
from sfms_robot.learning.loop import fit, optimizer
from sfms_robot.learning.losses import masking, reconstruction
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import SfmsModel, Tokenizer
from sfms_robot.listeners.sfms.placement import Strategy, place, place_learned
from sfms_robot.listeners.space import MotionSpace

WEIGHTS = "tokenizer.safetensors"
DRAWS = 2  # placements tried per window; the better one is the target of the masking loss


def train_tokenizer(
    settings: config.Training, data: Path, out: Path, each_step: Callable[[int, float], None] | None = None
) -> dict[str, float]:
    """Train on `data`/train and write `out`/tokenizer.safetensors; its predictor is as good as new.

    Returns the final loss and the held-out error. Ctrl-C saves what there is and goes on upward.
    `each_step(step, loss)` is called after every step.
    """
    torch.manual_seed(settings.seed)
    corpus = gather(clips.load(data / "train"), settings.listener.window_frames, MotionSpace.of(settings.listener))
    held_out = gather(
        clips.load(data / "validation"), settings.listener.window_frames, MotionSpace.of(settings.listener)
    )
    model = SfmsModel(settings.listener)
    fit_scales(model, corpus, settings.listener.channels)
    model.train()
    try:
        loss = _fit(model, corpus, settings.tokenizer, each_step)
    finally:
        checkpoint.save_config(out, settings.listener)
        checkpoint.save_weights(out / WEIGHTS, model)
    return {"loss": loss, "mse": reconstruction_error(model, held_out)}


def _fit(
    model: SfmsModel,
    corpus: Corpus,
    settings: config.TokenizerTraining,
    each_step: Callable[[int, float], None] | None,
) -> float:
    tokenizer = model.tokenizer
    motion = model.standardise(corpus.motion)
    starts = corpus.starts(tokenizer.window)
    # Exact masks come half from long stretches, as the predictor will see them, and half from single windows.
    long_masks = place_all(tokenizer, motion, corpus.lengths) if tokenizer.strategy == "exact" else None
    rest = [*tokenizer.quantizer.parameters(), *tokenizer.inpainter.parameters()]
    optimizers = [optimizer(rest, settings.learning_rate, settings.weight_decay)]
    if tokenizer.score is not None:  # two optimizers: the scores must not run ahead of the codes (IV-D2)
        optimizers.append(optimizer(tokenizer.score.parameters(), settings.score_learning_rate, settings.weight_decay))

    def loss_of(step: int) -> Tensor:
        chosen = starts[torch.randint(len(starts), (settings.batch,))]
        batch = windows(motion, chosen, tokenizer.window)
        if tokenizer.score is not None:
            hot, cold = settings.temperature
            temperature = hot * (cold / hot) ** (step / max(1, settings.steps - 1))
            return learned_loss(tokenizer, batch, temperature, settings)
        if long_masks is None:
            return _loss(tokenizer, batch, tokenizer.place(batch), settings.velocity_loss)[0]
        half = settings.batch // 2
        near = windows(long_masks, chosen[:half], tokenizer.window)
        mask = torch.cat([near, tokenizer.place(batch[half:])])
        return _loss(tokenizer, batch, mask, settings.velocity_loss)[0]

    frames = settings.batch * tokenizer.window
    return fit("tokenizer", settings.steps, loss_of, optimizers, settings.clip_norm, frames, each_step)


def _loss(tokenizer: Tokenizer, batch: Tensor, mask: Tensor, velocity: float = 0.0) -> tuple[Tensor, Tensor]:
    """Loss (13) without its masking term, and the squared error of each window (B,)."""
    codes = tokenizer.quantizer.encode(batch)
    restored = tokenizer.inpaint(codes, mask)
    at_keyframes = tokenizer.quantizer.decode(codes)
    loss = reconstruction(batch, restored, at_keyframes, mask, tokenizer.member, velocity)
    return loss, ((restored - batch) ** 2).mean((1, 2)).detach()


def learned_loss(tokenizer: Tokenizer, batch: Tensor, temperature: float, settings: config.TokenizerTraining) -> Tensor:
    """Loss (13) with sampled placements; the best of `DRAWS` is I* of equation (7)."""
    if tokenizer.score is None:
        raise ValueError("this tokenizer does not learn its placement")
    scores = tokenizer.score(batch)
    draws = [place_learned(scores, tokenizer.keyframes, temperature) for _ in range(DRAWS)]
    scored = [_loss(tokenizer, batch, mask, settings.velocity_loss) for mask, _ in draws]
    best = torch.stack([error for _, error in scored]).argmin(0)  # (B,)
    masks = torch.stack([mask for mask, _ in draws])
    target = masks[best, torch.arange(len(batch))]
    motion = torch.stack([loss for loss, _ in scored]).mean()
    return motion + settings.mask_loss * torch.stack([masking(relaxed, target) for _, relaxed in draws]).mean()


@torch.no_grad()
def reconstruction_error(
    model: SfmsModel, corpus: Corpus, strategy: Strategy | None = None, keyframes: Sequence[int] | None = None
) -> float:
    """Mean squared error on consecutive windows, in standardised units; another placement may be asked for."""
    tokenizer = model.tokenizer
    motion = model.standardise(corpus.motion)
    chosen = strategy or tokenizer.strategy
    score: Callable[[Tensor], Tensor] | None = tokenizer.score
    errors = []
    for batch in torch.split(windows(motion, _consecutive(corpus, tokenizer.window), tokenizer.window), 64):
        mask = place(batch, keyframes or tokenizer.keyframes, chosen, member=tokenizer.member, score=score)
        errors.append(_loss(tokenizer, batch, mask)[1])
    return float(torch.cat(errors).mean())


def _consecutive(corpus: Corpus, window: int) -> Tensor:
    firsts, at = [], 0
    for length in corpus.lengths:
        firsts.append(torch.arange(at, at + length - window + 1, window))
        at += length
    return torch.cat(firsts)
