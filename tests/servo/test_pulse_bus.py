import logging
import math

import numpy as np
import pytest
from board_rig import LIMIT_RAD, Bench
from emulated_port import EmulatedPort, Straight, bus_servo

from sfms_robot.config import BusConfig, load_firmware_map
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.servo.codecs import maestro
from sfms_robot.servo.pulse_bus import PulseBus

KINDS = ("maestro-24", "maestro-6", "ssc-32")


@pytest.fixture(params=KINDS)
def bench(request):
    return Bench(request.param)


def test_enabling_needs_somebody_who_knows(bench):
    other = Bench(bench.bus.model, confirmed=False)
    other.bus.connect()
    before = list(other.port.sent)
    with pytest.raises(ConfigError, match="report no position and jump to joint0, joint1.*confirm it with --yes"):
        other.bus.enable(other.bus.joints[:2])
    assert other.port.sent == before


def test_jump_is_said_aloud_once(bench, caplog):
    with caplog.at_level(logging.WARNING):
        bench.hold()
        bench.bus.enable(bench.bus.joints)
    assert [r.message.count("jumps to its first pose") for r in caplog.records] == [1]


def test_channels_come_on_one_at_a_time_at_rest(bench):
    rest = np.array([0.1, -0.2, 0.3, 0.0])
    bench = Bench(bench.bus.model, rest_rad=rest)
    bench.bus.connect()
    mark = len(bench.port.sent)
    assert bench.bus.enable(bench.bus.joints) == pytest.approx(rest, abs=0.001)
    assert len(bench.port.sent) - mark == 4 + 2  # and the board is asked whether it hears, before and after
    assert max(bench.port.waits) - bench.clock.t == pytest.approx(2 * LIMIT_RAD / 3.5)


def test_pulses_that_maestro_sends_already_are_kept_and_cost_no_wait():
    first = Bench()
    first.hold()
    first.ticks([0.3, 0.2, 0.1, -0.4], 2)
    before = first.pulses()
    first.bus.stop("hold")
    first.bus.close()
    second = Bench(rest_rad=np.full(4, 0.6))
    second.board = first.board
    second.bus.connect()
    waits = len(second.port.waits)
    assert second.bus.enable(second.bus.joints) == pytest.approx([0.3, 0.2, 0.1, -0.4], abs=0.001)
    assert second.pulses() == before and len(second.port.waits) == waits


def test_what_did_not_change_is_sent_in_turn_only(bench):
    held = bench.hold()
    bench.ticks(held, 10)
    mark = len(bench.port.sent)
    bench.ticks(held, 4, 0.01)
    assert len(bench.port.sent) - mark == 4
    channels = [line[1] for line in bench.port.sent[mark:]]
    assert sorted(channels) == sorted(b"0125" if bench.bus.model == "ssc-32" else [0, 1, 2, 5])


@pytest.mark.parametrize(
    ("file", "board", "cure"),
    [(False, True, "expects a CRC: set crc: true for this bus"), (True, False, "expects no CRC: set crc: false")],
)
def test_wrong_crc_setting_is_named_with_its_cure(file, board, cure):
    bench = Bench(crc=(file, board))
    with pytest.raises(BusError, match=rf"^bus 'face' on emulated at 115200 baud: the maestro-24 {cure}.*'Enable CRC'"):
        bench.bus.connect()
    assert bench.port.closed


def test_slow_wire_carries_the_newest_goals_and_never_piles_up():
    bench = Bench("ssc-32", channels=range(24), baud=9600)
    bench.hold()
    bench.clock.t = 10.0
    mark, start_s = len(bench.port.sent), bench.clock.t
    goals = np.zeros(24)
    for k in range(300):
        goals = np.full(24, 0.6 * math.sin(k / 20))
        bench.ticks(goals, 1, 0.01)
    for _ in range(2):
        bench.clock.t += 0.5
        bench.bus.poll(bench.clock.t)
    assert sum(map(len, bench.port.sent[mark:])) * 10 / 9600 <= bench.clock.t - start_s
    counts = bench.bus.statistics()
    assert counts["deferred"] > 250 and 8 < counts["writes"] < 40
    last = bench.bus._conversion.to_ticks(goals)
    bench.board.advance(bench.clock.t + 1.0)
    assert list(bench.pulses().values()) == list(last)


def test_ssc32_draws_lines_between_slow_goals():
    bench = Bench("ssc-32")
    held = bench.hold()
    bench.ticks(held, 1, 5.0)
    bench.ticks(held + 0.2, 1, 0.2)
    assert b"T200\r" in bench.port.sent[-1]
    bench.ticks(held + 0.3, 1, 0.01)
    assert b"T" not in bench.port.sent[-1]


def test_maestro_errors_become_faults_and_goals_are_sent_anew():
    bench = Bench()
    held = bench.hold()
    bench.ticks(held, 3)
    bench.board.fail(maestro.TIMEOUT_ERROR, bench.clock.t)
    assert set(bench.pulses().values()) == {0}
    assert {r.fault for r in bench.ticks(held, 11).values()} == {"serial timeout"}
    assert 0 not in bench.pulses().values() and {r.fault for r in bench.ticks(held, 11).values()} == {None}
    assert bench.bus.statistics()["faults"] == ["face: serial timeout"]


def test_damaged_bytes_are_counted_and_blame_no_joint():
    bench = Bench()
    held = bench.hold()
    bench.ticks(held, 3)
    bench.board.receive(b"\xb0", 115200, bench.clock.t)
    assert {r.fault for r in bench.ticks(held, 11).values()} == {None}
    counts = bench.bus.statistics()
    assert counts["faults"] == ["face: serial protocol"] and counts["errors"] == 1


def test_silent_board_gets_no_goals_and_is_taken_back(bench):
    held = bench.hold()
    bench.ticks(held, 1)
    bench.kill()
    silent = bench.ticks(held, 40)
    assert {r.fault for r in silent.values()} == {"no answer"}
    assert bench.bus.statistics()["silent"] == [0, 1, 2, 5]
    mark = len(bench.port.sent)
    bench.ticks(held + 0.1, 5)
    assert not any(b"P" in line or line[0] in (0x84, 0x9F) for line in bench.port.sent[mark:])
    bench.revive()
    assert {r.fault for r in bench.ticks(held, 11).values()} == {None}
    after = bench.bus.statistics()
    assert after["silent"] == [] and after["reconnects"] == 1
    bench.ticks(held + 0.1, 5)
    assert list(bench.pulses().values()) == list(bench.bus._conversion.to_ticks(held + 0.1))


def test_channels_that_lost_their_supply_come_on_again_one_at_a_time():
    bench = Bench()
    held = bench.hold()
    bench.ticks(held, 1)
    bench.kill()
    bench.ticks(held, 50)
    bench.board.restart(bench.clock.t)
    bench.revive()
    lit = []
    for _ in range(60):
        readings = bench.ticks(held + 0.1, 1)
        dark = [r.fault == "torque lost" for r in readings.values()]
        lit.append(4 - list(bench.pulses().values()).count(0))
        if bench.bus.statistics()["silent"] == []:
            assert dark.count(True) <= 4 - lit[-1]
    assert sorted(set(lit)) == [0, 1, 2, 3, 4] and lit == sorted(lit)
    assert lit.count(2) >= 4  # 1.4 rad at 3.5 rad/s
    assert {r.fault for r in readings.values()} == {None}
    assert list(bench.pulses().values()) == list(bench.bus._conversion.to_ticks(held + 0.1))


def test_asking_the_board_blocks_nobody(bench):
    held = bench.hold()
    bench.kill()
    waits = len(bench.port.waits)
    for _ in range(400):
        bench.ticks(held, 1, 0.01)
        assert all(deadline_s <= bench.clock.t for deadline_s in bench.port.waits[waits:])
        waits = len(bench.port.waits)


@pytest.mark.parametrize(
    ("model", "channel", "limit_rad", "problem"),
    [
        ("maestro-6", 9, LIMIT_RAD, r"joints.joint9.id: expected a channel of a maestro-6 \(0..5\), got 9"),
        ("ssc-32", 0, 1.6, r"a ssc-32 cannot send the pulses of joint0 \(\d+..\d+ us"),
    ],
)
def test_what_the_board_does_not_have_is_refused(model, channel, limit_rad, problem):
    with pytest.raises(ConfigError, match=problem):
        Bench(model, channels=[channel], limit_rad=limit_rad)


def test_range_beyond_the_factory_limits_of_a_maestro_is_said(caplog):
    with caplog.at_level(logging.WARNING):
        Bench("maestro-24", channels=[0], limit_rad=1.2)
    assert "widen the limits stored in the Maestro" in caplog.text


def test_two_boards_on_one_bus_are_refused():
    six, all_ = load_firmware_map("maestro-6"), load_firmware_map("maestro-24")
    servos = [bus_servo("a", 0, six, 0.1), bus_servo("b", 1, all_, 0.1)]
    with pytest.raises(ConfigError, match="one board has one model, the head names maestro-6 and maestro-24"):
        config = BusConfig(family="maestro", baud=115200)
        PulseBus("face", servos, Straight(six), lambda: EmulatedPort(None), 115200, 0.0, config)


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("model", ["maestro-24", "ssc-32"])
def test_pulses_that_a_killed_run_left_on_end_and_the_board_confirms_it(model, silent):
    left = Bench(model)
    left.hold()
    bench = Bench(model)
    bench.board, bench.clock = left.board, left.clock
    (bench.kill if silent else bench.revive)()
    assert bench.bus.end_pulses(range(24)) is not silent
    assert bench.on() == (left.on() if silent else []) and bench.port.closed
