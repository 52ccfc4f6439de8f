import numpy as np
import torch
from tiny_sfms import tiny_listener

from sfms_robot.listeners.sfms.draw import CodeReach
from sfms_robot.listeners.sfms.quantizer import indices_to_codes


def listener_with_speed(speed: float, bounded: bool = True):
    listener = tiny_listener()
    listener.model.motion_speed.fill_(speed)
    groups = [range(6), range(6, 58)]
    codes = listener.engine.run("rest", np.zeros((1, 40, 58), np.float32), np.zeros((1, 40, 2), np.float32))[1][0]
    return listener.model, CodeReach(codes, groups, [6, 8], listener.engine.tensors["motion_speed"], bounded)


def test_a_code_may_follow_itself_and_class_0_anything():
    _, reach = listener_with_speed(1e-6)
    for code in range(1, 7):
        allowed = ~reach.too_soon(np.array([[code, code]]), np.array([[1, 1]]))[0]
        assert allowed[:, 0].all() and allowed[:, code].all()


def test_allowed_codes_are_exactly_those_no_channel_has_to_hurry_for():
    model, reach = listener_with_speed(0.1)
    quantizer = model.tokenizer.quantizer
    codes = indices_to_codes(torch.arange(6)[:, None].expand(6, 2), quantizer.levels)
    neck = quantizer.decode(codes[None])[0, :, :6].detach()
    for gap in (1, 5, 20):
        allowed = ~reach.too_soon(np.array([[3, 0]]), np.array([[gap, gap]]))[0, 0, 1:7]
        np.testing.assert_array_equal(allowed, ((neck - neck[2]).abs() <= 0.1 * gap).all(-1))


def test_without_bounds_every_code_may_follow_at_once():
    _, reach = listener_with_speed(1e-6, bounded=False)
    assert (~reach.too_soon(np.array([[1, 1]]), np.array([[1, 1]])))[0].sum(1).tolist() == [7, 9]
