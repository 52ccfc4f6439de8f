import numpy as np
import pytest
import torch
from tiny_sfms import plans_of, speech, tiny_listener

from sfms_robot.config.hop import LEAD_S, STEP_S, default_hop
from sfms_robot.frames import FRAME_S
from sfms_robot.listeners.sfms.draw import UNDECIDED, Context, sample
from sfms_robot.listeners.sfms.model import neutral_tokens
from sfms_robot.listeners.sfms.stream import join
from sfms_robot.signals import phase


@torch.no_grad()
def offline(listener, speaker, seed):
    """The same motion computed from whole arrays: features of everything first, then windows cut out of them."""
    model, settings = listener.model, listener.settings
    p, h, hop, n = settings.past_frames, settings.future_frames, settings.hop_frames, len(speaker)
    audio, frontend = np.concatenate([frame.audio for frame in speaker]), listener.frontend
    rows = model.standardise_sound(torch.from_numpy(frontend.rows(audio)))
    voice = model.predictor.speaker.listen(torch.cat([torch.zeros(frontend.shape), rows])[None])[0]
    voice = torch.cat([torch.zeros(p, voice.shape[1]), voice])  # frame t at index p + t
    place = torch.zeros(p + n, frontend.phase_features)
    if frontend.phased:
        place[p:] = torch.from_numpy(phase.of_audio(audio))
    face = torch.from_numpy(np.stack([frame.face.motion for frame in speaker]))
    face = torch.cat([torch.zeros(p, 58), model.standardise(face)])
    known = torch.cat([torch.zeros(p), torch.ones(n)]).bool()
    tokens = torch.cat([neutral_tokens(model, listener.space, p), torch.zeros(n + h, 2).long()])
    path = model.standardise(torch.zeros(n + h + 2, 58))  # frame t at index 2 + t; two before the start
    plans, decided = {}, 1
    for now in range(0, n, hop):  # newest frame heard
        past = slice(now + 1, now + 1 + p)
        own = tokens[None, past.start : past.stop + h].clone()
        own[:, p + decided - (now + 1) :] = UNDECIDED
        parts = [x[None, past].numpy() for x in (face, known, voice, known, place)]
        seen = Context(*parts, own.numpy(), np.zeros((1, p + h, 0), np.float32))
        drawn = torch.from_numpy(listener.sampler.draw(seen, np.array([p - 1]), [seed], [now + h]))
        tokens[past.stop : past.stop + h] = drawn[0, p:]
        decided, window = now + 1 + h, model.tokenizer.decode(drawn)[0]
        joined = torch.from_numpy(
            join(path[now + 1 : now + 3].numpy(), window[-h - 2 :].numpy(), settings.sampling.seam_frames)
        )
        path = torch.cat([path[: now + 1], joined, path[now + 1 + len(joined) :]])
        plans[now] = listener.space.decode(model.restore(joined[2:]).numpy())[0]
    return plans


@pytest.mark.parametrize("hop", [1, 4, 8])
@pytest.mark.parametrize("changes", [{}, {"sequential": False, "phase": False}, {"audio": "mfcc78"}])
def test_stream_equals_offline(hop: int, changes: dict):
    listener, speaker = tiny_listener(hop=hop, **changes), speech(61)
    expected = offline(listener, speaker, seed=3)
    streamed = plans_of(listener, speaker, seed=3)
    assert list(streamed) == list(expected)
    for index, plan in streamed.items():
        np.testing.assert_allclose(plan.frames, expected[index], atol=1e-5)


def test_sampling_follows_the_probabilities_of_the_nucleus():
    logits = np.log(np.array([0.1, 0.4, 0.3, 0.2], np.float32))
    chance = np.random.default_rng(0).random((2000, 1))
    drawn = sample(np.tile(logits, (2000, 1, 1)), np.zeros(1, np.float32), np.float32(0.65), chance)
    counts = np.bincount(drawn[:, 0], minlength=4)
    assert counts[0] == counts[3] == 0 and counts[1] / 2000 == pytest.approx(4 / 7, abs=0.04)


@pytest.mark.parametrize(("horizon", "hop"), [(1, 1), (2, 1), (8, 4), (16, 12)])
def test_the_default_hop_is_the_largest_that_leaves_time_for_step_and_lead(horizon, hop):
    assert default_hop(horizon) == hop
    if hop > 1:
        assert hop * FRAME_S + STEP_S + LEAD_S <= (horizon - 1) * FRAME_S < (hop + 1) * FRAME_S + STEP_S + LEAD_S


def test_smoothing_rounds_the_corners_of_the_head_alone_and_a_plan_goes_on_in_place_and_speed():
    soft = tiny_listener(sampling={"smoothing": 0.5})
    steady = np.tile(np.arange(10, dtype=np.float32)[:, None], 58)
    np.testing.assert_allclose(soft.shown(steady), steady[2:], rtol=1e-6)
    corner = np.tile(np.maximum(np.arange(10, dtype=np.float32) - 5, 0)[:, None], 58)
    shown = soft.shown(corner)
    assert shown[3, :6].tolist() == [0.25] * 6
    np.testing.assert_array_equal(shown[:, 6:], corner[2:, 6:])
    assert np.abs(np.diff(shown[:, 0], 2)).max() <= 0.5 * np.abs(np.diff(corner[:, 0], 2)).max()
    np.testing.assert_array_equal(tiny_listener().shown(corner), corner[2:])
    path = join(np.array([[0.0], [1.0]], np.float32), np.full((10, 1), 5.0, np.float32), seam=4)[:, 0]
    assert path[:2].tolist() == [0.0, 1.0] and path[5:].tolist() == [5.0] * 5
    assert np.diff(path).min() >= 0 and np.diff(path).max() < 2
