"""One servo of a chain: its state, the reason for it, and its next request. Opens no port.

    off        no torque is wanted: before `enable`, after `stop`
    online     has torque and gets goals
    reduced    as online, with half the force, because of a fault or a load rule
    faulty     holds where it stands, with torque, and gets no goals: policy "hold"
    limp       torque off is wanted; it is written in every poll until the servo reports that torque is off
    silent     does not answer; gets no goals
    returning  is started up again: identity, settings, goal := present, torque
    rebooting  as returning, after a reboot
    rejoining  holds where it stands, and waits for goals that begin there
    given up   as limp, after too many failures, until it is enabled or called back
    released   as limp, on request: not a fault

The diagram and a table of all arrows are in docs/safety.md. Goals are sent only to members that are online or reduced
and whose torque has been seen on. So a servo that was lost moves only from where it stands.
Times are those of the port's clock, in seconds.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Final, Literal

from sfms_robot.config import Faults
from sfms_robot.errors import ServoError
from sfms_robot.servo.chain.link import Silent, Steps
from sfms_robot.servo.chain.startup import Startup
from sfms_robot.servo.policy import BusServo, counts, load_rules

log = logging.getLogger(__name__)

TORQUE_LOST: Final = "torque lost"  # the servo restarted, or its torque was switched off
TORQUE_ON: Final = "torque is not off"  # although torque off was written
NO_ANSWER: Final = "no answer"
GIVEN_UP: Final = "left alone"
MISSES: Final = 2  # single lost answers in a row before a servo is suspect
FIRST_PAUSE_S: Final = 0.05  # first pause between two probes of a silent servo
LONGEST_PAUSE_S: Final = 1.0
LOGGED_EVERY_S: Final = 10.0  # between two messages about a silence: a loose contact may fail many times a second
GATHER_S: Final = 0.25  # messages with the same text within this time share a line
RETRY_S: Final = 0.2  # wait after a silence during a return
REFUSED_S: Final = 2.0  # wait after a refusal during a return
LIMP_S: Final = 3.0  # time that a joint stays limp, for example after a pinch
ATTEMPTS: Final = 3  # most returns within `FORGET_S`; after them a servo is given up
FORGET_S: Final = 60.0
NEAR: Final = 1 / 500  # part of a turn; a goal this close to the position of a joint continues from there


MemberState = Literal[  # see the docstring of the module
    "off",
    "online",
    "reduced",
    "faulty",
    "limp",
    "silent",
    "returning",
    "rebooting",
    "rejoining",
    "given up",
    "released",
]
_States = frozenset[MemberState]
_DRIVEN: Final[_States] = frozenset({"online", "reduced"})  # get goals
POWERED: Final[_States] = _DRIVEN | {"faulty", "rejoining"}  # torque is wanted, and was seen
_LIMP: Final[_States] = frozenset({"limp", "given up", "released"})  # torque off is wanted
_COMING: Final[_States] = frozenset({"returning", "rebooting"})


class Notices:
    """Log lines about the servos of one bus. Servos with the same message at about the same time share a line.

    Args:
        servos: number of servos of the bus.
    """

    def __init__(self, bus: str, servos: int) -> None:
        self._bus, self._servos = bus, servos
        self._waiting: dict[tuple[int, str], dict[str, int]] = {}  # (level, text) -> servos, each with a count
        self._since_s: dict[tuple[int, str], float] = {}

    def add(self, servo: BusServo, text: str, level: int = logging.WARNING, times: int = 0) -> None:
        """Keep a message for `log`. `times`: how often it was left out since the last message."""
        self._waiting.setdefault((level, text), {})[str(servo)] = times

    def log(self, now_s: float = math.inf) -> None:
        """Log the messages that have waited for similar ones for `GATHER_S`; without a time, log all."""
        for key in list(self._waiting):
            if now_s - self._since_s.setdefault(key, now_s if now_s < math.inf else 0.0) < GATHER_S:
                continue
            del self._since_s[key]
            (level, text), servos = key, self._waiting.pop(key)
            every = len(servos) == self._servos > 2
            named = f"bus {self._bus!r}: all {self._servos} servos" if every else ", ".join(servos)
            most = max(servos.values())
            times = f" ({'up to ' * (len(servos) > 1)}{most} times since the last message)" if most else ""
            log.log(level, "%s: %s%s", named, text, times)


class Member:
    """State of one servo. Methods receive events; attributes show the requests that the servo needs.

    Args:
        index: position in bus order.
        startup: starts the servo up; has its joint, id, limits, safety and control table.
        faults: selects the faults that count.
        reported: faults of the bus, `joint: fault` in the order of appearance, for the report; each is logged once.
        notices: log lines of the bus.

    Attributes:
        state: see the docstring of the module.
        listed: the servo is read together with the others; otherwise it is probed alone, with growing pauses.
        probe_s: time of the next probe of a servo that is not listed.
        identified: the servo has been checked against the head's file.
        torque_seen: whether the servo last reported torque on; None if that is not known.
        job: the return of the servo, in steps of one exchange. `job_due_s`: time from which the next step may run.
        recalled: the servo was called back, and had not been lost.
        stands_ticks: position of a rejoining servo, reported at some time since `stands_s`.
        off_written: torque off has been sent since it was wanted.
        mismatch: registers that do not hold the written value, in words.
    """

    def __init__(
        self, index: int, startup: Startup, faults: Faults, reported: dict[str, None], notices: Notices
    ) -> None:
        self.index = index
        self._notices = notices
        self.startup = startup
        self.servo = startup.servo
        self.id = self.servo.id
        self.identified = False
        self.state: MemberState = "off"
        self.torque_seen: bool | None = None
        self.job: Steps[int] | None = None
        self.job_due_s = 0.0
        self.recalled = False
        self.stands_ticks = 0
        self.stands_s: float | None = None
        self.off_written = False
        self.mismatch: str | None = None
        self._faults = faults
        self._reported = reported
        self._ignored = set[str]()  # faults that do not count, each logged once
        self._bits = 0
        self._named: list[str] = []  # reported faults that count
        self._trouble: str | None = None  # any other fault
        self._back_s = math.inf  # when a limp servo may come back
        self._attempts_s: list[float] = []
        self._rules = load_rules(self.servo)
        self._over_s: dict[str, float] = {}  # rule -> since when it is broken
        self.lowest_mA = min((rule.current_mA for _, rule in self._rules), default=math.inf)
        self._forget_silence(True)

    def _forget_silence(self, listed: bool) -> None:
        self.listed = listed
        self.probe_s = -math.inf
        self._misses = 0
        self._pause_s = FIRST_PAUSE_S
        self._logged_s = -math.inf  # when its silence was last logged
        self._unlogged = 0  # silences since then
        self._logged_silent = False

    # --- what the servo needs -----------------------------------------------------------------------------------

    @property
    def gets_goals(self) -> bool:
        """Return whether goals are sent to it."""
        return self.state in _DRIVEN and self.torque_seen is True

    @property
    def to_release(self) -> bool:
        """Return whether torque off has to be written: it is wanted and was not reported."""
        return self.state in _LIMP and self.torque_seen is not False

    @property
    def over_load(self) -> bool:
        """Return whether a load rule is broken, but not yet for long enough."""
        return bool(self._over_s)

    @property
    def fault(self) -> str | None:
        """Return the text of `Reading.fault`."""
        if not self._named and self._trouble is None and self.mismatch is None:
            return None
        return "; ".join(filter(None, (", ".join(self._named) or self._trouble, self.mismatch))) or None

    # --- start and stop -----------------------------------------------------------------------------------------

    def connected(self, there: bool) -> None:
        """Note that `connect` has identified and prepared it, or (not `there`) that it did not answer."""
        self._reset("off")
        self._forget_silence(there)
        self.identified, self.torque_seen = there, None if there else False
        if not there:
            self._blame(NO_ANSWER)

    def enabled(self) -> None:
        """Note that `enable` switched torque on and verified it. Earlier faults are not acted upon again."""
        self._drop_job()
        self.state, self._trouble, self.mismatch = "online", None, None
        self.identified = self.torque_seen = True
        self._attempts_s.clear()

    def awaited(self) -> None:
        """Note that the servo is wanted but absent: it is brought in when it appears."""
        self._reset("silent")
        self._trouble = NO_ANSWER

    def stopped(self) -> None:
        """Note that no torque is wanted any more; `stop` switches it off. `enable` then prepares the servo again."""
        self._drop_job()
        self.state = "off"
        self.identified = False

    def released(self) -> None:
        """Request torque off until `enabled` or `called_back`; the poll writes it."""
        if self.state != "off":
            self._release(math.inf)
            self.state = "released"

    def called_back(self, now_s: float) -> None:
        """Bring it back as if it had been lost, unless it is driven, silent or returning; its faults count as known."""
        if self.state in _DRIVEN | _COMING | {"rejoining", "silent"}:
            return
        self._attempts_s.clear()
        if self.listed:
            self._return(now_s)
            self.recalled = True
        else:
            self.awaited()

    def _reset(self, state: MemberState) -> None:
        self._drop_job()
        self.state = state
        self._bits, self._named, self._trouble, self.mismatch = 0, [], None, None
        self._over_s.clear()

    # --- silence and answers ------------------------------------------------------------------------------------

    def answered(self) -> None:
        """Note that it has answered a request."""
        self._misses, self.listed = 0, True

    def unanswered(self, now_s: float) -> None:
        """Note that one answer was lost; the second in a row makes it suspect."""
        self._misses += 1
        if self._misses >= MISSES:
            self.suspect(now_s)

    def suspect(self, now_s: float, pause_s: float = FIRST_PAUSE_S) -> None:
        """Unlist it, so that it is probed alone. It gets goals until a probe fails: the wire may be the cause."""
        self.listed, self._pause_s, self.probe_s = False, FIRST_PAUSE_S, now_s + pause_s
        if pause_s:
            self._log_silence(now_s, again=True)

    def probe_failed(self, now_s: float) -> None:
        """Note that it did not answer a probe either."""
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        self.probe_s = now_s + self._pause_s
        self._log_silence(now_s, again=False)
        if self.state != "rebooting":  # a servo that reboots does not answer
            self.gone()

    def hurry(self, now_s: float) -> None:
        """Probe it soon, since another servo came back and this servo may be back, too."""
        self._pause_s, self.probe_s = FIRST_PAUSE_S, min(self.probe_s, now_s)

    def gone(self) -> None:
        """Note that it does not answer, for another reason than one lost packet, or that the port is gone."""
        if self.state in _DRIVEN | _COMING | {"rejoining"}:
            self._drop_job()
            self.state = "silent"
            self.torque_seen = None
            self._trouble = self._trouble or NO_ANSWER
        elif self.state in _LIMP or self.state == "faulty":
            self.torque_seen = None  # it may have changed

    def back(self, now_s: float) -> None:
        """Note that it was silent and answers again."""
        if self._logged_silent:
            self._logged_silent = False
            self._notices.add(self.servo, "answers again", logging.INFO)
        if self.state == "silent":
            self._return(now_s)
        elif self._trouble == NO_ANSWER:
            self._trouble = None

    def _log_silence(self, now_s: float, again: bool) -> None:
        """Log a silence, once in ten seconds, with the count of silences not logged. `again`: a new silence began."""
        if self._logged_silent:
            return
        if now_s < self._logged_s + LOGGED_EVERY_S:
            self._unlogged += again
            return
        self._notices.add(self.servo, "silent", times=self._unlogged)
        self._logged_s, self._unlogged, self._logged_silent = now_s, 0, True

    # --- what the servo reports ---------------------------------------------------------------------------------

    def take_bits(self, bits: int, measured: Mapping[str, float], now_s: float) -> None:
        """Process fault bits; act upon a fault that is new or begins to count. `measured`: see `policy.counts`."""
        if not bits and not self._bits:
            return
        self._bits = bits
        names = []
        for name in self.startup.table.faults_in(bits):
            if counts(name, self._faults, measured):
                names.append(name)
            elif name not in self._ignored:
                self._ignored.add(name)
                log.info("%s reports %s, which this head's configuration allows", self.servo, name)
        new = set(names) - set(self._named)
        # A limp or faulty servo keeps the reason for that, even if the fault has passed.
        if names or self.state not in _LIMP | {"faulty"}:
            self._named = names
        if new:
            self._report(", ".join(names))
            if self.state in POWERED:
                policy = self.servo.safety.on_fault
                self._act(policy, now_s, LIMP_S if policy == "reboot_and_ease_in" else math.inf)

    def take_current(self, current_mA: float, now_s: float) -> None:
        """Compare a present current with the load rules."""
        for name, rule in self._rules:
            if abs(current_mA) <= rule.current_mA:
                self._over_s.pop(name, None)
            elif now_s - self._over_s.setdefault(name, now_s) >= rule.for_s and self.state in _DRIVEN:
                self._over_s.clear()
                self._report(f"{name} ({abs(current_mA):.0f} mA)")
                self._trouble = name
                self._act(rule.then, now_s, LIMP_S)
                return

    def take_torque(self, on: bool, now_s: float) -> None:
        """Compare the torque enable that the servo reports with the wanted state."""
        self.torque_seen = on
        if self.state in _LIMP:
            if on and self.off_written:
                self._blame(TORQUE_ON)
            elif self._trouble == TORQUE_ON:
                self._trouble = None
        elif self.state == "silent" and not on and self.identified:
            self._report(TORQUE_LOST)  # it was silent because it restarted
        elif self.state in POWERED and not on:
            if self._named:
                self._release(math.inf)  # its own protection switched torque off, and it reports the reason
            else:
                self._blame(TORQUE_LOST)
                self._try_again(now_s, now_s)

    def take_registers(self, differing: Mapping[str, tuple[int, int]]) -> None:
        """Note the registers that hold another value than was written, by name: (seen, wanted)."""
        texts = [f"{name} reads {seen}, set to {wanted}" for name, (seen, wanted) in differing.items()]
        self.mismatch = ", ".join(texts) or None
        if self.mismatch:
            self._report(self.mismatch)

    def distrust(self, now_s: float) -> None:
        """Start it up as if it had been lost, after its watchdog has tripped: something may have happened unnoticed."""
        if self.state in _DRIVEN | {"rejoining"}:
            self._trouble = "watchdog"
            self._return(now_s)

    # --- return -------------------------------------------------------------------------------------------------

    def due(self, now_s: float) -> bool:
        """Return whether its job may take a step; begin the job of a limp servo whose time is over."""
        if self.state == "limp" and now_s >= self._back_s and self.torque_seen is False:
            self._back_s = math.inf
            self._try_again(now_s, now_s)
        return self.job is not None and self.job_due_s <= now_s

    @property
    def waits(self) -> bool:
        """Return whether it has a job, or will come back after being limp for a time."""
        return self.job is not None or self._back_s < math.inf

    @property
    def comes_back(self) -> bool:
        """Return whether it is silent or returning, and was checked against the head's file in this run."""
        return self.identified and self.state in _COMING | {"silent"}

    def step(self, now_s: float) -> bool:
        """Make one exchange of its job; return whether it now holds a position. Raises BusError if the port fails."""
        if self.job is None:
            return False
        if self.stands_s is None:
            self.stands_s = now_s
        try:
            self.job_due_s = now_s + next(self.job)
        except StopIteration as end:
            self.job = None
            self._holds(end.value)
            return True
        except Silent:
            self.job = None
            self._return(now_s + RETRY_S)
        except ServoError as error:
            self.job = None
            self._report(str(error))
            self._try_again(now_s + REFUSED_S, now_s)
        return False

    def accepts(self, goal_ticks: int) -> bool:
        """Return whether a goal continues from the position of this rejoining servo; if so, it is driven again."""
        if abs(goal_ticks - self.stands_ticks) > NEAR * self.startup.table.ticks_per_revolution:
            return False
        self.state = "reduced" if self._named and self.servo.safety.on_fault == "reduce" else "online"
        return True

    def _holds(self, ticks: int) -> None:
        recalled, bits, named = self.recalled, self._bits, self._named
        self._reset("rejoining")
        self.identified = self.torque_seen = True
        self.stands_ticks = ticks
        if recalled:
            self.recalled, self._bits, self._named = True, bits, named
        else:
            self._notices.add(self.servo, "back, and holds where it stands", logging.INFO)

    # --- inside -------------------------------------------------------------------------------------------------

    def _act(self, policy: str, now_s: float, limp_s: float) -> None:
        if policy == "hold":
            self.state = "faulty"
        elif policy == "reduce":
            # A servo that holds or rejoins got no goals: the next goal may be far from its position.
            if self.state in _DRIVEN:
                self.state = "reduced"
        elif policy == "reboot_and_ease_in" and self.startup.can_reboot:
            self._try_again(now_s, now_s, reboot=True)
        else:
            self._release(now_s + limp_s)

    def _release(self, back_s: float) -> None:
        self._drop_job()
        self.state, self._back_s, self.off_written = "limp", back_s, False
        if self.torque_seen:
            self.torque_seen = None

    def _try_again(self, due_s: float, now_s: float, reboot: bool = False) -> None:
        """Bring it back, at most `ATTEMPTS` times, since the cause is the servo, not the wire."""
        recent = self._attempts_s = [t for t in self._attempts_s if now_s - t < FORGET_S]
        if len(recent) < ATTEMPTS:
            recent.append(now_s)
            self._return(due_s, reboot)
            return
        self._notices.add(self.servo, f"came back {len(recent)} times in {FORGET_S:g} s, and is given up")
        self._release(math.inf)
        self.state = "given up"
        self._trouble = GIVEN_UP

    def _return(self, due_s: float, reboot: bool = False) -> None:
        self._drop_job()
        self.state = "rebooting" if reboot else "returning"
        self.torque_seen = None
        self.job, self.job_due_s = self.startup.bring_back(reboot), due_s
        self.stands_s = None

    def _drop_job(self) -> None:
        job, self.job = self.job, None
        self._back_s, self.recalled = math.inf, False
        if job is not None:
            job.close()

    def _blame(self, fault: str) -> None:
        self._report(fault)
        self._trouble = fault

    def _report(self, fault: str) -> None:
        named = f"{self.servo.joint}: {fault}"
        if named not in self._reported:
            self._notices.add(self.servo, fault)
        self._reported[named] = None
