from typing import get_args

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tiny_sfms import tiny_settings

from sfms_robot.listeners.sfms.draw import KEYS_STEP, around
from sfms_robot.listeners.sfms.model import Inpainter, Tokenizer
from sfms_robot.listeners.sfms.piecewise_linear import POSITION_BITS, Around, Neighbours
from sfms_robot.listeners.sfms.placement import Strategy
from sfms_robot.listeners.sfms.quantizer import Quantizer

MEMBER = torch.tensor([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])


def parts(residual: bool = True, layers: int = 1) -> tuple[Quantizer, Inpainter]:
    torch.manual_seed(0)
    settings = tiny_settings(tokenizer_width=8, tokenizer_layers=layers, inpainter="residual" if residual else "paper")
    quantizer = Quantizer(MEMBER, settings)
    return quantizer, Inpainter(quantizer, settings).eval()


def some_mask(frames: int, seed: int = 0) -> torch.Tensor:
    return (torch.rand(2, frames, 2, generator=torch.Generator().manual_seed(seed)) < 0.3).float()


def test_an_untrained_residual_inpainter_draws_straight_lines_between_decoded_keyframes():
    quantizer, inpainter = parts()
    codes, mask = quantizer.encode(torch.randn(2, 20, 3)), some_mask(20)
    mask[:, [0, -1]] = 1.0
    found, decoded = inpainter(codes, mask, quantizer), quantizer.decode(codes)
    for channel, group in enumerate((0, 1, 0)):
        near = Neighbours.in_mask(mask[..., group : group + 1])
        line = near.interpolate((decoded[..., channel] * mask[..., group])[..., None, None])[..., 0, 0]
        torch.testing.assert_close(found[..., channel], line)


@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("layers", [1, 3])
def test_only_keyframes_reach_the_output(residual, layers):
    quantizer, inpainter = parts(residual, layers)
    torch.nn.init.normal_(inpainter.out.weight)
    codes, mask = quantizer.encode(torch.randn(2, 20, 3)), some_mask(20)
    noise = torch.where(mask[..., None] > 0, codes, torch.randn_like(codes))
    assert torch.equal(inpainter(codes, mask, quantizer), inpainter(noise, mask, quantizer))


@pytest.mark.parametrize("residual", [True, False])
@pytest.mark.parametrize("layers", [1, 3])
@pytest.mark.parametrize("last", [1, 5, 20])
def test_the_last_frames_alone_are_those_of_the_whole_window(residual, layers, last):
    quantizer, inpainter = parts(residual, layers)
    torch.nn.init.normal_(inpainter.out.weight)
    codes, mask = quantizer.encode(torch.randn(2, 20, 3)), some_mask(20)
    whole = inpainter(codes, mask, quantizer)
    torch.testing.assert_close(inpainter(codes, mask, quantizer, last), whole[:, -last:])


@pytest.mark.parametrize("frames", [5, 20, 43])
def test_what_is_found_in_tokens_before_a_network_sees_them_is_what_is_around_them(frames):
    quantizer, inpainter = parts(layers=2)
    torch.nn.init.normal_(inpainter.out.weight)
    codes, mask = quantizer.encode(torch.randn(3, frames, 3)), torch.zeros(3, frames, 2)
    mask[:2] = some_mask(frames)  # the third window has no keyframe at all
    found = Around(*map(torch.from_numpy, around(mask.long().numpy())))
    near, expected = Neighbours.at(found.before, found.after), Neighbours.in_mask(mask)
    assert torch.equal(near.before, expected.before) and torch.equal(near.after, expected.after)
    assert found.rows.shape[1] == frames and found.seen.any(1).all()
    torch.testing.assert_close(inpainter(codes, mask, quantizer, None, found), inpainter(codes, mask, quantizer))
    some = Around(*map(torch.from_numpy, around(mask[:2].long().numpy())))
    assert some.rows.shape[1] == frames or some.rows.shape[1] % KEYS_STEP == 0
    assert torch.allclose(inpainter(codes[:2], mask[:2], quantizer, None, some), inpainter(codes, mask, quantizer)[:2])


@given(st.sets(st.integers(0, 39), min_size=1))
def test_positions_are_the_distances_to_the_neighbours_in_binary(frames):
    mask = torch.zeros(1, 40, 1)
    mask[0, sorted(frames)] = 1.0
    positions = Neighbours.in_mask(mask).positions()[0, :, 0]
    powers = 2.0 ** torch.arange(POSITION_BITS)
    for frame in range(40):
        before = max((f for f in frames if f <= frame), default=None)
        after = min((f for f in frames if f >= frame), default=None)
        assert positions[frame, :POSITION_BITS] @ powers == (0 if before is None else frame - before)
        assert positions[frame, POSITION_BITS : 2 * POSITION_BITS] @ powers == (0 if after is None else after - frame)
        assert positions[frame, 2 * POSITION_BITS].item() == (before is not None)


@pytest.mark.parametrize("quantizer", ["fsq", "vq"])
@pytest.mark.parametrize("placement", get_args(Strategy))
def test_every_kind_of_tokenizer_encodes_and_decodes(placement, quantizer):
    torch.manual_seed(0)
    groups = tiny_settings().model_dump()["groups"]
    if placement == "penalised":
        groups = {name: group | {"keyframes": None, "keyframe_cost": 40.0} for name, group in groups.items()}
    scores = {"width": 8, "layers": 1, "heads": 2}
    settings = tiny_settings(placement=placement, quantizer=quantizer, scores=scores, groups=groups)
    tokenizer, motion = Tokenizer(settings).eval(), torch.randn(2, 48, 58)
    mask = tokenizer.place(motion)
    tokens = tokenizer.encode(motion, mask)
    assert torch.equal(tokens > 0, mask > 0)
    counted = placement not in ("penalised", "adaptive")
    assert mask.sum(1).tolist() == [[6.0, 5.0]] * 2 if counted else mask.any(1).all()
    for group, one in enumerate(settings.groups.values()):
        assert tokens[..., group].max() <= one.codes
    at_mask = tokenizer.inpaint(tokenizer.quantizer.encode(motion), mask)
    torch.testing.assert_close(tokenizer.decode(tokens), at_mask)
