import pytest
import torch

from sfms_robot.listeners.sfms.placement import ConditionalScore, tracks


def test_curves_of_few_channels_hold_all_of_their_motion():
    motion = torch.randn(4, 20, 3)
    found = tracks(motion, torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), 2)
    centred = motion - motion.mean(1, keepdim=True)
    for group, channels in enumerate(([0, 1], [2])):
        own = centred[..., channels]
        own = own / own.square().sum(-1).mean(1).sqrt()[:, None, None]
        curves = found.curves.view(4, 2, 20, 2)[:, group]
        torch.testing.assert_close(curves @ curves.transpose(1, 2), own @ own.transpose(1, 2), rtol=1e-4, atol=1e-4)


def test_a_still_window_has_finite_scores():
    score = ConditionalScore(1, 8, 2, 1)
    track = tracks(torch.ones(1, 12, 1), torch.ones(1, 1), 1)
    assert score(track, torch.zeros(1, 12), torch.tensor([3])).isfinite().all()


@pytest.mark.parametrize("remaining", [0, 1, 4])
def test_chosen_frames_score_minus_infinity_and_no_other(remaining):
    score = ConditionalScore(1, 8, 2, 1)
    track = tracks(torch.randn(2, 12, 1).cumsum(1), torch.ones(1, 1), 1)
    chosen = torch.zeros(2, 12)
    chosen[:, [2, 7]] = 1.0
    logits = score(track, chosen, torch.full((2,), remaining))
    assert torch.equal(logits.isneginf(), chosen > 0)


def test_scores_know_how_many_keyframes_are_to_come():
    score = ConditionalScore(1, 8, 2, 1)
    track = tracks(torch.randn(1, 12, 1).cumsum(1), torch.ones(1, 1), 1)
    told = [score(track, torch.zeros(1, 12), torch.tensor([k])) for k in (0, 1, 5)]
    assert not torch.allclose(told[0], told[1]) and not torch.allclose(told[1], told[2])
