"""`bench campaign`: every fault on every family of servos, in virtual time.

In one run four emulated servos follow a slow wave through the limiter, as in the loop. Either a fault of the emulator
begins after a while, and after its end the servos get time to recover; or the servos differ from the head's file from
the start; or half of them are lost for good. A run is judged by the servos' own goals and positions, without the bus:

    escaped       an exception that the bus should have caught, or a bad goal that was accepted
    outside       goals outside the limits of a joint, counted for servos with torque
    pulse_us      the shortest and longest pulse of a board
    stale         readings whose position differs from the servo's position at the time of the reading
    recovered_s   time from the end of the fault until every joint is read, has torque and follows its goal, for good
    named         joints that stay disabled, with their fault: latched protection, or a servo that the bus gave up
    refused       the error at the start, if servos contradict the head's file
    off_s, stop_s time until torque was off, and until `stop` returned, when no servo answers
    left_on       servos with torque after the run

The effect of a corrupted byte from the host is stated per family (`corrupted_bytes`). On a board without a checksum
goals outside the limits are an expected effect, not a failure. Virtual time and seeded random numbers make every run
repeatable.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Final

import numpy as np

from sfms_robot.app.wiring import emulated
from sfms_robot.config import load_firmware_map
from sfms_robot.emulator.faults import KINDS
from sfms_robot.emulator.launch import EmulatedServo
from sfms_robot.errors import BusError, ServoError
from sfms_robot.lab import Figures
from sfms_robot.lab.bench.campaign_rig import (
    FAMILIES,
    LIMIT_DEG,
    RATE_HZ,
    RECOVERY_S,
    Judge,
    Rig,
    head_of,
    plugged_in,
)
from sfms_robot.lab.bench.measure import BenchResult, Say
from sfms_robot.servo.port import WrappedPort

_TICKS: Final = 1000
_QUIET, _FAULTY = 0.1, 0.5  # fraction of the ticks before the fault, and during it
_BAD_GOALS_EVERY: Final = 50
_OFF_S, _STOP_S = 0.02, 0.5  # longest allowed time until torque is off, and until `stop` returns
_FAILS_AFTER_S: Final = 1.0  # time without any answer after which a bus fails; for a board five times as long
_REPORTED_BY_S: Final = 7.0  # longest time until the failure of a board is reported
_OUTSIDE_DEG: Final = 8.0

# A fault of each kind: the kind, then ids (all servos of the wire if there are none), time and value.
SPECS: Final = {
    spec.partition("{")[0]: spec
    for spec in (
        "drop{two}{when}=0.3",
        "delay{two}{when}=0.03",
        "corrupt{two}{when}=0.3",
        "duplicate{two}{when}=0.5",
        "truncate{two}{when}=0.3",
        "echo{when}",
        "noise{when}=0.5",
        "request-drop{when}=0.3",
        "request-corrupt{when}=0.3",
        "request-delay{when}=0.03",
        "silent{one}{when}",
        "mute{one}{when}",
        "stuck{one}{when}",
        "overload{one}{when}",
        "overheat{one}{when}",
        "load{two}{when}=0.1",
        "voltage{when}=20",
        "brownout{when}",
        "hangup{when}",
    )
}
CORRUPT: Final = "request-corrupt"
STORED, MANY_TURNS, OUTSIDE = "stored limits", "many turns", "found outside"
HALF_DEAD, MUTE_AT_STOP = "one bus of two dead", "mute at stop"
STARTS: Final = (STORED, MANY_TURNS, OUTSIDE)
CASES: Final = (*KINDS, *STARTS, HALF_DEAD, MUTE_AT_STOP)
CONTRADICTS: Final = frozenset({STORED, MANY_TURNS})  # the bus may refuse such a servo at the start
LATCHED: Final = frozenset({"overload", "overheat", "voltage", "stuck"})  # a servo's protection latches these
LIMP_S: Final = {"stuck": 3.0}  # time for which a pinched joint stays limp before it recovers


@dataclass(frozen=True, kw_only=True)
class CaseOutcome:
    """The outcome of one case on one family (see the top of this file). `possible`: the family can have this case."""

    family: str
    case: str
    ticks: int = 0
    possible: bool = True
    escaped: str | None = None
    outside: int = 0
    pulse_us: Sequence[float] = ()
    stale: int = 0
    recovered_s: float | None = None
    named: Sequence[str] = ()
    refused: str | None = None
    off_s: float | None = None
    stop_s: float | None = None
    left_on: int = 0

    @property
    def as_stated(self) -> bool:
        """Return whether every joint recovered in time, or stays disabled for a stated reason."""
        if self.case == MUTE_AT_STOP:
            return (self.off_s or 0.0) <= _OFF_S and (self.stop_s or 0.0) <= _STOP_S and self.off_s is not None
        if self.refused is not None:
            return self.case in CONTRADICTS
        reasons = all("left alone" in each or self.case in LATCHED for each in self.named)
        within_s = RECOVERY_S + LIMP_S.get(self.case, 0.0)
        return self.recovered_s is not None and self.recovered_s <= within_s and reasons

    @property
    def passed(self) -> bool:
        unchecked = self.case == CORRUPT and not FAMILIES[self.family].checksum
        harmless = self.escaped is None and (unchecked or not self.outside) and not self.stale and not self.left_on
        return not self.possible or (harmless and self.as_stated)


@dataclass
class SilencePort(WrappedPort):
    """A port whose silent reads last until their deadline; written bytes arrive at once, then `arrived` is called."""

    baud: int
    arrived: Callable[[], None]

    def write(self, data: bytes) -> None:
        self.inner.write(data)
        self.inner.set_baud(self.baud)  # delivers the written bytes at once
        self.arrived()

    def read(self, n: int, deadline_s: float) -> bytes:
        data = self.inner.read(n, deadline_s)
        if not data:
            self.inner.wait_until(deadline_s)
        return data


def measure(say: Say) -> BenchResult:
    """Run the whole campaign as a bench."""
    logging.getLogger("sfms_robot").setLevel(logging.CRITICAL)  # thousands of expected faults
    outcomes = list[CaseOutcome]()
    for family, case in product(FAMILIES, CASES):
        say(f"{family}: {case}")
        outcomes.append(one(family, case))
    plain = [asdict(each) | {"passed": each.passed} for each in outcomes]
    passed, corrupted = all(each["passed"] for each in plain), corrupted_bytes(outcomes)
    lines = [f"{family}, corrupted bytes: {', '.join(said.values())}" for family, said in corrupted.items()]
    return BenchResult({"passed": passed, "runs": plain, "corrupted_bytes": corrupted}, table(outcomes), lines, passed)


def corrupted_bytes(outcomes: Sequence[CaseOutcome]) -> dict[str, dict[str, str]]:
    """Return, per family, its checksum and the effect of corrupted requests, in words."""
    return {
        each.family: {
            "checksum": FAMILIES[each.family].checksum or "no checksum",
            "goals": f"{each.outside} outside limits",
            "pulses": "{:g} to {:g} us".format(*each.pulse_us) if each.pulse_us else "no pulses",
        }
        for each in outcomes
        if each.case == CORRUPT
    }


def table(outcomes: Sequence[CaseOutcome]) -> list[Figures]:
    """Return a row per run, as printed."""

    def short(value: float | None) -> float | None:
        return None if value is None else round(value, 3)

    return [
        {
            "family": each.family,
            "case": each.case,
            "escaped": each.escaped or 0,
            "outside": each.outside,
            "stale": each.stale,
            "back s": short(each.recovered_s),
            "out": len(each.named) + (each.refused is not None),
            "off s": short(each.off_s),
            "stop s": short(each.stop_s),
            "left on": each.left_on,
            "passed": ("yes" if each.passed else "NO") if each.possible else "-",
        }
        for each in outcomes
    ]


def one(family: str, case: str, ticks: int = _TICKS) -> CaseOutcome:
    """Run one family in one case for `ticks` ticks."""
    if case == MUTE_AT_STOP:
        return _mute_at_stop(family)
    head = head_of(family, _FAILS_AFTER_S if case == HALF_DEAD else None)
    servos = emulated(head)
    if case in STARTS:
        servos["main"] = _found(servos["main"], case)
    if not servos["main"] or (case == "voltage" and load_firmware_map(servos["main"][0].model).tick_us):
        return CaseOutcome(family=family, case=case, possible=False)
    with plugged_in(head, servos) as rig:
        try:
            rig.hold()
        except ServoError as error:
            return _at_the_end(rig, CaseOutcome(family=family, case=case, refused=str(error)))
        over_s = start_s = rig.clock.now_s() + _QUIET * ticks / RATE_HZ
        if case == HALF_DEAD:
            rig.chains["other"].inject(f"silent@{start_s:g}")
        elif case in KINDS:
            over_s += _FAULTY * ticks / RATE_HZ
            names = {"one": f":{rig.ids[1]}", "two": f":{rig.ids[1]},{rig.ids[2]}"}
            rig.chains["main"].inject(SPECS[case].format(when=f"@{start_s:g}-{over_s:g}", **names))
        return _ride(rig, CaseOutcome(family=family, case=case, ticks=ticks), over_s)


def _found(servos: Sequence[EmulatedServo], case: str) -> list[EmulatedServo]:
    """Return the servos, two of which differ from the head's file; empty if the family cannot have this case."""
    table = load_firmware_map(servos[0].model)
    turn = round(table.ticks_per_revolution)
    changes: list[Figures]
    if case == OUTSIDE:
        beyond = round((LIMIT_DEG + _OUTSIDE_DEG) / 360.0 * table.ticks_per_revolution)
        changes = [{"start_ticks": table.center_ticks + sign * beyond} for sign in (1, -1)]
    elif case == STORED:
        names = [name for name in table.registers if name.endswith(("position_limit", "angle_limit"))]
        if not names:
            return []
        sides = {name: 1 if name.startswith(("max", "ccw")) else -1 for name in names}
        narrow = {name: table.center_ticks + side * turn // 20 for name, side in sides.items()}
        changes = [{"registers": narrow}] * 2
    else:
        if not table.registers or table.ticks_per_revolution != turn:
            return []  # a board, or a potentiometer, which has one turn only
        registers = {}
        if "multi_turn_offset" in table.registers:
            registers = {"cw_angle_limit": 4095, "ccw_angle_limit": 4095}
        elif "phase" in table.registers:
            registers = {"phase": 28}
        changes = [{"start_ticks": table.center_ticks + sign * turn + 54, "registers": registers} for sign in (1, -1)]
    return [servos[0], *(replace(s, **change) for s, change in zip(servos[1:3], changes, strict=True)), servos[3]]


def _ride(rig: Rig, outcome: CaseOutcome, over_s: float) -> CaseOutcome:
    """Run the ticks and judge them; at `over_s` the fault ends, or one of the two buses fails.

    A failed bus is reported once, by a BusError, and the other bus continues.
    """
    judge, reports, dies = Judge(rig), 0, outcome.case == HALF_DEAD
    for tick in range(outcome.ticks):
        if dies and rig.clock.now_s() >= over_s:
            judge.away = frozenset({2, 3})
        try:
            judge.see(rig.tick())
            if tick % _BAD_GOALS_EVERY == 0 and not dies:
                rig.try_bad_goals(bool(judge.named))
        except Exception as error:  # the campaign looks for exceptions that escape
            reports += 1
            if not dies or reports > 1 or not isinstance(error, BusError):
                outcome = replace(outcome, ticks=tick, escaped=f"{type(error).__name__}: {error}")
                break
    if dies and not reports and rig.clock.now_s() > over_s + _REPORTED_BY_S:
        outcome = replace(outcome, escaped="nothing: the failure of a bus was not reported")
    for chain in rig.chains.values():
        chain.clear_faults()  # connects dead servos again, so that torque off can reach them
    outcome = replace(
        outcome,
        outside=judge.outside,
        pulse_us=[edge(judge.pulses_us) for edge in (min, max) if judge.pulses_us],
        stale=judge.stale,
        recovered_s=judge.recovered_s(over_s),
        named=judge.named,
    )
    return _at_the_end(rig, outcome)


def _at_the_end(rig: Rig, outcome: CaseOutcome) -> CaseOutcome:
    """Switch torque off, and count the servos that still have torque."""
    rig.bus.stop("release")
    rig.bus.close()
    return replace(outcome, left_on=sum(bool(state["torque"]) for state in rig.states()))


def _mute_at_stop(family: str) -> CaseOutcome:
    """Call `stop` while all servos obey but do not answer, on a port where waiting for an answer costs time."""
    head, start_s, off_s = head_of(family), np.inf, np.inf

    def arrived() -> None:
        nonlocal off_s
        if rig.clock.now_s() >= start_s and not any(state["torque"] for state in rig.states()):
            off_s = min(off_s, rig.clock.now_s() - start_s)

    with plugged_in(head, wrap=lambda port: SilencePort(port, head.buses["main"].baud, arrived)) as rig:
        rig.hold()
        for _ in range(round(_QUIET * _TICKS)):
            rig.tick()
        rig.chains["main"].inject("mute")
        start_s = rig.clock.now_s()
        rig.bus.stop("release")
        stop_s = rig.clock.now_s() - start_s
        return _at_the_end(rig, CaseOutcome(family=family, case=MUTE_AT_STOP, off_s=float(off_s), stop_s=stop_s))
