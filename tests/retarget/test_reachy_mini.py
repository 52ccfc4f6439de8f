"""The antennas of Reachy Mini stand for the face it has not."""

import numpy as np
import pytest
from motion_rows import motion

from sfms_robot.config import load_head
from sfms_robot.retarget.channel_mapping import ChannelMapping

HEAD = load_head("reachy_mini")
MAPPING = ChannelMapping(HEAD)
REST_RAD = np.array([joint.rest_rad for joint in HEAD.joints.values()])


def raised_deg(**channels: float) -> tuple[float, float]:
    """How far the right and the left antenna go up from rest."""
    turned = np.degrees(MAPPING.angles(motion(**channels)) - REST_RAD)
    assert turned[:7] == pytest.approx(np.zeros(7))  # body and legs follow the head pose, not the face
    right, left = turned[7:]
    return float(right), -float(left)


def test_antennas_show_brows_and_smiles_by_parts_of_forty_degrees_on_their_side():
    assert raised_deg(browInnerUp=1.0) == pytest.approx((32, 32), abs=1e-4)
    assert raised_deg(browDownLeft=1.0, browDownRight=1.0) == pytest.approx((-24, -24), abs=1e-4)
    assert raised_deg(mouthSmileLeft=1.0, mouthSmileRight=1.0) == pytest.approx((12, 12), abs=1e-4)
    assert raised_deg(mouthFrownLeft=1.0, mouthFrownRight=1.0) == pytest.approx((-12, -12), abs=1e-4)
    assert raised_deg(browOuterUpLeft=1.0) == pytest.approx((4, 20), abs=1e-4)
    assert raised_deg(browOuterUpRight=1.0) == pytest.approx((20, 4), abs=1e-4)
    up = {name: 1.0 for name in ("browInnerUp", "browOuterUpLeft", "browOuterUpRight", "mouthSmileLeft")}
    assert raised_deg(**up) == pytest.approx((40, 40))
