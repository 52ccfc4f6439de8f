"""Phase 1 (IV-D): keyframe scores, quantizer and inpainter, trained together on their reconstruction."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.learning.corpus import first_frames, windows
from sfms_robot.lab.learning.job import ALONE, Job, LossOf, Run, noise_of, normal, uniform
from sfms_robot.lab.learning.sfms.features import SfmsCorpus, corpora, fit_scales, place_all, standard_motion
from sfms_robot.lab.learning.training_loop import fit, optimizer
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import SfmsModel, Tokenizer
from sfms_robot.listeners.sfms.piecewise_linear import completion_errors
from sfms_robot.listeners.sfms.placement import (
    ConditionalScore,
    ScoreNetwork,
    Strategy,
    Tracks,
    place_adaptive,
    place_learned,
    tracks,
)
from sfms_robot.listeners.sfms.quantizer import Codebook

WEIGHTS = "tokenizer.safetensors"
DRAWS = 2  # placements tried per window; the better one is the target of the masking loss
CHUNK = 32  # windows placed and encoded at a time


def train_tokenizer(
    settings: config.Training,
    data: Path,
    out: Path,
    run: Run = ALONE,
    order: Order | None = None,
) -> dict[str, Any]:
    """Train on `data`/train and write `out`/tokenizer.safetensors; the predictor in it is untrained.

    `order`: see `features.corpora`.

    Returns the figures of the run and the held-out error. Ctrl-C leaves a checkpoint in `out`, from which
    `run.resume` continues; the weights are written when the run is finished.
    """
    listener = settings.listener
    if listener.quantizer == "vq" and run.group.size * (run.accumulate or 1) > 1:
        raise ConfigError("listener.quantizer = 'vq' moves its codes beside gradients: one process, one piece a step")
    corpus, held_out = corpora(settings, data, run, order, heard=False).values()
    torch.manual_seed(settings.seed)
    model = SfmsModel(listener)
    fit_scales(model, corpus)
    job = tokenizer_job(settings, model, corpus, held_out, run.device)
    outcome = fit(job, out, run)
    if run.group.first:
        checkpoint.save_config(out, listener)
        checkpoint.save_weights(out / WEIGHTS, model)
    return {"mse": reconstruction_error(model, held_out.to(run.device)), **asdict(outcome)}


def tokenizer_job(
    settings: config.Training, model: SfmsModel, corpus: SfmsCorpus, held_out: SfmsCorpus, device: torch.device
) -> Job:
    """Return the job of phase 1; move the model to `device`."""
    phase, tokenizer = settings.tokenizer, model.tokenizer
    identity = corpus.identity(settings, "tokenizer", phase)
    model.to(device)
    corpus, held_out = corpus.to(device), held_out.to(device)
    motion = standard_motion(model, corpus)
    return Job(
        name="tokenizer",
        model=model,
        optimizers=optimizers_of(tokenizer, phase),
        loss_of=loss_of_steps(tokenizer, motion, corpus.lengths, phase),
        held_out=_held_out(model, held_out),
        frames_per_step=phase.batch * tokenizer.window,
        phase=phase,
        seed=settings.seed,
        identity=identity,
    )


def optimizers_of(tokenizer: Tokenizer, phase: config.TokenizerTraining) -> list[torch.optim.Optimizer]:
    """Return optimizers of codes and inpainter, and of scores if any, which must not run ahead of the codes (IV-D2)."""
    rest = [*tokenizer.quantizer.parameters(), *tokenizer.inpainter.parameters()]
    made = [optimizer(rest, phase.learning_rate, phase.weight_decay)]
    if tokenizer.score is not None:
        made.append(optimizer(tokenizer.score.parameters(), phase.score_learning_rate, phase.weight_decay))
    return made


def amplified(batch: Tensor, gain: float, generator: Generator) -> Tensor:
    """Scale the motion of windows (B, T, C), all channels alike; `gain`: deviation of the logarithm of the factor.

    The few faces of the data lack the widest movements of other faces. The best masks stay the best.
    """
    if not gain:
        return batch
    factor = torch.exp(gain * normal(generator, len(batch), 1, 1))
    return batch * factor.to(batch.device, non_blocking=True)


def loss_of_steps(
    tokenizer: Tokenizer, motion: Tensor, lengths: Sequence[int], phase: config.TokenizerTraining, gain: float = 0.0
) -> LossOf:
    """Return the loss of a step on standardised motion (N, C) of dyads of these lengths, for the strategy of placement.

    `gain`: of `amplified`.
    """
    score = tokenizer.score
    if isinstance(score, ScoreNetwork):
        starts, adaptive = first_frames(lengths, tokenizer.window), tokenizer.strategy == "adaptive"

        def jointly(step: int, generator: Generator, samples: int) -> Tensor:
            """Return loss (13) with placements sampled by Algorithm 1; the best of `DRAWS` is I* of equation (7)."""
            chosen = starts[torch.randint(len(starts), (samples,), generator=generator)]
            hot, cold = phase.temperature
            temperature = hot * (cold / hot) ** (step / max(1, phase.steps - 1))
            batch = amplified(windows(motion, chosen, tokenizer.window), gain, generator)
            scores, noise = score(batch), noise_of(generator, batch.device)
            draws = [
                place_adaptive(scores, temperature, noise)
                if adaptive
                else place_learned(scores, tokenizer.keyframes, temperature, noise, tempered=phase.tempered_draws)
                for _ in range(DRAWS)
            ]
            scored = [tokenizer_loss(tokenizer, batch, mask, phase, generator) for mask, _ in draws]
            best = torch.stack([error for _, error in scored]).argmin(0)  # (B,)
            target = torch.stack([mask for mask, _ in draws])[best, torch.arange(len(batch), device=batch.device)]
            loss = torch.stack([each for each, _ in scored]).mean()
            if adaptive:  # equation (8)
                wanted = torch.tensor(tokenizer.keyframes, device=batch.device)
                off = torch.stack([(mask.sum(1) - wanted).abs().mean() for mask, _ in draws])
                loss = loss + phase.sparsity * off.mean()
            # L1^mask of (13): relaxed k-hot masks against the mask of the best reconstruction drawn
            missed = [(relaxed - target.detach()).abs().sum(1).mean() for _, relaxed in draws]
            return loss + phase.mask_loss * torch.stack(missed).mean()

        return jointly
    draw, most = batches(tokenizer, motion, lengths, phase.steps * phase.batch), max(tokenizer.keyframes)

    def beside(step: int, generator: Generator, samples: int) -> Tensor:
        batch, mask = draw(samples, generator)
        batch = amplified(batch, gain, generator)
        loss = tokenizer_loss(tokenizer, batch, mask, phase, generator)[0]
        if score is None:
            return loss
        some = lively(batch, tokenizer.member, score.curves, phase.score_tracks, generator)
        return loss + imitation(score, some, most, generator)

    return beside


def reconstruction(
    motion: Tensor, restored: Tensor, at_keyframes: Tensor, mask: Tensor, member: Tensor, velocity: float
) -> Tensor:
    """Return L2 + the first part of L2^Q of (13), and, beyond the paper, `velocity` times the error of the steps.

    The velocity term smooths the corners of movement between coarse codes. ||z^kf - z^kf^|| is taken in motion
    space: the error of the codes alone, at the keyframes. The stop-gradient terms of L2^Q are computed by the
    codebook (`Grid.commitment`, `Codebook.commitment`), since they depend on whether its codes can move.

    Args:
        motion, restored, at_keyframes: (B, T, C); the last decoded from each frame's own code.
        mask: (B, T, G); member: (G, C).
    """
    weight = mask.detach() @ member  # (B, T, C)
    keyframes = ((motion - at_keyframes) ** 2 * weight).sum() / weight.sum().clamp(min=1.0)
    steps = F.mse_loss(restored.diff(dim=1), motion.diff(dim=1))
    return F.mse_loss(restored, motion) + keyframes + velocity * steps


def tokenizer_loss(
    tokenizer: Tokenizer,
    batch: Tensor,
    mask: Tensor,
    phase: config.TokenizerTraining,
    generator: Generator,
) -> tuple[Tensor, Tensor]:
    """Return loss (13) without its masking term, and the squared error of each window (B,).

    A learned codebook has no gradient and is updated here.
    """
    quantizer = tokenizer.quantizer
    latent = quantizer.latent(batch)
    if isinstance(quantizer.codebook, Codebook):
        quantizer.codebook.learn(latent, mask, generator)
    codes = quantizer.codebook.nearest(latent)
    restored = tokenizer.inpaint(codes, mask)
    at_keyframes = quantizer.decode(codes)
    loss = reconstruction(batch, restored, at_keyframes, mask, tokenizer.member, phase.velocity_loss)
    committed = quantizer.codebook.commitment(latent, mask.detach())
    return loss + phase.commitment * committed, ((restored - batch) ** 2).mean((1, 2)).detach()


def held_out_windows(model: SfmsModel, corpus: SfmsCorpus) -> Tensor:
    """Return consecutive windows (W, T, C), standardised."""
    window = model.tokenizer.window
    return windows(standard_motion(model, corpus), first_frames(corpus.lengths, window, window), window)


def _held_out(model: SfmsModel, corpus: SfmsCorpus) -> Callable[[], float]:
    """Return a function that computes the held-out error with the masks of training, placed once if that is slow."""
    tokenizer = model.tokenizer
    if not isinstance(tokenizer.score, ConditionalScore) and tokenizer.strategy != "penalised":
        return lambda: reconstruction_error(model, corpus)
    seen = held_out_windows(model, corpus)
    mask = tokenizer.place(seen, strategy=teacher(tokenizer.strategy))
    return lambda: float(window_errors(tokenizer, seen, mask).mean())


@torch.no_grad()
def window_errors(tokenizer: Tokenizer, motion: Tensor, mask: Tensor) -> Tensor:
    """Return the mean squared error (W,) of standardised windows (W, T, C) encoded and decoded at a mask (W, T, G)."""
    errors = []
    for some, at in zip(torch.split(motion, CHUNK), torch.split(mask, CHUNK), strict=True):
        restored = tokenizer.inpaint(tokenizer.quantizer.encode(some), at)
        errors.append(((restored - some) ** 2).mean((1, 2)))
    return torch.cat(errors)


@torch.no_grad()
def reconstruction_error(model: SfmsModel, corpus: SfmsCorpus, strategy: Strategy | None = None) -> float:
    """Return the mean squared error on consecutive windows, in standardised units; `strategy`: another placement."""
    tokenizer = model.tokenizer
    motion = held_out_windows(model, corpus)
    masks = [tokenizer.place(some, tokenizer.keyframes, strategy) for some in torch.split(motion, CHUNK)]
    return float(window_errors(tokenizer, motion, torch.cat(masks)).mean())


# --- Training of conditional keyframe scores: a teacher computes the final error of every choice ------------------
#
# The score network chooses the keyframes of some tracks, partly at random. At each state that it passes, the teacher
# computes for every frame the error of the best mask of k keyframes that contains the chosen frames and this frame
# (`piecewise_linear.completion_errors`). The scores learn to prefer the frames with the least final error. Because the
# states are the network's own, it learns to recover from its own mistakes.
#
# Equation (13) alone is not enough: through Algorithm 1 a score learns only from the draw it took part in, and the loss
# stalls above that of evenly placed keyframes. The teacher's error is that of linear interpolation, from which the
# inpainter starts.
#
# Error of linear interpolation relative to the exact masks, on recorded faces (unseen takes), one set of keyframes per
# channel, k = 3, 7, 10: even keyframes 4.3, 11, 15; choices of this network 1.7, 2.0, 1.6; after two sweeps 1.16, 1.23,
# 1.13 (width 32, 2 layers, 1,500 steps of 32 tracks).

FLOOR = 0.05  # added to the least error, in squared deviations of the track; smaller differences are not visible
SHARPNESS = 0.1  # temperature of the teacher's preferences
CANDIDATES = 4  # candidate tracks for each track that is learned from
EXPLORED = 0.5  # share of choices that are drawn at random instead of by the highest score


def imitation(score: ConditionalScore, track: Tracks, most: int, generator: Generator) -> Tensor:
    """Return the cross-entropy of scores and teacher over all states of choosing 1..`most` keyframes per track."""
    n = len(track.curves)
    k = torch.randint(1, most + 1, (n,), generator=generator)  # on the CPU, since it sets the number of states
    rows, chosen, remaining = states(score, track, k, noise_of(generator, track.curves.device))
    regret = regrets(track[rows], chosen, k.to(rows.device, non_blocking=True)[rows], most)
    wanted = torch.softmax(-regret / SHARPNESS, dim=1)
    logits = score(track[rows], chosen, remaining)
    heard = torch.log_softmax(logits, dim=1).masked_fill(chosen > 0.5, 0.0)
    return -(wanted * heard).sum(1).mean()


@torch.no_grad()
def lively(motion: Tensor, member: Tensor, curves: int, count: int, generator: Generator) -> Tracks:
    """Draw at most `count` tracks of motion (B, T, C), lively ones more often: still ones have no best keyframes."""
    few = -(-CANDIDATES * count // len(member))  # windows that give enough candidates
    some = motion[torch.randperm(len(motion), generator=generator)[:few].to(motion.device, non_blocking=True)]
    found = tracks(some, member, curves)
    around = (some - some.mean(1, keepdim=True)).square().mean(1) @ member.T  # (B, G)
    noise = noise_of(generator, motion.device)
    weight = around.float().flatten().clamp(max=1.0).sqrt() + 0.05
    rows = torch.multinomial(weight, min(count, len(weight)), generator=noise)
    return found[rows]


@torch.no_grad()
def states(score: ConditionalScore, track: Tracks, k: Tensor, generator: Generator) -> tuple[Tensor, Tensor, Tensor]:
    """Return all states (track row, chosen frames (S, T), keyframes to come) that the choices of the network reach.

    `k` (n,): number of keyframes of each track, on the CPU. The generator is on the device of the tracks.
    """
    n, t, _ = track.curves.shape
    mask = track.curves.new_zeros(n, t)
    rows, chosen, remaining = [], [], []
    for step in range(int(k.max())):
        here = (step < k).nonzero()[:, 0].to(mask.device, non_blocking=True)
        to_come = (k - step).to(mask.device, non_blocking=True)
        rows.append(here)
        chosen.append(mask[here])
        remaining.append(to_come[here])
        logits = score(track, mask, to_come.clamp(min=1))
        noise = -torch.log(-torch.log(uniform(generator, n, t).clamp(1e-7, 1 - 1e-7)))
        drawn = uniform(generator, n) < EXPLORED
        picked = (logits + noise * drawn[:, None]).argmax(1, keepdim=True)
        mask = mask.scatter(1, picked, 1.0)
    return torch.cat(rows), torch.cat(chosen), torch.cat(remaining)


@torch.no_grad()
def regrets(track: Tracks, chosen: Tensor, k: Tensor, most: int) -> Tensor:
    """Return the error with all k keyframes of each next frame (S, T), in excess of the best next frame's.

    It is a share of the least error; infinite for frames that are already chosen.
    """
    errors = completion_errors(track.cost, chosen, most)  # (S, most, T)
    errors = errors[torch.arange(len(k), device=k.device), k - 1]
    least = errors.amin(1, keepdim=True)
    return ((errors - least) / (least + FLOOR)).masked_fill(chosen > 0.5, torch.inf)


# --- Keyframe masks for training: placed for every batch, or, if that is slow, taken from a bank placed before ----
#
# Conditional scores (`learned`) are trained on the exact masks, and so are the codes and the inpainter: once the scores
# are learned, their masks differ little from their teacher's, and need not be placed again at each step.

FEW_GROUPS = 8  # up to this number, exact masks of a batch take less time than its step
MOST_WINDOWS = 2000  # windows whose masks are kept; windows that overlap more teach little

Batch = Callable[[int, Generator], tuple[Tensor, Tensor]]  # batch size -> motion (B, T, C), masks (B, T, G)


def teacher(strategy: Strategy) -> Strategy:
    """Return the placement that a tokenizer of this strategy is trained on."""
    return "exact" if strategy == "learned" else strategy


@torch.no_grad()
def _masks(tokenizer: Tokenizer, batch: Tensor) -> Tensor:
    """Return the masks (B, T, G) of windows by the teacher's placement."""
    count = None if tokenizer.strategy == "exact" else tokenizer.keyframes  # with a given count, gaps are not bounded
    return tokenizer.place(batch, count, teacher(tokenizer.strategy))


def batches(tokenizer: Tokenizer, motion: Tensor, lengths: Sequence[int], drawn: int) -> Batch:
    """Return the function that draws a batch: windows of the standardised motion (N, C) with their masks.

    `lengths` are those of the dyads in `motion`, `drawn` the number of windows over the whole training.
    """
    strategy, window = tokenizer.strategy, tokenizer.window
    starts, kept, whole = first_frames(lengths, window), None, None
    if teacher(strategy) == "exact" and len(tokenizer.member) > FEW_GROUPS:
        starts = starts[:: max(1, -(-len(starts) // min(drawn, MOST_WINDOWS)))]  # spread evenly
        parts = torch.split(starts, CHUNK)
        kept = torch.cat([_masks(tokenizer, windows(motion, some, window)) > 0.5 for some in parts])
    elif strategy in ("penalised", "exact"):
        whole = place_all(tokenizer, motion, lengths)

    def draw(size: int, generator: Generator) -> tuple[Tensor, Tensor]:
        chosen = torch.randint(len(starts), (size,), generator=generator)
        batch = windows(motion, starts[chosen], window)
        if kept is not None:
            return batch, kept[chosen.to(kept.device, non_blocking=kept.is_cuda)].float()
        if whole is None:
            return batch, _masks(tokenizer, batch)
        mask = windows(whole, starts[chosen], window)
        if strategy == "penalised":  # a window is cut from its dyad; its first frame holds the last keyframe
            mask[:, 0] = 1.0
            return batch, mask
        # A tokenizer with exact placement at run time gets half its masks from long stretches, as the predictor will.
        return batch, torch.cat([mask[: size // 2], _masks(tokenizer, batch[size // 2 :])])

    return draw
