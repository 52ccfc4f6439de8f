"""Training data of an SFMS listener, frame by frame: both motions, the speaker's sound and the place in a phrase."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from sfms_robot import config
from sfms_robot.frames import FRAME_HZ, FRAME_SAMPLES, Floats
from sfms_robot.lab.corpora.clips import Dyad, at_rate
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.corpora.formats import open_for
from sfms_robot.lab.learning import corpus as dyads
from sfms_robot.lab.learning.corpus import (
    Corpus,
    fit_sway,
    motion_scales,
    shared_frames,
    training_data,
    windows,
)
from sfms_robot.lab.learning.job import ALONE, Run, uniform
from sfms_robot.listeners.audio_frontend import AudioFrontend
from sfms_robot.listeners.sfms.draw import UNDECIDED, Context
from sfms_robot.listeners.sfms.model import SfmsModel, Tokenizer
from sfms_robot.listeners.sfms.predictor import last_keyframes
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.signals import mel
from sfms_robot.signals import phase as phases
from sfms_robot.signals.voice_activity import mel_levels_db

FASTEST = 0.9995  # quantile of a channel's steps that counts as its speed
LEAST_SPEED = 0.05  # in deviations per frame

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class SfmsFrames:
    """N frames of dyads.

    Attributes:
        motion: (N, C) listener, in the motion space of the model, the part that the model draws.
        face: (N, C) speaker, in the same space, 0 where unknown; face_known: (N,) bool.
        sound: (N, R, bins) half precision, features of the speaker's voice; heard: (N,) bool.
        phase: (N, F) the speaker's place in a phrase.
        control: (N, K) control rows of the listener's events; K = 0 without events.
        sway: (N, S) the listener's slow motion, if it is not in `motion`; S = 0 without sway.
    """

    motion: Tensor
    face: Tensor
    face_known: Tensor
    sound: Tensor
    heard: Tensor
    phase: Tensor
    control: Tensor
    sway: Tensor


SfmsCorpus = Corpus[SfmsFrames]


def corpora(
    settings: config.Training, data: Path, run: Run, order: Order | None, heard: bool = True
) -> dict[str, SfmsCorpus]:
    """Return the frames of train and validation, from a folder or a pack.

    `order`: of the channels in the files, if not the layout's own (`open_dataset`). `heard`: with the speaker's sound,
    which a tokenizer does not need.
    """
    listener, space = settings.listener, MotionSpace.of(settings.listener)

    def read(split: str) -> SfmsCorpus:
        dyads = open_for(space.name, data, split, order, [listener.audio] if heard else ())
        if dyads.fps != FRAME_HZ and split == "train" and not heard:  # logged once, in the first of two phases
            log.warning(
                "%s has %g frames a second and is not resampled; streamed, a listener shows %d a second",
                data, dyads.fps, FRAME_HZ,
            )  # fmt: skip
        frontend = AudioFrontend.of(listener) if heard else None
        return gather(dyads, listener.window_frames, space, frontend, listener, run, split)

    return training_data(data, SfmsFrames, settings, read)


def gather(
    listened: Sequence[Dyad],
    window: int,
    space: MotionSpace,
    frontend: AudioFrontend | None = None,
    settings: config.Sfms | None = None,
    run: Run = ALONE,
    split: str = "",
) -> SfmsCorpus:
    """Run `corpus.gather` in one motion space.

    `frontend` extracts features of the sound; None leaves the sound out, which is enough for a tokenizer.
    `settings`: of a listener, which may have events; None for one without.
    """
    one = partial(frames_of, space=space, frontend=frontend, settings=settings)
    return dyads.gather({"listening": listened}, window, one, run, split)


def frames_of(
    dyad: Dyad, space: MotionSpace, frontend: AudioFrontend | None = None, settings: config.Sfms | None = None
) -> SfmsFrames:
    """Return the frames of one dyad. Raises ConfigError (`corpus.shared_frames`)."""
    face, known, motion, sway, control = shared_frames(dyad, space, settings)
    sound, phase = _audio_features(dyad, frontend)
    return SfmsFrames(
        motion=motion,
        face=face,
        face_known=known,
        sound=sound,
        heard=torch.full((len(sound),), bool(sound.any())),
        phase=phase,
        control=control,
        sway=sway,
    )


def _audio_features(dyad: Dyad, frontend: AudioFrontend | None) -> tuple[Tensor, Tensor]:
    """Return sound (N, R, bins) in half precision and phase (N, F), zeros without sound."""
    frames = len(dyad.listener)
    if frontend is None:
        return torch.zeros(frames, 0, 0, dtype=torch.half), torch.zeros(frames, 0)
    audio, found = dyad.voice, dyad.features.get(frontend.audio)
    if found is None and frontend.audio == "mel" and (audio is not None or dyad.mel is not None):
        found = dyad.mel_rows()
    elif found is None and audio is not None:
        found = at_rate(frontend.rows(_whole(audio)), FRAME_HZ, frames, dyad.fps)
    phase = np.zeros((frames, frontend.phase_features), np.float32)
    if frontend.phased and audio is not None:
        phase = at_rate(phases.of_audio(_whole(audio)), FRAME_HZ, frames, dyad.fps)
    elif frontend.phased and dyad.mel is not None:
        rows = dyad.mel.reshape(frames, mel.ROWS_PER_FRAME, mel.MEL_BINS)
        ours = at_rate(rows, dyad.fps, math.ceil(frames * FRAME_HZ / dyad.fps), FRAME_HZ)  # phases are in our frames
        phase = at_rate(phases.of_levels(mel_levels_db(ours)), FRAME_HZ, frames, dyad.fps)
    sound = (
        torch.zeros(frames, *frontend.shape) if found is None else torch.from_numpy(found).view(frames, *frontend.shape)
    )
    return sound.half(), torch.from_numpy(phase)


def _whole(audio: Floats) -> Floats:
    """Return the samples, padded with silence to a whole number of our frames."""
    return np.pad(audio, (0, -len(audio) % FRAME_SAMPLES))


def fit_scales(model: SfmsModel, corpus: SfmsCorpus) -> None:
    """Set the means, deviations and speeds of the model's motion, and its sway if that is separate."""
    mean, spread = motion_scales(corpus.frames.motion, model.settings.channels)
    model.motion_mean.copy_(mean)
    model.motion_std.copy_(spread)
    steps = (corpus.steps(corpus.frames.motion) / model.motion_std).abs().sort(dim=0).values
    model.motion_speed.copy_(steps[int(FASTEST * len(steps))].clamp(min=LEAST_SPEED))
    if model.swaying:
        fit_sway(model, corpus.by_dyad(corpus.frames.sway))


def standard_motion(model: SfmsModel, corpus: SfmsCorpus) -> Tensor:
    """Return the standardised motion (N, C) of a corpus, on the model's device."""
    return model.standardise(corpus.frames.motion.to(model.motion_mean.device))


def context(
    model: SfmsModel,
    corpus: SfmsCorpus,
    tokens: Tensor,
    starts: Tensor,
    louder: Tensor | None = None,
    held: Tensor | None = None,
) -> Context[Tensor]:
    """Return the predictor's inputs at the end of each window's past, with the tokens of the future undecided.

    `tokens`: (N, G) of the corpus, or (B, T, G) of separate windows.
    `louder` (B,): added to the sound before it is standardised, for features that are logarithms.
    `held` (N, G): tokens of a window's first frame, which holds the last keyframe (`held_tokens`).
    """
    frames, device = corpus.frames, model.motion_mean.device
    past, future = model.settings.past_frames, model.settings.future_frames
    starts = starts.to(frames.heard.device)
    looked_at = torch.arange(-1, past, device=starts.device)  # one frame more, for the convolution
    index = (starts[:, None] + looked_at).clamp(min=0)
    heard = frames.heard[index]
    heard[:, 0] &= ~corpus.begins[starts]
    heard, sound = heard.to(device), frames.sound[index].to(device).float()
    if louder is not None:
        sound = sound + louder.to(device, non_blocking=True).view(-1, 1, 1, 1)
    sound = torch.where(heard[..., None, None], model.standardise_sound(sound), 0.0)
    own = windows(tokens, starts, past) if tokens.ndim == 2 else tokens[:, :past].clone()
    if held is not None:
        own[:, 0] = held[starts.to(held.device)]
    undecided = own.new_full((len(own), future, own.shape[2]), UNDECIDED)
    return Context(
        face=model.standardise(windows(frames.face, starts, past).to(device)),
        face_known=windows(frames.face_known, starts, past).to(device),
        voice=model.predictor.speaker.listen(sound.flatten(1, 2)),
        heard=heard[:, 1:],
        phase=windows(frames.phase, starts, past).to(device),
        tokens=torch.cat([own, undecided], dim=1),
        control=windows(frames.control, starts, past + future).to(device),
    )


# --- Tokens of the motion of a whole corpus, on which phase 2 is trained ------------------------------------------

TOGETHER = 64  # stretches of one length that are placed at once
STRETCH_WINDOWS = 10  # exact placement shares its keyframes among this many windows


@torch.no_grad()
def place_all(tokenizer: Tokenizer, motion: Tensor, lengths: Sequence[int]) -> Tensor:
    """Place the keyframes (N, G) of all dyads.

    `penalised` places each dyad as a whole, `exact` stretches of `STRETCH_WINDOWS` windows, so that busy seconds can
    borrow keyframes from quiet ones of the same stretch, and every other strategy single windows.
    """
    pieces: list[Tensor] = []
    for dyad in torch.split(motion, list(lengths)):
        size = tokenizer.window * (STRETCH_WINDOWS if tokenizer.strategy == "exact" else 1)
        if tokenizer.strategy == "penalised":
            size = len(dyad)
        whole, rest = divmod(len(dyad), size)
        sizes = [size] * whole
        if not sizes or rest >= tokenizer.window:
            sizes.append(rest)
        else:  # no stretch is shorter than a window, unless it is the only one
            sizes[-1] += rest
        pieces += torch.split(dyad, sizes)
    alike: dict[int, list[int]] = {}  # pieces of one length are placed together
    for index, piece in enumerate(pieces):
        alike.setdefault(len(piece), []).append(index)
    masks: dict[int, Tensor] = {}
    for indices in alike.values():
        for some in range(0, len(indices), TOGETHER):
            chosen = indices[some : some + TOGETHER]
            masks |= zip(chosen, tokenizer.place(torch.stack([pieces[index] for index in chosen])), strict=True)
    return torch.cat([masks[index] for index in range(len(pieces))])


@torch.no_grad()
def tokenise(model: SfmsModel, corpus: SfmsCorpus) -> Tensor:
    """Return the tokens (N, G) of every listener in the corpus."""
    motion = standard_motion(model, corpus)
    mask = place_all(model.tokenizer, motion, corpus.lengths)
    return torch.where(mask > 0.5, keyframe_tokens(model, motion), 0)


@torch.no_grad()
def keyframe_tokens(model: SfmsModel, motion: Tensor) -> Tensor:
    """Return the tokens (N, G) that each frame of standardised motion (N, C) has as a keyframe."""
    quantizer = model.tokenizer.quantizer
    return torch.cat([quantizer.codebook.indices(quantizer.encode(m[None]))[0] + 1 for m in torch.split(motion, 4096)])


@torch.no_grad()
def window_tokens(model: SfmsModel, motion: Tensor, dense: Tensor, starts: Tensor) -> Tensor:
    """Return the tokens (B, T, G) of windows, each placed separately, as the paper's are (V-B, V-C).

    `motion` (N, C) standardised; `dense` (N, G): `keyframe_tokens` of it.
    """
    tokenizer = model.tokenizer
    mask = tokenizer.place(windows(motion, starts, tokenizer.window))
    if tokenizer.strategy == "penalised":  # a window's first frame holds the last keyframe
        mask[:, 0] = 1.0
    return torch.where(mask > 0.5, windows(dense, starts, tokenizer.window), 0)


def held_tokens(tokens: Tensor, lengths: Sequence[int]) -> Tensor:
    """Return the last keyframe (N, G) at or before each frame of its dyad, 0 if none, of tokens (N, G) of dyads."""
    return torch.cat([last_keyframes(one[None]).tokens[0, ..., 0] for one in torch.split(tokens, list(lengths))])


# --- Keyframes that are left out in training, because a roll-out misses some too ----------------------------------
#
# Teacher forcing never shows the predictor a face that should have returned and has not: a lid whose opening was not
# drawn, a nod that has lost its last swing. In a roll-out this happens, and such a face would stay until some later
# keyframe. So the last keyframes before the first frame to draw are sometimes left out. If the face is then wrong by
# more than the cost of a keyframe, the target is a keyframe at once: the true face of that frame.

MISSED_FRAMES = 6  # frames before the first frame to draw


def without_last_keyframes(
    tokens: Tensor,
    dense: Tensor,
    motion: Tensor,
    first: Tensor,
    member: Tensor,
    costs: Tensor,
    share: float,
    generator: torch.Generator,
) -> Tensor:
    """Return tokens (B, T, G): a `share` of groups lacks its last keyframes and is corrected in frame `first`.

    Args:
        tokens: true tokens; dense: (B, T, G) tokens that each frame has as a keyframe.
        motion: (B, T, C) standardised; member: (G, C); costs: (G,) of a keyframe, in squared units of the motion.
        first: (B,) the first frame to draw, above 0.
        generator: on the device of the tokens.
    """
    b, t, groups = tokens.shape
    row, frame = torch.arange(b, device=tokens.device)[:, None], torch.arange(t, device=tokens.device)
    recent = (frame >= first[:, None] - MISSED_FRAMES) & (frame < first[:, None])
    chosen = uniform(generator, b, 1, groups) < share
    left = torch.where(recent[..., None] & chosen, 0, tokens)
    last = last_keyframes(left).at[row[:, 0], first - 1][..., 0]  # (B, G)
    off = motion[row, last.clamp(min=0)] - motion[row[:, 0], first][:, None]  # (B, G, C)
    wrong = (last >= 0) & ((off**2 * member).sum(-1) > costs) & (left != tokens).any(1)
    left[row[:, 0], first] = dense[row[:, 0], first]
    return torch.where(wrong[:, None], left, tokens)
