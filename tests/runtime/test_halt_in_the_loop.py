"""Emergency stop on emulated servos in virtual time: braked under the limits, held or released, latched, resumed."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from loop_rig import Posed, Ran, Watcher, run_listener

from sfms_robot.app.open_head import build_motion
from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import BusError
from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, FaceFrame, SpeakerFrame
from sfms_robot.ports import Bus, Source
from sfms_robot.runtime.clock import VirtualClock
from sfms_robot.runtime.halt import HaltLatch
from sfms_robot.runtime.safety import EASE_S

RATE_HZ = 100.0
HEAD = load_head("face28")
JOINTS = list(HEAD.joints)
NECK = [joint for joint in JOINTS if joint.startswith("neck")]
STOPS_S = 0.5  # more than any joint of this head needs from full speed


def swing(times_s):
    return np.sin(2 * np.pi * times_s)


# A listener that nods all the time, opens its jaw with it, and looks about.
NODDER = Posed(pitch=lambda s: 0.15 * swing(s), yaw=lambda s: 0.2 * swing(s), jawOpen=lambda s: 0.4 * np.abs(swing(s)))


class Somebody(Source):
    """A face that is always there, until `gone_s`."""

    def __init__(self, gone_s: float = np.inf) -> None:
        self._given, self._gone_s = 0, gone_s
        self.told_rad_s: list[float] = []

    def moves(self, speed_rad_s: float) -> None:
        self.told_rad_s.append(speed_rad_s)

    def read(self, now_s: float) -> list[SpeakerFrame]:
        frames = []
        while (time_s := (self._given + 1) * FRAME_S) <= now_s + 1e-9:
            self._given += 1
            face = FaceFrame(time_s, np.zeros(6, np.float32), np.zeros(52, np.float32))
            seen = time_s <= self._gone_s
            frames.append(SpeakerFrame(time_s, np.zeros(640 if seen else 0, np.float32), face if seen else None))
        return frames


@pytest.fixture
def chain() -> Iterator[Chain]:
    with launch(emulated(HEAD)["main"], virtual=True) as running:
        yield running


def run(
    chain: Chain,
    does: Callable[[HaltLatch], dict[int, Callable[[], None]]] = lambda latch: {},
    seconds: float = 4.0,
    latch: HaltLatch | None = None,
    without: tuple[str, ...] = (),
    **how: Any,
) -> Ran:
    clock, latch, motion = VirtualClock(), latch or HaltLatch(), build_motion(HEAD, RATE_HZ)
    clock.wait_until(chain_time(chain))
    ran = run_listener(
        HEAD, chain, NODDER, Watcher(does(latch)), clock=clock, rate_hz=RATE_HZ, duration_s=seconds, without=without,
        answers=True, halt=latch, holds=motion.holds, heat=motion.heat, ignored=frozenset(without),
        **{"source": Somebody()} | how,
    )  # fmt: skip
    TIMES[id(chain)] = clock.now_s()
    return ran


TIMES: dict[int, float] = {}


def chain_time(chain: Chain) -> float:
    return TIMES.get(id(chain), 0.0)


def torque(chain: Chain, joint: str) -> bool:
    return bool(chain.state(HEAD.joints[joint].id)["torque"])


@settings(max_examples=2, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(halted=st.integers(60, 250), resumed=st.integers(0, 120))
@example(halted=100, resumed=0)  # the very tick in which all have eased in
def test_a_halt_brakes_holds_the_neck_lets_go_of_the_rest_and_eases_in_when_it_is_released(chain, halted, resumed):
    seen: dict[str, bool] = {}
    late = halted + round(STOPS_S * RATE_HZ) + resumed

    def does(latch: HaltLatch) -> dict[int, Callable[[], None]]:
        def look() -> None:
            seen.update({joint: torque(chain, joint) for joint in JOINTS})
            latch.resume("device")

        return {halted: lambda: latch.close("key"), late: look}

    ran = run(chain, does, seconds=(late + 250) / RATE_HZ)
    assert ran.outcome == "done" and ran.log.audited.violations == 0
    before = "starting" if halted < EASE_S * RATE_HZ else "listening"
    assert [ran.ticks[halted].state, ran.ticks[halted + 1].state] == [before, "halted"]
    assert ran.ticks[halted + 1].why == ("key",)
    goals, stop = ran.watcher.goals(), halted + round(STOPS_S * RATE_HZ)
    assert np.array_equal(goals[stop], goals[late])  # stands, for as long as it is halted
    assert seen == {joint: joint in NECK for joint in JOINTS}
    assert "starting" in ran.states[ran.states.index("halted") :] and ran.states[-2:] == ["listening", "stopping"]
    after = goals[late + round((EASE_S + 0.5) * RATE_HZ) :]
    assert np.ptp(after, axis=0)[JOINTS.index(NECK[1])] > 0.05  # it nods again


def test_a_head_that_is_halted_at_the_end_moves_no_more(chain):
    ran = run(chain, lambda latch: {150: lambda: latch.close("key")}, seconds=3.0)
    assert ran.log.eased == 0 and ran.states[-1] == "halted"
    assert not any(torque(chain, joint) for joint in JOINTS)


@pytest.mark.parametrize(
    ("halted", "resumed", "before"), [(150, 151, ["starting", "listening"]), (20, 120, ["starting"])]
)
def test_a_halt_that_is_released_at_once_or_comes_while_joints_ease_in_ends_when_the_head_stands(
    chain, halted, resumed, before
):
    ran = run(chain, lambda latch: {halted: lambda: latch.close("key"), resumed: lambda: latch.resume("device")})
    assert ran.states == [*before, "halted", "starting", "listening", "stopping"]
    assert ran.log.audited.violations == 0


def test_a_halt_while_joints_are_switched_on_takes_torque_off_and_ends_the_run(chain):
    latch, looks = HaltLatch(), iter(range(99))

    def halted_at_the_fifth_joint() -> bool:
        if next(looks) == 4:
            latch.close("key")
        return False

    with pytest.raises(BusError, match="halted by key while joints were switched on"):
        run(chain, latch=latch, interrupted=halted_at_the_fifth_joint)
    assert not any(torque(chain, joint) for joint in JOINTS)


def came_back(ran: Ran) -> dict[str, int]:
    """The tick in which each joint held its place again, by joint."""
    return {joint: k for k, tick in enumerate(ran.ticks) for joint, each in tick.readings.items() if each.rejoined}


def test_joints_come_back_a_few_per_tick_while_those_that_hold_go_on(chain):
    resumed = 250
    ran = run(
        chain, lambda latch: {150: lambda: latch.close("key"), resumed: lambda: latch.resume("device")},
        seconds=6.0, without=("jaw",),
    )  # fmt: skip
    back = came_back(ran)
    assert set(back) == set(JOINTS) - set(NECK) - {"jaw"}
    per_tick = [list(back.values()).count(k) for k in range(resumed, max(back.values()) + 1)]
    assert max(per_tick) <= 3 and sum(map(bool, per_tick)) > 5 and len(per_tick) < RATE_HZ
    goals = ran.watcher.goals()
    for joint, k in back.items():  # no goal moves before its joint is back
        assert np.ptp(goals[resumed : k + 1, JOINTS.index(joint)]) == 0.0
        assert goals[k + 1, JOINTS.index(joint)] == pytest.approx(ran.ticks[k].readings[joint].position_rad, abs=2e-3)
    neck = goals[resumed : max(back.values()), JOINTS.index(NECK[1])]
    assert np.ptp(neck) > 1e-3  # which is on its way already
    assert np.ptp(goals[-150:, JOINTS.index("jaw")]) > 0.05  # one that was left out is drawn as before
    assert ran.states == ["starting", "listening", "halted", "starting", "listening", "stopping"]
    assert ran.log.audited.violations == 0


@pytest.mark.parametrize("after", [1, pytest.param(10, marks=pytest.mark.slow), 40])
def test_a_second_halt_while_joints_come_back_halts_again(chain, after):
    torques: list[list[str]] = []

    def does(latch: HaltLatch) -> dict[int, Callable[[], None]]:
        again = 250 + after
        return {
            150: lambda: latch.close("key"), 250: lambda: latch.resume("device"),
            again: lambda: latch.close("page", "page"), again + 40: look, again + 60: lambda: latch.resume("page"),
        }  # fmt: skip

    def look() -> None:
        torques.append([joint for joint in JOINTS if torque(chain, joint)])

    ran = run(chain, does, seconds=6.0)
    assert ran.outcome == "done" and ran.log.audited.violations == 0
    assert ran.states == [
        "starting", "listening", "halted", "starting", "halted", "starting", "listening", "stopping",
    ]  # fmt: skip
    assert ran.ticks[250 + after + 1].why == ("page",)
    assert torques == [NECK]
    halted = ran.ticks[250 + after + 2 : 250 + after + 60]
    assert not any(each.rejoined for tick in halted for each in tick.readings.values())  # those on their way stay off
    assert set(came_back(ran)) == set(JOINTS) - set(NECK)


def test_all_causes_are_named_and_a_halt_that_ends_before_the_head_stands_ends_nothing(chain):
    def does(latch: HaltLatch) -> dict[int, Callable[[], None]]:
        return {
            150: lambda: latch.close("key"), 151: lambda: latch.close("page", "page"),
            153: lambda: latch.resume("device"),
        }  # fmt: skip

    ran = run(chain, does, seconds=5.0)
    assert ran.ticks[151].why == ("key",) and ran.ticks[152].why == ran.ticks[155].why == ("key", "page")
    assert ran.outcome == "done" and ran.states[2:] == ["halted", "starting", "listening", "stopping"]


def test_a_head_that_lost_its_torque_because_the_loop_stood_still_comes_back_whole(chain):
    class Late(HaltLatch):
        """As one whose watching thread has taken torque off."""

        def answer(self) -> bool:
            return not super().answer()

    buses: list[Bus] = []

    def does(latch: HaltLatch) -> dict[int, Callable[[], None]]:
        def dead() -> None:
            latch.close("key")
            buses[0].torque_off("release")

        return {150: dead, 250: lambda: latch.resume("device")}

    ran = run(chain, does, seconds=6.0, latch=Late(), opened=buses.append)
    assert ran.outcome == "done" and ran.log.audited.violations == 0
    assert set(came_back(ran)) == set(JOINTS) and ran.states[-2:] == ["listening", "stopping"]
    assert np.ptp(ran.watcher.goals()[-100:, JOINTS.index(NECK[1])]) > 0.05


def test_who_is_gone_is_not_answered_and_who_comes_is_answered_within_half_a_second(chain):
    ran = run(chain, source=Somebody(gone_s=3.0), seconds=8.0)
    pitch = np.array([tick.motion[CHANNEL_INDEX["pitch"]] for tick in ran.ticks])
    t = np.array([tick.time_s for tick in ran.ticks])
    assert np.ptp(pitch[(t > 1.5) & (t < 3.0)]) > 0.2
    assert np.ptp(pitch[(t > 4.5) & (t < 8.0)]) == 0.0  # nothing has come for half a second: it does not answer


def test_a_hot_servo_moves_less_and_then_rests(chain):
    jaw = HEAD.joints["jaw"]
    chain.heat(jaw.id, 69.0)
    ran = run(chain, seconds=6.0)
    goals = np.array([tick.goals_rad[JOINTS.index("jaw")] for tick in ran.ticks])
    assert np.abs(goals[-100:] - jaw.rest_rad).max() < 1e-6
    assert ran.log.audited.violations == 0


def test_the_source_is_told_how_fast_joints_move_and_that_they_stand_while_they_are_halted(chain):
    somebody = Somebody()
    ran = run(chain, lambda latch: {150: lambda: latch.close("key")}, seconds=3.0, source=somebody)
    speeds = np.abs(np.diff(ran.watcher.goals(), axis=0)).sum(axis=1) * RATE_HZ
    assert np.allclose(somebody.told_rad_s[1:], speeds)
    assert max(speeds[100:150]) > 0.1 and set(somebody.told_rad_s[-50:]) == {0.0}
