"""One servo's states: the arrows of the diagram in docs/safety.md. Without a wire, times are given."""

import logging
from typing import get_args

import pytest
from emulated_port import bus_servo

from sfms_robot.config import Faults, LoadRule, Safety, load_firmware_map
from sfms_robot.errors import ServoError
from sfms_robot.servo.chain import member as rules
from sfms_robot.servo.chain.member import LONGEST_PAUSE_S, Member, MemberState, Notices
from sfms_robot.servo.chain.startup import Silent

OVERLOAD, STANDS = 1 << 5, 2100
STATES = get_args(MemberState)
OFF, ONLINE, REDUCED, FAULTY, LIMP, SILENT, RETURNING, REBOOTING, REJOINING, GIVEN_UP, RELEASED = STATES


class Way:
    """How a servo starts up again: ends with where it stands, or as `failure` says."""

    def __init__(self, can_reboot=True, **safety):
        self.servo = bus_servo("jaw", 4, load_firmware_map("xl330-m288"), safety=Safety(**safety))
        self.table = self.servo.table
        self.can_reboot = can_reboot
        self.failure = None
        self.asked = []

    def bring_back(self, reboot):
        self.asked.append(reboot)
        yield 0.5 if reboot else 0.0
        if self.failure is not None:
            raise self.failure
        return STANDS


def made(notices=None, **how):
    """An enabled servo."""
    member = Member(0, Way(**how), Faults(), {}, notices or Notices("main", 1))
    member.connected(True)
    member.enabled()
    return member


@pytest.fixture
def member():
    return made()


def run(member, now_s):
    """All steps of its job that are due; the time is the caller's."""
    while member.due(now_s):
        member.step(now_s)


def silent(member, now_s=0.0):
    member.suspect(now_s)
    member.probe_failed(now_s)


def fails(member, now_s=0.0):
    member.take_bits(OVERLOAD, {}, now_s)


def overloads(member, now_s=0.0):
    """A current above the load rule, for long enough."""
    member.take_current(150, now_s)
    member.take_current(-150, now_s + 0.1)


def refuses(member, failure=None):
    member.startup.failure = failure


def mute_again(member):
    """Fall silent once more while it comes back at 1 s."""
    silent(member)
    member.back(1.0)
    refuses(member, Silent("no answer"))
    run(member, 1.0)
    refuses(member)


def refused_often(member):
    refuses(member, ServoError("is another model"))
    member.back(0.0)
    for k in range(rules.ATTEMPTS + 1):
        run(member, k * rules.REFUSED_S)


EVENTS = {each.__name__: each for each in (run, silent, fails, overloads, mute_again, refused_often)}
AGAIN_S = 1.0 + rules.RETRY_S


def pinch(then, **more):
    return {"pinch": LoadRule(current_mA=100, for_s=0.1, then=then), **more}


ARROWS = [  # how its head is set, what happens, where it is then, the fault it reports
    ({}, [], ONLINE, None),
    ({}, [("suspect", 0.0)], ONLINE, None),  # until a probe is in vain
    ({}, [("suspect", 0.0), ("probe_failed", 0.05)], SILENT, "no answer"),
    ({}, [("connected", False), ("awaited",)], SILENT, "no answer"),
    ({}, [("connected", False), ("awaited",), ("answered",), ("back", 3.0), ("run", 3.0)], REJOINING, None),
    ({}, [("silent",), ("answered",), ("back", 1.0)], RETURNING, "no answer"),
    ({}, [("silent",), ("back", 1.0), ("run", 1.0)], REJOINING, None),
    ({}, [("silent",), ("back", 1.0), ("run", 1.0), ("silent", 2.0)], SILENT, "no answer"),
    ({}, [("silent",), ("back", 1.0), ("silent", 1.1)], SILENT, "no answer"),
    ({}, [("mute_again",), ("run", AGAIN_S - 0.01)], RETURNING, "no answer"),
    ({}, [("mute_again",), ("run", AGAIN_S)], REJOINING, None),
    ({}, [("silent",), ("refused_often",)], GIVEN_UP, "left alone"),
    ({}, [("silent",), ("refused_often",), ("enabled",)], ONLINE, None),
    ({}, [("silent",), ("released",), ("called_back", 1.0)], SILENT, "no answer"),
    ({}, [("stopped",), ("released",)], OFF, None),
    ({"on_fault": "limp"}, [("fails",), ("fails",)], LIMP, "overload"),
    ({"on_fault": "hold"}, [("fails",), ("fails",)], FAULTY, "overload"),
    ({"on_fault": "reduce"}, [("fails",), ("fails",)], REDUCED, "overload"),
    ({"on_fault": "reduce"}, [("distrust", 0.0), ("run", 0.0), ("fails",)], REJOINING, "overload"),
    ({"on_fault": "reduce"}, [("distrust", 0.0), ("run", 0.0), ("fails",), ("accepts", STANDS)], REDUCED, "overload"),
    ({"on_fault": "reboot_and_ease_in"}, [("fails",), ("fails",)], REBOOTING, "overload"),
    ({"on_fault": "reboot_and_ease_in"}, [("fails",), ("run", 0.0), ("silent", 0.1)], REBOOTING, "overload"),
    ({"on_fault": "reboot_and_ease_in"}, [("fails",), ("run", 0.0), ("silent", 0.1), ("run", 0.5)], REJOINING, None),
    ({"on_fault": "reboot_and_ease_in", "can_reboot": False}, [("fails",)], LIMP, "overload"),
    (
        {"on_fault": "reboot_and_ease_in", "can_reboot": False},
        [("fails",), ("take_torque", False, 0.1), ("run", rules.LIMP_S)],
        REJOINING,
        None,
    ),
    (pinch("limp"), [("overloads",)], LIMP, "pinched"),
    (pinch("hold"), [("overloads",)], FAULTY, "pinched"),
    (pinch("reduce"), [("overloads",)], REDUCED, "pinched"),
    (pinch("hold", on_fault="reduce"), [("overloads",), ("fails",)], FAULTY, "overload"),
    (pinch("limp"), [("overloads",), ("run", 0.1 + rules.LIMP_S)], LIMP, "pinched"),  # not yet seen limp
    (pinch("limp"), [("overloads",), ("take_torque", False, 4.0), ("run", 4.0)], REJOINING, None),
    (pinch("limp"), [("overloads",), ("silent", 1.0), ("take_torque", False, 4.0), ("run", 4.0)], REJOINING, None),
    ({}, [("take_torque", False, 0.0)], RETURNING, "torque lost"),
    ({"on_fault": "hold"}, [("fails",), ("take_torque", False, 0.1)], LIMP, "overload"),  # its own protection
    ({}, [("distrust", 0.0)], RETURNING, "watchdog"),
    ({}, [("distrust", 0.0), ("run", 0.0)], REJOINING, None),
    ({}, [("gone",)], SILENT, "no answer"),  # the port
    ({"on_fault": "limp"}, [("fails",), ("gone",)], LIMP, "overload"),
    ({"on_fault": "hold"}, [("fails",), ("gone",)], FAULTY, "overload"),
    ({}, [("take_registers", {"operating_mode": (1, 3)})], ONLINE, "operating_mode reads 1, set to 3"),
    ({}, [("take_registers", {"operating_mode": (1, 3)}), ("take_registers", {})], ONLINE, None),
]


@pytest.mark.parametrize(("how", "events", "state", "fault"), ARROWS)
def test_events_lead_to_the_state_of_the_diagram(how, events, state, fault):
    member = made(**how)
    for name, *arguments in events:
        if name in EVENTS:
            EVENTS[name](member, *arguments)
        else:
            getattr(member, name)(*arguments)
    assert (member.state, member.fault) == (state, fault) and member.gets_goals is (state in (ONLINE, REDUCED))
    assert (member.job is not None) is (state in (RETURNING, REBOOTING))


def test_one_lost_answer_is_forgiven_and_the_second_is_not(member):
    for now_s, answers in ((0.0, True), (0.1, False), (0.2, True)):
        member.unanswered(now_s)
        assert member.listed is (now_s < 0.2)
        if answers:
            member.answered()


def test_rejoining_to_online_by_a_goal_near_to_where_it_stands(member):
    silent(member)
    member.back(1.0)
    run(member, 1.0)
    assert member.state == REJOINING and not member.accepts(STANDS + 50) and not member.gets_goals
    assert member.accepts(STANDS + 5) and member.state == ONLINE and member.gets_goals


def test_pinch_needs_current_without_a_break():
    member = made(**pinch("limp"))
    for current_mA, now_s in ((150, 0.00), (50, 0.06), (-150, 0.08)):
        member.take_current(current_mA, now_s)
        assert member.state == ONLINE
    member.take_current(-150, 0.19)
    assert (member.state, member.fault) == (LIMP, "pinched")


@pytest.mark.parametrize("before", [state for state in STATES if state != OFF])
def test_every_state_but_off_to_released_and_back_by_enable(member, before):
    member.state = before
    member.released()
    assert member.state == RELEASED and not member.gets_goals
    assert member.to_release and member.job is None and not member.waits
    member.take_torque(False, 1.0)
    assert not member.to_release and member.fault is None
    fails(member)
    assert member.state == RELEASED  # whatever it says of itself
    member.gone()
    assert member.to_release  # who knows what it does now
    member.enabled()
    assert member.state == ONLINE


@pytest.mark.parametrize("before", STATES)
def test_called_back_it_returns_from_every_state_in_which_it_neither_goes_on_nor_comes(member, before):
    fails(member)  # a fault that is there before and after: it is not acted upon again
    member.state, mine = before, member._named
    member.called_back(1.0)
    if before in (OFF, FAULTY, LIMP, GIVEN_UP, RELEASED):
        assert member.state == RETURNING and member.recalled
        run(member, 1.0)
        assert member.state == REJOINING and member.recalled and member.fault == "overload" and mine
        assert member.accepts(STANDS)
        fails(member, 1.1)
        assert member.state == ONLINE
    else:
        assert member.state == before and member.startup.asked == []


@pytest.mark.parametrize("state", STATES)
def test_from_any_state_to_off_by_stop(member, state):
    member.state = state
    member.stopped()
    assert member.state == OFF and member.job is None and not member.to_release


def test_limp_is_to_be_released_until_the_servo_says_so_and_again_after_a_silence():
    member = made(on_fault="limp")
    fails(member)
    member.take_torque(True, 0.0)  # as it was before anything was written
    assert member.to_release and member.fault == "overload"
    member.off_written = True
    member.take_torque(True, 0.1)
    assert member.to_release
    member.take_torque(False, 0.2)
    assert not member.to_release
    silent(member, 1.0)
    assert member.state == LIMP and member.to_release


def test_loose_contact_is_said_once_in_ten_seconds_with_a_count(caplog):
    caplog.set_level(logging.INFO)
    notices = Notices("main", 1)
    member = made(notices=notices)
    for tick in range(200):
        member.suspect(tick * 0.1)
        member.answered()
        member.back(tick * 0.1)
        notices.log(tick * 0.1)
    said = [(record.levelname, record.getMessage()) for record in caplog.records]
    first, again = "jaw (id 4): silent", ("INFO", "jaw (id 4): answers again")
    assert said == [("WARNING", first), again, ("WARNING", f"{first} (99 times since the last message)"), again]


def test_servos_with_one_message_at_one_time_share_a_line(caplog):
    notices = Notices("main", 3)
    servos = [bus_servo(name, number, load_firmware_map("xl330-m288")) for number, name in enumerate("abc", 1)]
    for at_s, servo in ((1.0, servos[0]), (1.1, servos[1])):
        notices.add(servo, "silent", times=servo.id)
        notices.log(at_s)
    assert not caplog.messages
    notices.log(1.3)
    for servo in servos:
        notices.add(servo, "silent")
    notices.log()
    notices.log()
    assert caplog.messages == [
        "a (id 1), b (id 2): silent (up to 2 times since the last message)",
        "bus 'main': all 3 servos: silent",
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
