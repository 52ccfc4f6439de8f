"""Phase 2 (IV-D3): the next-token predictor, teacher-forced on the tokens of phase 1."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.learning.calibrate import calibrated
from sfms_robot.learning.corpus import Corpus, context, gather, windows
from sfms_robot.learning.datasets import clips
from sfms_robot.learning.loop import fit, optimizer
from sfms_robot.learning.losses import next_tokens
from sfms_robot.learning.tokenizer import WEIGHTS as TOKENIZER_WEIGHTS
from sfms_robot.learning.tokens import tokenise
from sfms_robot.listeners import checkpoint
from sfms_robot.listeners.sfms.model import SfmsModel
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context
from sfms_robot.listeners.sfms.quantizer import codes_to_indices, indices_to_codes
from sfms_robot.listeners.sfms.stream import neutral_tokens
from sfms_robot.listeners.space import MotionSpace

CALIBRATION_DYADS = 8
LN_PER_DB = math.log(10) / 10  # of power


def train_listener(
    settings: config.Training, data: Path, out: Path, each_step: Callable[[int, float], None] | None = None
) -> dict[str, float]:
    """Train on `data`/train with `out`/tokenizer.safetensors and write `out`/config.yaml and model.safetensors.

    Returns final and held-out loss. Ctrl-C saves what there is and goes on upward.
    `each_step(step, loss)` is called after every step.
    """
    torch.manual_seed(settings.seed)
    model = SfmsModel(settings.listener)
    checkpoint.load_weights(out / TOKENIZER_WEIGHTS, model)
    dyads = clips.load(data / "train")
    corpus = gather(dyads, settings.listener.window_frames, MotionSpace.of(settings.listener))
    model.train()
    try:
        loss = _fit(model, corpus, settings, each_step)
    finally:
        checkpoint.save_config(out, corrected(settings))
        checkpoint.save_weights(out / checkpoint.WEIGHTS, model)
    rounds = settings.predictor.calibration_rounds
    some = dyads[:: max(1, len(dyads) // CALIBRATION_DYADS)][
        :CALIBRATION_DYADS
    ]  # of the training set: held out stays so
    checkpoint.save_config(out, calibrated(corrected(settings), model, some, rounds))
    held_out = gather(
        clips.load(data / "validation"), settings.listener.window_frames, MotionSpace.of(settings.listener)
    )
    return {"loss": loss, "held_out_loss": held_out_loss(model, held_out, settings)}


def corrected(settings: config.Training) -> config.Sfms:
    """The listener with the weight of class 0 in (14) taken out of its probability again: p' ~ w p."""
    bias = -math.log(settings.predictor.transition_weight)
    groups = {
        name: group.model_copy(update={"transition_bias": round(group.transition_bias + bias, 3)})
        for name, group in settings.listener.groups.items()
    }
    return settings.listener.model_copy(update={"groups": groups})


def _fit(
    model: SfmsModel,
    corpus: Corpus,
    settings: config.Training,
    each_step: Callable[[int, float], None] | None,
) -> float:
    training, listener = settings.predictor, settings.listener
    tokens = tokenise(model, corpus)
    starts = corpus.starts(listener.window_frames)
    neutral = neutral_tokens(model, MotionSpace.of(listener), listener.past_frames)

    def loss_of(step: int) -> Tensor:
        chosen = starts[torch.randint(len(starts), (training.batch,))]
        seen = context(model, corpus, tokens, chosen, listener.past_frames)
        seen = augment(seen, model.predictor.levels, neutral, training)
        return _loss(model, seen, windows(tokens, chosen + listener.past_frames, listener.future_frames), settings)

    optimizers = [optimizer(model.predictor.parameters(), training.learning_rate, training.weight_decay)]
    frames = training.batch * listener.window_frames
    return fit("listener", training.steps, loss_of, optimizers, training.clip_norm, frames, each_step)


def _loss(model: SfmsModel, seen: Context, target: Tensor, settings: config.Training) -> Tensor:
    """Loss (14) on the future frames behind a random number of given ones (0: the paper's parallel prediction)."""
    b, h, _ = target.shape
    given = torch.arange(h) < torch.randint(h, (b, 1))  # (B, H)
    future = torch.where(given[..., None], target, UNDECIDED)
    logits = model.predictor.decode(model.predictor.remember(seen), seen.tokens, future)
    training = settings.predictor
    weights = [training.group_weights.get(name, 1.0) for name in settings.listener.groups]
    return next_tokens(logits, target, ~given, training.transition_weight, weights)


def augment(seen: Context, levels: Tensor, neutral: Tensor, training: config.PredictorTraining) -> Context:
    """Missing modalities, louder and softer voices, a cold start, and a past that is not quite what was meant."""
    b, p, _ = seen.tokens.shape
    gain = (torch.rand(b, 1, 1) * 2 - 1) * training.gain_db * LN_PER_DB
    # Standardised bins differ little in scale; one shift for all stands for the gain.
    mel = seen.mel + gain / 2.5
    heard = seen.heard & (torch.rand(b, 1) >= training.drop_audio)
    known = seen.face_known & (torch.rand(b, 1) >= training.drop_face)
    tokens = perturb(seen.tokens, levels, training.history_noise)
    # Neutral prefix (IV-C): the first frames are as a stream begins, with nothing heard or seen.
    cold = torch.rand(b, 1) < training.neutral_prefix
    cut = torch.randint(1, p + 1, (b, 1))
    before = cold & (torch.arange(p) < cut)
    shifted = neutral[(torch.arange(p) - cut) % p]  # (B, P, G): its end at the cut
    tokens = torch.where(before[..., None], shifted, tokens)
    return replace(seen, mel=mel, heard=heard & ~before, face_known=known & ~before, tokens=tokens)


def perturb(tokens: Tensor, levels: Tensor, share: float) -> Tensor:
    """A share of the keyframes one level off in one dimension: in a roll-out the past is the model's own."""
    codes = indices_to_codes((tokens - 1).clamp(min=0), levels)
    dims = levels.shape[1]
    moved = torch.nn.functional.one_hot(torch.randint(dims, tokens.shape), dims) * (
        torch.randint(2, tokens.shape)[..., None] * 2 - 1
    )
    noisy = (codes + moved * 2 / (levels - 1)).clamp(-1.0, 1.0)
    changed = (tokens > 0) & (torch.rand(tokens.shape) < share)
    return torch.where(changed, codes_to_indices(noisy, levels) + 1, tokens)


@torch.no_grad()
def held_out_loss(model: SfmsModel, corpus: Corpus, settings: config.Training, batches: int = 20) -> float:
    """Loss (14) without augmentation on windows drawn with a fixed seed."""
    listener = settings.listener
    model.eval()
    tokens = tokenise(model, corpus)
    starts = corpus.starts(listener.window_frames)
    total = 0.0
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for _ in range(batches):
            chosen = starts[torch.randint(len(starts), (64,))]
            seen = context(model, corpus, tokens, chosen, listener.past_frames)
            target = windows(tokens, chosen + listener.past_frames, listener.future_frames)
            total += float(_loss(model, seen, target, settings))
    return total / batches
