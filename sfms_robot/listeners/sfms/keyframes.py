"""Tokens of a stream, as numbers: the last keyframes before every frame, and a window that moves on.

A token is 0 at a transition, 1 + i at a keyframe of code i, UNDECIDED where nobody has drawn it yet. B streams, P past
and H future frames, G groups.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Floats

Tokens = NDArray[np.int64]
UNDECIDED: Final = -1
KEPT_FRAMES: Final = 1  # of the future, whatever is told
SAME: Final = 1e-5  # what is told of a frame differs by more, or does not
KEYS_STEP: Final = 8
NEUTRAL_STRIDE: Final = 8  # frames between the keyframes of the neutral face a stream begins with


class LastKeyframes(NamedTuple):
    """The last two keyframes of every group, the newer first: tokens (..., G, 2), 0 for none yet, and their frames."""

    tokens: Tokens
    at: Tokens

    def then(self, drawn: Tokens, frame: int) -> LastKeyframes:
        """After the tokens (..., G) `drawn` for `frame`."""
        key, tokens, at = drawn > 0, self.tokens.copy(), self.at.copy()
        for part in (tokens, at):
            np.copyto(part[..., 1], part[..., 0], where=key)
        np.copyto(tokens[..., 0], drawn, where=key)
        np.copyto(at[..., 0], frame, where=key)
        return LastKeyframes(tokens, at)


def last_keyframes(tokens: Tokens) -> LastKeyframes:
    """Tokens (B, T, G) -> the last keyframes at every frame, that frame included; -1 is before the first frame."""
    windows, frames, groups = tokens.shape
    window, group = np.arange(windows)[:, None, None], np.arange(groups)
    # Frame -1 before all others holds no keyframe, nor is any before it: it is where those look that have none.
    known = np.zeros((windows, frames + 1, groups), tokens.dtype)
    np.maximum(tokens, 0, out=known[:, 1:])
    last = np.maximum.accumulate(np.where(known > 0, np.arange(frames + 1)[:, None], 0), axis=1)
    before = np.concatenate([last[:, :1], last[:, :-1]], axis=1)[window, last, group]  # as of the frame before
    at = np.stack([last, before], axis=-1)[:, 1:]
    return LastKeyframes(known[window[..., None], at, group[:, None]], at - 1)


def around(tokens: Tokens) -> tuple[NDArray[Any], ...]:
    """The parts of `neighbours.Around` of tokens (B, T, G): where each frame's keyframes are, and which frames are any.

    A window without any looks at all of its frames. K is as many as the fullest window has, up to the next whole
    `KEYS_STEP`: engines prepare themselves for every K that they meet.
    """
    windows, frames, _ = tokens.shape
    key, frame = tokens > 0, np.arange(frames)[:, None]
    before = np.maximum.accumulate(np.where(key, frame, -1), axis=1)
    after = np.ascontiguousarray(np.minimum.accumulate(np.where(key, frame, frames)[:, ::-1], axis=1)[:, ::-1])
    seen: NDArray[np.bool_] = np.asarray(key.any(-1))
    seen[~seen.any(-1)] = True
    counts, window = seen.sum(-1, keepdims=True), np.arange(windows)[:, None]
    most = min(-(-int(counts.max()) // KEYS_STEP) * KEYS_STEP, frames)
    rows = np.argsort(~seen, axis=1, kind="stable")[:, :most] + window * frames
    places = np.maximum(seen.cumsum(-1) - 1, 0) + window * most
    return before, after, rows, np.arange(most) < counts, places


def neutral_mask(frames: int, groups: int) -> Floats:
    """(frames, groups): where the keyframes of a still, neutral face are, the last of them at the newest frame."""
    mask = np.zeros((frames, groups), np.float32)
    mask[(frames - 1) % NEUTRAL_STRIDE :: NEUTRAL_STRIDE] = 1.0
    return mask


def passed(tokens: Tokens, path: Floats, frames: int = 1, holds: bool = False) -> tuple[Tokens, Floats]:
    """Tokens (B, P + H, G) and path (B, 2 + H, C) of `frames` later.

    What has passed without having been planned, before the first plan, was the neutral face: no keyframe. `holds`: the
    last keyframe that has left the window stands at its first frame.
    """
    horizon = path.shape[1] - 2
    moved = np.concatenate([tokens[:, frames:], np.full_like(tokens[:, :frames], UNDECIDED)], axis=1)
    np.maximum(moved[:, :-horizon], 0, out=moved[:, :-horizon])
    if holds:
        moved[:, 0] = _newest(tokens[:, : frames + 1])
    return moved, np.concatenate([path[:, frames:], np.repeat(path[:, -1:], frames, axis=1)], axis=1)


def _newest(tokens: Tokens) -> Tokens:
    """(B, T, G) -> the last keyframe of each group (B, G), 0 where there is none."""
    out: Tokens = np.maximum(tokens[:, 0], 0)
    for frame in range(1, tokens.shape[1]):
        out = np.where(tokens[:, frame] > 0, tokens[:, frame], out)
    return out


def anchored(tokens: Tokens, drawn: NDArray[np.bool_], settled: Tokens, ramp: int) -> Tokens:
    """Tokens (B, T, G) in which no ramp to a keyframe just `drawn`, (B, T, G), begins before frame `settled` (B,): what
    a group held until then is a keyframe there.

    Without it, motion that was shown already would have been on its way to a keyframe that nobody knew of, and a nod
    would begin before the time for which it was told.
    """
    stream, frame = np.arange(len(tokens)), np.arange(tokens.shape[1])
    new, out = drawn & (tokens > 0), tokens.copy()
    behind = frame > settled[:, None]
    ahead = (tokens > 0) & (behind & (frame < settled[:, None] + ramp))[..., None]
    first = ahead.argmax(1)  # the next keyframe of each group, if there is any
    is_new = np.take_along_axis(new, first[:, None], axis=1)[:, 0]
    held = _newest(np.where(behind[..., None], 0, tokens))
    out[stream, settled] = np.where(ahead.any(1) & is_new, held, tokens[stream, settled])
    return out


def later(control: Floats, frames: int = 1) -> Floats:
    """Control (B, P + H, K) of `frames` later; of frames that nothing was told of yet it is 0."""
    return np.concatenate([control[:, frames:], np.zeros_like(control[:, :frames])], axis=1)


def revoked(tokens: Tokens, drawn_under: Floats, told: Floats, horizon: int) -> tuple[Tokens, Tokens]:
    """Tokens (B, P + H, G) without those of the future that what is told now, (B, P + H, K), has overtaken.

    And (B,) the last frame of each stream that is settled: the one before those overtaken, else the newest shown.
    """
    changed = (np.abs(told - drawn_under)[:, -horizon:] > SAME).any(-1)
    stale: NDArray[Any] = np.logical_or.accumulate(changed, axis=1)
    stale[:, :KEPT_FRAMES] = False
    future = np.where(stale[..., None], UNDECIDED, tokens[:, -horizon:])
    overtaken = stale & (tokens[:, -horizon:, 0] != UNDECIDED)
    settled = tokens.shape[1] - horizon - 1 + np.where(overtaken.any(1), overtaken.argmax(1), 0)
    return np.concatenate([tokens[:, :-horizon], future], axis=1), settled
