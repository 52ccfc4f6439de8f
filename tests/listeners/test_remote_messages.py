"""The wire between a robot and a server: what is said comes back, and nothing else is taken for a message."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from same import same

from sfms_robot.errors import PacketError
from sfms_robot.frames import EVENT_KINDS, FaceFrame, ListenerEvent, Plan, SpeakerFrame
from sfms_robot.listeners import remote_messages as messages

TIMES = st.floats(0, 1e6, width=64)


SEEDS = st.integers(0, 2**32 - 1).map(np.random.default_rng)  # arrays of this size take hypothesis long to draw


def floats(*shape):
    return SEEDS.map(lambda rng: rng.normal(0, 3, shape).astype(np.float32))


SOUND = SEEDS.map(lambda rng: (rng.integers(-32768, 32768, 640) / 32768).astype(np.float32))
FACES = st.builds(FaceFrame, TIMES, floats(6), floats(52), st.none() | floats(3))
FRAMES = st.builds(
    SpeakerFrame, TIMES, SOUND | st.just(np.zeros(0, np.float32)), st.none() | FACES, st.none() | SOUND,
    st.none() | st.floats(0, 1), st.none() | floats(3),
)  # fmt: skip
EVENTS = st.builds(
    ListenerEvent, st.sampled_from(EVENT_KINDS), TIMES, st.floats(0, 5), st.floats(0, 1), st.integers(1, 5),
    st.none() | st.tuples(st.floats(-1, 1), st.floats(-1, 1)), st.none() | st.floats(0, 1), st.none() | st.floats(0, 1),
    st.dictionaries(st.text(max_size=8), st.floats(-5, 5), max_size=3),
)  # fmt: skip


@st.composite
def plans(draw):
    length = draw(st.integers(1, 9))
    return Plan(
        draw(TIMES), np.array(draw(st.lists(TIMES, min_size=length, max_size=length))), draw(floats(length, 58)),
        draw(st.none() | floats(length, 3)), tuple(draw(st.lists(EVENTS, max_size=3))),
        draw(st.dictionaries(st.sampled_from(EVENT_KINDS), st.floats(0, 9))),
    )  # fmt: skip


def sent_plan(plan):
    return messages.SentPlan(number=0, plan=plan, echo_s=1.0, came_s=1.0, sent_s=1.0, step_ms=1.0)


@given(st.integers(0, 2**31 - 1), FRAMES, TIMES, TIMES | st.just(math.nan))
def test_a_frame_comes_as_it_was_sent(number, frame, sent_s, server_s):
    sent = messages.SentFrame(number, frame, sent_s, server_s)
    assert same(messages.parse_frame(messages.frame_message(sent)), sent)


@given(SEEDS.map(lambda rng: rng.uniform(-1, 1, 640).astype(np.float32)))
def test_sound_loses_half_a_step_of_a_sound_card_at_most(audio):
    heard = messages.parse_frame(
        messages.frame_message(messages.SentFrame(0, SpeakerFrame(0.04, audio), 0.0))
    ).frame.audio
    assert np.abs(heard - audio).max() <= 1 / 32768


@given(st.integers(0, 2**31 - 1), plans(), TIMES, TIMES, TIMES, st.floats(0, 1e4, width=32))
def test_a_plan_comes_as_it_was_made(number, plan, echo_s, came_s, sent_s, step_ms):
    sent = messages.SentPlan(number=number, plan=plan, echo_s=echo_s, came_s=came_s, sent_s=sent_s, step_ms=step_ms)
    assert same(messages.parse_plan(messages.plan_message(sent)), sent)


@given(plans(), st.tuples(EVENTS, EVENTS))
def test_a_plan_tells_the_events_of_plans_before_it_first(plan, earlier):
    told = messages.parse_plan(messages.plan_message(sent_plan(plan), earlier)).plan
    assert told.events == (*earlier, *plan.events)


@pytest.mark.parametrize(
    "said",
    [
        messages.Join("a", 3), messages.Join("a", 3, {"nod": 2.0}),
        messages.Welcome(stream="s", server="big-1", listener="sfms-small", horizon=8, hop=3),
        messages.Refusal("full", False), messages.Notice("skipped", 3), messages.Notice("calm", calmness={"nod": 1.0}),
    ],
)  # fmt: skip
def test_words_come_as_they_were_said(said):
    assert messages.parse_words(messages.words_message(said)) == said


def whole_messages():
    frame = SpeakerFrame(0.04, np.zeros(640, np.float32), FaceFrame.of(0.0, np.zeros(58)))
    plan = Plan(0.04, np.array([0.08]), np.zeros((1, 58), np.float32))
    return [
        (messages.parse_frame, messages.frame_message(messages.SentFrame(0, frame, 1.0))),
        (messages.parse_plan, messages.plan_message(sent_plan(plan))),
    ]


@pytest.mark.parametrize(("parse", "message"), whole_messages(), ids=["frame", "plan"])
def test_a_message_that_is_cut_short_too_long_or_of_another_protocol_is_none(parse, message):
    for end in range(len(message)):
        with pytest.raises(PacketError):
            parse(message[:end])
    with pytest.raises(PacketError, match="1 bytes too many"):
        parse(message + b"x")
    with pytest.raises(PacketError, match="got protocol 2"):
        parse(message[:1] + b"\x02" + message[2:])


@given(st.binary(max_size=300))
def test_random_bytes_are_refused_in_one_line(data):
    for parse in (messages.parse_frame, messages.parse_plan, messages.parse_words):
        with pytest.raises(PacketError):
            parse(data)
    for parse, message in whole_messages():
        at = len(message) - len(data)
        try:
            parse(message[:at] + data)
        except PacketError as error:
            assert "\n" not in str(error)


def test_interfaces_fit_whatever_the_version_and_words_of_a_later_protocol_are_read_as_far_as_named():
    assert messages.OURS.fits(replace(messages.OURS, version="9.9"))
    assert not messages.OURS.fits(replace(messages.OURS, motion="deca56"))
    assert not messages.OURS.fits(replace(messages.OURS, protocol=2))
    assert not messages.OURS.fits(replace(messages.OURS, frame_hz=30))
    told = json.loads(messages.words_message(messages.Join("a", 0)))
    told["interface"] |= {"protocol": 7, "colour": "red"}
    assert messages.parse_words(json.dumps(told).encode()).interface.protocol == 7


@pytest.mark.parametrize(
    "told",
    ["{", "{}", '{"type": "join"}', '{"type": "join", "client": 3, "seed": 0}', '{"type": "robot"}',
     '{"type": "join", "client": "a", "seed": -1}', '{"type": "join", "client": "a", "seed": true}',
     '{"type": "join", "client": "a", "seed": 1' + 99 * "0" + "}",
     '{"type": "notice", "kind": "calm", "calmness": 3}', '{"type": "refusal", "reason": "full", "final": 1}',
     '{"type": "notice", "kind": "leave", "more": 1}', "[" * 9_000, "{" + " " * 20_000 + "}"],
)  # fmt: skip
def test_words_that_are_none_are_refused(told):
    with pytest.raises(PacketError):
        messages.parse_words(told.encode())
