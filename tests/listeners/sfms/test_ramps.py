"""A ramp to a keyframe begins no earlier than somebody knew of it; so nods come out as told, whatever the hop."""

import numpy as np
import pytest
from tiny_sfms import speech

from sfms_robot.config import find
from sfms_robot.frames import CHANNEL_INDEX, ListenerEvent
from sfms_robot.lab.evaluation.detection import Detected, added_up, asked_and_seen
from sfms_robot.lab.evaluation.rollout import rollout
from sfms_robot.listeners.registry import at_hop, load_listener
from sfms_robot.listeners.sfms.draw import UNDECIDED, anchored, revoked

NOW, RAMP = 4, 4


def window(*tokens: int) -> np.ndarray:
    """(1, T, 1) of one group, the newest frame shown at `NOW`."""
    return np.array(tokens)[None, :, None]


def now_of(tokens: np.ndarray, before: np.ndarray) -> int:
    found = anchored(tokens, before == UNDECIDED, np.array([NOW]), RAMP)
    rest = np.arange(tokens.shape[1]) != NOW
    np.testing.assert_array_equal(found[:, rest], tokens[:, rest])
    return int(found[0, NOW, 0])


def test_what_was_held_is_a_keyframe_where_a_ramp_to_a_new_one_begins():
    assert now_of(window(0, 7, 0, 0, 0, 0, 3, 0, 0), window(0, 7, 0, 0, 0, -1, -1, -1, -1)) == 7


@pytest.mark.parametrize(
    "tokens, before",
    [
        ((0, 7, 0, 0, 0, 0, 0, 0, 3), (0, 7, 0, 0, 0, -1, -1, -1, -1)),  # its ramp begins later by itself
        ((0, 7, 0, 0, 0, 0, 3, 0, 2), (0, 7, 0, 0, 0, 0, 3, -1, -1)),  # on its way already
        ((0, 7, 0, 0, 0, 0, 0, 0, 0), (0, 7, 0, 0, 0, -1, -1, -1, -1)),  # none
    ],
)
def test_where_no_ramp_begins_anew_nothing_changes(tokens, before):
    assert now_of(window(*tokens), window(*before)) == 0


def test_a_keyframe_at_the_newest_frame_stays_and_without_any_before_there_is_none():
    assert now_of(window(0, 7, 0, 0, 5, 0, 3, 0, 0), window(0, 7, 0, 0, 5, -1, -1, -1, -1)) == 5
    assert now_of(window(0, 0, 0, 0, 0, 0, 3, 0, 0), window(0, 0, 0, 0, 0, -1, -1, -1, -1)) == 0


def test_groups_and_streams_are_each_by_itself():
    tokens = np.stack([window(0, 7, 0, 0, 0, 0, 3, 0, 0)[0, :, 0], np.zeros(9, int)], axis=1)
    both = np.stack([tokens, tokens[:, ::-1]])
    found = anchored(both, np.arange(9)[None, :, None] > NOW + 0 * both, np.array([NOW, NOW]), RAMP)
    np.testing.assert_array_equal(found[:, NOW], [[7, 0], [0, 7]])


def test_a_ramp_begins_no_earlier_than_what_it_was_told_for():
    """Frames that are kept show what they showed: a ramp to a keyframe behind them begins at the last of them."""
    tokens = np.concatenate([window(0, 7, 0, 0, 0, 0, 0, 0, 3)] * 3)
    told = np.zeros((3, 9, 1), np.float32)
    told[0, NOW + 3 :] = told[1, NOW + 1 :] = 1.0
    kept, settled = revoked(tokens, np.zeros_like(told), told, 4)
    assert settled.tolist() == [NOW + 2, NOW + 1, NOW]  # the next frame is kept, whatever is told; nothing told anew
    drawn = np.where(kept == UNDECIDED, window(0, 0, 0, 0, 0, 0, 0, 0, 3), kept)
    found = anchored(drawn, kept == UNDECIDED, settled, RAMP)
    assert found[:, :, 0].tolist() == [
        [0, 7, 0, 0, 0, 0, 7, 0, 3],
        [0, 7, 0, 0, 0, 7, 0, 0, 3],
        [0, 7, 0, 0, 0, 0, 0, 0, 3],
    ]


@pytest.mark.parametrize("hop", [pytest.param(1, marks=pytest.mark.slow), 2, 4])
def test_nods_come_out_as_told_and_when(hop: int):
    """Of every length and size that are decided: the shipped listener, told of them in silence."""
    listener = at_hop(load_listener(find("listeners", "sfms-small", "config.yaml")), hop).how
    made_s = [(each_s, swings) for each_s in (0.3, 0.4, 0.55) for swings in (1, 2, 3)]
    nods = [
        ListenerEvent("nod", 2.0 + 3.0 * at, each_s * swings, np.radians(5.0 if at % 2 else 4.0), swings)
        for at, (each_s, swings) in enumerate(made_s)
    ]
    silence = speech(round(25 * (nods[-1].end_s + 2)))
    motions = rollout(listener, silence, [1, 2, 3], nods).motion
    seen = added_up(asked_and_seen(nods, Detected.of(motion), {"nod": -0.06}) for motion in motions)["nod"]
    assert seen.recall >= 26 / 27 and seen.precision >= 26 / 27
    pitch = np.degrees(motions[..., CHANNEL_INDEX["pitch"]])
    made = [np.ptp(pitch[:, round(25 * nod.start_s) - 2 : round(25 * nod.end_s) + 2], axis=1) for nod in nods]
    assert 0.85 < np.median(np.array(made) / np.degrees([[nod.size] for nod in nods])) < 1.15
