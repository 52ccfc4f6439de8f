import numpy as np
import pytest

from sfms_robot.signals.minimum_jerk import ease, minimum_jerk


def test_rests_at_both_ends_and_is_its_own_mirror():
    u = np.linspace(0.0, 1.0, 201)
    way = minimum_jerk(u)
    assert (way[0], way[-1]) == (0.0, 1.0)
    assert np.all(np.diff(way) > 0)
    assert way + way[::-1] == pytest.approx(np.ones(201), abs=1e-12)
    for ends in (way[:2], 1 - way[-2:]):
        assert np.ptp(ends) < 10.1 * 0.005**3  # third order: neither speed nor acceleration


def test_easing_starts_and_ends_at_rest_and_never_turns_back() -> None:
    values = [ease(u / 1000) for u in range(-100, 1101)]
    assert values[0] == 0.0 and values[-1] == 1.0
    assert all(a <= b for a, b in zip(values, values[1:], strict=False))
    assert ease(1e-3) < 1e-7 and 1 - ease(1 - 1e-3) < 1e-7
