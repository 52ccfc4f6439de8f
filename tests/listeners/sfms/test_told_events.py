"""A listener that is told of events: stream = offline, causality, what may be revoked, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from made_dyads import made_dyad
from tiny_sfms import plans_of, speech, told_listener

from sfms_robot.errors import ConfigError
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, POSE_CHANNELS, ListenerEvent
from sfms_robot.lab.corpora.clips import Dyad
from sfms_robot.lab.evaluation.rollout import frames_of_dyad, offline_rollout, rollout
from sfms_robot.listeners.sfms.draw import KEPT_FRAMES, UNDECIDED, passed, revoked
from sfms_robot.signals.control import COLUMNS, control_track

NOD = ListenerEvent("nod", 0.8, 0.8, 0.1, swings=2)
SMILE = ListenerEvent("smile", 1.5, 2.0, 0.6)
GAZE_NAMES = [name for name in BLENDSHAPES if name.startswith("eyeLook")]
GAZE = [CHANNEL_INDEX[name] for name in GAZE_NAMES]


@pytest.fixture(scope="module")
def told():
    return told_listener(hop=2)


def dyad(frames: int = 60, events=(NOD, SMILE)) -> Dyad:
    faces = np.random.default_rng(0).uniform(0, 0.3, (2, frames, 58)).astype(np.float32)
    return made_dyad(faces[1], speaker=faces[0], events=events)


@pytest.mark.parametrize("hop", [1, 2, 4, 8])
def test_a_stream_that_is_told_equals_offline(hop: int):
    listener, one = told_listener(hop=hop), dyad()
    whole = offline_rollout(listener, one, [3, 4]).motion
    streamed = rollout(listener, frames_of_dyad(one), [3, 4], one.events).motion
    for row in range(2):
        np.testing.assert_allclose(listener.space.decode(whole[row].numpy())[0], streamed[row], atol=2e-4)


@pytest.mark.parametrize("start_s", [0.5, 1.0, 1.3])
def test_an_event_changes_nothing_before_it_is_told(told, start_s: float):
    speaker = speech(50)
    without = plans_of(told, speaker)
    with_it = plans_of(told, speaker, events=[replace(NOD, start_s=start_s)])
    for index, plan in without.items():
        if start_s > (index + 3) * 0.04 + 1e-9:
            np.testing.assert_array_equal(plan.frames, with_it[index].frames)
    assert any(not np.array_equal(without[i].frames, with_it[i].frames) for i in without)


@pytest.mark.parametrize("hop", [1, 2])
@pytest.mark.parametrize("start_s", [0.52, 0.8, 1.0, 1.31])
def test_what_is_told_shows_within_120_ms_of_its_beginning(hop: int, start_s: float):
    """Tokens that were drawn before it was known do not stand in its way; with weights that heed what is told."""
    listener = told_listener(hop=hop)
    with torch.no_grad():
        listener.model.predictor.control_in[2].weight.mul_(50)
    speaker = speech(50)
    shown = [rollout(listener, speaker, [1], events).motion[0] for events in ((), (replace(NOD, start_s=start_s),))]
    differs = np.abs(shown[0] - shown[1]).max(axis=1) > 1e-6
    first = int(differs.argmax())
    assert differs.any() and start_s - 0.12 <= first * 0.04 <= start_s + 0.12


def test_what_is_told_again_as_it_was_calls_nothing_off(told):
    memory, last = told.start(1), None
    past, ahead = told.control_frames
    for index, frame in enumerate(speech(60)):
        plan, memory = told.step(frame, memory, control_track([NOD, SMILE], index + 1 - past, past + ahead))
        if plan is not None and last is not None:
            np.testing.assert_array_equal(memory.tokens[-8 : -told.hop], last[-8 + told.hop :])
        last = memory.tokens if plan is not None else last


def test_tokens_are_revoked_where_told_otherwise_and_the_last_keyframe_is_held_at_the_edge():
    tokens = np.ones((2, 48, 3), np.int64)
    before = np.zeros((2, 48, len(COLUMNS)), np.float32)
    told = before.copy()
    told[0, 43, 5] = 0.5  # of frame 3 of the future, and of that alone
    told[1, 40, 5] = 0.5  # of the next frame, which stays nevertheless
    told[:, 10] = 1.0  # what is past is past
    after, settled = revoked(tokens, before, told, 8)
    assert settled.tolist() == [42, 40]
    assert (after[0, 43:] == UNDECIDED).all() and (after[0, :43] == 1).all()
    assert (after[1, 40 + KEPT_FRAMES :] == UNDECIDED).all() and (after[1, : 40 + KEPT_FRAMES] == 1).all()
    tokens, path = np.zeros((1, 48, 2), np.int64), np.zeros((1, 10, 4), np.float32)
    tokens[0, 1, 0], tokens[0, 20, 1] = 5, 3
    for step in (1, 2, 3):
        moved, _ = passed(tokens, path, step, holds=True)
        assert moved[0, 0].tolist() == [5, 0]
    assert passed(tokens, path, 3)[0][0, 0].tolist() == [0, 0]
    onto_one, _ = passed(tokens, path, 20, holds=True)
    assert onto_one[0, 0].tolist() == [5, 3]


def test_gaze_is_left_to_kinematics_and_each_stream_sways_from_rest_its_own_way(told):
    for plan in plans_of(told, speech(30), events=[NOD]).values():
        assert (plan.frames[:, GAZE] == 0).all() and np.abs(plan.frames[:, :6]).max() > 0
    one, other = plans_of(told, speech(90), seed=1), plans_of(told, speech(90), seed=2)
    assert not np.array_equal(one[80].frames[:, :6], other[80].frames[:, :6])
    nothing = np.zeros((1, 90, 58), np.float32)
    still = told.with_sway(nothing, told.start(1).sway[None], 0) - told.engine.tensors["motion_mean"]
    assert np.abs(still[0, 0, :6]).max() < 1e-4 < np.abs(still[0, 60:, :6]).max() and not still[..., 6:].any()


@pytest.mark.parametrize("shape", [(47, 36), (48, 35)])
def test_control_of_another_shape_is_refused(told, shape):
    with pytest.raises(ValueError, match=rf"control has shape \({shape[0]}, {shape[1]}\), not \(48, 36\)"):
        told.step(speech(1)[0], told.start(1), np.zeros(shape, np.float32))


def test_one_that_is_not_told_takes_none(tiny):
    assert tiny.control_frames == (0, 0)
    with pytest.raises(ValueError, match=r"control has shape \(48, 36\)"):
        tiny.step(speech(1)[0], tiny.start(1), np.zeros((48, 36), np.float32))


NECK = {"channels": POSE_CHANNELS, "levels": (3, 2)}
FACE = {"channels": [name for name in BLENDSHAPES if not name.startswith("eyeLook")], "levels": (2, 4)}


@pytest.mark.parametrize(
    "changes, text",
    [
        ({"events": False, "sway": True, "placement": "exact",
          "groups": {"neck": NECK | {"keyframes": 3}, "face": FACE | {"channels": BLENDSHAPES, "keyframes": 3}}},
         "sway: expected events: true, without which a nod counts as sway"),
        ({"groups": {"neck": NECK | {"keyframe_cost": 1}, "face": FACE | {"channels": GAZE_NAMES, "keyframe_cost": 1}}},
         "'eyeLookDownLeft' is not a channel"),
        ({"groups": {"neck": NECK | {"keyframes": 3}, "face": FACE | {"keyframe_cost": 1}}},
         "groups.neck: placement penalised takes keyframe_cost, not keyframes"),
        ({"placement": "exact", "groups": {"neck": NECK | {"keyframe_cost": 3}, "face": FACE | {"keyframes": 1}}},
         "groups.neck: placement exact takes keyframes, not keyframe_cost"),
    ],
)  # fmt: skip
def test_a_configuration_that_contradicts_itself_is_refused(changes, text):
    with pytest.raises(ConfigError, match=text):
        told_listener(**changes)
