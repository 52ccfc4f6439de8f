"""Responses learnt from sight: their laws on data of known shape."""

import numpy as np
import pytest

from sfms_robot.config import load_head
from sfms_robot.config.head import drives
from sfms_robot.frames import BLENDSHAPES
from sfms_robot.retarget.channel_mapping import Units
from sfms_robot.retarget.response_fit import FLATTEST, STEEPEST, asked, fit, fitted_drives, rms

RNG = np.random.default_rng(3)
ONE = np.ones(1)
HAS = RNG.uniform(-1, 1, (4000, 1))


def curved(x, power=1.7, gain=1.2):
    return np.sign(x) * gain * np.abs(x) ** power


def test_a_known_response_is_found_under_noise():
    (response,) = fit(HAS, curved(HAS) + RNG.normal(0, 0.02, HAS.shape), -ONE, ONE)
    grid = np.linspace(-1, 1, 41)
    assert rms(response(grid) - curved(grid)) < 0.015


def test_what_the_tracker_sees_at_rest_is_no_response_and_the_curve_undoes_the_response():
    (response,) = fit(HAS, curved(HAS) + 0.1, -ONE, ONE)
    assert response.offset == pytest.approx(0.1, abs=0.01) and response(np.zeros(1))[0] == 0.0
    (response,) = fit(HAS, curved(HAS), -ONE, ONE)
    x, y = np.array(response.curve).T
    assert (np.diff(x) > 0).all() and np.abs(response(y) - x).max() < 1e-4


@pytest.mark.parametrize(
    "looks", [np.sign(HAS), -HAS, 0 * HAS, RNG.normal(size=HAS.shape)], ids=["step", "-", "0", "?"]
)
def test_whatever_was_seen_the_response_rises_within_its_bounds(looks):
    (response,) = fit(HAS, looks, -ONE, ONE)
    slopes = np.diff(response.looks) / np.diff(response.has)
    assert slopes.min() >= FLATTEST - 1e-6 and slopes.max() <= STEEPEST + 1e-6
    assert 0.0 in response.has and response(np.zeros(1))[0] == 0.0


def test_a_joint_that_hardly_moved_is_left_alone_and_frames_without_a_face_do_not_count():
    assert fit(0.05 * HAS, HAS, -ONE, ONE) == [None] and fit(HAS[:20], HAS[:20], -ONE, ONE) == [None]
    looks = curved(HAS)
    looks[::3] = np.nan
    (response,) = fit(HAS, looks, -ONE, ONE)
    assert np.isfinite(response.looks).all()


def test_units_go_there_and_back():
    units = Units.of(load_head("face28"))
    values = RNG.uniform(units.low, units.high, (50, len(units.low)))
    assert units.values(units.angles(values)) == pytest.approx(values, abs=1e-12)


def test_twins_answer_each_for_themselves_and_rest_stays_rest():
    head = load_head("face28")
    units, names = Units.of(head), list(head.joints)
    has = np.clip(RNG.uniform(-1, 1, (2000, len(names))), units.low, units.high)
    looks = has.copy()
    left, right = names.index("corner_left"), names.index("corner_right")
    looks[:, right] = curved(has[:, right])
    found = fitted_drives(head, fit(has, looks, units.low, units.high))
    fitted = head.model_copy(
        update={"joints": {n: j.model_copy(update={"drive": found.get(n, j.drive)}) for n, j in head.joints.items()}}
    )
    faces = np.zeros((2, 52), dtype=np.float32)
    faces[1, BLENDSHAPES.index("mouthSmileLeft")] = faces[1, BLENDSHAPES.index("mouthSmileRight")] = 0.4
    rest, smile = asked(fitted, faces)
    assert not rest.any()
    assert smile[left] == pytest.approx(0.4, abs=0.01) and curved(smile[right]) == pytest.approx(0.4, abs=0.02)
    assert drives(head)["corner_right"] != drives(fitted)["corner_right"]
