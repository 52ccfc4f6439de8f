"""Laws of every kind of stream: one seed is one motion, nothing looks ahead, and streams share nothing."""

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from same import same
from tiny_arig import arig_listener, soft, talk
from tiny_sfms import told_listener

from sfms_robot.config import Calmness
from sfms_robot.data import data_dir
from sfms_robot.frames import FRAME_S, ListenerEvent, SpeakerFrame
from sfms_robot.listeners.eventful import EventfulListener
from sfms_robot.listeners.events.model import EventModel
from sfms_robot.listeners.registry import load_folder
from sfms_robot.signals.control import control_track

LIVELY = Calmness(nod=40, shake=10, tilt=10, smile=20, brow_raise=20, blink=40, gaze_shift=30, addressed="assume")
NOD, SMILE = ListenerEvent("nod", 0.3, 0.5, 0.1, 2), ListenerEvent("smile", 0.5, 0.6, 0.5)
SHIPPED = data_dir("configs") / "listeners"
KINDS = {
    "sfms": lambda tiny: tiny,
    "sfms with events": lambda tiny: told_listener(hop=2),
    "sfms on onnx": lambda tiny: load_folder(SHIPPED / "sfms-small", "onnx").at_hop(4),
    "arig": lambda tiny: soft(arig_listener()),
    "arig with events": lambda tiny: soft(arig_listener(events=True, draws="innovation", sway=True)),
    "arig on onnx": lambda tiny: load_folder(SHIPPED / "arig-small", "onnx"),
    "events decided": lambda tiny: EventfulListener(told_listener(hop=2), EventModel.load(), LIVELY),
}


@pytest.fixture(scope="module", params=KINDS)
def listener(request, tiny):
    return KINDS[request.param](tiny)


def control(listener, index, events=(NOD,)):
    """The control of a step, as far as it takes any."""
    past, ahead = getattr(listener, "control_frames", (0, 0))
    return [control_track(events, index + 1 - past, past + ahead)] if ahead else []


def stream(listener, speaker, seed=1, events=(NOD,)):
    memory, plans = listener.start(seed), []
    for index, frame in enumerate(speaker):
        plan, memory = listener.step(frame, memory, *control(listener, index, events))
        plans.append(plan)
    return plans, memory


def test_a_plan_comes_on_every_hop_and_starts_one_frame_later(listener):
    for index, plan in enumerate(stream(listener, talk(13))[0]):
        assert (plan is None) == (index % listener.hop > 0)
        if plan is not None:
            assert plan.frames.shape == (listener.horizon, 58) and plan.frames.dtype == np.float32
            assert plan.made_at_s == pytest.approx((index + 1) * FRAME_S)
            np.testing.assert_allclose(plan.times_s, plan.made_at_s + FRAME_S * np.arange(1, listener.horizon + 1))
            assert np.isfinite(plan.frames).all() and 0 <= plan.frames[:, 6:].min() and plan.frames[:, 6:].max() <= 1


def test_one_seed_repeats_and_two_differ(listener):
    one, again, other = (stream(listener, talk(20), seed)[0] for seed in (1, 1, 2))
    assert same(tuple(one), tuple(again)) and not same(tuple(one), tuple(other))


@pytest.mark.parametrize("changed_from", [1, 8, 16])
def test_later_frames_never_change_earlier_plans(listener, changed_from):
    speaker = talk(36)
    before, _ = stream(listener, speaker)
    after, _ = stream(listener, speaker[:changed_from] + talk(36, seed=9)[changed_from:])
    assert same(tuple(before[:changed_from]), tuple(after[:changed_from]))
    assert not same(tuple(before[changed_from:]), tuple(after[changed_from:]))


def test_a_step_never_changes_its_memory(listener):
    _, memory = stream(listener, talk(12))
    before, frame, rows = copy.deepcopy(memory), talk(13)[12], control(listener, 12)
    assert same(listener.step(frame, memory, *rows), listener.step(frame, memory, *rows)) and same(memory, before)


def test_arrays_of_a_frame_may_be_used_again(listener):
    memory, plans = listener.start(1), []
    for index, frame in enumerate(talk(13)):
        plan, memory = listener.step(frame, memory, *control(listener, index))
        plans.append(plan)
        for array in (frame.audio, frame.agent_audio, frame.face.pose, frame.face.blendshapes):
            array[:] = 1.0
    assert same(tuple(plans), tuple(stream(listener, talk(13))[0]))


def test_streams_of_any_age_together_are_each_one_alone(listener):
    one, begins = talk(30), (0, 3, 10, 0, 0)
    speakers = [*(talk(30, seed) for seed in (4, 5, 6)), one, one]
    events = ((NOD,), (), (SMILE, NOD), (NOD,), (SMILE,))
    alone = [stream(listener, speaker, *own)[0] for speaker, *own in zip(speakers, range(5), events, strict=True)]
    memories, together = [listener.start(seed) for seed in range(5)], [[] for _ in begins]
    for now in range(30):
        live = [row for row, begin in enumerate(begins) if begin <= now]
        rows = [control(listener, now - begins[row], events[row]) for row in live]
        controls = [[each for (each,) in rows]] if rows[0] else []
        frames = [speakers[row][now - begins[row]] for row in live]
        stepped = listener.step_each(frames, [memories[row] for row in live], *controls)
        for row, (plan, memories[row]) in zip(live, stepped, strict=True):
            together[row].append(plan)
    for plans, others in zip(alone, together, strict=True):
        for plan, other in zip(plans, others, strict=False):
            assert (plan is None) == (other is None)
            if plan is not None:
                assert plan.events == other.events
                np.testing.assert_allclose(plan.frames, other.frames, rtol=1e-4, atol=5e-5)


@given(has=st.lists(st.tuples(st.booleans(), st.booleans(), st.booleans()), min_size=1, max_size=12))
def test_any_mix_of_missing_modalities_is_normal(listener, has):
    speaker = []
    for frame, (face, audio, agent) in zip(talk(len(has)), has, strict=True):
        shown, said = frame.face if face else None, frame.agent_audio if agent else None
        speaker.append(SpeakerFrame(frame.time_s, frame.audio if audio else frame.audio[:0], shown, said))
    assert all(plan is None or np.isfinite(plan.frames).all() for plan in stream(listener, speaker)[0])


def test_a_face_that_is_not_finite_is_a_face_not_known(listener):
    lost, blind = (
        [replace(frame, face=face and replace(frame.face, pose=frame.face.pose * np.nan)) for frame in talk(12)]
        for face in (True, None)
    )
    assert same(tuple(stream(listener, lost)[0]), tuple(stream(listener, blind)[0]))
