"""The same evidence gives the same events; nothing that lies makes it nod like a woodpecker; a knob is a knob."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.config import Calmness
from sfms_robot.frames import (
    CHANNEL_INDEX,
    EVENT_KINDS,
    FRAME_S,
    FRAME_SAMPLES,
    MOTION_DIM,
    FaceFrame,
    ListenerEvent,
    SpeakerFrame,
)
from sfms_robot.listeners.events.evidence import CORNERS, EPS_S, sense
from sfms_robot.listeners.events.model import AT_PERSON, EventModel
from sfms_robot.signals.event_sizes import RETURN_SIZE

MODEL = EventModel.load()
MINUTES = 2
FRAMES = round(MINUTES * 60 / FRAME_S)
NOBODY = np.zeros(0, np.float32)
MOST_NODS = 12.0  # a minute, of a head that takes itself for addressed all along
HEAD = ("nod", "shake", "tilt")


def talk(frames=FRAMES, seed=0):
    """(frames,) phrases of 1 to 6 s with pauses of 0.4 to 1.6 s."""
    rng = np.random.default_rng(seed)
    lengths = np.array([(rng.integers(25, 150), rng.integers(10, 40)) for _ in range(frames // 35)]).ravel()
    return np.repeat(np.arange(len(lengths)) % 2 == 0, lengths)[:frames]


def sound(active, seed=0):
    """(N, 640) noise, loud where somebody speaks."""
    rng, level = np.random.default_rng(seed), np.where(active, 0.1, 1e-4)[:, None]
    return (level * rng.standard_normal((len(active), FRAME_SAMPLES))).astype(np.float32)


VOICE = sound(talk())


def conversation(voice=VOICE, attention=None, face=None, agent=None):
    """Speaker frames; attention and face are (N,) and (N, 58), or none."""
    for index, audio in enumerate(voice):
        time_s = (index + 1) * FRAME_S
        seen = None if face is None else FaceFrame.of(time_s, face[index])
        yield SpeakerFrame(
            time_s, audio, seen, None if agent is None else agent[index],
            None if attention is None else attention[index],
        )  # fmt: skip


def listen(frames, seed=1, calmness=None, own=None, memory=None):
    """All events, and the nod hazard of every frame."""
    memory = memory or MODEL.start(seed, calmness or Calmness())
    events, hazards = [], []
    for frame in frames:
        sensed, heard = sense(frame, memory.sensed)
        done = memory.done if own is None else tuple(one for one in own if one.start_s < frame.time_s - EPS_S)
        ((decided, memory),) = MODEL.decide_each([sensed], [replace(memory, done=done)])
        memory = replace(memory, sensed=heard)
        events += decided
        hazards.append(memory.hazards_hz["nod"])
    return events, np.array(hazards)


def of(kind, events):
    return [event for event in events if event.kind == kind]


@pytest.fixture(scope="module")
def usual():
    return listen(conversation())[0]


def test_everything_that_people_do_happens(usual):
    lively = Calmness(shake=6, tilt=6, laugh=6, smile=6, mm_hm=6, brow_raise=6)
    more = [listen(conversation(), seed, lively)[0] for seed in (1, 2)]
    assert {event.kind for events in more for event in events} == set(EVENT_KINDS)
    assert 1 * MINUTES <= len(of("nod", usual)) <= MOST_NODS * MINUTES
    assert 8 * MINUTES <= len(of("blink", usual)) <= 30 * MINUTES


def test_events_are_whole_and_none_of_the_head_begins_inside_another(usual):
    for event in usual:
        assert event.duration_s > 0 and event.size > 0 and 1 <= event.swings <= 4
        assert round(event.start_s / FRAME_S) == pytest.approx(event.start_s / FRAME_S)
        if event.probability is not None:
            assert event.draw < event.probability and event.evidence is not None
        if event.kind == "nod":
            assert math.radians(2) < event.size < math.radians(13)
            assert 0.3 <= event.duration_s / event.swings <= 0.66
    head = [event for event in usual if event.kind in HEAD]
    assert all(after.start_s >= before.end_s - 2 * FRAME_S for before, after in zip(head, head[1:], strict=False))


def test_a_look_away_is_followed_by_a_look_back(usual):
    looks = of("gaze_shift", usual)
    assert len(looks) >= 4
    for away, back in zip(looks[::2], looks[1::2], strict=False):
        assert away.target_rad != AT_PERSON and back.target_rad == AT_PERSON
        assert 0 <= back.start_s - away.end_s < 0.2 and math.hypot(*away.target_rad) == pytest.approx(away.size)
    aside_s = sum(event.duration_s for event in looks[::2])
    assert 0.005 < aside_s / (60 * MINUTES) < 0.25


def test_nobody_nods_to_silence_or_over_own_words():
    silence = np.zeros((FRAMES, FRAME_SAMPLES), np.float32)
    assert not [e for e in listen(conversation(silence))[0] if e.kind not in ("blink", "gaze_shift")]
    said = sound(np.ones(FRAMES, bool), seed=5)
    assert not [e for e in listen(conversation(agent=said))[0] if e.kind not in ("blink", "gaze_shift")]


def test_without_a_microphone_a_moving_mouth_is_a_voice():
    face = np.zeros((FRAMES, MOTION_DIM), np.float32)
    swing = 0.15 + 0.15 * np.sin(2 * np.pi * 4 * np.arange(FRAMES) * FRAME_S)
    face[:, CHANNEL_INDEX["jawOpen"]] = np.where(talk(), swing, 0)
    deaf = [NOBODY] * FRAMES
    assert of("nod", listen(conversation(deaf, face=face))[0])
    assert not of("nod", listen(conversation(deaf, face=np.zeros_like(face)))[0])


@settings(max_examples=5)
@given(st.floats(0.1, 30), st.floats(1.01, 4))
def test_more_of_a_knob_is_never_less_of_its_hazard(rate, times):
    frames = list(conversation())[:750]
    low = listen(frames, calmness=Calmness(nod=rate), own=())[1]
    high = listen(frames, calmness=Calmness(nod=min(60.0, rate * times)), own=())[1]
    assert (high >= low).all() and high.max() > 0


def test_attention_unknown_is_between_flickering_is_none_and_without_a_face_it_is_as_asked_for():
    asks = {
        name: listen(conversation(attention=np.full(FRAMES, value)), own=())[1].mean()
        for name, value in {"looked at": 1.0, "unknown": math.nan, "not": 0.0}.items()
    }
    assert asks["not"] < asks["unknown"] < asks["looked at"]
    looked = listen(conversation(), own=())[1]
    assume = listen(conversation(), own=(), calmness=Calmness(addressed="assume"))[1]
    never = listen(conversation(), own=(), calmness=Calmness(addressed="never"))[1]
    np.testing.assert_array_equal(looked, assume)
    assert never.mean() < 0.6 * assume.mean()
    frames = [attention % 2 for attention in range(FRAMES)]
    flickers, untold = (listen(conversation(attention=given), own=())[1] for given in (frames, None))
    np.testing.assert_array_equal(flickers, untold)


def test_a_head_that_moves_as_it_talks_does_not_nod_and_one_that_is_silent_does():
    times = np.arange(FRAMES) * FRAME_S
    face, moving = np.zeros((2, FRAMES, MOTION_DIM), np.float32)
    moving[:, 1] = np.radians(6) * np.sin(np.pi * np.minimum(times % 4.0, 0.5) / 0.5) ** 2  # every four seconds
    for voice, least, most in ((sound(np.ones(FRAMES, bool)), 0.0, 0.0), (VOICE, 0.02, np.inf)):
        moved, still = (listen(conversation(voice, face=one), own=())[1] for one in (moving, face))
        assert least <= np.abs(moved - still).max() <= most


def faces():
    rng, still = np.random.default_rng(4), np.zeros((FRAMES, MOTION_DIM), np.float32)
    upside = still.copy()
    upside[:, 0] = np.pi
    upside[:, 1] = np.pi * np.sign(rng.normal(size=FRAMES))
    yield "constant", still + 0.3
    yield "saturated", still + 1.0
    yield "beyond", still + 1e6
    yield "upside down", upside
    yield "not finite", np.where(rng.random((FRAMES, 1)) < 0.5, np.nan, still + np.float32(np.inf)).astype(np.float32)
    yield "noise", rng.normal(0, 1, (FRAMES, MOTION_DIM)).astype(np.float32)
    nods = still.copy()
    nods[:, 1] = np.radians(6) * np.sin(2 * np.pi * 2 * np.arange(FRAMES) * FRAME_S)
    yield "always nodding", nods


@pytest.mark.parametrize(("name", "face"), list(faces()), ids=lambda value: value if isinstance(value, str) else "")
def test_a_face_that_lies_never_makes_it_nod_without_end(name, face):
    events, hazards = listen(conversation(attention=np.random.default_rng(5).random(FRAMES), face=face))
    assert len(of("nod", events)) <= MOST_NODS * MINUTES
    assert np.isfinite(hazards).all()


LEVELS = st.sampled_from([0.0, 1.0, -1.0, math.nan, math.inf, 1e30])
ATTENTIONS = st.none() | st.floats(allow_nan=True, allow_infinity=True)
MOTIONS = st.none() | st.sampled_from([0.0, math.nan, math.inf, -1e30])


@given(st.lists(st.tuples(LEVELS, ATTENTIONS, MOTIONS, st.booleans()), min_size=1, max_size=12))
def test_hazards_are_finite_whatever_comes_in(rows):
    memory = MODEL.start(0, Calmness())
    for index, (level, attention, motion, heard) in enumerate(rows):
        face = None if motion is None else FaceFrame.of(index * FRAME_S, np.full(MOTION_DIM, motion))
        audio = np.full(FRAME_SAMPLES, level, np.float32) if heard else NOBODY
        with np.errstate(all="ignore"):
            speaker = SpeakerFrame((index + 1) * FRAME_S, audio, face, audio, attention)
            ((_, memory),) = MODEL.step_each([speaker], [memory])
        assert all(math.isfinite(rate) and rate >= 0 for rate in memory.hazards_hz.values())


def test_own_history_replaces_what_was_decided():
    frames = list(conversation())[:1000]
    nods = [ListenerEvent("nod", 10.0, 2.0, 0.1), ListenerEvent("nod", 20.0, 0.5, 0.1)]
    _, hazards = listen(frames, own=nods)
    assert not hazards[slice(round(10.0 / FRAME_S) + 2, round(12.0 / FRAME_S) - 2)].any()
    _, none = listen(frames, own=())
    before = round(10.0 / FRAME_S)
    np.testing.assert_array_equal(hazards[:before], none[:before])
    assert (hazards[before:] != none[before:]).any()


def smiling(onsets_s, frames=FRAMES, size=0.7):
    """(N, 58) a face that smiles for two seconds from each onset on."""
    face = np.zeros((frames, MOTION_DIM), np.float32)
    for onset_s in onsets_s:
        first = round(onset_s / FRAME_S)
        rise = np.minimum(1.0, np.r_[np.arange(50), np.arange(10)[::-1]] / 10)
        face[first : first + 60, CORNERS] = size * rise[:, None]
    return face


def test_a_smile_is_returned_in_time_and_size_and_more_smiles_more_often():
    onsets_s = np.arange(5.0, 115.0, 10.04)  # of either parity of steps
    face = smiling(onsets_s)
    found = [of("smile", listen(conversation(face=face), seed)[0]) for seed in range(8)]
    begun_s = np.array([event.start_s for events in found for event in events])
    after_s = begun_s[:, None] - onsets_s
    returned = ((after_s > 0.4) & (after_s <= 1.5)).any(axis=1)
    share = returned.sum() / (8 * len(onsets_s))
    others = ((after_s > 4.0) & (after_s <= 5.1)).any(axis=1).sum() / (8 * len(onsets_s))
    assert 0.1 + others <= share <= 0.6
    sizes = np.array([event.size for events in found for event in events])
    assert sizes[returned] == pytest.approx(RETURN_SIZE * 0.7, abs=0.06)
    few = [of("smile", listen(conversation(face=smiling(onsets_s[::5])), seed)[0]) for seed in range(8)]
    assert sum(map(len, few)) < 0.6 * len(begun_s)


@pytest.mark.slow
def test_a_silent_person_who_smiles_is_smiled_at_and_one_who_always_smiles_is_not_all_the_time():
    silence, face = sound(np.zeros(FRAMES, bool)), smiling(np.arange(5.0, 115.0, 10.0))
    assert sum(len(of("smile", listen(conversation(silence, face=face), seed)[0])) for seed in range(8)) >= 8
    always = np.tile(smiling([0.0])[20], (FRAMES, 1))
    found = [of("smile", listen(conversation(face=always), seed)[0]) for seed in range(8)]
    assert sum(map(len, found)) <= 2 * MINUTES * 8
