"""Whatever is raised, wherever, at whichever tick: the head comes to rest and torque goes off, seen on the wire."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from loop_rig import Posed, Watcher, driven

from sfms_robot.app.open_head import build_bus, build_motion, run_log
from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_head
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import BusError, ModelError
from sfms_robot.frames import CHANNEL_INDEX
from sfms_robot.retarget.spontaneous import HeadLife
from sfms_robot.runtime.clock import InlineFeed, VirtualClock
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.safety import REST_LIMIT_S, Interrupt
from sfms_robot.sources.paired import PairedSource

HEAD = load_head("interbotix_wxxms")
RATE_HZ = max(bus.rate_hz for bus in HEAD.buses.values())
SECONDS = 0.8
ERRORS = (ModelError, BusError, ValueError, ZeroDivisionError, MemoryError, KeyboardInterrupt, SystemExit)
PLACES = (
    "source.read", "feed.push", "feed.poll", "timeline.accept", "timeline.sample", "retargeter.step", "limiter.step",
    "life.step", "bus.write", "bus.poll",
)  # fmt: skip


class Raising:
    """Any part, of which one method raises: at its `first` call, and at `times` calls in all."""

    def __init__(self, part: Any, method: str, error: type[BaseException], first: int, times: int = 1) -> None:
        self._part, self._method, self._error = part, method, error
        self._first, self._last, self._calls = first, first + times, 0

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._part, name)
        return self._counted(found) if name == self._method else found

    def _counted(self, call: Any) -> Any:
        def called(*arguments: Any) -> Any:
            self._calls += 1
            if self._first <= self._calls < self._last:
                raise self._error(f"{self._method} broke")
            return call(*arguments)

        return called


@pytest.fixture(scope="module")
def chain() -> Iterator[Chain]:
    near = {joint.id: joint.zero_ticks + 100 for joint in HEAD.joints.values()}
    servos = [replace(servo, start_ticks=near[servo.id]) for servo in emulated(HEAD)["main"]]
    with launch(servos, virtual=True) as running:  # the way from a sagged pose is longer than the run
        yield running


def raises() -> None:
    raise RuntimeError("a browser tab was closed")


def ran(
    chain: Chain, clock: VirtualClock, place: str = "", error: type[BaseException] = ValueError, first: int = 1,
    times: int = 1, observer: Watcher | None = None, interrupted: Any = lambda: False, limiter: Any = None,
) -> tuple[str, RunLog]:  # fmt: skip
    """One run on a fresh bus, in which `place` raises."""
    motion, bus = build_motion(HEAD, RATE_HZ), build_bus(HEAD, {"main": chain}, clock)
    bus.connect()
    log = run_log(HEAD, RATE_HZ)
    parts: dict[str, Any] = {
        "source": PairedSource(duration_s=SECONDS), "feed": InlineFeed(Posed(yaw=lambda times_s: 0.3), 0),
        "timeline": motion.timeline, "retargeter": motion.retargeter, "limiter": motion.limiter, "bus": bus,
        "life": HeadLife(HEAD.life, 0),
    }  # fmt: skip
    if limiter:
        parts["limiter"] = limiter(parts["limiter"])
    if place:
        name, method = place.split(".")
        parts[name] = Raising(parts[name], method, error, first, times)
    try:
        outcome, _ = driven(
            HEAD, parts.pop("bus"), clock, rate_hz=RATE_HZ, duration_s=SECONDS, observer=observer or Watcher(), log=log,
            interrupted=interrupted, **parts,
        )  # fmt: skip
    except BaseException as raised:
        outcome = f"{type(raised).__name__}: {raised}"
    finally:
        bus.close()
    return outcome, log


def assert_limp(chain: Chain) -> None:
    for name, joint in HEAD.joints.items():
        assert chain.state(joint.id)["torque"] == 0, f"{name} still has torque"


def assert_at_rest(chain: Chain) -> None:
    assert_limp(chain)
    for name, joint in HEAD.joints.items():
        assert abs(chain.state(joint.id)["position"] - joint.zero_ticks) <= 4, f"{name} is not at rest"


@given(place=st.sampled_from(PLACES), error=st.sampled_from(ERRORS), at=st.integers(1, 70))
def test_an_exception_at_any_place_of_any_tick_ends_at_rest_without_torque(chain, place, error, at):
    first = {"source.read": at, "feed.push": 1 + at % 20, "feed.poll": at, "timeline.accept": 1 + at % 5}.get(place, at)
    outcome, log = ran(chain, VirtualClock(), place, error, first)
    assert outcome == f"{error.__name__}: {place.split('.')[1]} broke"
    assert log.audited.violations == 0
    assert_at_rest(chain)


@pytest.mark.parametrize("place", ["limiter.step", "bus.write", "bus.poll"])
def test_what_raises_for_good_still_leaves_no_torque(chain, place):
    outcome, _ = ran(chain, VirtualClock(), place, ZeroDivisionError, 20, 10**9)
    assert outcome.startswith("ZeroDivisionError")
    assert_limp(chain)


LISTENED = round(SECONDS * RATE_HZ) + 1  # ticks; the way to rest follows


@pytest.mark.parametrize("at", [5, LISTENED, LISTENED + 39])
def test_an_observer_that_raises_is_detached_and_the_run_goes_on_to_its_rest(chain, caplog, at):
    observer = Watcher({at: raises})
    outcome, log = ran(chain, VirtualClock(), observer=observer)
    assert outcome == "done" and len(observer.ticks) == at and log.audited.violations == 0
    assert log.detached == {"Watcher": "RuntimeError: a browser tab was closed"}
    assert len([line for line in caplog.messages if "Watcher" in line]) == 1
    assert_at_rest(chain)


def test_the_way_to_rest_is_seen_and_the_last_face_fades_with_it(chain):
    observer = Watcher()
    outcome, log = ran(chain, VirtualClock(), observer=observer)
    assert outcome == "done" and len(observer.ticks) == log.ticks
    ways = [tick.state for tick in observer.ticks]
    first = ways.index("stopping")
    assert len(ways) - first == log.eased >= RATE_HZ and set(ways[first:]) == {"stopping"}
    times_s = [tick.time_s for tick in observer.ticks]
    assert np.diff(times_s) == pytest.approx(np.full(len(times_s) - 1, 1 / RATE_HZ))
    yaw = [abs(tick.motion[CHANNEL_INDEX["yaw"]]) for tick in observer.ticks[first - 1 :]]
    assert yaw[0] > 0.1 and yaw[-1] == 0.0 and all(a >= b for a, b in zip(yaw, yaw[1:], strict=False))
    last = observer.ticks[-1]
    assert set(last.readings) == set(HEAD.joints)
    assert last.goals_rad == pytest.approx([joint.rest_rad for joint in HEAD.joints.values()], abs=1e-3)


def test_asked_to_end_between_two_joints_the_rest_of_them_stay_off(chain):
    asked = iter([False, True, True, True])
    outcome, log = ran(chain, VirtualClock(), interrupted=lambda: next(asked))
    assert outcome == "interrupted" and log.ticks == 0
    assert_limp(chain)


def test_asked_to_end_during_the_last_easing_counts_as_interrupted(chain):
    watcher = Watcher()
    outcome, _ = ran(chain, VirtualClock(), observer=watcher, interrupted=lambda: len(watcher.ticks) > SECONDS * 100)
    assert outcome == "interrupted"
    assert_at_rest(chain)


def test_before_torque_the_first_request_ends_whatever_goes_on():
    with pytest.raises(KeyboardInterrupt):
        Interrupt().on_signal(2, None)


class Late(VirtualClock):
    """Of a computer that makes one tick in eight."""

    def wait_until(self, time_s: float) -> None:
        super().wait_until(time_s + 0.07)


def test_a_computer_that_is_late_still_comes_to_rest(chain):
    """Its goals take eight times as long; torque stays on until they have arrived."""
    clock = Late()
    ran(chain, clock)
    assert clock.now_s() < SECONDS + REST_LIMIT_S
    assert_at_rest(chain)


def test_a_limiter_that_never_brings_its_goals_there_holds_nobody_for_longer_than_the_limit(chain):
    class Lame:
        """Lets goals move in its first ticks only."""

        def __init__(self, limiter: Any) -> None:
            self._limiter, self._ticks = limiter, 0

        def __getattr__(self, name: str) -> Any:
            return getattr(self._limiter, name)

        def step(self, reference_rad: Any, state: Any) -> Any:
            self._ticks += 1
            goals, after = self._limiter.step(reference_rad, state)
            return (goals, after) if self._ticks < 10 else (state.motion[0], state)

    clock = Late()
    _, log = ran(chain, clock, limiter=Lame)
    assert clock.now_s() == pytest.approx(SECONDS + REST_LIMIT_S, abs=1.0)
    assert_limp(chain)
