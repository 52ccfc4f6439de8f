"""One servo's states: a test per arrow of the diagram in docs/safety.md. Without a wire, times are given."""

import pytest
from emulated_port import bus_servo

from sfms_robot.config import Faults, LoadRule, Safety, load_firmware_map
from sfms_robot.errors import ServoError
from sfms_robot.servo.chain import member as rules
from sfms_robot.servo.chain.member import LONGEST_PAUSE_S, Member, MemberState
from sfms_robot.servo.chain.startup import Silent
from sfms_robot.servo.registers import Table

OVERLOAD = 1 << 5
STANDS = 2100


class Way:
    """How a servo starts up again: ends with where it stands, or as `failure` says."""

    can_reboot = True

    def __init__(self, **safety):
        self.servo = bus_servo("jaw", 4, load_firmware_map("xl330-m288"), safety=Safety(**safety))
        self.table = Table.of(self.servo.map)
        self.failure = None
        self.asked = []

    def bring_back(self, reboot):
        self.asked.append(reboot)
        yield 0.5 if reboot else 0.0
        if self.failure is not None:
            raise self.failure
        return STANDS


@pytest.fixture
def way():
    return Way()


@pytest.fixture
def member(way):
    return made(way)


def made(way, **safety):
    """An enabled servo."""
    way.servo = Way(**safety).servo
    member = Member(0, way, Faults(), {})
    member.connected(True)
    member.enabled()
    return member


def run(member, now_s):
    """All steps of its job that are due; the time is the caller's."""
    while member.due(now_s):
        member.step(now_s)


def silent(member, now_s=0.0):
    member.suspect(now_s)
    member.probe_failed(now_s)


def fails(member, now_s=0.0):
    member.take_bits(OVERLOAD, {}, now_s)


def test_off_to_online_by_enable(way):
    member = made(way)
    assert member.state is MemberState.ONLINE and member.gets_goals


def test_online_to_silent_when_a_probe_is_in_vain_and_not_before(member):
    member.suspect(0.0)
    assert member.state is MemberState.ONLINE and not member.listed
    member.probe_failed(0.05)
    assert member.state is MemberState.SILENT and not member.gets_goals and member.fault == "no answer"


def test_one_lost_answer_is_forgiven_and_the_second_is_not(member):
    for now_s, answers in ((0.0, True), (0.1, False), (0.2, True)):
        member.unanswered(now_s)
        assert member.listed is (now_s < 0.2)
        if answers:
            member.answered()


def test_silent_to_returning_to_rejoining_to_online(member):
    silent(member)
    assert not member.listed
    member.answered()
    member.back(1.0)
    assert member.state is MemberState.RETURNING and not member.gets_goals
    run(member, 1.0)
    assert member.state is MemberState.REJOINING and member.rejoined and member.fault is None and not member.gets_goals
    assert not member.accepts(STANDS + 50)
    assert member.accepts(STANDS + 5)
    assert member.state is MemberState.ONLINE and member.gets_goals


def test_off_to_silent_by_enable_of_one_that_is_absent(way):
    member = made(way)
    member.connected(False)
    member.awaited()
    assert member.state is MemberState.SILENT and member.fault == "no answer"
    member.answered()
    member.back(3.0)
    run(member, 3.0)
    assert member.state is MemberState.REJOINING and member.identified


def test_returning_to_silent_and_again(member):
    silent(member)
    member.back(1.0)
    silent(member, 1.1)
    assert member.state is MemberState.SILENT and member.job is None


def test_returning_goes_on_after_a_silence_of_its_own(member, way):
    silent(member)
    member.back(1.0)
    way.failure = Silent("no answer")
    run(member, 1.0)
    assert member.state is MemberState.RETURNING
    way.failure = None
    run(member, 1.0 + rules.RETRY_S - 0.01)
    assert member.state is MemberState.RETURNING
    run(member, 1.0 + rules.RETRY_S)
    assert member.state is MemberState.REJOINING


def test_returning_to_given_up_when_it_refuses_again_and_again(member, way):
    way.failure = ServoError("is another model")
    silent(member)
    member.back(0.0)
    now_s = 0.0
    for _ in range(rules.ATTEMPTS + 1):
        run(member, now_s)
        now_s += rules.REFUSED_S
    assert member.state is MemberState.GIVEN_UP and member.fault == "left alone" and member.to_release


@pytest.mark.parametrize("before", [state for state in MemberState if state is not MemberState.OFF])
def test_every_state_but_off_to_released_and_back_by_enable(member, before):
    member.state = before
    member.released()
    assert member.state is MemberState.RELEASED and not member.gets_goals
    assert member.to_release and member.job is None and not member.waits
    member.take_torque(False, 1.0)
    assert not member.to_release and member.fault is None
    fails(member)
    assert member.state is MemberState.RELEASED  # whatever it says of itself
    member.gone()
    assert member.to_release  # who knows what it does now
    member.enabled()
    assert member.state is MemberState.ONLINE


@pytest.mark.parametrize("before", list(MemberState))
def test_called_back_it_returns_from_every_state_in_which_it_neither_goes_on_nor_comes(member, way, before):
    fails(member)  # a fault that is there before and after: it is not acted upon again
    member.state, mine = before, member._named
    member.called_back(1.0)
    if before in (MemberState.OFF, MemberState.FAULTY, MemberState.LIMP, MemberState.GIVEN_UP, MemberState.RELEASED):
        assert member.state is MemberState.RETURNING and member.recalled
        run(member, 1.0)
        assert member.state is MemberState.REJOINING and member.recalled and member.fault == "overload" and mine
        assert member.accepts(STANDS)
        fails(member, 1.1)
        assert member.state is MemberState.ONLINE
    else:
        assert member.state is before and way.asked == []


def test_called_back_while_it_is_silent_it_comes_when_it_answers(member):
    silent(member)
    member.released()
    member.called_back(1.0)
    assert member.state is MemberState.SILENT and member.fault == "no answer"
    member.answered()
    member.back(2.0)
    run(member, 2.0)
    assert member.state is MemberState.REJOINING and not member.recalled


def test_off_stays_off_when_it_is_released(member):
    member.stopped()
    member.released()
    assert member.state is MemberState.OFF


def test_given_up_to_online_by_enable(member, way):
    test_returning_to_given_up_when_it_refuses_again_and_again(member, way)
    member.enabled()
    assert member.state is MemberState.ONLINE and member.fault is None


@pytest.mark.parametrize(
    ("policy", "state"),
    [
        ("limp", MemberState.LIMP),
        ("hold", MemberState.FAULTY),
        ("reduce", MemberState.REDUCED),
        ("reboot_and_ease_in", MemberState.REBOOTING),
    ],
)
def test_online_by_a_fault_to_what_the_head_says(way, policy, state):
    member = made(way, on_fault=policy)
    fails(member)
    assert member.state is state and member.fault == "overload"
    assert member.gets_goals is (state is MemberState.REDUCED)
    fails(member)
    assert member.state is state  # once


def test_online_by_a_fault_to_limp_for_a_while_where_there_is_no_reboot(way):
    way.can_reboot = False
    member = made(way, on_fault="reboot_and_ease_in")
    fails(member)
    assert member.state is MemberState.LIMP
    member.take_torque(False, 0.1)
    run(member, rules.LIMP_S)
    assert member.state is MemberState.REJOINING


def test_rebooting_to_rejoining_and_silence_meanwhile_is_no_absence(way):
    member = made(way, on_fault="reboot_and_ease_in")
    fails(member)
    assert way.asked == [] or way.asked == [True]
    run(member, 0.0)
    silent(member, 0.1)
    assert member.state is MemberState.REBOOTING
    run(member, 0.5)
    assert member.state is MemberState.REJOINING and way.asked == [True]


@pytest.mark.parametrize(
    ("then", "state"), [("limp", MemberState.LIMP), ("hold", MemberState.FAULTY), ("reduce", MemberState.REDUCED)]
)
def test_online_by_a_load_rule(way, then, state):
    member = made(way, pinch=LoadRule(current_mA=100, for_s=0.1, then=then))
    member.take_current(150, 0.0)
    member.take_current(150, 0.1)
    assert member.state is state and member.fault == "pinched"


def test_a_joint_that_holds_does_not_get_goals_by_a_fault_that_reduces_others(way):
    member = made(way, on_fault="reduce", pinch=LoadRule(current_mA=100, for_s=0.1, then="hold"))
    member.take_current(150, 0.0)
    member.take_current(150, 0.1)
    fails(member)
    assert member.state is MemberState.FAULTY and not member.gets_goals and member.fault == "overload"


def test_limp_stays_to_be_released_until_the_servo_says_so(way):
    member = made(way, on_fault="limp")
    fails(member)
    assert member.to_release
    member.take_torque(True, 0.0)  # as it was before anything was written
    assert member.fault == "overload"
    member.off_written = True
    member.take_torque(True, 0.1)
    assert member.to_release
    member.take_torque(False, 0.2)
    assert not member.to_release


def test_limp_to_returning_after_its_time_and_not_before_it_is_seen_limp(way):
    member = made(way, pinch=LoadRule(current_mA=100, for_s=0.1, then="limp"))
    member.take_current(150, 0.0)
    member.take_current(150, 0.1)
    run(member, 0.1 + rules.LIMP_S)
    assert member.state is MemberState.LIMP
    member.take_torque(False, 4.0)
    run(member, 4.0)
    assert member.state is MemberState.REJOINING


def test_limp_that_falls_silent_is_to_be_released_again(way):
    member = made(way, on_fault="limp")
    fails(member)
    member.take_torque(False, 0.1)
    silent(member, 1.0)
    assert member.state is MemberState.LIMP and member.to_release


def test_online_to_returning_when_its_torque_is_gone(member):
    member.take_torque(False, 0.0)
    assert member.state is MemberState.RETURNING and member.fault == "torque lost"


def test_faulty_to_limp_when_its_own_protection_took_the_torque(way):
    member = made(way, on_fault="hold")
    fails(member)
    member.take_torque(False, 0.1)
    assert member.state is MemberState.LIMP and member.fault == "overload"


def test_rejoining_to_silent(member):
    silent(member)
    member.back(0.0)
    run(member, 0.0)
    silent(member, 1.0)
    assert member.state is MemberState.SILENT


def test_online_to_returning_when_it_is_distrusted(member):
    member.distrust("watchdog", 0.0)
    assert member.state is MemberState.RETURNING and member.fault == "watchdog"
    run(member, 0.0)
    assert member.state is MemberState.REJOINING and member.fault is None


@pytest.mark.parametrize("state", list(MemberState))
def test_from_any_state_to_off_by_stop(member, state):
    member.state = state
    member.stopped()
    assert member.state is MemberState.OFF and member.job is None and not member.to_release


def test_port_that_is_gone_makes_all_silent_but_those_that_are_out(way):
    limp, held, online = made(way, on_fault="limp"), made(way, on_fault="hold"), made(way)
    for each in (limp, held):
        fails(each)
    for each in (limp, held, online):
        each.gone()
    assert [each.state for each in (limp, held, online)] == [MemberState.LIMP, MemberState.FAULTY, MemberState.SILENT]


def test_registers_that_differ_are_a_fault_until_they_do_not(member):
    member.take_registers({"operating_mode": (1, 3)})
    assert member.fault == "operating_mode reads 1, set to 3" and member.gets_goals
    member.take_registers({})
    assert member.fault is None


def test_loose_contact_is_said_once_in_ten_seconds_with_a_count(member, caplog):
    for tick in range(200):
        member.suspect(tick * 0.1)
        member.answered()
        member.back(tick * 0.1)
    said = [record.getMessage() for record in caplog.records]
    assert said == [
        "jaw (id 4) is silent",
        "jaw (id 4) answers again",
        "jaw (id 4) is silent (99 times since the last message)",
        "jaw (id 4) answers again",
    ]


def test_probes_of_a_dead_servo_become_rare_and_never_stop(member):
    member.suspect(0.0)
    probes = []
    for k in range(2000):
        if member.probe_s <= 0.01 * k:
            probes.append(0.01 * k)
            member.probe_failed(0.01 * k)
    gaps = [b - a for a, b in zip(probes, probes[1:], strict=False)]
    assert 15 < len(probes) < 30
    assert gaps[0] < 0.2 and gaps[-1] == pytest.approx(LONGEST_PAUSE_S, abs=0.02)
