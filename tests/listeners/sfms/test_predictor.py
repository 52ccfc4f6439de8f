import numpy as np
import pytest
import torch
from tiny_sfms import tiny_listener, tiny_settings

from sfms_robot.listeners.audio_frontend import SHAPES
from sfms_robot.listeners.sfms import draw
from sfms_robot.listeners.sfms.draw import UNDECIDED, Context
from sfms_robot.listeners.sfms.predictor import SpeakerEncoder

HEARD = torch.ones(1, 40, dtype=torch.bool)


def context(drawn_frames: int = 0, **changes) -> Context:
    drawn = torch.Generator().manual_seed(2)
    tokens = torch.randint(0, 7, (1, 48, 2), generator=drawn)
    tokens[:, 40 + drawn_frames :] = UNDECIDED
    face, voice = torch.randn(1, 40, 58, generator=drawn), torch.randn(1, 40, 16, generator=drawn)
    phase = torch.rand(1, 40, 21, generator=drawn)
    return Context(face, HEARD, voice, HEARD, phase, tokens, torch.zeros(1, 48, 0))._replace(**changes)


@torch.no_grad()
def logits(predictor, seen: Context, target: torch.Tensor | None = None) -> torch.Tensor:
    return predictor.teacher_forced(seen, torch.ones(1, 8, 2).long() if target is None else target)


@pytest.mark.parametrize("changed", [0, 3, 6])
def test_a_frame_knows_the_keyframes_before_it_and_none_behind(tiny, changed: int):
    one, other = torch.ones(1, 8, 2).long(), torch.ones(1, 8, 2).long()
    other[:, changed] = 4
    a, b = (logits(tiny.model.predictor, context(), target) for target in (one, other))
    assert torch.equal(a[:, : changed + 1], b[:, : changed + 1])
    assert not torch.equal(a[:, changed + 1], b[:, changed + 1])


def test_a_parallel_predictor_answers_all_frames_alone_and_what_is_drawn_already_changes_what_follows(tiny):
    predictor = tiny_listener(sequential=False).model.predictor
    a, b = (logits(predictor, context(), torch.full((1, 8, 2), token)) for token in (0, 4))
    assert torch.equal(a, b)
    a, b = (logits(tiny.model.predictor, context(drawn)) for drawn in (0, 4))
    assert not torch.equal(a, b)


@pytest.mark.parametrize("sequential", [True, False])
@pytest.mark.parametrize("modality", ["voice", "face"])
def test_what_is_marked_missing_does_not_matter(modality: str, sequential: bool):
    predictor = tiny_listener(sequential=sequential).model.predictor
    gone = torch.zeros_like(HEARD)
    if modality == "voice":
        one = context(heard=gone)
        other = one._replace(voice=torch.full((1, 40, 16), torch.nan), phase=torch.full((1, 40, 21), torch.nan))
    else:
        one, other = context(face_known=gone), context(face_known=gone, face=torch.full((1, 40, 58), torch.nan))
    assert torch.equal(logits(predictor, one), logits(predictor, other))


def test_many_answers_are_those_to_copies_of_the_speaker_and_every_weight_has_a_gradient(tiny):
    one, copies = context(), context()
    own = torch.cat([one.tokens, one.tokens.flip(1).clamp(min=0)])
    names = ("face", "face_known", "voice", "heard", "phase")
    both = {name: getattr(one, name).expand(2, *[-1] * (getattr(one, name).ndim - 1)) for name in names}
    copies = Context(**both, tokens=own, control=one.control.expand(2, -1, -1))
    with torch.no_grad():
        torch.testing.assert_close(tiny.model.predictor(one._replace(tokens=own)), tiny.model.predictor(copies))
    predictor = tiny_listener().model.predictor
    seen = context(voice=predictor.speaker.listen(torch.randn(1, 41 * 4, 128)), face_known=torch.rand(1, 40) > 0.5)
    seen = seen._replace(heard=torch.rand(1, 40) > 0.5, tokens=context(3).tokens)
    out = predictor.teacher_forced(seen, torch.randint(0, 7, (1, 8, 2)))
    out[out.isfinite()].square().sum().backward()
    assert [name for name, weight in predictor.named_parameters() if weight.grad is None] == []


@pytest.mark.parametrize("audio", ["mel", "mfcc78"])
@pytest.mark.parametrize("chunk", [1, 3, 7])
def test_listening_in_chunks_equals_listening_at_once(audio: str, chunk: int):
    rows, bins = SHAPES[audio]
    encoder = SpeakerEncoder(tiny_settings(audio=audio, phase=False))
    sound = torch.randn(1, 22 * rows, bins)
    whole = encoder.listen(sound)
    parts = [encoder.listen(sound[:, at * rows : (at + chunk + 1) * rows]) for at in range(0, 21, chunk)]
    torch.testing.assert_close(torch.cat(parts, dim=1)[:, :21], whole)


def test_a_trail_grown_frame_by_frame_is_the_trail_of_the_whole():
    tokens = np.random.default_rng(0).integers(0, 3, (4, 30, 5))
    whole = draw.last_keyframes(tokens)
    grown = draw.LastKeyframes(*(part[:, 9] for part in whole))
    for frame in range(10, 30):
        grown = draw.with_drawn(grown, tokens[:, frame], frame)
        for a, b in zip(grown, whole, strict=True):
            assert np.array_equal(a, b[:, frame])
