"""`evaluate interaction`: numbers for qualities that ARIG's paper judges by eye: states, lips, chunk borders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.config.listener import STATES
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, FRAME_HZ, FRAME_S, NO_SOUND, Bools, Doubles, Floats
from sfms_robot.lab import Figures
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.conversational_states import STATE, UNKNOWN
from sfms_robot.lab.corpora.phrase_timing import near
from sfms_robot.lab.evaluation.listener_tables import spread_clips
from sfms_robot.lab.evaluation.rollout import rollouts
from sfms_robot.lab.learning.arig.features import open_scenes
from sfms_robot.listeners import audio_frontend
from sfms_robot.listeners.registry import load_listener

_LAGS: Final = 12  # largest lag of the jaw in the search, in frames in both directions
_JAW: Final = CHANNEL_INDEX["jawOpen"]
_STILL: Final = 1e-4  # a jaw with a smaller deviation does not move

States = NDArray[np.int8]


def evaluate_interaction(name: str, data: Path, clips: int | None, seed: int, split: str = "test") -> Figures:
    """Return figures of states, lips, chunk borders and the end of speech on the sets of `data` of a split.

    Uses at most `clips` dyads of each set. Raises ConfigError for a listener without states, or data without such sets.
    """
    listener = load_listener(name)
    settings = getattr(getattr(listener, "how", listener), "settings", None)
    if not isinstance(settings, config.Arig):
        raise ConfigError(f"--listener {name}: does not speak; this command evaluates listeners of kind arig")
    held_out = {scene: spread_clips(dyads, clips) for scene, dyads in open_scenes(data, split).items()}
    rolled = {scene: rollouts(listener, dyads, seed, f"{name}, {scene}") for scene, dyads in held_out.items()}
    every = [one for scene in held_out for one in rolled[scene]]
    dyads = [dyad for each in held_out.values() for dyad in each]
    motions, people = [motion for motion, _ in every], [dyad.listener for dyad in dyads]
    lips: Figures = {}
    for scene in ("speaking", "interaction"):  # filmed recordings, and the agent's talk in interaction
        if scene in held_out:
            made, recorded = [motion for motion, _ in rolled[scene]], [dyad.listener for dyad in held_out[scene]]
            lips |= {f"lips_{scene}_{key}": value for key, value in jaw_tracking(made, recorded).items()}
    return {
        "listener": name,
        "split": split,
        "dyads": {scene: len(each) for scene, each in held_out.items()},
        "chunk_border_acceleration_ratio": border_ratio(motions, settings.chunk_frames),
        "dyads_border_acceleration_ratio": border_ratio(people, settings.chunk_frames),
        **_states([states for _, states in every], dyads, data, clips),
        **lips,
        "jaw_left_a_second_after_speech": listening_again(motions, dyads),
        "people_jaw_left_a_second_after_speech": listening_again(people, dyads),
    }


# --- states ---------------------------------------------------------------------------------------------------------


def _states(rolled: Sequence[States], dyads: Sequence[Dyad], data: Path, clips: int | None) -> Figures:
    """Return accuracies of the listener's states, and of two rules on voices that follow from the training labels."""
    labelled = [
        (states, dyad, dyad.states) for states, dyad in zip(rolled, dyads, strict=True) if dyad.states is not None
    ]
    said = np.concatenate([np.zeros(0, np.int8), *(answers for answers, _, _ in labelled)])
    if (said < 0).all():
        return {}
    truth = np.concatenate([states for _, _, states in labelled])
    truth = np.where(said < 0, UNKNOWN, truth).astype(np.int8)  # the state of a stream's first frame is not predicted
    voices = np.concatenate([voice_tracks(dyad) for _, dyad, _ in labelled])
    tables = {
        name: confusion(answers, truth) for name, answers in {"state": said, **_by_rule(voices, data, clips)}.items()
    }
    found: Figures = {}
    for name, table in tables.items():
        found[f"{name}_accuracy"], found[f"{name}_balanced_accuracy"] = accuracies(table)
    return {**found, "confusion": {"states": list(STATES), "label_by_answer": tables["state"].tolist()}}


def _by_rule(voices: Bools, data: Path, clips: int | None) -> dict[str, States]:
    """Return the answers of the most frequent state and of the best voice rule of training for voices (N, 2).

    The best rule from voice activity alone is the most frequent state of each pattern of speech, agent x user.
    """
    learned = [
        (voice_tracks(dyad), dyad.states)
        for each in open_scenes(data, "train").values()
        for dyad in spread_clips(each, clips)
        if dyad.states is not None
    ]
    states = np.concatenate([np.zeros(0, np.int8), *(states for _, states in learned)])
    if not (known := states >= 0).any():
        return {}
    heard = np.concatenate([voices for voices, _ in learned])
    counts = np.zeros((2, 2, len(STATES)), np.int64)
    np.add.at(counts, (*heard[known].astype(int).T, states[known]), 1)
    rule = np.where(counts.any(axis=-1), counts.argmax(axis=-1), STATE["waiting"]).astype(np.int8)
    majority = np.full(len(voices), counts.sum(axis=(0, 1)).argmax(), np.int8)
    return {"majority": majority, "voice_rule": rule[tuple(voices.astype(int).T)]}


def voice_tracks(dyad: Dyad) -> Bools:
    """Return the speech (N, 2) of agent and user as the listener gets it: the agent's now, the user's a frame late."""
    silent = np.zeros(len(dyad.listener), bool)
    agent, user = (
        silent if track is None else audio_frontend.track(track)[1] for track in (dyad.agent_audio, dyad.audio)
    )
    return np.stack([agent, np.r_[False, user[:-1]]], axis=-1)


def confusion(said: States, states: States) -> NDArray[np.int64]:
    """Count frames by label (rows) and answer (columns), (7, 7); frames without either drop out."""
    counts = np.histogram2d(states, said, np.arange(len(STATES) + 1))[0]  # UNKNOWN is outside of all bins
    return counts.astype(np.int64)


def accuracies(table: NDArray[np.int64]) -> tuple[float, float]:
    """Return the share on the diagonal, and the mean over the occurring states of the share found; NaN without any.

    A constant answer has a second figure of 1 over the number of these states.
    """
    of, found = table.sum(axis=1), np.diag(table)
    if not of.any():
        return np.nan, np.nan
    return float(found.sum() / of.sum()), float((found[of > 0] / of[of > 0]).mean())


# --- lips and smoothness --------------------------------------------------------------------------------------------


def jaw_tracking(made: Sequence[Floats], recorded: Sequence[Floats]) -> dict[str, float]:
    """Return how the jaw of motions (N, 58) follows the recorded ones; pairs of 24 frames or fewer are left out.

    The figures are the correlation at lag 0, over all clips, each minus its mean; the lag (positive: late) with the
    highest correlation, and this correlation; and the deviation of the jaw over that of the recorded jaw.
    """
    long = [(a[:, _JAW], b[:, _JAW]) for a, b in zip(made, recorded, strict=True) if len(a) > 2 * _LAGS]

    def at_lag(lag: int) -> tuple[Doubles, Doubles]:
        """Return both tracks, all clips one after the other, ours `lag` frames later."""
        parts = [(one[max(0, lag) : len(one) + min(0, lag)], other[max(0, -lag) : len(other) - max(0, lag)])
                 for one, other in long]  # fmt: skip
        ours, theirs = (np.concatenate([one - one.mean() for one in each]) for each in zip(*parts, strict=True))
        return ours.astype(np.float64), theirs.astype(np.float64)

    found, spread = {0: 0.0}, 0.0
    if long:
        for lag in range(-_LAGS, _LAGS + 1):
            x, y = at_lag(lag)
            found[lag] = float(np.corrcoef(x, y)[0, 1]) if min(x.std(), y.std()) >= _STILL else 0.0
        ours, theirs = at_lag(0)
        spread = float(ours.std() / max(theirs.std(), _STILL))
    best = max(found, key=lambda lag: (found[lag], -abs(lag)))
    return {"correlation": found[0], "lag_frames": best, "correlation_at_lag": found[best], "jaw_spread": spread}


def border_ratio(motions: Sequence[Floats], period: int) -> float:
    """Return the mean acceleration of the head's rotation at chunk borders over that elsewhere.

    Frame t of a motion (N, 58) was made in chunk (t - 1) // period; an acceleration is at a border when its three
    frames are of different chunks. The first second, in which a stream settles, does not count.
    """
    at, away = [], []
    for motion in motions:
        size = np.linalg.norm(np.diff(motion[FRAME_HZ:, :3].astype(float), 2, axis=0), axis=1) / FRAME_S**2
        frame = np.arange(FRAME_HZ, len(motion) - 2) - 1  # the earliest of the three
        across = frame // period != (frame + 2) // period
        at.append(size[across])
        away.append(size[~across])
    inside = float(np.concatenate(away).mean()) if away else 0.0
    return float(np.concatenate(at).mean()) / inside if inside else np.nan


def listening_again(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> float:
    """Return the mean jaw opening more than a second away from the agent's own voice, over the mean during it."""
    speaking, after = [NO_SOUND], [NO_SOUND]
    for one, dyad in zip(motions, dyads, strict=True):
        if dyad.agent_audio is None:
            continue
        active = audio_frontend.track(dyad.agent_audio)[1]
        spans = np.flatnonzero(active)[:, None] * FRAME_S + np.array([0.0, FRAME_S])
        recent = near(spans, len(active), 1.0)
        speaking.append(one[active, _JAW])
        after.append(one[~recent, _JAW])
    said, quiet = np.concatenate(speaking), np.concatenate(after)
    return float(quiet.mean() / said.mean()) if len(said) and len(quiet) and said.mean() > 0 else np.nan
