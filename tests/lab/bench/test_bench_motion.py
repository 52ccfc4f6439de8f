"""What `bench retarget` and `bench lead` measure, on runs short enough for a test."""

import numpy as np
import pytest

from sfms_robot.data import head_names
from sfms_robot.lab.bench.motion_bench import delay_ticks, delays, retarget

HEADS = head_names()
QUICK = ["op3_head", "open_duck_mini_v2_head", "poppy_head", "reachy_mini", "inmoov2_ssc32"]


@pytest.mark.parametrize("shift", [-3.0, 0.0, 0.4, 3.7, 12.25])
def test_a_delay_is_found_between_two_ticks(shift):
    ticks = np.arange(600)[:, None]
    rates, phases = np.array([[0.05, 0.11, 0.083]]), np.array([[0.3, 1.0, 2.0]])
    meant = np.sin(ticks * rates + phases) + 0.5 * np.sin(ticks * 1.7 * rates)
    seen = 0.3 + 0.8 * (np.sin((ticks - shift) * rates + phases) + 0.5 * np.sin((ticks - shift) * 1.7 * rates))
    assert delay_ticks(meant, seen, 30) == pytest.approx(shift, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", HEADS)
def test_led_by_its_lag_every_joint_is_less_than_a_tick_late(name):
    _, led_s, unled_s = delays(name, duration_s=4.0) if name in QUICK else delays(name)
    moved = np.isfinite(led_s)
    assert moved.any() if name in QUICK else moved.mean() > 0.8
    assert np.abs(led_s[moved]).max() < 0.010
    assert name not in QUICK or unled_s[moved].min() > 0.030


def test_a_tick_is_measured_part_by_part_beside_a_matrix_product():
    rows = retarget()
    parts = {f"retarget.{part}" for part in ("tick", "timeline", "mapping", "limits", "calibration")}
    assert set(rows) == parts
    assert all(row["median"] > 0 and row["ratio"] > 0 and row["unit"] == "ms" for row in rows.values())
