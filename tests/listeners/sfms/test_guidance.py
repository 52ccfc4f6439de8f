from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_sfms import guided_listener, plans_of, speech, tiny_listener, tiny_settings

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS
from sfms_robot.listeners.sfms.draw import Seen, guided
from sfms_robot.listeners.sfms.keyframes import UNDECIDED
from sfms_robot.listeners.sfms.predictor import Context
from sfms_robot.signals import phase


def seen(heard: bool, face_known: bool, silence_s: float = 0.0) -> Seen:
    """Three streams; the speaker has talked for 2 s, or been silent for `silence_s`."""
    place = phase.features(np.array([[0.0 if silence_s else 2.0, silence_s, 1.0]]))
    rng = np.random.default_rng(2)
    tokens = rng.integers(0, 7, (3, 48, 2))
    tokens[:, 44:] = UNDECIDED
    return Seen(
        face=rng.normal(size=(1, 40, 58)).astype(np.float32),
        face_known=np.full((1, 40), face_known),
        voice=rng.normal(size=(1, 40, 16)).astype(np.float32),
        heard=np.full((1, 40), heard),
        phase=np.tile(place, (1, 40, 1)),
        tokens=tokens,
        control=np.zeros((3, 48, 0), np.float32),
    )


def context(known: Seen) -> Context:
    return Context(*(torch.from_numpy(getattr(known, field.name)) for field in fields(Seen)))


def test_guidance_of_1_is_none_bit_for_bit(tiny):
    speaker = speech(21)
    for index, plan in plans_of(guided_listener(1.0), speaker).items():
        np.testing.assert_array_equal(plan.frames, plans_of(tiny, speaker)[index].frames)


@torch.no_grad()
def test_what_is_known_of_nobody_is_what_a_silent_unseen_speaker_leaves():
    predictor = guided_listener(3.0).model.predictor
    there, gone = context(seen(True, True)), context(seen(False, False))
    both = predictor(there, absent=predictor.absent_speaker(40))
    torch.testing.assert_close(both[:3], predictor(there))
    torch.testing.assert_close(both[3:], predictor(gone))


@pytest.mark.parametrize("guidance", [0.0, 3.0])
def test_with_nobody_there_guidance_changes_nothing(tiny, guidance: float):
    speaker = speech(13, face=False, audio=False)
    alone = plans_of(tiny, speaker)
    for index, plan in plans_of(guided_listener(guidance), speaker).items():
        np.testing.assert_allclose(plan.frames, alone[index].frames, atol=1e-5)


def test_guidance_of_0_makes_a_group_deaf_and_leaves_the_others_their_ears():
    deaf, all_ears = guided_listener(0.0), guided_listener(1.0)

    there, gone = seen(True, True), seen(False, False)
    neck, face = first_drawn(deaf, there).T
    assert np.array_equal(neck, first_drawn(deaf, gone)[:, 0]) and np.array_equal(
        face, first_drawn(all_ears, there)[:, 1]
    )
    assert not np.array_equal(face, first_drawn(deaf, gone)[:, 1])


def first_drawn(listener, known: Seen, streams: int = 200) -> np.ndarray:
    """(streams, G): the first token of as many streams with one past."""
    alike = replace(known, tokens=np.tile(known.tokens[:1], (streams, 1, 1)), control=np.zeros((streams, 48, 0), "f4"))
    return listener.sampler.draw(alike, range(streams), [8] * streams)[:, 44]


def test_guidance_has_faded_when_nobody_has_spoken_for_long():
    plain, strong = guided_listener(1.0), guided_listener(8.0)
    for silence_s, same in ((0.0, False), (1.5, False), (3.2, True), (60.0, True)):
        known = seen(True, True, silence_s)
        assert np.array_equal(first_drawn(plain, known), first_drawn(strong, known)) == same


def test_the_nucleus_in_silence_is_that_of_silence_alone():
    groups = tiny_settings().model_dump()["groups"]
    groups["neck"]["nucleus_in_silence"] = 1e-6  # the likeliest alone
    plain, still = tiny_listener(), tiny_listener(groups=groups)
    talk, silence, pause = seen(True, True), seen(True, True, 3.2), seen(True, True, 2.2)
    assert np.array_equal(first_drawn(still, talk), first_drawn(plain, talk))
    found = [len(np.unique(first_drawn(still, each)[:, 0])) for each in (silence, pause, talk)]
    assert found[0] == 1 < found[1] <= found[2]
    assert np.array_equal(first_drawn(still, silence)[:, 1], first_drawn(plain, silence)[:, 1])


@pytest.mark.parametrize("guidance", [2.0, 5.0])
def test_guided_streams_side_by_side_do_what_each_does_alone(guidance: float):
    listener, speaker, seeds = guided_listener(guidance), speech(21), (1, 2, 3)
    alone = [plans_of(listener, speaker, seed) for seed in seeds]
    memories = [listener.start(seed) for seed in seeds]
    for index, frame in enumerate(speaker):
        plans, memories = listener.step_many(frame, memories)
        for plan, own in zip(plans, alone, strict=False):
            np.testing.assert_allclose(plan.frames, own[index].frames, atol=1e-5)


LOGITS = st.lists(st.floats(-20, 20), min_size=5, max_size=5)


@given(heard=LOGITS, unheard=LOGITS, guidance=st.floats(0, 10))
def test_guidance_multiplies_what_the_speaker_changes_in_the_odds(heard, unheard, guidance):
    a, b, strength = (np.array([x]) for x in (heard, unheard, [guidance]))
    out = guided(a, b, strength)
    np.testing.assert_allclose(np.diff(out - b), guidance * np.diff(a - b), atol=1e-9, rtol=1e-9)


def test_a_class_that_a_group_lacks_stays_impossible():
    lacking = np.array([[0.0, 1.0, -np.inf]])
    out = guided(lacking, np.array([[0.5, 0.0, -np.inf]]), np.array([[3.0]]))
    assert out.tolist() == [[-1.0, 3.0, -np.inf]]


def test_guidance_below_0_is_refused():
    groups = {"neck": {"channels": POSE_CHANNELS, "levels": (3, 2), "keyframes": 6, "guidance": -1}}
    with pytest.raises(ConfigError, match="guidance"):
        config.parse(config.Sfms, tiny_settings().model_dump() | {"groups": groups}, "tiny")


def test_a_nucleus_in_silence_needs_a_listener_that_knows_silence():
    groups = tiny_settings().model_dump()["groups"]
    groups["neck"]["nucleus_in_silence"] = 0.9
    with pytest.raises(ConfigError, match=r"groups\.neck\.nucleus_in_silence: without phase"):
        tiny_settings(groups=groups, phase=False)
