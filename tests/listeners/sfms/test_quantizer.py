import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sfms_robot.listeners.sfms.quantizer import Quantizer, as_levels, codes_to_indices, indices_to_codes, quantize

grids = st.integers(1, 4).flatmap(
    lambda dims: st.lists(st.lists(st.integers(2, 6), min_size=dims, max_size=dims), min_size=1, max_size=3)
)


@settings(max_examples=30, deadline=None)
@given(grids)
def test_every_index_is_the_index_of_its_code(grid: list[list[int]]):
    levels = as_levels(grid)
    sizes = levels.prod(-1).long()
    indices = torch.stack([torch.arange(int(sizes.max())) % size for size in sizes], dim=-1)
    codes = indices_to_codes(indices, levels)
    assert torch.equal(codes_to_indices(codes, levels), indices)
    for group, size in enumerate(sizes):
        assert len(codes[: int(size), group].unique(dim=0)) == size


@settings(max_examples=30, deadline=None)
@given(grids, st.integers(0, 1000))
def test_a_quantized_value_is_on_the_grid_and_the_nearest_there(grid: list[list[int]], seed: int):
    levels = as_levels(grid)
    latent = torch.randn(5, *levels.shape, generator=torch.Generator().manual_seed(seed)) * 2
    code = quantize(latent, levels)
    torch.testing.assert_close(indices_to_codes(codes_to_indices(code, levels), levels), code)
    assert ((code - torch.tanh(latent)).abs() <= 1 / (levels - 1) + 1e-5).all()


def test_the_gradient_passes_through_the_rounding():
    latent = torch.zeros(1, 1, 2, requires_grad=True)
    quantize(latent, as_levels([[4, 5]])).sum().backward()
    torch.testing.assert_close(latent.grad, torch.ones(1, 1, 2))


def test_a_group_neither_sees_nor_moves_the_channels_of_another():
    torch.manual_seed(0)
    member = torch.tensor([[1.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    quantizer = Quantizer(member, [[5, 5], [5, 5]])
    x = torch.randn(1, 4, 3)
    moved = x.clone()
    moved[..., 2] += 3
    assert torch.equal(quantizer.encode(x)[..., 0, :], quantizer.encode(moved)[..., 0, :])
    codes = quantizer.encode(x)
    other = codes.clone()
    other[..., 1, :] = -other[..., 1, :]
    assert torch.equal(quantizer.decode(codes)[..., :2], quantizer.decode(other)[..., :2])


@pytest.mark.parametrize("value", [-9.0, 9.0])
def test_extremes_reach_the_ends_of_the_grid(value: float):
    code = quantize(torch.full((1, 1, 1), value), as_levels([[4]]))
    assert code.item() == pytest.approx(value / 9)
