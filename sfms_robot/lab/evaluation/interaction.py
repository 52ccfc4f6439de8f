"""`evaluate interaction`: numbers for what ARIG's paper leaves to the eye: states, lips, chunk borders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot import config
from sfms_robot.config import find
from sfms_robot.config.listener import STATES
from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, Floats
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.conversational_states import STATE, UNKNOWN
from sfms_robot.lab.evaluation.listener_tables import spread_clips
from sfms_robot.lab.evaluation.phrase_timing import near
from sfms_robot.lab.evaluation.rollout import Rollout, bar, rollouts
from sfms_robot.lab.learning.arig.features import open_scenes
from sfms_robot.listeners import audio_frontend
from sfms_robot.listeners.registry import load_listener
from sfms_robot.ports import Listener

_LAGS: Final = 12  # frames in both directions in which the jaw is searched
_JAW: Final = CHANNEL_INDEX["jawOpen"]
_STILL: Final = 1e-4  # deviation of a jaw that does not move

States = NDArray[np.int8]
Bools = NDArray[np.bool_]


def evaluate_interaction(name: str, data: Path, clips: int | None, seed: int) -> dict[str, Any]:
    """Return figures of states, lips, chunk borders and the end of speech on the validation sets of `data`.

    At most `clips` dyads of each set. Raises ConfigError for a listener without states, or data without such sets.
    """
    listener = load_listener(find("listeners", name, "config.yaml"))
    settings = getattr(getattr(listener, "how", listener), "settings", None)
    if not isinstance(settings, config.Arig):
        raise ConfigError(f"--listener {name}: does not speak; this command evaluates listeners of kind arig")
    held_out = {scene: spread_clips(dyads, clips) for scene, dyads in open_scenes(data, "validation").items()}
    rolled = played(name, listener, held_out, seed)
    every = [one for scene in held_out for one in rolled[scene]]
    dyads = [dyad for each in held_out.values() for dyad in each]
    motions, people = [one.motion[0] for one in every], [dyad.listener for dyad in dyads]
    lips: dict[str, Any] = {}
    for scene in ("speaking", "interaction"):  # filmed recordings, and the agent's talk in interaction
        if scene in held_out:
            made, recorded = [one.motion[0] for one in rolled[scene]], [dyad.listener for dyad in held_out[scene]]
            lips |= {f"lips_{scene}_{key}": value for key, value in jaw_tracking(made, recorded).items()}
    return {
        "listener": name,
        "dyads": {scene: len(each) for scene, each in held_out.items()},
        "chunk_border_acceleration_ratio": border_ratio(motions, settings.chunk_frames),
        "dyads_border_acceleration_ratio": border_ratio(people, settings.chunk_frames),
        **_states(every, dyads, data, clips),
        **lips,
        "jaw_left_a_second_after_speech": listening_again(motions, dyads),
        "people_jaw_left_a_second_after_speech": listening_again(people, dyads),
    }


def played(
    name: str, listener: Listener, held_out: Mapping[str, Sequence[Dyad]], seed: int, clip_frames: int = 1
) -> dict[str, list[Rollout]]:
    """Play a listener through the dyads of each scene, with a progress bar."""
    with bar(name, sum(map(len, held_out.values()))) as advance:
        return {scene: rollouts(listener, dyads, seed, advance, clip_frames) for scene, dyads in held_out.items()}


# --- states ---------------------------------------------------------------------------------------------------------


def _states(rolled: Sequence[Rollout], dyads: Sequence[Dyad], data: Path, clips: int | None) -> dict[str, Any]:
    """Return accuracies of the listener's states, and of two rules on voices that the training labels give."""
    labelled = [
        (one.states[0], dyad, dyad.states) for one, dyad in zip(rolled, dyads, strict=True) if dyad.states is not None
    ]
    said = np.concatenate([np.zeros(0, np.int8), *(answers for answers, _, _ in labelled)])
    if (said < 0).all():
        return {}
    truth = np.concatenate([states for _, _, states in labelled])
    truth = np.where(said < 0, UNKNOWN, truth).astype(np.int8)  # the first frame of a stream is given
    voices = np.concatenate([voice_tracks(dyad) for _, dyad, _ in labelled])
    tables = {
        name: confusion(answers, truth) for name, answers in {"state": said, **_by_rule(voices, data, clips)}.items()
    }
    found: dict[str, Any] = {}
    for name, table in tables.items():
        found |= {f"{name}_accuracy": accuracy(table), f"{name}_balanced_accuracy": balanced_accuracy(table)}
    return {**found, "confusion": {"states": list(STATES), "label_by_answer": tables["state"].tolist()}}


def _by_rule(voices: Bools, data: Path, clips: int | None) -> dict[str, States]:
    """Return the answers of the most frequent state and of the best voice rule of training for voices (N, 2)."""
    learned = [
        dyad
        for each in open_scenes(data, "train").values()
        for dyad in spread_clips(each, clips)
        if dyad.states is not None
    ]
    states = np.concatenate([np.zeros(0, np.int8), *(dyad.states for dyad in learned if dyad.states is not None)])
    if not (states >= 0).any():
        return {}
    majority = np.full(len(voices), np.bincount(states[states >= 0]).argmax(), np.int8)
    rule = voice_rule(np.concatenate([voice_tracks(dyad) for dyad in learned]), states)
    return {"majority": majority, "voice_rule": rule[voices[:, 0].astype(int), voices[:, 1].astype(int)]}


def voice_rule(voiced: Bools, states: States) -> States:
    """Return the most frequent state (2, 2) of each pattern of speech (N, 2), agent x user; unlabelled frames drop out.

    This is the best that voice activity alone can do.
    """
    best = np.full((2, 2), STATE["waiting"], np.int8)
    for agent in (0, 1):
        for user in (0, 1):
            seen = states[(voiced[:, 0] == agent) & (voiced[:, 1] == user) & (states >= 0)]
            if len(seen):
                best[agent, user] = np.bincount(seen, minlength=len(STATES)).argmax()
    return best


def voice_tracks(dyad: Dyad) -> Bools:
    """Return the speech (N, 2) of agent and user as the listener hears it: the agent's now, the user's a frame late."""
    silent = np.zeros(len(dyad.listener), bool)
    agent, user = (
        silent if track is None else audio_frontend.track(track)[1] for track in (dyad.agent_audio, dyad.audio)
    )
    return np.stack([agent, np.r_[False, user[:-1]]], axis=-1)


def confusion(said: States, states: States) -> NDArray[np.int64]:
    """Count frames by label (rows) and answer (columns), (7, 7); frames without either drop out."""
    known = (said != UNKNOWN) & (states != UNKNOWN)
    out = np.zeros((len(STATES), len(STATES)), np.int64)
    np.add.at(out, (states[known], said[known]), 1)
    return out


def accuracy(table: NDArray[np.int64]) -> float:
    """Return the share on the diagonal; NaN of an empty table."""
    total = table.sum()
    return float(np.trace(table) / total) if total else float("nan")


def balanced_accuracy(table: NDArray[np.int64]) -> float:
    """Return the mean, over the states that occur, of the share found; a constant answer gets 1 over their number."""
    of = table.sum(axis=1)
    return float((np.diag(table)[of > 0] / of[of > 0]).mean()) if of.any() else float("nan")


# --- lips and smoothness --------------------------------------------------------------------------------------------


def jaw_tracking(made: Sequence[Floats], recorded: Sequence[Floats], lags: int = _LAGS) -> dict[str, float]:
    """Return how the jaw of motions (N, 58) follows the recorded ones; pairs of 2 `lags` frames or fewer drop out.

    correlation at lag 0, over all clips, each less its mean; the lag (positive: late) with the highest correlation, and
    that; and the deviation of the jaw over that of the recorded one.
    """
    long = [(a[:, _JAW], b[:, _JAW]) for a, b in zip(made, recorded, strict=True) if len(a) > 2 * lags]
    found = {0: 0.0}
    spread = 0.0
    if long:
        found = {lag: _pooled(long, lag) for lag in range(-lags, lags + 1)}
        ours, theirs = (np.concatenate([one - one.mean() for one in each]).std() for each in zip(*long, strict=True))
        spread = float(ours / max(theirs, _STILL))
    best = max(found, key=lambda lag: (found[lag], -abs(lag)))
    return {"correlation": found[0], "lag_frames": best, "correlation_at_lag": found[best], "jaw_spread": spread}


def _pooled(pairs: Sequence[tuple[Floats, Floats]], lag: int) -> float:
    ours, theirs = [], []
    for one, other in pairs:
        a, b = one[max(0, lag) : len(one) + min(0, lag)], other[max(0, -lag) : len(other) - max(0, lag)]
        ours.append(a - a.mean())
        theirs.append(b - b.mean())
    x, y = np.concatenate(ours).astype(float), np.concatenate(theirs).astype(float)
    return float(np.corrcoef(x, y)[0, 1]) if min(x.std(), y.std()) >= _STILL else 0.0


def border_ratio(motions: Sequence[Floats], period: int, first: int = 1, skip: int = 25) -> float:
    """Return the mean acceleration of the head's rotation at chunk borders over that elsewhere.

    Frame t of a motion (N, 58) was made in chunk (t - first) // period; an acceleration is at a border when its three
    frames are of different chunks. The first `skip` frames, in which a stream settles, do not count.
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


def listening_again(motions: Sequence[Floats], dyads: Sequence[Dyad]) -> float:
    """Return the mean jaw opening a second and more after the agent's own voice over that during it."""
    speaking, after = [np.zeros(0, np.float32)], [np.zeros(0, np.float32)]
    for one, dyad in zip(motions, dyads, strict=True):
        if dyad.agent_audio is None:
            continue
        active = audio_frontend.track(dyad.agent_audio)[1]
        spans = np.flatnonzero(active)[:, None] * FRAME_S + np.array([0.0, FRAME_S])
        recent = near(spans, len(active), 1 / FRAME_S, 1.0)
        speaking.append(one[active, _JAW])
        after.append(one[~recent, _JAW])
    said, quiet = np.concatenate(speaking), np.concatenate(after)
    return float(quiet.mean() / said.mean()) if len(said) and len(quiet) and said.mean() > 0 else float("nan")
