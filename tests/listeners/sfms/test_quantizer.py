import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_sfms import tiny_settings

from sfms_robot.listeners.sfms.quantizer import Codebook, Grid, Quantizer

grids = st.integers(1, 4).flatmap(
    lambda dims: st.lists(st.lists(st.integers(2, 6), min_size=dims, max_size=dims), min_size=1, max_size=3)
)


@given(grids)
def test_every_index_is_the_index_of_its_code(levels: list[list[int]]):
    grid = Grid(levels)
    sizes = grid.levels.prod(-1).long()
    indices = torch.stack([torch.arange(int(sizes.max())) % size for size in sizes], dim=-1)
    codes = grid.codes(indices)
    assert torch.equal(grid.indices(codes), indices)
    for group, size in enumerate(sizes):
        assert len(codes[: int(size), group].unique(dim=0)) == size


@given(grids, st.integers(0, 1000))
def test_a_quantized_value_is_on_the_grid_and_the_nearest_there(levels: list[list[int]], seed: int):
    grid = Grid(levels)
    latent = torch.randn(5, *grid.levels.shape, generator=torch.Generator().manual_seed(seed)) * 2
    code = grid.nearest(latent)
    torch.testing.assert_close(grid.codes(grid.indices(code)), code)
    assert ((code - torch.tanh(latent)).abs() <= 1 / (grid.levels - 1) + 1e-5).all()


def book(sizes=(5, 3), dims: int = 2) -> Codebook:
    torch.manual_seed(0)
    return Codebook(list(sizes), dims)


def test_every_vector_is_the_nearest_to_itself_and_passes_its_gradient_to_the_encoder_alone():
    codebook = book()
    indices = torch.stack([torch.arange(5), torch.arange(5) % 3], dim=-1)
    assert torch.equal(codebook.indices(codebook.codes(indices)), indices)
    assert codebook.indices(torch.randn(1, 200, 2, 2) * 9)[..., 1].max() < 3
    codebook, latent = book(), torch.randn(1, 4, 2, 2, requires_grad=True)
    code = codebook.nearest(latent)
    torch.testing.assert_close(code.detach(), codebook.codes(codebook.indices(latent)))
    code.sum().backward()
    torch.testing.assert_close(latent.grad, torch.ones_like(latent))


def test_commitment_is_the_distance_to_the_vectors_at_keyframes_only():
    codebook = book((1, 1))
    codebook.vectors.zero_()
    latent = torch.tensor([[[[3.0, 1.0], [0.0, 0.0]], [[9.0, 9.0], [9.0, 9.0]]]], requires_grad=True)
    loss = codebook.commitment(latent, torch.tensor([[[1.0, 1.0], [0.0, 0.0]]]))
    assert loss.item() == pytest.approx((9 + 1) / 2 / 2)
    loss.backward()
    assert (latent.grad[0, 1] == 0).all() and latent.grad[0, 0, 0, 0] > 0


def test_vectors_settle_at_the_means_of_their_keyframes_and_idle_ones_begin_anew():
    codebook, drawn = book((2,), 1), torch.Generator().manual_seed(0)
    mask = torch.ones(1, 40, 1)
    for _ in range(600):
        noise = torch.randn(1, 40, 1, 1, generator=drawn) * 0.1
        codebook.learn(torch.where(torch.arange(40)[None, :, None, None] < 20, -2.0, 3.0) + noise, mask, drawn)
    assert sorted(codebook.vectors[0, :, 0].tolist()) == pytest.approx([-2.0, 3.0], abs=0.05)
    codebook, drawn = book((8,), 1), torch.Generator().manual_seed(0)
    codebook.vectors.fill_(100.0)
    latent, mask = torch.rand(1, 400, 1, 1, generator=drawn), torch.zeros(1, 400, 1)
    mask[:, ::2] = 1.0
    for _ in range(30):
        codebook.learn(latent, mask, drawn)
    assert ((codebook.vectors >= 0) & (codebook.vectors <= 1)).all() and len(codebook.indices(latent).unique()) == 8


@pytest.mark.parametrize("kind", ["fsq", "vq"])
def test_uneven_groups_read_and_write_their_own_channels(kind):
    torch.manual_seed(0)
    member = torch.tensor([[0.0, 1.0, 1.0, 1.0], [1.0, 0.0, 0.0, 0.0]])
    quantizer, motion = Quantizer(member, tiny_settings(quantizer=kind)), torch.randn(1, 3, 4)
    latent = quantizer.latent(motion)
    for channel in range(4):
        moved = motion.clone()
        moved[..., channel] += 1
        changed = (quantizer.latent(moved) != latent).any(-1)
        assert torch.equal(changed[0, 0].float(), member[:, channel])
    codes = quantizer.encode(motion)
    for group in range(2):
        other = codes.clone()
        other[..., group, :] += 0.5
        changed = quantizer.decode(other) != quantizer.decode(codes)
        assert torch.equal(changed[0, 0].float(), member[group])
