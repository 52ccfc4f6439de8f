"""The loop on emulated servos in virtual time, under a hand-written listener: whatever happens, it comes to rest."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from loop_rig import Posed, Ran, Watcher, run_listener

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import RobotError
from sfms_robot.frames import CHANNEL_INDEX, MOTION_DIM, SpeakerFrame
from sfms_robot.ports import Source
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.runtime.loop import turned_by_hand
from sfms_robot.sources.paired import PairedSource

RATE_HZ = 100.0
ORIGIN_S = 300.0  # of the clock, as of `time.monotonic`
HEAD = load_head("face28")


def nodder(**broken) -> Posed:
    return Posed(pitch=lambda times_s: 0.1 * np.sin(2 * np.pi * times_s), **broken)


@pytest.fixture
def chain() -> Iterator[Chain]:
    with launch(emulated(HEAD)["main"], virtual=True) as running:
        yield running


def run(chain: Chain, listener: Posed, watcher: Watcher | None = None, seconds: float = 2.0, **how: Any) -> Ran:
    clock = VirtualClock()
    clock.origin_s = ORIGIN_S
    how = {"source": PairedSource(duration_s=seconds)} | how
    return run_listener(
        HEAD, chain, listener, watcher or Watcher(), clock=clock, rate_hz=RATE_HZ, duration_s=seconds, **how
    )


def assert_at_rest(chain: Chain) -> None:
    for name, joint in HEAD.joints.items():
        servo = chain.state(joint.id)
        assert servo["torque"] == 0, f"{name} still has torque"
        assert abs(servo["position"] - joint.zero_ticks) <= 3, f"{name} is not at rest"


def test_a_run_ends_at_rest_without_torque_and_without_a_violation(chain: Chain) -> None:
    ran = run(chain, nodder())
    assert ran.outcome == "done" and (ran.log.frames, ran.watcher.frames, ran.watcher.plans) == (50, 50, 13)
    assert [tick.state for tick in ran.ticks].index("stopping") == 201 and ran.log.audited.violations == 0
    assert_at_rest(chain)


def test_a_plan_that_is_not_finite_is_refused_and_the_face_stays_safe(chain: Chain) -> None:
    ran = run(chain, nodder(nan_from=20))
    assert ran.outcome == "done" and ran.log.refused_plans > 0
    assert all(np.isfinite(tick.goals_rad).all() for tick in ran.ticks) and ran.log.audited.violations == 0
    assert_at_rest(chain)


def test_a_servo_that_refuses_torque_leaves_none_of_them_with_torque(chain: Chain) -> None:
    chain.fault(5, 0x20)  # overload, latched until reboot
    watcher = Watcher()
    with pytest.raises(RobotError, match=r"lid_left \(id 5\)"):
        run(chain, nodder(), watcher)
    assert watcher.ticks == []
    assert not any(chain.state(joint.id)["torque"] for joint in HEAD.joints.values())


class Started(Source):
    """A source that keeps what it was told: its start, and when it was read."""

    def __init__(self) -> None:
        self.told: list[tuple[str, float]] = []

    def start(self, origin_s: float) -> None:
        self.told.append(("start", origin_s))

    def read(self, now_s: float) -> list[SpeakerFrame]:
        self.told.append(("read", now_s))
        return []


def test_a_source_starts_once_at_the_first_tick_after_torque_came_on(chain: Chain) -> None:
    source = Started()
    ran = run(chain, nodder(), seconds=0.5, source=source)
    (_, origin_s), *read = source.told
    assert origin_s == ORIGIN_S and read[0] == ("read", 0.0) and {what for what, _ in read} == {"read"}
    assert ran.outcome == "done" and ran.ticks[0].time_s == 0.0


def test_only_what_turns_head_or_eyes_is_by_hand():
    planned = np.zeros((3, MOTION_DIM), np.float32)
    assert not turned_by_hand(planned, planned)
    for channel, turned in (("mouthSmileLeft", False), ("eyeBlinkLeft", False), ("yaw", True), ("eyeLookUpLeft", True)):
        asked = planned.copy()
        asked[1, CHANNEL_INDEX[channel]] = 0.3
        assert turned_by_hand(planned, asked) == turned
