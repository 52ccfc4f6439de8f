from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_sfms import guided_listener, plans_of, speech, tiny_listener, tiny_settings

from sfms_robot import config
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS
from sfms_robot.listeners.sfms.draw import guided
from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context
from sfms_robot.signals import phase


def seen(heard: bool, face_known: bool, silence_s: float = 0.0) -> Context:
    """Three streams; the speaker has talked for 2 s, or been silent for `silence_s`."""
    place = phase.features(np.array([[0.0 if silence_s else 2.0, silence_s, 1.0]]))
    drawn = torch.Generator().manual_seed(2)
    tokens = torch.randint(0, 7, (3, 48, 2), generator=drawn)
    tokens[:, 44:] = UNDECIDED
    return Context(
        face=torch.randn(1, 40, 58, generator=drawn),
        face_known=torch.full((1, 40), face_known),
        voice=torch.randn(1, 40, 16, generator=drawn),
        heard=torch.full((1, 40), heard),
        phase=torch.from_numpy(place).expand(1, 40, -1),
        tokens=tokens,
        control=torch.zeros(3, 48, 0),
    )


def test_guidance_of_1_is_none_bit_for_bit(tiny):
    speaker = speech(21)
    for index, plan in plans_of(guided_listener(1.0), speaker).items():
        np.testing.assert_array_equal(plan.frames, plans_of(tiny, speaker)[index].frames)


@torch.no_grad()
def test_what_is_known_of_nobody_is_what_a_silent_unseen_speaker_leaves():
    predictor = guided_listener(3.0).model.predictor
    both = predictor(seen(True, True), absent=predictor.absent_speaker(40))
    torch.testing.assert_close(both[:3], predictor(seen(True, True)))
    torch.testing.assert_close(both[3:], predictor(seen(False, False)))


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
    assert torch.equal(neck, first_drawn(deaf, gone)[:, 0]) and torch.equal(face, first_drawn(all_ears, there)[:, 1])
    assert not torch.equal(face, first_drawn(deaf, gone)[:, 1])


def first_drawn(listener, context: Context, streams: int = 200) -> torch.Tensor:
    """(streams, G): the first token of as many streams with one past."""
    alike = replace(context, tokens=context.tokens[:1].expand(streams, -1, -1))
    return listener.sampler.draw(alike, [torch.Generator().manual_seed(seed) for seed in range(streams)])[:, 44]


def test_guidance_has_faded_when_nobody_has_spoken_for_long():
    plain, strong = guided_listener(1.0), guided_listener(8.0)
    for silence_s, same in ((0.0, False), (1.5, False), (3.2, True), (60.0, True)):
        context = seen(True, True, silence_s)
        assert torch.equal(first_drawn(plain, context), first_drawn(strong, context)) == same


def test_the_nucleus_in_silence_is_that_of_silence_alone():
    groups = tiny_settings().model_dump()["groups"]
    groups["neck"]["nucleus_in_silence"] = 1e-6  # the likeliest alone
    plain, still = tiny_listener(), tiny_listener(groups=groups)
    talk, silence, pause = seen(True, True), seen(True, True, 3.2), seen(True, True, 2.2)
    assert torch.equal(first_drawn(still, talk), first_drawn(plain, talk))
    found = [len(first_drawn(still, context)[:, 0].unique()) for context in (silence, pause, talk)]
    assert found[0] == 1 < found[1] <= found[2]
    assert torch.equal(first_drawn(still, silence)[:, 1], first_drawn(plain, silence)[:, 1])


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
    a, b, strength = (torch.tensor([x], dtype=torch.float64) for x in (heard, unheard, [guidance]))
    out = guided(a, b, strength)
    torch.testing.assert_close((out - b).diff(), guidance * (a - b).diff(), atol=1e-9, rtol=1e-9)


def test_a_class_that_a_group_lacks_stays_impossible():
    lacking = torch.tensor([[0.0, 1.0, -torch.inf]])
    out = guided(lacking, torch.tensor([[0.5, 0.0, -torch.inf]]), torch.tensor([[3.0]]))
    assert out.tolist() == [[-1.0, 3.0, -torch.inf]]


def test_guidance_below_0_is_refused():
    groups = {"neck": {"channels": POSE_CHANNELS, "levels": (3, 2), "keyframes": 6, "guidance": -1}}
    with pytest.raises(ConfigError, match="guidance"):
        config.parse(config.Sfms, tiny_settings().model_dump() | {"groups": groups}, "tiny")


def test_a_nucleus_in_silence_needs_a_listener_that_knows_silence():
    groups = tiny_settings().model_dump()["groups"]
    groups["neck"]["nucleus_in_silence"] = 0.9
    with pytest.raises(ConfigError, match=r"groups\.neck\.nucleus_in_silence: without phase"):
        tiny_settings(groups=groups, phase=False)
