"""Phase 2 (IV-D3): the next-token predictor, teacher-forced on the tokens of phase 1."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Generator, Tensor
from torch.nn import functional as F

from sfms_robot import config
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.learning.corpus import ACTIVE, fit_sound, windows
from sfms_robot.lab.learning.job import ALONE, Job, Run, is_drawn, noise_of, uniform
from sfms_robot.lab.learning.sfms.features import (
    SfmsCorpus,
    context,
    corpora,
    held_tokens,
    keyframe_tokens,
    standard_motion,
    tokenise,
    window_tokens,
    without_last_keyframes,
)
from sfms_robot.lab.learning.sfms.tokenizer_trainer import WEIGHTS as TOKENIZER_WEIGHTS
from sfms_robot.lab.learning.training_loop import digest_of, fit, optimizer
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.draw import UNDECIDED, Context
from sfms_robot.listeners.sfms.model import SfmsModel, neutral_tokens
from sfms_robot.listeners.sfms.quantizer import Grid
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals.mel import LN_PER_DB

TokensOf = Literal["dyads", "windows"]
HELD_OUT_BATCHES, HELD_OUT_BATCH = 20, 64


def train_listener(
    settings: config.Training,
    data: Path,
    out: Path,
    run: Run = ALONE,
    order: Order | None = None,
) -> dict[str, Any]:
    """Train on `data`/train with `out`/tokenizer.safetensors and write `out`/config.yaml and model.safetensors.

    Sampling is calibrated afterwards, by roll-outs (`train_runs.calibrate`).

    `order`: see `features.corpora`.

    Returns the figures of the run. Ctrl-C leaves a checkpoint in `out`, from which `run.resume` continues; the weights
    are written when the run is finished.
    """
    listener, phase = settings.listener, settings.predictor
    corpus, held_out = corpora(settings, data, run, order).values()
    torch.manual_seed(settings.seed)
    model = SfmsModel(listener)
    checkpoint.load_weights(out / TOKENIZER_WEIGHTS, model)
    fit_sound(model, (corpus.frames.sound, corpus.frames.heard))
    job = listener_job(settings, model, corpus, held_out, run.device)
    outcome = fit(job, out, run)
    last = outcome.held_out
    if last is None:
        last = held_out_loss(Lessons(model, held_out.to(run.device), phase.tokens), phase)
    if run.group.first:
        checkpoint.save_config(out, corrected(settings))
        checkpoint.save_weights(out / checkpoint.WEIGHTS, model)
    scores = keyframe_scores(model.cpu(), held_out, phase.tokens)
    return {**asdict(outcome), "held_out_loss": last, **scores}


def listener_job(
    settings: config.Training, model: SfmsModel, corpus: SfmsCorpus, held_out: SfmsCorpus, device: torch.device
) -> Job:
    """Return the job of phase 2, on a model whose tokenizer is trained; move the model to `device`."""
    phase, listener = settings.predictor, settings.listener
    identity = corpus.identity(settings, "predictor", phase)
    neutral = neutral_tokens(model, MotionSpace.of(listener), listener.past_frames).to(device)
    identity["tokenizer weights"] = digest_of(model.tokenizer)
    model.to(device)
    lessons, unseen = (Lessons(model, each.to(device), phase.tokens) for each in (corpus, held_out))
    starts, motion = lessons.starts, lessons.motion
    eventful = starts_with_events(corpus, starts, listener) if phase.event_windows else starts
    dense = keyframe_tokens(model, motion) if phase.missed_keyframes else lessons.tokens
    codebook = model.tokenizer.quantizer.codebook
    grid = codebook if isinstance(codebook, Grid) else None
    costs = torch.tensor(model.tokenizer.costs, device=device)

    def loss_of(step: int, generator: Generator, batch: int) -> Tensor:
        chosen = starts[torch.randint(len(starts), (batch,), generator=generator)]
        if phase.event_windows and len(eventful):
            busy = uniform(generator, batch) < phase.event_windows
            chosen = torch.where(busy, eventful[torch.randint(len(eventful), (batch,), generator=generator)], chosen)
        # Vary the level, since microphones differ.
        louder = (uniform(generator, batch) * 2 - 1) * phase.gain_db * LN_PER_DB if listener.audio == "mel" else None
        chosen = chosen.to(device, non_blocking=True)
        noise = noise_of(generator, device)
        seen, target = lessons.at(chosen, louder)
        seen = augment(seen, grid, neutral, phase, noise)
        meant = torch.cat([seen.tokens[:, : listener.past_frames], target], dim=1)
        count = _drawn(listener, target, generator)
        if phase.missed_keyframes:
            meant = without_last_keyframes(
                meant,
                windows(dense, chosen, listener.window_frames),
                windows(motion, chosen, listener.window_frames),
                listener.past_frames + count[:, 0].to(device, non_blocking=True),
                member=model.tokenizer.member,
                costs=costs,
                share=phase.missed_keyframes,
                generator=noise,
            )
        return _loss(model, seen, meant, count, phase)

    return Job(
        name="listener",
        model=model,
        optimizers=[optimizer(model.predictor.parameters(), phase.learning_rate, phase.weight_decay)],
        loss_of=loss_of,
        held_out=lambda: held_out_loss(unseen, phase),
        frames_per_step=phase.batch * listener.window_frames,
        phase=phase,
        seed=settings.seed,
        identity=identity,
    )


class Lessons:
    """Windows of a corpus for the predictor to learn: the inputs of each, and the tokens that come next.

    Attributes:
        starts: first frames of all windows.
        tokens: (N, G) of whole dyads.
        motion: (N, C) standardised.
    """

    def __init__(self, model: SfmsModel, corpus: SfmsCorpus, placed: TokensOf = "dyads") -> None:
        """Tokenise a corpus. `placed`: see `PredictorTraining.tokens`."""
        settings = model.settings
        self.model, self._corpus = model, corpus
        self.starts = corpus.starts(settings.window_frames)
        self.tokens = tokenise(model, corpus)
        self.motion = standard_motion(model, corpus)
        self._held: Tensor | None = None
        self._dense: Tensor | None = None
        if placed == "windows":
            self._dense = keyframe_tokens(model, self.motion)
        elif settings.placement == "penalised":
            self._held = held_tokens(self.tokens, corpus.lengths)

    def at(self, starts: Tensor, louder: Tensor | None = None) -> tuple[Context[Tensor], Tensor]:
        """Return the contexts of windows at (B,) starts, and the tokens (B, H, G) that come next."""
        settings = self.model.settings
        if self._dense is None:
            own = windows(self.tokens, starts, settings.window_frames)
        else:
            own = window_tokens(self.model, self.motion, self._dense, starts)
        return context(self.model, self._corpus, own, starts, louder, self._held), own[:, settings.past_frames :]

    def some(self, generator: Generator) -> Iterator[tuple[Context[Tensor], Tensor]]:
        """Yield batches of `at` for windows drawn at random."""
        for _ in range(HELD_OUT_BATCHES):
            yield self.at(self.starts[torch.randint(len(self.starts), (HELD_OUT_BATCH,), generator=generator)])


def starts_with_events(corpus: SfmsCorpus, starts: Tensor, listener: config.Sfms) -> Tensor:
    """Return those of the `starts` in whose future an event other than a blink is under way."""
    busy = (corpus.frames.control[:, ACTIVE] > 0).any(-1)
    return starts[windows(busy, starts + listener.past_frames, listener.future_frames).any(1)]


def corrected(settings: config.Training) -> config.Sfms:
    """Return the listener with the weight of class 0 in (14) removed from its probability (p' ~ w p), if configured."""
    if not settings.predictor.undo_weight:
        return settings.listener
    bias = -math.log(settings.predictor.transition_weight)
    groups = {
        name: group.model_copy(update={"transition_bias": round(group.transition_bias + bias, 3)})
        for name, group in settings.listener.groups.items()
    }
    return settings.listener.model_copy(update={"groups": groups})


def _drawn(listener: config.Sfms, target: Tensor, generator: Generator) -> Tensor:
    """Draw the number (B, 1), on the CPU, of frames of each future (B, H, G) that are fixed when the rest is planned.

    It is 0 in the paper's training, and for a listener whose hop is a whole plan, since nothing of the plan before is
    left. A stream of hop 4 plans with 4 frames fixed.
    """
    b, h, _ = target.shape
    return torch.randint(h if listener.hop_frames < h else 1, (b, 1), generator=generator)


def _loss(
    model: SfmsModel, seen: Context[Tensor], meant: Tensor, count: Tensor, phase: config.PredictorTraining
) -> Tensor:
    """Return cross-entropy (14) and soft-DTW on the future after its first `count` frames, which are fixed.

    `count` (B, 1) is on the CPU.
    `meant` (B, P + H, G): tokens of the past, in place of those in `seen`, and of the future.
    """
    h = model.settings.future_frames
    target = meant[:, -h:]
    counted = torch.arange(h) >= count  # (B, H)
    drawn = ~counted.to(target.device, non_blocking=True)
    future = torch.where(drawn[..., None], target, UNDECIDED)
    logits = model.predictor.teacher_forced(seen._replace(tokens=torch.cat([meant[:, :-h], future], dim=1)), target)
    weights = [phase.group_weights.get(name, 1.0) for name in model.settings.groups]
    loss = next_tokens(logits.unbind(-2), target, counted, phase.transition_weight, weights)
    if phase.dtw_weight:
        key = (target > 0).float()
        expected = 1 - torch.softmax(logits, dim=-1)[..., 0]
        expected = torch.where(drawn[..., None], key, expected)
        loss = loss + phase.dtw_weight * keyframe_dtw(expected, key, phase.dtw_gamma)
    return loss


def augment(
    seen: Context[Tensor],
    grid: Grid | None,
    neutral: Tensor,
    training: config.PredictorTraining,
    generator: Generator,
) -> Context[Tensor]:
    """Return contexts with missing modalities, a cold start and a noisy past. `neutral` (P, G).

    All tensors and the generator are on one device (`learning.job.noise_of`).
    """
    b, p = seen.heard.shape
    device = seen.tokens.device
    heard = seen.heard & (uniform(generator, b, 1) >= training.drop_audio)
    known = seen.face_known & (uniform(generator, b, 1) >= training.drop_face)
    past = perturb(seen.tokens[:, :p], grid, training.history_noise, generator)
    # Neutral prefix (IV-C): the first frames are like the start of a stream, without sound or face.
    cold = uniform(generator, b, 1) < training.neutral_prefix
    cut = torch.randint(1, p + 1, (b, 1), generator=generator, device=device)
    frame = torch.arange(p, device=device)
    before = cold & (frame < cut)
    shifted = neutral[(frame - cut) % p]  # (B, P, G): its end at the cut
    past = torch.where(before[..., None], shifted, past)
    tokens = torch.cat([past, seen.tokens[:, p:]], dim=1)
    nothing_yet = torch.cat([before, before.new_zeros(b, tokens.shape[1] - p)], dim=1)
    control = seen.control.masked_fill(nothing_yet[..., None], 0.0)
    return seen._replace(heard=heard & ~before, face_known=known & ~before, tokens=tokens, control=control)


def perturb(tokens: Tensor, grid: Grid | None, share: float, generator: Generator) -> Tensor:
    """Move a share of the keyframes by one level in one dimension, since in a roll-out the past is the model's own.

    Without a grid (vq) codes have no neighbours: these keyframes are left out instead, which a roll-out does too.
    """
    if not is_drawn(generator, share):
        return tokens
    place = generator.device
    changed = (tokens > 0) & (uniform(generator, *tokens.shape) < share)
    if grid is None:
        return torch.where(changed, 0, tokens)
    codes, dims = grid.codes((tokens - 1).clamp(min=0)), grid.dims
    dimension = torch.randint(dims, tokens.shape, generator=generator, device=place)
    sign = torch.randint(2, tokens.shape, generator=generator, device=place)[..., None] * 2 - 1
    moved = F.one_hot(dimension, dims) * sign
    noisy = (codes + moved * 2 / (grid.levels - 1)).clamp(-1.0, 1.0)
    return torch.where(changed, grid.indices(noisy) + 1, tokens)


@torch.no_grad()
def held_out_loss(lessons: Lessons, phase: config.PredictorTraining) -> float:
    """Return the loss without augmentation on windows drawn with a fixed seed."""
    model = lessons.model.eval()
    generator = Generator().manual_seed(0)
    losses = []
    for seen, target in lessons.some(generator):
        meant = torch.cat([seen.tokens[:, : -target.shape[1]], target], dim=1)
        losses.append(float(_loss(model, seen, meant, _drawn(model.settings, target, generator), phase)))
    return sum(losses) / len(losses)


@torch.no_grad()
def keyframe_scores(model: SfmsModel, corpus: SfmsCorpus, placed: TokensOf = "dyads") -> dict[str, float]:
    """Return recall and precision of keyframes, teacher-forced: a frame counts as one if its probability is above half.

    All groups and future frames are pooled, on windows drawn with a fixed seed. `placed`: `PredictorTraining.tokens`.
    """
    model.eval()
    hit = said = true = 0
    for seen, target in Lessons(model, corpus, placed).some(Generator().manual_seed(0)):
        expected = model.predictor.teacher_forced(seen, target).softmax(-1)[..., 0] < 0.5
        key = target > 0
        hit += int((expected & key).sum())
        said += int(expected.sum())
        true += int(key.sum())
    return {"keyframe_recall": hit / max(1, true), "keyframe_precision": hit / max(1, said)}


def next_tokens(
    logits: Sequence[Tensor],
    target: Tensor,
    counted: Tensor,
    transition_weight: float,
    group_weights: Sequence[float],
) -> Tensor:
    """Return (14): weighted cross-entropy, class 0 weighing `transition_weight` and a keyframe 1; mean over groups.

    Args:
        logits: per group (B, H, V_g + 1).
        target: (B, H, G) classes.
        counted: (B, H) bool: frames that are to be predicted; on the CPU, or else the host waits for their number.
    """
    total = target.new_zeros((), dtype=torch.float32)
    rows = counted.flatten().nonzero()[:, 0].to(target.device, non_blocking=True)
    for group, values in enumerate(logits):
        truth = target[..., group].flatten()[rows]
        weight = torch.where(truth == 0, transition_weight, 1.0)
        loss = F.cross_entropy(values.flatten(0, 1)[rows], truth, reduction="none")
        total = total + group_weights[group] * (loss * weight).sum() / weight.sum()
    return total / sum(group_weights)


# --- Soft dynamic time warping (Cuturi and Blondel, ICML 2017): a DTW whose minima are soft, so that it has a gradient
#
# The predictor's loss applies it to the keyframe indicator (IV-D3, "binary soft dynamic time warping"): a keyframe that
# is expected one frame late costs less than one that is not expected at all. The paper states neither smoothing nor
# weight.


def soft_dtw(cost: Tensor, gamma: float) -> Tensor:
    """Return the least summed cost (B,) of a path through cost (B, T, U), from corner to corner, with soft minima.

    Steps (1, 0), (0, 1), (1, 1), full window. As `gamma` goes to 0 the result becomes that of DTW; above 0 it is lower.
    The paths are summed along anti-diagonals, so that each diagonal of the whole batch is computed at once.
    """
    if gamma <= 0:
        raise ValueError(f"gamma {gamma:g} must be above 0")
    b, rows, columns = cost.shape
    # The path sums have a border of infinity; diagonal d holds cells (i, d - i) by i, shifted by that border.
    far = torch.full((b, rows + 1), torch.inf, dtype=cost.dtype, device=cost.device)
    before, last = far, far
    row = torch.arange(rows, device=cost.device)
    for diagonal in range(rows + columns - 1):
        column = diagonal - row
        inside = (column >= 0) & (column < columns)
        here = cost[:, row, column.clamp(0, columns - 1)]  # (B, T)
        if diagonal:
            three = torch.stack([last[:, 1:], last[:, :-1], before[:, :-1]])  # from the left, above, both
            some = three.isfinite().any(0)
            soft = -gamma * torch.logsumexp(-torch.where(some, three, 0.0) / gamma, dim=0)
            here = here + torch.where(some, soft, torch.inf)  # with a finite gradient where all three are infinite
        now = torch.where(inside, here, torch.inf)
        before, last = last, torch.cat([far[:, :1], now], dim=1)
    return last[:, rows]


def keyframe_dtw(expected: Tensor, target: Tensor, gamma: float) -> Tensor:
    """Return the mean soft-DTW per frame of keyframe probabilities and indicators (B, H, G), each group a sequence."""
    p, y = (one.transpose(1, 2).flatten(0, 1) for one in (expected, target))  # (B G, H)
    cost = (p[:, :, None] - y[:, None, :]) ** 2
    return soft_dtw(cost, gamma).mean() / target.shape[1]
