"""Regions of a head are turned up and down from the command line, and while it runs."""

import numpy as np
import pytest
from loop_rig import Watcher, driven

from sfms_robot.app.head.pose import NobodyThere
from sfms_robot.app.listen.knobs import LiveKnobs
from sfms_robot.app.open_head import build_bus, build_motion
from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import launch
from sfms_robot.errors import ConfigError
from sfms_robot.frames import MOTION_DIM
from sfms_robot.lab.bench.motion_bench import Waves
from sfms_robot.runtime.clock import VirtualClock

HEAD = load_head("face28")
RETARGETER = build_motion(HEAD, 100.0).retargeter


def test_a_region_at_intensity_0_rests_alone_and_nothing_given_is_what_the_file_says():
    face = np.full(MOTION_DIM, 0.2, dtype=np.float32)
    plain, _ = RETARGETER.step(face, RETARGETER.start())
    without, _ = RETARGETER.step(face, RETARGETER.start(), LiveKnobs(HEAD, ["brows=0"]).now)
    changed = {name for name, a, b in zip(RETARGETER.joints, plain, without, strict=True) if a != b}
    assert changed and all(name.startswith("brow") for name in changed)
    same, _ = RETARGETER.step(face, RETARGETER.start(), LiveKnobs(HEAD).now)
    assert np.array_equal(plain, same)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("nose=1", "'nose' is not a region of this head (neck, eyes"),
        ("neck=3", "intensity of neck = 3 is not in 0..2"),
        ("neck=nan", "intensity of neck = nan is not in 0..2"),
        ("neck", "--intensity 'neck' is not REGION=VALUE"),
        ("neck=loud", "--intensity 'neck=loud' is not REGION=VALUE"),
    ],
)
def test_a_knob_that_is_none_is_refused_in_one_line(given, said):
    with pytest.raises(ConfigError) as caught:
        LiveKnobs(HEAD, [given])
    assert said in str(caught.value)


def test_all_regions_are_turned_together_and_none_leaves_its_range():
    knobs = LiveKnobs(HEAD, ["neck=0.5", "brows=1.95"])
    before = knobs.values["intensity"]
    knobs.turn_all(0.1)
    assert knobs.values["intensity"] == {region: pytest.approx(min(at + 0.1, 2.0)) for region, at in before.items()}
    assert knobs.now.intensity.max() == 2.0
    for _ in range(30):
        knobs.turn_all(-0.1)
    assert set(knobs.values["intensity"].values()) == {0.0}
    angles, _ = RETARGETER.step(np.full(MOTION_DIM, 0.2, dtype=np.float32), RETARGETER.start(), knobs.now)
    assert angles == pytest.approx(build_motion(HEAD, 100.0).rest_rad, abs=0.02)


def test_a_knob_turned_while_the_head_runs_takes_effect_within_its_limits():
    head, clock, watcher = load_head("op3_head"), VirtualClock(), Watcher()
    off, on = LiveKnobs(head, ["neck=0"]).now, LiveKnobs(head).now
    with launch(emulated(head)["main"], virtual=True) as chain:
        bus = build_bus(head, {"main": chain}, clock)
        bus.connect()
        _, log = driven(
            head, bus, clock, rate_hz=100.0, duration_s=4.0, observer=watcher, source=NobodyThere(), feed=Waves(),
            knobs=lambda: off if len(watcher.ticks) >= 200 else on,
        )  # fmt: skip
        bus.close()
    sent = watcher.goals()
    assert np.ptp(sent[100:200], axis=0).min() > 0.01
    assert np.abs(sent[320:] - build_motion(head, 100.0).rest_rad).max() < 1e-6
    assert log.audited.violations == 0
