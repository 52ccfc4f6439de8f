"""`bench live`: latencies add up from the stamps that travel, whatever the run; a blow that is not told of is found."""

import numpy as np
import pytest
from virtual_time import Time

from sfms_robot.frames import FRAME_S, FaceFrame, Plan, SpeakerFrame
from sfms_robot.lab.bench.live_bench import SETTLED_S, STAGES, Stamps
from sfms_robot.lab.bench.torture_bench import missed_ticks
from sfms_robot.ports import Tick

TICK_S = 0.01
SOUND = np.zeros(640, np.float32)


def stamped(seconds, hop, source_s, plan_s, write_s=0.0, skip=()):
    """A run in made-up time: frames come `source_s` late, plans `plan_s` after the frame that they are made of."""
    time = Time()
    stamps = Stamps(lambda: source_s / 2, 1 / TICK_S, time.now_s)
    given, plans = 0, []
    for tick in range(round(seconds / TICK_S)):
        if tick in skip:
            continue
        time.t = tick * TICK_S
        while (end_s := (given + 1) * FRAME_S) + source_s <= time.t + 1e-9:
            face = FaceFrame(end_s - 0.01, np.zeros(6, np.float32), np.zeros(52, np.float32))
            stamps.heard(SpeakerFrame(end_s, SOUND, face))
            if given % hop == 0:
                plans.append((time.t + plan_s, end_s))
            given += 1
        while plans and plans[0][0] <= time.t + 1e-9:
            made_at_s = plans.pop(0)[1]
            stamps.planned(Plan(made_at_s, np.array([made_at_s + FRAME_S]), np.zeros((1, 58), np.float32)))
        time.t += write_s
        stamps.tick(Tick(tick * TICK_S, np.zeros(58, np.float32), np.zeros(1), {}))
    return stamps.report()


@pytest.mark.parametrize("hop", [1, 2, 4])
def test_a_sound_waits_for_its_hop_the_source_the_plan_and_the_write(hop):
    told = stamped(SETTLED_S + 20, hop, 0.02, 0.01, 0.002)
    assert told["stages_ms"]["block"] == {"p50": pytest.approx(10), "p95": pytest.approx(10)}
    assert told["stages_ms"]["grid"]["p50"] == pytest.approx(10)
    assert told["stages_ms"]["plan"]["p50"] == pytest.approx(10)
    assert told["stages_ms"]["write"]["p50"] == pytest.approx(2)
    sound = told["sound_to_goal_ms"]
    assert sound["p50"] == pytest.approx(hop * 20 + 32, abs=6) and sound["p95"] == pytest.approx(hop * 38 + 32, abs=9)
    assert set(told["stages_ms"]) == set(STAGES)
    assert told["face_to_goal_ms"]["p95"] == pytest.approx(10 + (hop - 1) * 40 + 32, abs=1)


def test_ticks_that_did_not_come_are_missed():
    told = stamped(2.0, 4, 0.0, 0.01, skip=(50, 51, 120))
    assert told["missed_ticks"] == 3 and told["ticks"] == 197


def test_missed_ticks_are_laid_to_the_blow_before_them():
    times_s = np.delete(np.arange(0, 60, TICK_S), [1010, 1011, 4000])
    expected = {"after_a_blow": 2, "otherwise": 1, "expected_after_a_blow": pytest.approx(0.59, abs=0.02)}
    assert missed_ticks(times_s, [10.0]) == expected
    assert missed_ticks(times_s, [])["after_a_blow"] == 0
