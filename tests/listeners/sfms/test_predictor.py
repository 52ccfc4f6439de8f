from dataclasses import replace

import pytest
import torch

from sfms_robot.listeners.sfms.predictor import UNDECIDED, Context, _loudness, _speech_phase

HEARD = torch.ones(1, 40, dtype=torch.bool)


def context(**changes) -> Context:
    drawn = torch.Generator().manual_seed(2)
    return replace(
        Context(
            face=torch.randn(1, 40, 58, generator=drawn),
            face_known=HEARD,
            mel=torch.randn(1, 160, 128, generator=drawn),
            heard=HEARD,
            tokens=torch.randint(0, 7, (1, 40, 2), generator=drawn),
        ),
        **changes,
    )


@torch.no_grad()
def logits(predictor, seen: Context, given: int = 0) -> list[torch.Tensor]:
    future = torch.full((1, 8, 2), UNDECIDED)
    future[:, :given] = 1
    return predictor.decode(predictor.remember(seen), seen.tokens, future)


def test_every_group_gets_its_codes_and_the_transition_for_every_future_frame(tiny):
    assert [tuple(group.shape) for group in logits(tiny.model.predictor, context())] == [(1, 8, 7), (1, 8, 9)]


@pytest.mark.parametrize("given", [1, 4, 7])
def test_frames_already_decided_change_what_follows(tiny, given: int):
    parallel = logits(tiny.model.predictor, context())
    after = logits(tiny.model.predictor, context(), given)
    assert all(not torch.equal(a[:, given:], b[:, given:]) for a, b in zip(parallel, after, strict=True))


@pytest.mark.parametrize("modality", ["voice", "face"])
def test_what_is_marked_missing_does_not_matter(tiny, modality: str):
    gone = torch.zeros_like(HEARD)
    if modality == "voice":
        one, other = context(heard=gone), context(heard=gone, mel=torch.ones(1, 160, 128))
    else:
        one, other = context(face_known=gone), context(face_known=gone, face=torch.ones(1, 40, 58))
    for a, b in zip(logits(tiny.model.predictor, one), logits(tiny.model.predictor, other), strict=True):
        assert torch.equal(a, b)


def speech_then_silence(silent_frames: int) -> torch.Tensor:
    mel = torch.ones(1, 160, 128)
    if silent_frames:
        mel[:, -4 * silent_frames :] = -1.0
    return mel


@pytest.mark.parametrize("silent, bin_", [(0, 0), (1, 1), (4, 1), (5, 2), (9, 2), (10, 3), (19, 3), (20, 4), (38, 4)])
def test_silence_so_far_falls_into_its_bin_whatever_the_gain(silent: int, bin_: int):
    for gain in (-1.5, 0.0, 1.5):
        phase = _speech_phase(speech_then_silence(silent) + gain * (silent > 0), HEARD)
        assert phase[0, :6].argmax() == bin_


def test_loudness_does_not_depend_on_the_gain():
    mel = torch.randn(1, 160, 128)
    torch.testing.assert_close(_loudness(mel, HEARD), _loudness(mel + 3, HEARD), atol=1e-5, rtol=1e-4)
