"""One servo of a chain: its state, the reason for it, and its next request. Opens no port.

    off        no torque is wanted: before `enable`, after `stop`
    online     has torque and gets goals
    reduced    the same, with half the force: a fault or a load rule said so
    faulty     keeps its torque where it stands and gets no goals: policy "hold"
    limp       torque off is wanted; written in every poll until the servo says that it is off
    silent     does not answer; gets no goals
    returning  is started up again: identity, settings, goal := present, torque
    rebooting  the same after a reboot
    rejoining  holds where it stands, and waits for goals that begin there
    given up   failed too often: as limp, until it is enabled or called back
    released   the same because it was asked for: no fault

The diagram and a table of all arrows are in docs/safety.md. A goal is sent to members that are online or reduced and
have been seen with torque, and to no others. So a servo that was away moves only from where it stands.
Times are those of the port's clock, in seconds.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping, Sequence
from enum import Enum
from typing import Any, Final, Protocol

from sfms_robot.config import Faults
from sfms_robot.errors import ServoError
from sfms_robot.servo.chain.fault_reporter import FaultReporter, about
from sfms_robot.servo.chain.liveness import FIRST_PAUSE_S, LONGEST_PAUSE_S, Liveness
from sfms_robot.servo.chain.startup import Silent, Steps
from sfms_robot.servo.policy import BusServo, Measured, counts, load_rules
from sfms_robot.servo.registers import Table

log = logging.getLogger(__name__)

TORQUE_LOST: Final = "torque lost"  # it restarted, or something switched it off
TORQUE_ON: Final = "torque is not off"  # though it was asked to be
NO_ANSWER: Final = "no answer"
GIVEN_UP: Final = "left alone"
MISSES: Final = 2  # single lost answers in a row before a servo counts as silent
RETRY_S: Final = 0.2  # after a silence on the way back
REFUSED_S: Final = 2.0  # after a refusal on the way back
LIMP_S: Final = 3.0  # a joint that was pinched stays limp so long
ATTEMPTS: Final = 3  # of coming back within `FORGET_S`, then it is given up
FORGET_S: Final = 60.0
NEAR: Final = 1 / 500  # of a turn: a goal this close to where a joint stands continues from there


class State(Enum):
    __hash__ = object.__hash__  # members are single objects; Enum's own hash is Python, a hundred times a tick

    OFF = "off"
    ONLINE = "online"
    REDUCED = "reduced"
    FAULTY = "faulty"
    LIMP = "limp"
    SILENT = "silent"
    RETURNING = "returning"
    REBOOTING = "rebooting"
    REJOINING = "rejoining"
    GIVEN_UP = "given up"
    RELEASED = "released"


ONLINE: Final = State.ONLINE  # by way of the class each is a call, for every servo in every tick
REDUCED: Final = State.REDUCED
REJOINING: Final = State.REJOINING
_DRIVEN: Final = frozenset({ONLINE, REDUCED})  # get goals
_POWERED: Final = _DRIVEN | {State.FAULTY, State.REJOINING}  # torque is wanted, and was seen
_LIMP: Final = frozenset({State.LIMP, State.GIVEN_UP, State.RELEASED})  # torque off is wanted
_COMING: Final = frozenset({State.RETURNING, State.REBOOTING})


class Restart(Protocol):
    """The part of `Startup` that a member needs."""

    @property
    def can_reboot(self) -> bool: ...

    def bring_back(self, index: int, reboot: bool) -> Steps[int]: ...


class Member:
    """One servo. Events come in by methods; what it wants is read from its attributes.

    Args:
        index: place in the bus.
        servo: joint, id, limits and safety.
        table: its control table.
        faults: which of its faults count.
        reporter: of the bus.

    Attributes:
        state: see the module.
        liveness: whether it answers.
        identified: it has been checked against the head's file.
        torque_seen: what it last said; None where it is not known.
        job: its way back, in steps of one exchange, and when the next is due.
        rejoined: it came to hold a position in this poll.
        recalled: it was called back and had not been away.
        stands_ticks: where, while it is rejoining; told at some time since `stands_s`.
        off_written: torque off has been sent since it was wanted.
        mismatch: registers that do not hold what was asked of them, in words.
    """

    def __init__(self, index: int, servo: BusServo, table: Table, faults: Faults, reporter: FaultReporter) -> None:
        self.index = index
        self.id = servo.id
        self.servo = servo
        self.table = table
        self.liveness = Liveness()
        self.identified = False
        self.state = State.OFF
        self.torque_seen: bool | None = None
        self.job: Steps[int] | None = None
        self.job_due_s = 0.0
        self.rejoined = self.recalled = False
        self.stands_ticks = 0
        self.stands_s: float | None = None
        self.off_written = False
        self.mismatch: str | None = None
        self._faults = faults
        self._reporter = reporter
        self._restart: Restart | None = None
        self._bits = 0
        self._named: list[str] = []  # its own faults, those that count
        self._trouble: str | None = None  # what else is wrong
        self._back_s = math.inf  # when a limp one may come back
        self._attempts_s: list[float] = []
        self._rules = [(name, rule) for name, rule in load_rules(servo)]
        self._over_s: dict[str, float] = {}  # since when a rule is broken
        self.lowest_mA = min((rule.current_mA for _, rule in self._rules), default=math.inf)

    # --- what it wants ------------------------------------------------------------------------------------------

    @property
    def gets_goals(self) -> bool:
        return self.state in _DRIVEN and self.torque_seen is True

    @property
    def torque_wanted(self) -> bool | None:
        """None where it is not for the poll to say: before `enable`, or on its way back."""
        if self.state in _POWERED:
            return True
        return False if self.state in _LIMP else None

    @property
    def to_release(self) -> bool:
        """Torque off has to be written: nobody has seen that it is."""
        return self.state in _LIMP and self.torque_seen is not False

    @property
    def over_load(self) -> bool:
        """A load rule is broken just now, not yet for long enough."""
        return bool(self._over_s)

    @property
    def fault(self) -> str | None:
        """For `Reading.fault`."""
        if not self._named and self._trouble is None and self.mismatch is None:
            return None
        own = [", ".join(self._named)] if self._named else [self._trouble] if self._trouble else []
        return "; ".join(own + ([self.mismatch] if self.mismatch else [])) or None

    # --- start and stop -----------------------------------------------------------------------------------------

    def attach(self, restart: Restart) -> None:
        """The wire in use from now on."""
        self._restart = restart

    def connected(self) -> None:
        """Identified and prepared by `connect`; torque as found."""
        self._reset(State.OFF)
        self.liveness, self.identified, self.torque_seen = Liveness(), True, None

    def absent(self) -> None:
        """It did not answer to `connect`."""
        self._reset(State.OFF)
        self.liveness, self.identified, self.torque_seen = Liveness(listed=False), False, None
        self._say(NO_ANSWER)

    def enabled(self) -> None:
        """Torque came on by `enable`, and was seen. Faults it had before are told, and not acted upon again."""
        self._drop_job()
        self.state, self._trouble, self.mismatch = State.ONLINE, None, None
        self.identified = self.torque_seen = True
        self._attempts_s.clear()

    def awaited(self) -> None:
        """`enable` wants it, and it is not there: brought in when it appears."""
        self._reset(State.SILENT)
        self._trouble = NO_ANSWER

    def stopped(self) -> None:
        """No torque is wanted any more; `stop` sees to it."""
        self._drop_job()
        self.state = State.OFF

    def released(self) -> None:
        """Torque off is wanted until `enable`; the poll sees to it."""
        if self.state is not State.OFF:
            self._release(math.inf)
            self.state = State.RELEASED

    def called_back(self, now_s: float) -> None:
        """Bring it back as if it had been away, unless it is driven or on its way; its faults count as known."""
        if self.state in _DRIVEN | _COMING | {State.REJOINING, State.SILENT}:
            return
        self._attempts_s.clear()
        if self.liveness.listed:
            self._return(now_s)
            self.recalled = True
        else:
            self.awaited()

    def _reset(self, state: State) -> None:
        self._drop_job()
        self.state = state
        self._bits, self._named, self._trouble, self.mismatch = 0, [], None, None
        self._over_s.clear()

    # --- liveness -----------------------------------------------------------------------------------------------

    def answered(self) -> bool:
        """It has answered a request; whether it was away."""
        liveness = self.liveness
        back = not liveness.listed
        liveness.misses, liveness.listed = 0, True
        return back

    def unanswered(self, now_s: float) -> bool:
        """One answer was lost; whether that makes it suspect."""
        self.liveness.misses += 1
        if self.liveness.misses >= MISSES:
            self.suspect(now_s)
        return not self.liveness.listed

    def suspect(self, now_s: float, pause_s: float = FIRST_PAUSE_S) -> None:
        """Off the list, and probed alone. Its goals go on until a probe is in vain: it may have been the wire."""
        liveness = self.liveness
        liveness.listed, liveness.pause_s, liveness.probe_s = False, FIRST_PAUSE_S, now_s + pause_s
        if pause_s:
            liveness.say_silent(about(self.servo), now_s, again=True)

    def probe_failed(self, now_s: float) -> None:
        liveness = self.liveness
        liveness.pause_s = min(2.0 * liveness.pause_s, LONGEST_PAUSE_S)
        liveness.probe_s = now_s + liveness.pause_s
        liveness.say_silent(about(self.servo), now_s, again=False)
        if self.state is not State.REBOOTING:  # a servo that reboots does not answer
            self.gone()

    def hurry(self, now_s: float) -> None:
        """Somebody else came back: perhaps this one does, too."""
        self.liveness.pause_s, self.liveness.probe_s = FIRST_PAUSE_S, min(self.liveness.probe_s, now_s)

    def gone(self) -> None:
        """It does not answer, and not because of one lost packet; or the port is gone."""
        if self.state in _DRIVEN | _COMING | {State.REJOINING}:
            self._drop_job()
            self.state = State.SILENT
            self.torque_seen = None
            self._trouble = self._trouble or NO_ANSWER
        elif self.state in _LIMP or self.state is State.FAULTY:
            self.torque_seen = None  # who knows what it does now

    def back(self, now_s: float) -> None:
        """A servo that was silent answers again."""
        self.liveness.say_back(about(self.servo))
        if self.state is State.SILENT:
            self._return(now_s)
        elif self._trouble == NO_ANSWER:
            self._trouble = None

    # --- what it says -------------------------------------------------------------------------------------------

    def take_bits(self, bits: int, seen: Measured, now_s: float) -> None:
        """Fault bits as told by the servo; acted upon when a fault is new, or begins to count."""
        if not bits and not self._bits:
            return
        self._bits = bits
        names = []
        for name in self._names(bits):
            if counts(name, self._faults, seen):
                names.append(name)
            else:
                self._reporter.excuse(self.servo, name)
        new = set(names) - set(self._named)
        if names or self.state not in _LIMP | {State.FAULTY}:  # who stays out says why, also when it has passed
            self._named = names
        if new:
            self._reporter.say(self.servo, ", ".join(names))
            if self.state in _POWERED:
                self._act(self.servo.safety.on_fault, now_s, LIMP_S if self._eases_in else math.inf)

    def take_current(self, current_mA: float, now_s: float) -> None:
        """Judge a present current."""
        for name, rule in self._rules:
            if abs(current_mA) <= rule.current_mA:
                self._over_s.pop(name, None)
            elif now_s - self._over_s.setdefault(name, now_s) >= rule.for_s and self.state in _DRIVEN:
                self._over_s.clear()
                self._reporter.say(self.servo, f"{name} ({abs(current_mA):.0f} mA)")
                self._trouble = name
                self._act(rule.then, now_s, LIMP_S)
                return

    def take_torque(self, on: bool, now_s: float) -> None:
        """Torque enable as told by the servo, against what is wanted."""
        self.torque_seen = on
        if self.state in _LIMP:
            if on and self.off_written:
                self._say(TORQUE_ON)
            elif self._trouble == TORQUE_ON:
                self._trouble = None
        elif self.state is State.SILENT and not on and self.identified:
            self._reporter.say(self.servo, TORQUE_LOST)  # it was away because it restarted
        elif self.state in _POWERED and not on:
            if self._named:
                self._release(math.inf)  # its own protection took the torque, and said why
            else:
                self._say(TORQUE_LOST)
                self._try_again(now_s, now_s)

    def take_registers(self, differing: Mapping[str, tuple[int, int]]) -> None:
        """Registers that hold another value than was asked for, by name: (seen, wanted)."""
        texts = [f"{name} reads {seen}, set to {wanted}" for name, (seen, wanted) in differing.items()]
        self.mismatch = ", ".join(texts) or None
        if self.mismatch:
            self._reporter.say(self.servo, self.mismatch)

    def distrust(self, fault: str, now_s: float) -> None:
        """Something may have gone on behind our back: started up as if it had been away."""
        if self.state in _DRIVEN | {State.REJOINING}:
            self._trouble = fault
            self._return(now_s)

    # --- the way back -------------------------------------------------------------------------------------------

    def due(self, now_s: float) -> bool:
        """Whether its job may take a step; a limp one whose time is over begins one."""
        if self.state is State.LIMP and now_s >= self._back_s and self.torque_seen is False:
            self._back_s = math.inf
            self._try_again(now_s, now_s)
        return self.job is not None and self.job_due_s <= now_s

    @property
    def waits(self) -> bool:
        """Something is still to come: a job, or the end of being limp."""
        return self.job is not None or self._back_s < math.inf

    @property
    def comes_back(self) -> bool:
        """True if it is away or on its way back, and was checked against the head's file earlier in this run."""
        return self.identified and self.state in _COMING | {State.SILENT}

    def step(self, now_s: float) -> None:
        """Take one exchange of its job. Raises BusError when the port fails."""
        if self.job is None:
            return
        if self.stands_s is None:
            self.stands_s = now_s
        try:
            self.job_due_s = now_s + next(self.job)
        except StopIteration as end:
            self.job = None
            self._holds(end.value)
        except Silent:
            self.job = None
            self._return(now_s + RETRY_S)
        except ServoError as error:
            self.job = None
            self._reporter.say(self.servo, str(error))
            self._try_again(now_s + REFUSED_S, now_s)

    def accepts(self, goal_ticks: int) -> bool:
        """A goal for a rejoining joint: whether it continues from where that stands; it is online then."""
        if abs(goal_ticks - self.stands_ticks) > NEAR * self.table.ticks_per_revolution:
            return False
        self.state = State.ONLINE
        return True

    def _holds(self, ticks: int) -> None:
        recalled, bits, named = self.recalled, self._bits, self._named
        self._reset(State.REJOINING)
        self.identified = self.torque_seen = self.rejoined = True
        self.stands_ticks = ticks
        if recalled:
            self.recalled, self._bits, self._named = True, bits, named
        else:
            log.warning("%s is back and holds where it stands", about(self.servo))

    # --- inside -------------------------------------------------------------------------------------------------

    @property
    def _eases_in(self) -> bool:
        return self.servo.safety.on_fault == "reboot_and_ease_in"

    def _act(self, policy: str, now_s: float, limp_s: float) -> None:
        if policy == "limp":
            self._release(now_s + limp_s)
        elif policy == "hold":
            self.state = State.FAULTY
        elif policy == "reduce":
            if self.state is not State.FAULTY:  # one that holds got no goals: the next may be far from where it stands
                self.state = State.REDUCED
        elif self._restart is not None and self._restart.can_reboot:
            self._try_again(now_s, now_s, reboot=True)
        else:
            self._release(now_s + limp_s)

    def _release(self, back_s: float) -> None:
        self._drop_job()
        self.state, self._back_s, self.off_written = State.LIMP, back_s, False
        if self.torque_seen:
            self.torque_seen = None

    def _try_again(self, due_s: float, now_s: float, reboot: bool = False) -> None:
        """The servo itself is to blame, not the wire: so many times, then no more."""
        recent = self._attempts_s = [t for t in self._attempts_s if now_s - t < FORGET_S]
        if len(recent) < ATTEMPTS:
            recent.append(now_s)
            self._return(due_s, reboot)
            return
        log.warning("%s came back %d times in %g s and is left alone", about(self.servo), len(recent), FORGET_S)
        self._release(math.inf)
        self.state = State.GIVEN_UP
        self._trouble = GIVEN_UP

    def _return(self, due_s: float, reboot: bool = False) -> None:
        self._drop_job()
        if self._restart is None:
            raise ServoError(f"{about(self.servo)} has no wire to come back on")
        self.state = State.REBOOTING if reboot else State.RETURNING
        self.torque_seen = None
        self.job, self.job_due_s = self._restart.bring_back(self.index, reboot), due_s
        self.stands_s = None

    def _drop_job(self) -> None:
        job, self.job = self.job, None
        self._back_s, self.recalled = math.inf, False
        if job is not None:
            job.close()

    def _say(self, fault: str) -> None:
        self._reporter.say(self.servo, fault)
        self._trouble = fault

    def _names(self, bits: int) -> list[str]:
        faults = self.table.faults if self.table.protocol == 2 else self.table.status_faults
        return [faults.get(bit, f"hardware error bit {bit}") for bit in range(8) if bits >> bit & 1]


def members_of(
    servos: Sequence[BusServo], tables: Sequence[Table], faults: Faults, reporter: FaultReporter
) -> list[Member]:
    """In bus order."""
    pairs: Any = zip(servos, tables, strict=True)
    return [Member(index, servo, table, faults, reporter) for index, (servo, table) in enumerate(pairs)]
