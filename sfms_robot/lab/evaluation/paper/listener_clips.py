"""What listeners answer to the dyads of a table, cut into its clips."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import torch

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_HZ, Doubles
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.corpora.collection import Dataset, usable
from sfms_robot.lab.evaluation.paper.listener_tables import FRAMES, NEEDED_FRAMES, Clips, cut
from sfms_robot.lab.evaluation.paper.over_people import people_of
from sfms_robot.lab.evaluation.rollout import frames_of_dyad, offline_rollout, rollout, whole_clips
from sfms_robot.lab.learning.corpus import in_space
from sfms_robot.lab.learning.sfms.features import frames_of
from sfms_robot.listeners.sfms.stream import SfmsListener
from sfms_robot.listeners.space import MotionSpace
from sfms_robot.ports import Listener

TRAIN_DYADS: Final = 200  # that the heuristics take their means from


def shared_space(listeners: Mapping[str, Listener]) -> MotionSpace:
    """The motion space of all listeners, of one that decides events that of its model of motion.

    Raises ConfigError when there are several.
    """
    spaces = {
        name: getattr(getattr(listener, "how", listener), "space", MotionSpace("arkit58", np.zeros(58)))
        for name, listener in listeners.items()
    }
    if len({space.name for space in spaces.values()}) > 1:
        named = ", ".join(f"{name}: {space.name}" for name, space in spaces.items())
        raise ConfigError(f"one table has one motion space, these have several ({named}): evaluate them one by one")
    return next(iter(spaces.values()))


def spread(dyads: Dataset, most: int | None) -> list[Dyad]:
    """At most that many, evenly from first to last; those that cannot be read are left out, named in a warning.

    Raises ConfigError when none can be read.
    """
    step = 1.0 if most is None else max(1.0, len(dyads) / most)
    chosen = replace(dyads, clips=tuple(dyads.clips[int(at)] for at in np.arange(0, len(dyads), step)))
    found = list(usable(chosen))
    if not found:
        raise ConfigError(f"{dyads.layout} {dyads.split}: none of {len(chosen)} clips can be read")
    return found


def collect(
    number: int,
    listeners: Mapping[str, Listener],
    space: MotionSpace,
    train: Sequence[Dyad],
    held_out: Sequence[Dyad],
    seeds: Sequence[int],
    each: Callable[[], None] = lambda: None,
) -> tuple[Clips, dict[str, Doubles]]:
    """Clips of a table, and what every listener answers to them (N, K, T, D), K seeds.

    A listener hears a dyad from its beginning; clips are cut out of what it did. `each()` is called after every dyad of
    every listener. Raises ConfigError when the dyads are too short for the table's metrics.
    """
    learned = [np.asarray(in_space(dyad, dyad.listener, space)) for dyad in train]
    heard = [frames_of(dyad, space) for dyad in held_out]
    longest = max(len(one.motion) for one in heard)
    frames = min(FRAMES[number], longest, max(len(one) for one in learned))
    if frames < NEEDED_FRAMES[number]:
        raise ConfigError(f"table {number} needs clips of {NEEDED_FRAMES[number]} frames, the longest has {longest}")
    rest = torch.tensor(space.neutral, dtype=torch.float32)
    faces = [np.asarray(torch.where(one.face_known[:, None], one.face, rest)) for one in heard]  # unknown: at rest
    clips = Clips(
        space.name,
        cut([np.asarray(one.motion) for one in heard], frames),
        cut(faces, frames),
        cut(learned, frames),
        people_of(held_out, [len(one.motion) for one in heard], frames),
    )
    answered = {}
    for name, listener in listeners.items():
        motions = []
        for dyad in held_out:
            motions.append(_answered(listener, space, dyad, seeds, frames))
            each()
        answered[name] = cut(motions, frames)
    return clips, answered


def _answered(listener: Listener, space: MotionSpace, dyad: Dyad, seeds: Sequence[int], frames: int) -> Doubles:
    """(S, N, D) in the space; what is no whole clip of so many frames may be left out."""
    if isinstance(listener, SfmsListener):
        return np.asarray(offline_rollout(listener, dyad, seeds).motion)
    if dyad.space != "arkit58":
        raise ConfigError(
            f"dyad {dyad.name} is in {dyad.space}: a listener of another kind than sfms takes faces alone"
        )
    if dyad.fps != FRAME_HZ:
        raise ConfigError(
            f"dyad {dyad.name} has {dyad.fps:g} frames a second: such a listener is streamed at {FRAME_HZ}"
        )
    heard = whole_clips(frames_of_dyad(dyad), frames)
    return np.stack([space.encode(one) for one in rollout(listener, heard, seeds).motion])
