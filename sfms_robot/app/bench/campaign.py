"""Every kind of trouble on every family of servos, in virtual time: what the bus lets through, and what comes back.

One run: four emulated servos follow a slow wave under the limiter, as in the loop. Either a fault of the emulator sets
in after a while, and when it has passed they get time to come back; or the servos are not as the head's file says from
the start, or half of them are lost for good. Judged from outside, by what the emulated servos hold and where they are:

    escaped       an exception left the bus that should not have
    outside       goals outside the limits of a joint that a servo held, and bad goals that were not refused
    stale         readings that tell another position than the servo had at the time they name
    recovered_s   from the end of the fault until every joint is read, has torque and follows its goal, for good
    named         joints that stay out, with their fault named: protection that is latched, or a servo left alone
    refused       what the bus said at the start, of servos that contradict the head's file
    off_s, stop_s until the torque was off, and until `stop` returned, where nobody answers
    left_on       servos that had torque when all was over

A run is the same every time: time is virtual, and the dice are seeded.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

import numpy as np

from sfms_robot.app.bench.campaign_rig import FAMILIES, LIMIT_DEG, RATE_HZ, RECOVERY_S, Judge, Rig, head_of, plugged_in
from sfms_robot.app.bench.measure import Told
from sfms_robot.app.wiring import emulated
from sfms_robot.config import Head, load_firmware_map
from sfms_robot.emulator.faults import KINDS
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import BusError, ServoError
from sfms_robot.servo.port import Port, WrappedPort

TICKS: Final = 1000
_QUIET, _FAULTY = 0.1, 0.5  # fraction of the ticks before the fault, and with it
_BAD_GOALS_EVERY: Final = 50
_OFF_S, _STOP_S = 0.02, 0.5  # the longest that torque-off and `stop` may take
_FAILS_AFTER_S: Final = 1.0  # a bus on which nobody answers; a board is given five times that
_SAID_BY_S: Final = 7.0  # a board that fails is said
_OUTSIDE_DEG: Final = 8.0

# Kind -> ids (all of the wire where there are none) and value.
SPECS: Final[Mapping[str, str]] = {
    "drop": "drop{two}{when}=0.3",
    "delay": "delay{two}{when}=0.03",
    "corrupt": "corrupt{two}{when}=0.3",
    "duplicate": "duplicate{two}{when}=0.5",
    "truncate": "truncate{two}{when}=0.3",
    "echo": "echo{when}",
    "noise": "noise{when}=0.5",
    "silent": "silent{one}{when}",
    "mute": "mute{one}{when}",
    "stuck": "stuck{one}{when}",
    "overload": "overload{one}{when}",
    "overheat": "overheat{one}{when}",
    "load": "load{two}{when}=0.1",
    "voltage": "voltage{when}=20",
    "brownout": "brownout{when}",
    "hangup": "hangup{when}",
}
STORED, MANY_TURNS, OUTSIDE = "stored limits", "many turns", "found outside"
HALF_DEAD, MUTE_AT_STOP = "one bus of two dead", "mute at stop"
STARTS: Final = (STORED, MANY_TURNS, OUTSIDE)
CASES: Final = (*KINDS, *STARTS, HALF_DEAD, MUTE_AT_STOP)
CONTRADICTS: Final = frozenset({STORED, MANY_TURNS})  # a servo may be refused for it at the start
LATCHED: Final = frozenset({"overload", "overheat", "voltage", "stuck"})  # a servo's protection holds on to these
LIMP_S: Final = {"stuck": 3.0}  # a joint that was pinched stays limp so long before it comes back


@dataclass(frozen=True)
class Outcome:
    """What came of one case on one family; see the head of this file. `possible`: this family can have that case."""

    family: str
    case: str
    ticks: int
    possible: bool = True
    escaped: str | None = None
    outside: int = 0
    stale: int = 0
    recovered_s: float | None = None
    named: Sequence[str] = ()
    refused: str | None = None
    off_s: float | None = None
    stop_s: float | None = None
    left_on: int = 0

    @property
    def as_stated(self) -> bool:
        """Whether every joint came back in time, or stays out for a reason that is stated."""
        if self.case == MUTE_AT_STOP:
            return (self.off_s or 0.0) <= _OFF_S and (self.stop_s or 0.0) <= _STOP_S and self.off_s is not None
        if self.refused is not None:
            return self.case in CONTRADICTS
        reasons = all("left alone" in each or self.case in LATCHED for each in self.named)
        within_s = RECOVERY_S + LIMP_S.get(self.case, 0.0)
        return self.recovered_s is not None and self.recovered_s <= within_s and reasons

    @property
    def passed(self) -> bool:
        harmless = self.escaped is None and not self.outside and not self.stale and not self.left_on
        return not self.possible or (harmless and self.as_stated)


@dataclass
class SilencePort(WrappedPort):
    """A port on which silence costs time; what is written arrives at once, and is said."""

    baud: int
    arrived: Callable[[], None] = field(default=lambda: None)

    def write(self, data: bytes) -> None:
        self.inner.write(data)
        self.inner.set_baud(self.baud)  # hands over what was written
        self.arrived()

    def read(self, n: int, deadline_s: float) -> bytes:
        data = self.inner.read(n, deadline_s)
        if not data:
            self.inner.wait_until(deadline_s)
        return data


def one(family: str, case: str, ticks: int = TICKS) -> Outcome:
    """`ticks` of one family in one case."""
    if case == MUTE_AT_STOP:
        return _mute_at_stop(family)
    if case == HALF_DEAD:
        return _half_dead(family, ticks)
    head = head_of(family)
    servos = _found(head, case) if case in STARTS else emulated(head)["main"]
    if servos is None:
        return Outcome(family, case, 0, possible=False)
    with plugged_in(head, {"main": servos}) as rig:
        try:
            rig.hold()
        except ServoError as error:
            return _at_the_end(rig, Outcome(family, case, 0, refused=str(error)))
        start_s = rig.clock.now_s() + _QUIET * ticks / RATE_HZ
        end_s = start_s + _FAULTY * ticks / RATE_HZ
        if case in KINDS and not _injected(rig, _spec(case, rig.ids, start_s, end_s)):
            return Outcome(family, case, 0, possible=False)
        return _at_the_end(rig, _ride(rig, Outcome(family, case, ticks), end_s if case in KINDS else start_s))


def _injected(rig: Rig, spec: str) -> bool:
    """Whether the servos of this family can have that fault."""
    try:
        rig.chains["main"].inject(spec)
    except BusError as error:
        if "concerns no servo" not in str(error):
            raise
        return False
    return True


def _found(head: Head, case: str) -> list[EmulatedServo] | None:
    """The head's servos, two of them not as its file says; None where this family cannot be found like that."""
    servos = list(emulated(head)["main"])
    table = load_firmware_map(servos[0].model)
    turn = round(table.ticks_per_revolution)
    changes: list[dict[str, Any]]
    if case == OUTSIDE:
        beyond = round((LIMIT_DEG + _OUTSIDE_DEG) / 360.0 * table.ticks_per_revolution)
        changes = [{"start_ticks": table.center_ticks + sign * beyond} for sign in (1, -1)]
    elif case == STORED:
        names = [name for name in table.registers if name.endswith(("position_limit", "angle_limit"))]
        if not names:
            return None
        sides = {"min": -1, "cw_": -1, "max": 1, "ccw": 1}
        narrow = {name: table.center_ticks + sides[name[:3]] * turn // 20 for name in names}
        changes = [{"registers": narrow}] * 2
    else:
        if not table.registers or table.ticks_per_revolution != turn:
            return None  # a board, or a potentiometer, which knows one turn only
        registers = {}
        if "multi_turn_offset" in table.registers:
            registers = {"cw_angle_limit": 4095, "ccw_angle_limit": 4095}
        elif "phase" in table.registers:
            registers = {"phase": 28}
        changes = [{"start_ticks": table.center_ticks + sign * turn + 54, "registers": registers} for sign in (1, -1)]
    return [servos[0], *(replace(s, **change) for s, change in zip(servos[1:3], changes, strict=True)), servos[3]]


def _ride(rig: Rig, outcome: Outcome, end_s: float) -> Outcome:
    """Its ticks, judged; what is wrong is over at `end_s`."""
    judge, accepted, ticks = Judge(rig), 0, outcome.ticks
    for tick in range(ticks):
        try:
            readings = rig.tick()
            judge.see(readings)
            if tick % _BAD_GOALS_EVERY == 0:
                accepted += rig.refuses(readings[rig.bus.joints[-1]])
        except Exception as error:  # what escapes is what is looked for
            escaped = f"{type(error).__name__}: {error}"
            return replace(outcome, ticks=tick, escaped=escaped, outside=judge.outside + accepted, stale=judge.stale)
    return _judged(replace(outcome, outside=accepted), judge, end_s)


def _judged(outcome: Outcome, judge: Judge, end_s: float) -> Outcome:
    recovered_s, outside = judge.recovered_s(end_s), outcome.outside + judge.outside
    return replace(outcome, outside=outside, stale=judge.stale, recovered_s=recovered_s, named=judge.named)


def _at_the_end(rig: Rig, outcome: Outcome) -> Outcome:
    """Torque off; who has it all the same?"""
    rig.bus.stop("release")
    rig.bus.close()
    return replace(outcome, left_on=sum(bool(state["torque"]) for state in rig.states()))


def _half_dead(family: str, ticks: int) -> Outcome:
    """Two buses; after a while nobody answers on one of them any more, which is said once; the other goes on."""
    head = head_of(family, _FAILS_AFTER_S)
    outcome, said = Outcome(family, HALF_DEAD, ticks), 0
    with plugged_in(head) as rig:
        rig.hold()
        judge, dead_s = Judge(rig), rig.clock.now_s() + _QUIET * ticks / RATE_HZ
        rig.chains["other"].inject(f"silent@{dead_s:g}")
        for tick in range(ticks):
            if rig.clock.now_s() >= dead_s:
                judge.away = frozenset({2, 3})
            try:
                judge.see(rig.tick())
            except Exception as error:  # one BusError is the news that a bus has failed
                said += 1
                if said > 1 or not isinstance(error, BusError):
                    outcome = replace(outcome, ticks=tick, escaped=f"{type(error).__name__}: {error}")
                    break
        if not said and rig.clock.now_s() > dead_s + _SAID_BY_S:
            outcome = replace(outcome, escaped="nothing: nobody said that a bus has failed")
        rig.chains["other"].clear_faults()  # plugged in again: torque off has to reach it
        return _at_the_end(rig, _judged(outcome, judge, dead_s))


def _mute_at_stop(family: str) -> Outcome:
    """Everybody hears and nobody answers when `stop` is called, and silence costs time."""
    head, ports = head_of(family), list[SilencePort]()

    def wrapped(port: Port) -> Port:
        ports.append(SilencePort(port, head.buses["main"].baud))
        return ports[-1]

    with plugged_in(head, wrap=wrapped) as rig:
        rig.hold()
        for _ in range(round(_QUIET * TICKS)):
            rig.tick()
        rig.chains["main"].inject("mute")
        start_s, off_s = rig.clock.now_s(), np.inf

        def arrived() -> None:
            nonlocal off_s
            if not any(state["torque"] for state in rig.states()):
                off_s = min(off_s, rig.clock.now_s() - start_s)

        ports[-1].arrived = arrived
        rig.bus.stop("release")
        stop_s = rig.clock.now_s() - start_s
        ports[-1].arrived = lambda: None
        return _at_the_end(rig, Outcome(family, MUTE_AT_STOP, 0, off_s=float(off_s), stop_s=stop_s))


def _spec(fault: str, ids: Sequence[int], start_s: float, end_s: float) -> str:
    when = f"@{start_s:g}-{end_s:g}"
    return SPECS[fault].format(one=f":{ids[1]}", two=f":{ids[1]},{ids[2]}", when=when)


def run_campaign(
    families: Iterable[str] = tuple(FAMILIES),
    cases: Iterable[str] = CASES,
    ticks: int = TICKS,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Outcome]:
    """Every case on every family."""
    cases = list(cases)
    out = []
    for family in families:
        for case in cases:
            progress(f"{family}: {case}")
            out.append(one(family, case, ticks))
    return out


def measure(say: Callable[[str], None]) -> Told:
    """`run_campaign`, as `bench` tells it."""
    logging.getLogger("sfms_robot").setLevel(logging.CRITICAL)  # thousands of faults are said elsewhere
    outcomes = run_campaign(progress=say)
    plain = [asdict(each) | {"passed": each.passed} for each in outcomes]
    passed = all(each.passed for each in outcomes)
    return Told({"passed": passed, "runs": plain}, table(outcomes), passed=passed)


def table(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row per run, as printed."""
    return [
        {
            "family": each.family,
            "case": each.case,
            "escaped": each.escaped or 0,
            "outside": each.outside,
            "stale": each.stale,
            "back s": None if each.recovered_s is None else round(each.recovered_s, 2),
            "out": len(each.named) + (each.refused is not None),
            "off s": None if each.off_s is None else round(each.off_s, 3),
            "stop s": None if each.stop_s is None else round(each.stop_s, 3),
            "left on": each.left_on,
            "passed": ("yes" if each.passed else "NO") if each.possible else "-",
        }
        for each in outcomes
    ]
