import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sfms_robot.lab.evaluation.metrics import dtw
from sfms_robot.lab.learning.sfms.predictor_trainer import keyframe_dtw, next_tokens, soft_dtw
from sfms_robot.lab.learning.sfms.tokenizer_trainer import reconstruction

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


def test_next_token_loss_is_weighted_cross_entropy_of_the_counted_frames():
    logits = torch.log(torch.tensor([[[0.5, 0.25, 0.25], [0.1, 0.8, 0.1], [1 / 3, 1 / 3, 1 / 3]]]))
    target = torch.tensor([[[0], [1], [2]]])
    counted = torch.tensor([[True, True, False]])
    expected = (0.2 * -torch.tensor(0.5).log() - torch.tensor(0.8).log()) / 1.2
    torch.testing.assert_close(next_tokens([logits], target, counted, 0.2, [1.0]), expected)


@pytest.mark.parametrize("frames", [(8, 8), (3, 7), (1, 4), (5, 1)])
def test_the_gradient_is_that_of_finite_differences(frames: tuple[int, int]):
    cost = torch.rand(3, *frames, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: soft_dtw(c, 0.3), (cost,))


@given(st.integers(1, 6), st.integers(1, 6), st.integers(0, 2**31))
def test_with_hard_minima_it_is_the_squared_dtw(rows: int, columns: int, seed: int):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(rows, 1)), rng.normal(size=(columns, 1))
    cost = torch.from_numpy((a - b.T) ** 2)[None]
    assert float(soft_dtw(cost, 1e-4)) == pytest.approx(dtw(a, b[None])[0] ** 2, abs=5e-3)


def test_a_keyframe_one_frame_late_costs_less_than_none_and_more_than_in_time():
    def indicator(*frames: int) -> torch.Tensor:
        out = torch.zeros(1, 8, 1)
        out[:, list(frames)] = 1.0
        return out

    in_time, late, none = (float(keyframe_dtw(one, indicator(3), 0.01)) for one in
                           (indicator(3), indicator(4), indicator()))  # fmt: skip
    assert in_time <= late < none
