"""Torque off on boards: whatever was going on, the pulses of this head end, and none comes on by itself afterwards."""

import math

import numpy as np
import pytest
from board_rig import Bench
from emulated_port import EmulatedPort
from hypothesis import example, given
from hypothesis import strategies as st

from sfms_robot.errors import BusError, PortError
from sfms_robot.servo.codecs.maestro import get_position, set_target

KINDS = ("maestro-24", "ssc-32")
FIVE = (0, 1, 2, 5, 7)


class Adapter:
    """A USB adapter: unplugged, its ports are gone for good; the board behind it keeps its own supply.

    `interrupt` runs once, before the `at`-th exchange with a port: a signal handler, or another thread.
    """

    def __init__(self):
        self.plugged = True
        self.times = 0
        self.interrupt, self.at = None, math.inf
        self.calls = 0

    def unplug(self):
        self.plugged, self.times = False, self.times + 1

    def call(self, port):
        if not self.plugged or port.times != self.times:
            raise BusError(f"{port.name}: is gone")
        self.calls += 1
        if self.interrupt is not None and self.calls >= self.at:
            interrupt, self.interrupt = self.interrupt, None
            interrupt()


class PluggedPort(EmulatedPort):
    """A port on which silence costs time."""

    def __init__(self, adapter, *rest):
        if not adapter.plugged:
            raise PortError("emulated: no such device")
        super().__init__(*rest)
        self.adapter, self.times = adapter, adapter.times

    def write(self, data):
        self.adapter.call(self)
        super().write(data)

    def read(self, n, deadline_s):
        self.adapter.call(self)
        data = super().read(n, deadline_s)
        if not data:
            self.clock.wait_until(deadline_s)
        return data

    def discard_input(self):
        self.adapter.call(self)
        super().discard_input()


class ConnectedBench(Bench):
    """A connected bus, on an adapter that may be unplugged."""

    def __init__(self, model, channels=FIVE, **more):
        self.adapter = Adapter()
        super().__init__(model, channels, **more)
        self.bus.connect()

    def new_port(self, *rest):
        return PluggedPort(self.adapter, *rest)

    def enable(self):
        return self.bus.enable(self.bus.joints)

    def tick(self, goals_rad=None):
        return self.ticks(goals_rad, 1, 0.02)


@pytest.fixture(params=KINDS)
def model(request):
    return request.param


EVENTS = st.lists(st.tuples(st.integers(0, 40), st.sampled_from(["unplug", "plug"])), max_size=6)


@example(events=[(0, "unplug")], ticks=0, last="torque_off", model="maestro-24")
@given(
    events=EVENTS, ticks=st.integers(0, 40), last=st.sampled_from(["stop", "torque_off"]), model=st.sampled_from(KINDS)
)
def test_stop_ends_the_pulses_of_a_board_that_can_be_reached_and_of_one_that_comes_back(events, ticks, last, model):
    bench = ConnectedBench(model)
    held = bench.enable()
    for count, event in events:
        for _ in range(count):
            bench.tick(held)
        if event == "unplug":
            bench.adapter.unplug()
        else:
            bench.adapter.plugged = True
    for _ in range(ticks):
        bench.tick(held)
    getattr(bench.bus, last)("release")
    if bench.adapter.plugged:
        assert bench.on() == []
    else:
        assert bench.on() != []
        bench.adapter.plugged = True
        for _ in range(20):
            bench.tick()
        assert bench.on() == []


@given(at=st.integers(1, 150), model=st.sampled_from(KINDS))
def test_torque_off_anywhere_in_enable_ends_it_and_no_pulse_comes_on_afterwards(at, model):
    bench = ConnectedBench(model)
    bench.adapter.calls, bench.adapter.at = 0, at
    bench.adapter.interrupt = lambda: bench.bus.torque_off("release")
    try:
        held = bench.enable()
    except BusError as error:
        assert "torque was switched off" in str(error)
        assert bench.on() == []
        with pytest.raises(ValueError, match="no joint is enabled"):
            bench.bus.write(np.zeros(len(FIVE)), bench.clock.t)
        for _ in range(100):
            bench.tick()
        assert bench.on() == []
    else:
        assert bench.adapter.interrupt is not None, "enable went on after torque off"
        bench.tick(held)
    bench.adapter.interrupt = None
    bench.enable()
    assert bench.on() == list(FIVE)


@given(at=st.integers(1, 60), model=st.sampled_from(KINDS))
def test_torque_off_anywhere_in_a_tick_is_the_last_word(at, model):
    bench = ConnectedBench(model)
    held = bench.enable()
    bench.adapter.calls, bench.adapter.at = 0, at
    bench.adapter.interrupt = lambda: bench.bus.torque_off("release")
    for k in range(200):
        bench.tick(held + 0.1 * math.sin(k / 5))
    assert bench.adapter.interrupt is None and bench.on() == []
    bench.bus.stop("release")
    with pytest.raises(ValueError, match="no joint is enabled"):
        bench.tick(held)


def test_joint_that_must_hold_keeps_its_pulses_when_the_others_are_released(model):
    bench = ConnectedBench(model, stiff=(2,))
    bench.enable()
    bench.bus.torque_off("hold")
    assert bench.on() == list(FIVE)
    bench.bus.torque_off("release")
    assert bench.on() == [2]
    bench.bus.stop("release")
    assert bench.on() == [2] and bench.bus.statistics()["torque_unconfirmed"] == []
    bench.enable()
    bench.kill()
    bench.bus.stop("release")
    assert bench.bus.statistics()["torque_unconfirmed"] == ["joint0", "joint1", "joint5", "joint7"]


def test_torque_off_waits_for_nothing_and_stop_for_half_a_second_when_the_board_is_mute(model):
    bench = ConnectedBench(model, channels=range(24), baud=9600)
    held = bench.enable()
    bench.clock.t += 5.0
    bench.tick(held + 0.1)
    receive = bench.board.receive
    bench.board.receive = lambda data, baud, now_s: receive(data, baud, now_s)[:0]
    start_s = bench.clock.t
    bench.bus.torque_off("release")
    assert bench.clock.t == start_s and bench.on() == []
    bench.bus.stop("release")
    assert bench.clock.t - start_s <= 0.5


def test_stop_asks_whether_the_pulses_are_off_and_repeats_itself():
    bench = ConnectedBench("maestro-24")
    bench.enable()
    receive, lost = bench.board.receive, []

    def deaf_to_the_first(data, baud, now_s):
        if not lost:
            lost.append(data)
            return b""
        return receive(data, baud, now_s)

    bench.board.receive = deaf_to_the_first
    bench.bus.stop("release")
    assert lost and bench.on() == []


@pytest.mark.parametrize("mute", [None, 5])
def test_channels_whose_pulses_go_on_are_listed_and_a_lost_answer_confirms_nothing(mute):
    bench = ConnectedBench("maestro-24")
    bench.enable()
    receive, last = bench.board.receive, set_target(7, 0)

    def deaf_to_the_last(data, baud, now_s):
        answer = receive(data.replace(last, b""), baud, now_s)
        return b"" if mute is not None and data == get_position(mute) else answer

    bench.board.receive = deaf_to_the_last
    bench.bus.stop("release")
    listed = bench.bus.statistics()["torque_unconfirmed"]
    assert bench.on() == [7] and (listed == ["joint7"] if mute is None else "joint7" in listed)


def test_one_joint_comes_on_within_a_second(model):
    bench = ConnectedBench(model, limit_rad=1.5 if model == "ssc-32" else 1.1, baud=9600)
    for joint in bench.bus.joints:
        start_s = bench.clock.t
        bench.bus.enable([joint])
        assert 0.3 < bench.clock.t - start_s <= 1.0
