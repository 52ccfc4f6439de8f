from typing import get_args

import pytest
import torch
from tiny_sfms import tiny_settings

from sfms_robot.listeners.sfms.model import Tokenizer
from sfms_robot.listeners.sfms.placement import Strategy


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
