"""Torque off on boards: whatever was going on, the pulses of this head end, and none comes on by itself afterwards."""

import math

import numpy as np
import pytest
from device_port import DevicePort, Time
from hypothesis import example, given
from hypothesis import strategies as st

from sfms_robot.config import Safety, load_firmware_map
from sfms_robot.emulator.pulse_boards import MaestroBoard, Ssc32Board
from sfms_robot.errors import BusError, PortError
from sfms_robot.servo.boards.maestro_bus import MaestroBus
from sfms_robot.servo.boards.ssc32_bus import Ssc32Bus
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.registers import Table

KINDS = {"maestro-24": (MaestroBus, MaestroBoard), "ssc-32": (Ssc32Bus, Ssc32Board)}
FIVE = (0, 1, 2, 5, 7)


class Pulses:
    """0 rad is the middle."""

    def __init__(self, table, limit_rad):
        self.center, self.limit_rad = table.center_ticks, limit_rad
        self.per_rad = table.ticks_per_revolution / (2 * math.pi)

    def to_ticks(self, angles_rad):
        return np.rint(self.center + np.clip(angles_rad, -self.limit_rad, self.limit_rad) * self.per_rad).astype(int)

    def to_rad(self, ticks):
        return (np.asarray(ticks) - self.center) / self.per_rad


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


class PluggedPort(DevicePort):
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


class Bench:
    def __init__(self, model, channels=FIVE, limit_rad=0.7, baud=115200, stiff=()):
        firmware_map = load_firmware_map(model)
        bus_class, board_class = KINDS[model]
        table = Table.of(firmware_map)
        self.clock, self.adapter, self.ports = Time(), Adapter(), []
        rows = [{"id": i, "baud": baud, "start_ticks": table.center_ticks} for i in channels]
        self.board = board_class(table, rows)

        def open_port():
            self.ports.append(PluggedPort(self.adapter, self.board, baud, self.clock))
            return self.ports[-1]

        safety = {True: Safety(stop="hold"), False: Safety()}
        servos = [BusServo(f"j{i}", i, firmware_map, -limit_rad, limit_rad, safety[i in stiff]) for i in channels]
        conversion = Pulses(table, limit_rad)
        self.bus = bus_class("face", servos, conversion, open_port, baud, confirmed=True)
        self.bus.connect()

    def enable(self):
        return self.bus.enable(self.bus.joints)

    def tick(self, goals_rad=None, period_s=0.02):
        self.clock.t += period_s
        if goals_rad is not None:
            self.bus.write(goals_rad, self.clock.t)
        return self.bus.poll(self.clock.t)

    def on(self):
        return [channel.id for channel in self.board.servos if channel.pulse]


@pytest.fixture(params=KINDS)
def model(request):
    return request.param


EVENTS = st.lists(st.tuples(st.integers(0, 40), st.sampled_from(["unplug", "plug"])), max_size=6)


@example(events=[(0, "unplug")], ticks=0, last="torque_off", model="maestro-24")
@given(
    events=EVENTS,
    ticks=st.integers(0, 40),
    last=st.sampled_from(["stop", "torque_off"]),
    model=st.sampled_from(list(KINDS)),
)
def test_stop_ends_the_pulses_of_a_board_that_can_be_reached_and_of_one_that_comes_back(events, ticks, last, model):
    bench = Bench(model)
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


@given(at=st.integers(1, 150), model=st.sampled_from(list(KINDS)))
def test_torque_off_anywhere_in_enable_ends_it_and_no_pulse_comes_on_afterwards(at, model):
    bench = Bench(model)
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


@given(at=st.integers(1, 60), model=st.sampled_from(list(KINDS)))
def test_torque_off_anywhere_in_a_tick_is_the_last_word(at, model):
    bench = Bench(model)
    held = bench.enable()
    bench.adapter.calls, bench.adapter.at = 0, at
    bench.adapter.interrupt = lambda: bench.bus.torque_off("release")
    for k in range(200):
        bench.tick(held + 0.1 * math.sin(k / 5))
    assert bench.adapter.interrupt is None
    assert bench.on() == []
    bench.bus.stop("release")
    with pytest.raises(ValueError, match="no joint is enabled"):
        bench.tick(held)


def test_joint_that_must_hold_keeps_its_pulses_in_torque_off(model):
    bench = Bench(model, stiff=(2,))
    bench.enable()
    bench.bus.torque_off("hold")
    assert bench.on() == list(FIVE)
    bench.bus.torque_off("release")
    assert bench.on() == [2]


def test_torque_off_waits_for_nothing_and_stop_for_half_a_second_when_the_board_is_mute(model):
    bench = Bench(model, channels=range(24), baud=9600)
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
    bench = Bench("maestro-24")
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


def test_one_joint_comes_on_within_a_second(model):
    bench = Bench(model, limit_rad=1.5 if model == "ssc-32" else 1.1, baud=9600)
    for joint in bench.bus.joints:
        start_s = bench.clock.t
        bench.bus.enable([joint])
        assert 0.3 < bench.clock.t - start_s <= 1.0


def test_torque_off_before_connect_and_after_close_does_nothing(model):
    bench = Bench(model)
    bench.enable()
    bench.bus.close()
    sent = [list(port.sent) for port in bench.ports]
    bench.bus.torque_off("release")
    bench.bus.stop("release")
    assert [list(port.sent) for port in bench.ports] == sent
