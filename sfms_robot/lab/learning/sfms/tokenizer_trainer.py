"""Phase 1 (IV-D): keyframe scores, quantizer and inpainter, trained together by what they reconstruct."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.lab.learning.job import Job, LossOf, Run
from sfms_robot.lab.learning.sfms.features import SfmsCorpus, fit_scales, gather
from sfms_robot.lab.learning.sfms.imitation import imitation, lively
from sfms_robot.lab.learning.sfms.losses import masking, reconstruction
from sfms_robot.lab.learning.sfms.masks import batches, teacher
from sfms_robot.lab.learning.training_loop import fit, optimizer
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import SfmsModel, Tokenizer
from sfms_robot.listeners.sfms.placement import ConditionalScore, ScoreNetwork, Strategy, place_learned
from sfms_robot.listeners.sfms.quantizer import Codebook
from sfms_robot.listeners.space import MotionSpace

WEIGHTS = "tokenizer.safetensors"
DRAWS = 2  # placements tried per window; the better one is the target of the masking loss
CHUNK = 32  # windows placed and encoded at a time

log = logging.getLogger(__name__)


def train_tokenizer(
    settings: config.Training,
    data: Path,
    out: Path,
    run: Run = Run(),  # noqa: B008
    order: Order | None = None,
) -> dict[str, Any]:
    """Train on `data`/train and write `out`/tokenizer.safetensors; its predictor is as good as new.

    `order`: of the channels in the files, if not the layout's own (`open_dataset`).

    Returns the figures of the run and the held-out error. Ctrl-C leaves a checkpoint in `out`, from which
    `run.resume` goes on; the weights are written when the run is finished.
    """
    listener, space = settings.listener, MotionSpace.of(settings.listener)
    if listener.quantizer == "vq" and run.group.size * (run.accumulate or 1) > 1:
        raise ConfigError("listener.quantizer = 'vq' moves its codes beside gradients: one process, one piece a step")
    dyads = open_for(space.name, data, "train", order)
    if dyads.fps != FRAME_HZ:
        log.warning(
            "%s has %g frames a second and is learned as it is; streamed, a listener shows %d a second",
            data, dyads.fps, FRAME_HZ,
        )  # fmt: skip
    unseen = open_for(space.name, data, "validation", order)
    corpus, held_out = (
        gather(some, listener.window_frames, space, None, listener, run.staging(split))
        for some, split in ((dyads, "train"), (unseen, "validation"))
    )
    torch.manual_seed(settings.seed)
    model = SfmsModel(listener)
    fit_scales(model, corpus, listener.channels)
    job = tokenizer_job(settings, model, corpus, held_out, run.device)
    outcome = fit(job, out, run)
    if run.group.first:
        checkpoint.save_config(out, listener)
        checkpoint.save_weights(out / WEIGHTS, model)
    return {"mse": reconstruction_error(model, held_out.to(run.device)), **asdict(outcome)}


def tokenizer_job(
    settings: config.Training, model: SfmsModel, corpus: SfmsCorpus, held_out: SfmsCorpus, device: torch.device
) -> Job:
    """Phase 1 as the loop takes it; moves the model to `device`."""
    phase, tokenizer = settings.tokenizer, model.tokenizer
    fingerprint = corpus.fingerprint()
    model.to(device)
    corpus, held_out = corpus.to(device), held_out.to(device)
    motion = model.standardise(corpus.frames.motion.to(model.motion_mean.device))
    return Job(
        name="tokenizer",
        model=model,
        optimizers=optimizers_of(tokenizer, phase),
        loss_of=loss_of_steps(tokenizer, motion, corpus.lengths, phase),
        held_out=_held_out(model, held_out),
        frames_per_step=phase.batch * tokenizer.window,
        phase=phase,
        seed=settings.seed,
        identity={
            "seed": settings.seed,
            "listener": settings.listener.model_dump(mode="json"),
            "tokenizer": phase.identity(),
            "data": fingerprint,
        },
    )


def optimizers_of(tokenizer: Tokenizer, phase: config.TokenizerTraining) -> list[torch.optim.Optimizer]:
    """Of codes and inpainter, and of the scores where there are any: they must not run ahead of the codes (IV-D2)."""
    rest = [*tokenizer.quantizer.parameters(), *tokenizer.inpainter.parameters()]
    made = [optimizer(rest, phase.learning_rate, phase.weight_decay)]
    if tokenizer.score is not None:
        made.append(optimizer(tokenizer.score.parameters(), phase.score_learning_rate, phase.weight_decay))
    return made


def amplified(batch: Tensor, gain: float, generator: torch.Generator) -> Tensor:
    """Windows (B, T, C) that move more or less than they did, all channels alike: `gain` deviates the logarithm.

    A few faces do not hold what the next face does at its widest. The best masks stay the best.
    """
    if not gain:
        return batch
    return batch * torch.exp(gain * torch.randn(len(batch), 1, 1, generator=generator)).to(batch.device)


def loss_of_steps(
    tokenizer: Tokenizer, motion: Tensor, lengths: Sequence[int], phase: config.TokenizerTraining, gain: float = 0.0
) -> LossOf:
    """Loss of one step on motion (N, C), standardised, of dyads of those lengths, by how keyframes are placed.

    `gain`: of `amplified` windows.
    """
    if isinstance(tokenizer.score, ScoreNetwork):
        starts = first_frames(lengths, tokenizer.window)

        def jointly(step: int, generator: torch.Generator, samples: int) -> Tensor:
            chosen = starts[torch.randint(len(starts), (samples,), generator=generator)]
            hot, cold = phase.temperature
            temperature = hot * (cold / hot) ** (step / max(1, phase.steps - 1))
            batch = amplified(windows(motion, chosen, tokenizer.window), gain, generator)
            return learned_loss(tokenizer, batch, temperature, phase, generator)

        return jointly
    draw = batches(tokenizer, motion, lengths, phase.steps * phase.batch)
    score, most = tokenizer.score, max(tokenizer.keyframes)

    def beside(step: int, generator: torch.Generator, samples: int) -> Tensor:
        batch, mask = draw(samples, generator)
        batch = amplified(batch, gain, generator)
        loss = tokenizer_loss(tokenizer, batch, mask, phase, generator)[0]
        if score is None:
            return loss
        some = lively(batch, tokenizer.member, score.curves, phase.score_tracks, generator)
        return loss + imitation(score, some, most, generator)

    return beside


def tokenizer_loss(
    tokenizer: Tokenizer,
    batch: Tensor,
    mask: Tensor,
    phase: config.TokenizerTraining,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Loss (13) without its masking term, and the squared error of each window (B,).

    With a `generator` a learned codebook takes its own step: it has no gradient.
    """
    quantizer = tokenizer.quantizer
    latent = quantizer.latent(batch)
    if generator is not None and isinstance(quantizer.codebook, Codebook):
        quantizer.codebook.learn(latent, mask, generator)
    codes = quantizer.codebook.nearest(latent)
    restored = tokenizer.inpaint(codes, mask)
    at_keyframes = quantizer.decode(codes)
    loss = reconstruction(batch, restored, at_keyframes, mask, tokenizer.member, phase.velocity_loss)
    committed = quantizer.codebook.commitment(latent, mask.detach())
    return loss + phase.commitment * committed, ((restored - batch) ** 2).mean((1, 2)).detach()


def learned_loss(
    tokenizer: Tokenizer,
    batch: Tensor,
    temperature: float,
    phase: config.TokenizerTraining,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Loss (13) with placements sampled by Algorithm 1; the best of `DRAWS` is I* of equation (7)."""
    if not isinstance(tokenizer.score, ScoreNetwork):
        raise ValueError("this tokenizer does not learn its placement the paper's way")
    scores = tokenizer.score(batch)
    draws = [place_learned(scores, tokenizer.keyframes, temperature, generator) for _ in range(DRAWS)]
    scored = [tokenizer_loss(tokenizer, batch, mask, phase, generator) for mask, _ in draws]
    best = torch.stack([error for _, error in scored]).argmin(0)  # (B,)
    masks = torch.stack([mask for mask, _ in draws])
    target = masks[best, torch.arange(len(batch), device=batch.device)]
    motion = torch.stack([loss for loss, _ in scored]).mean()
    return motion + phase.mask_loss * torch.stack([masking(relaxed, target) for _, relaxed in draws]).mean()


def held_out_windows(model: SfmsModel, corpus: SfmsCorpus) -> Tensor:
    """Consecutive windows (W, T, C), standardised."""
    window = model.tokenizer.window
    return windows(
        model.standardise(corpus.frames.motion.to(model.motion_mean.device)),
        first_frames(corpus.lengths, window, window),
        window,
    )


def _held_out(model: SfmsModel, corpus: SfmsCorpus) -> Callable[[], float]:
    """Error to watch: with the masks that training uses, placed once where that takes its time."""
    tokenizer = model.tokenizer
    if not isinstance(tokenizer.score, ConditionalScore) and tokenizer.strategy != "penalised":
        return lambda: reconstruction_error(model, corpus)
    seen = held_out_windows(model, corpus)
    mask = tokenizer.place(seen, strategy=teacher(tokenizer.strategy))
    return lambda: float(window_errors(tokenizer, seen, mask).mean())


@torch.no_grad()
def window_errors(tokenizer: Tokenizer, motion: Tensor, mask: Tensor) -> Tensor:
    """Mean squared error (W,) of windows (W, T, C) encoded and decoded at a mask (W, T, G), in standardised units."""
    errors = []
    for some, at in zip(torch.split(motion, CHUNK), torch.split(mask, CHUNK), strict=True):
        restored = tokenizer.inpaint(tokenizer.quantizer.encode(some), at)
        errors.append(((restored - some) ** 2).mean((1, 2)))
    return torch.cat(errors)


@torch.no_grad()
def reconstruction_error(
    model: SfmsModel, corpus: SfmsCorpus, strategy: Strategy | None = None, keyframes: Sequence[int] | None = None
) -> float:
    """Mean squared error on consecutive windows, in standardised units; another placement may be asked for."""
    tokenizer = model.tokenizer
    motion = held_out_windows(model, corpus)
    masks = [tokenizer.place(some, keyframes or tokenizer.keyframes, strategy) for some in torch.split(motion, CHUNK)]
    return float(window_errors(tokenizer, motion, torch.cat(masks)).mean())
