import pytest
import torch

from sfms_robot.lab.learning.sfms.predictor_trainer import next_tokens
from sfms_robot.lab.learning.sfms.tokenizer_trainer import masking, reconstruction

MEMBER = torch.tensor([[1.0, 0.0], [0.0, 1.0]])


def test_perfect_reconstruction_costs_nothing_and_a_steady_offset_no_velocity():
    motion = torch.randn(2, 6, 2)
    assert reconstruction(motion, motion, motion, torch.ones(2, 6, 2), MEMBER, 5.0) == 0
    motion = torch.randn(1, 5, 2)
    args = (motion, motion + 1, motion, torch.ones(1, 5, 2), MEMBER)
    assert reconstruction(*args, 7.0) == pytest.approx(float(reconstruction(*args, 0.0)))


def test_the_quantization_term_counts_keyframes_of_their_own_group_only():
    motion = torch.zeros(1, 4, 2)
    wrong = motion.clone()
    wrong[0, 1, 0] = 3.0  # group 0, frame 1
    mask = torch.zeros(1, 4, 2)
    mask[0, 2, 0] = mask[0, 1, 1] = 1.0
    assert reconstruction(motion, motion, wrong, mask, MEMBER, 0.0) == 0
    mask[0, 1, 0] = 1.0
    assert reconstruction(motion, motion, wrong, mask, MEMBER, 0.0) == pytest.approx(9 / 3)


def test_masking_is_the_distance_to_the_best_mask():
    best = torch.tensor([1.0, 0.0, 1.0])[None, :, None]
    assert masking(best, best) == 0 and masking(1 - best, best) == 3


def test_next_token_loss_is_weighted_cross_entropy_of_the_counted_frames():
    logits = torch.log(torch.tensor([[[0.5, 0.25, 0.25], [0.1, 0.8, 0.1], [1 / 3, 1 / 3, 1 / 3]]]))
    target = torch.tensor([[[0], [1], [2]]])
    counted = torch.tensor([[True, True, False]])
    expected = (0.2 * -torch.tensor(0.5).log() - torch.tensor(0.8).log()) / 1.2
    torch.testing.assert_close(next_tokens([logits], target, counted, 0.2, [1.0]), expected)
