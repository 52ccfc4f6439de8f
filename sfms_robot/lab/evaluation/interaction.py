"""What ARIG's paper leaves to the eye, as numbers: states, lips, and the smoothness of motion at chunk borders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config.listener import STATES
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.conversational_states import STATE, UNKNOWN
from sfms_robot.lab.evaluation.phrase_timing import near
from sfms_robot.listeners import audio_frontend

LAGS: Final = 12  # frames either way in which the jaw is looked for
JAW: Final = CHANNEL_INDEX["jawOpen"]
STILL: Final = 1e-4  # deviation of a jaw that does not move

States = NDArray[np.int8]
Bools = NDArray[np.bool_]


# --- states -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class VoiceRule:
    """The best that voice activity alone can say: of each pattern, agent x user, its most frequent state."""

    states: States  # (2, 2)

    @classmethod
    def of(cls, voiced: Bools, states: States) -> VoiceRule:
        """From speech (N, 2) of agent and user and labels (N,); an unlabelled frame does not count."""
        best = np.full((2, 2), STATE["waiting"], np.int8)
        for agent in (0, 1):
            for user in (0, 1):
                seen = states[(voiced[:, 0] == agent) & (voiced[:, 1] == user) & (states >= 0)]
                if len(seen):
                    best[agent, user] = np.bincount(seen, minlength=len(STATES)).argmax()
        return cls(best)

    def __call__(self, voiced: Bools) -> States:
        """(N, 2) -> (N,)."""
        out: States = self.states[voiced[:, 0].astype(int), voiced[:, 1].astype(int)]
        return out


def voice_tracks(dyad: Dyad) -> Bools:
    """(N, 2) speech of agent and user as the listener itself hears it: the agent's now, the user's a frame late."""
    silent = np.zeros(len(dyad.listener), bool)
    agent, user = (
        silent if track is None else audio_frontend.track(track)[1] for track in (dyad.agent_audio, dyad.audio)
    )
    return np.stack([agent, np.r_[False, user[:-1]]], axis=-1)


def confusion(said: States, states: States) -> NDArray[np.int64]:
    """(7, 7) frames by label (rows) and answer (columns); frames without either do not count."""
    known = (said != UNKNOWN) & (states != UNKNOWN)
    out = np.zeros((len(STATES), len(STATES)), np.int64)
    np.add.at(out, (states[known], said[known]), 1)
    return out


def accuracy(table: NDArray[np.int64]) -> float:
    """Share on the diagonal; NaN of nothing."""
    total = table.sum()
    return float(np.trace(table) / total) if total else float("nan")


def balanced_accuracy(table: NDArray[np.int64]) -> float:
    """Mean over the states that occur of the share found; a majority class gets 1 over their number."""
    of = table.sum(axis=1)
    return float((np.diag(table)[of > 0] / of[of > 0]).mean()) if of.any() else float("nan")


# --- lips -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class JawTracking:
    """How a jaw follows the recorded one.

    Attributes:
        correlation: at lag 0, all clips pooled, each less its mean.
        lag_frames: at which it is highest, positive: late; best: the correlation there.
        spread: deviation of the jaw over that of the recorded one.
    """

    correlation: float
    lag_frames: int
    best: float
    spread: float


def jaw_tracking(played: Sequence[Floats], recorded: Sequence[Floats], lags: int = LAGS) -> JawTracking:
    """Motions (N, 58), made and recorded; a pair that is not longer than `lags` either way does not count."""
    long = [pair for pair in zip(played, recorded, strict=True) if len(pair[0]) > 2 * lags]
    if not long:
        return JawTracking(0.0, 0, 0.0, 0.0)
    played, recorded = zip(*long, strict=True)
    found = {lag: _pooled(played, recorded, lag) for lag in range(-lags, lags + 1)}
    best = max(found, key=lambda lag: (found[lag], -abs(lag)))
    spreads = [np.concatenate([one[:, JAW] - one[:, JAW].mean() for one in each]).std() for each in (played, recorded)]
    return JawTracking(found[0], best, found[best], float(spreads[0] / max(spreads[1], STILL)))


def _pooled(played: Sequence[Floats], recorded: Sequence[Floats], lag: int) -> float:
    ours, theirs = [], []
    for one, other in zip(played, recorded, strict=True):
        a, b = one[max(0, lag) : len(one) + min(0, lag), JAW], other[max(0, -lag) : len(other) - max(0, lag), JAW]
        ours.append(a - a.mean())
        theirs.append(b - b.mean())
    x, y = np.concatenate(ours).astype(float), np.concatenate(theirs).astype(float)
    if min(x.std(), y.std()) < STILL:
        return 0.0
    return float(np.corrcoef(x, y)[0, 1])


# --- smoothness -------------------------------------------------------------------------------------------------


def border_ratio(motions: Sequence[Floats], period: int, first: int = 1, skip: int = 25) -> float:
    """Mean acceleration of the head's rotation at chunk borders over that elsewhere.

    Frame t of a motion (N, 58) was made in chunk (t - first) // period; an acceleration is at a border when its three
    frames are not of one chunk. The first `skip` frames, in which a stream settles, do not count.
    """
    at, away = [], []
    for motion in motions:
        size = np.linalg.norm(np.diff(motion[skip:, :3].astype(float), 2, axis=0), axis=1) / FRAME_S**2
        frame = np.arange(skip, len(motion) - 2) - first  # the earliest of the three
        across = frame // period != (frame + 2) // period
        at.append(size[across])
        away.append(size[~across])
    inside = float(np.concatenate(away).mean()) if away else 0.0
    return float(np.concatenate(at).mean()) / inside if inside else float("nan")


def listening_again(played: Sequence[Floats], dyads: Sequence[Dyad]) -> float:
    """Of motions (N, 58): share of the jaw's mean opening left a second after the agent's own voice has stopped."""
    speaking, after = [], []
    for one, dyad in zip(played, dyads, strict=True):
        if dyad.agent_audio is None:
            continue
        active = audio_frontend.track(dyad.agent_audio)[1]
        spans = np.flatnonzero(active)[:, None] * FRAME_S + np.array([0.0, FRAME_S])
        recent = near(spans, len(active), 1 / FRAME_S, 1.0)
        speaking.append(one[active, JAW])
        after.append(one[~recent, JAW])
    said = np.concatenate(speaking) if speaking else np.zeros(0)
    quiet = np.concatenate(after) if after else np.zeros(0)
    return float(quiet.mean() / said.mean()) if len(said) and len(quiet) and said.mean() > 0 else float("nan")
