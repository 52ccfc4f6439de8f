"""One poll of a wire: its requests, the answers, and the servos that did not answer. For every family of the chain.

On a chain each servo waits for the answer of the servo before it. So where the answers to one request stop, exactly one
servo is suspect, and the servos behind it are read again in the same poll, without it. A lost answer in the middle is
tolerated once. If no servo answers, none is suspect until that has happened a few times; then all are suspect, since
the supply may be gone. A suspect is probed alone, with growing pauses, until it answers.

Servos 1 to 4, read together; "fast" is a fast sync read (one packet of all), "sync" a plain one. Requests of one poll:

    case                              requests                     consequence
    all answer                        fast 1 2 3 4                 -
    3 is dead (wire with fast read)   fast 1 2 3 4, sync 4         3 is suspect
    3 is dead (without)               sync 1 2 3 4, sync 4         3 is suspect
    1 is dead, fast read works        fast 1 2 3 4, sync 2 3 4     1 has missed once; suspect the second time
    1 is dead, without fast read      sync 1 2 3 4, sync 2 3 4     1 is suspect
    2's answer is lost, 3, 4 answer   sync 1 2 3 4                 2 has missed once; suspect the second time
    fast read answered by none        fast 1 2 3 4, sync 2 3 4 1   all answer the second: counted against the fast read;
      (not yet known to work)                                      after five in a row only plain reads are used
    wire dead, first poll             fast 1 2 3 4, sync ..., ...  none: it may be the wire; the next poll begins with
                                                                   another servo and makes one request
    wire dead, third poll             fast 3 4 1 2                 all are suspect, and probed alone

**Time.** A poll has a budget, and its requests share one allowance of silence (`RegisterLink.within`). The first read
is always made, every other read only if it would end in time even without an answer (`affords`). So any number of
silent servos costs a poll one read deadline. A servo is not suspect if its request had no time to wait (`judged`).

    budget = the larger of  0.8 / rate - goals,  first read + read deadline + a turn of the adapter

A purpose for which the budget never has room (on a slow wire, or with an adapter that holds answers back) still gets
one request a few times a second (`grants`), and the poll is longer by that request.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

from sfms_robot.config import BusConfig
from sfms_robot.config.wire_time import BITS, Framing, Way
from sfms_robot.servo.chain.link import AWAY_LATE_S, Answer, Answers, RegisterLink
from sfms_robot.servo.chain.member import Member
from sfms_robot.servo.chain.telemetry import Block, Telemetry
from sfms_robot.servo.codecs.dxl2 import ALERT

log = logging.getLogger(__name__)

USE: Final = 0.8  # usable part of a tick; the rest is for probes, retries and a busy computer
TURN_S: Final = 0.001  # delay of an adapter at every request: USB transfers bytes every millisecond
QUIET_POLLS: Final = 3  # polls without any answer before all servos are suspect instead of the wire
_REQUESTS: Final = 3  # requests for the same data in one poll, at most
_SILENCES: Final = 2  # single reads in one poll that may stay unanswered
_PROBES: Final = 4  # most probes in one poll; an unanswered probe is the last
_FAST_FAILURES: Final = 5
_HEALTH_POLLS: Final = 5  # polls between two reads of torque and error status, if servos are read together
_HEALTH_SHARE: Final = 8  # servos in one such read
_ALERTS_READ: Final = 2  # servos with a new alert that are read in one poll
_IN_TURN_SHARE: Final = 0.6  # part of a tick that reading servos one by one may take
_GROUP_TRIAL_S: Final = 0.05
_TURNAROUND_S: Final = 0.0005  # delay of host and servo between a request and its answer


@dataclass
class PollOutcome:
    """Answers to a read of all servos. `gaps`: ids at which answers stopped; `missed`: ids of other missing answers."""

    answers: Answers = field(default_factory=dict)
    gaps: list[int] = field(default_factory=list)
    missed: list[int] = field(default_factory=list)
    judged: bool = False  # a request waited for the full silence


class StatusPoll:
    """Reader of the members of one bus, which passes them their answers.

    Args:
        bus: its name, for messages.
        members: in bus order.
        telemetry: receives positions and other values.
        config: configuration of the bus.
        counts: counters of the bus; reads, errors and retries are incremented in place.
        framing: sizes of the packets on this wire, in bytes.

    Attributes:
        link: link over the wire; set by the bus when it opens the port.
        read_deadline_s: time without a byte after which a servo counts as silent on this wire.
        budget_s: time that a poll may take, with waits for answers, but without requests that are granted in addition.
        quiet_polls: polls in a row in which no servo answered.
    """

    link: RegisterLink

    def __init__(
        self,
        bus: str,
        members: Sequence[Member],
        telemetry: Telemetry,
        config: BusConfig,
        counts: dict[str, int],
        framing: Framing,
    ) -> None:
        self._bus = bus
        self._members = members
        self._by_id = {member.id: member for member in members}
        self._telemetry = telemetry
        self._config = config
        self._counts = counts
        self._framing = framing
        self.read_deadline_s = config.read_deadline_ms / 1e3
        self._tells = {each.id for each in members if telemetry.currents[each.index] is not None}
        # Bits of an answer's error byte that are about the servo; the others are about the request.
        status_bits = [sum(1 << bit for bit in member.startup.table.status_faults) for member in members]
        self._error_bits = status_bits if telemetry.error is None else [ALERT] * len(members)
        self.restart(grouped=False)

    def restart(self, grouped: bool, fast: bool = False, proven: bool = True) -> None:
        """Forget the past, and begin with a new connection.

        Args:
            grouped: several servos can be read by one request; otherwise they are read one by one, in rotation.
            fast: servos can answer in one packet together, which is given up if it fails too often.
            proven: the fast read is known to work here.
        """
        self._grouped, self._fast = grouped, fast
        self._fast_proven, self._fast_failures = proven and fast, 0
        self.quiet_polls = 0
        self._rotation, self._looks, self._currents = Rotation(), Rotation(), Rotation()
        self._polls = 0
        self._turn = 0
        self._flagged = set[int]()  # ids whose status says that something is wrong
        self._missing = set(self._by_id)  # ids of members that have to be notified when they answer
        self._answered: list[int] = []  # ids that answered in this poll, and may be asked for more
        self._plan()

    def find_reads(self, present: list[int], group: bool) -> None:
        """Find out how the servos that answered, `present`, can be read together, and begin with this connection.

        `group`: try one request for several servos. Where the link has a fast read, all servos answer such a request.
        """
        if self.link.has_fast_read:
            wanted = self._config.fast_read
            fast = wanted == "on"
            if wanted == "auto":
                fast = len(self.link.read_many(*self._telemetry.position, present, fast=True)) == len(present)
            self.restart(grouped=True, fast=fast, proven=wanted == "auto")
            return
        if group:
            with self.link.patient(_GROUP_TRIAL_S):
                group = len(self.link.read_many(*self._telemetry.block, present)) == len(present)
            if not group:
                log.info("bus %r: not every servo answers group requests: they are read one by one", self._bus)
        self.restart(group)

    def _plan(self) -> None:
        """Compute how many whole blocks fit into a tick, and the budget of a poll."""
        telemetry, config, count = self._telemetry, self._config, len(self._members)
        (_, position), (_, block) = telemetry.position, telemetry.block
        byte_s, way = BITS / config.baud, "fast" if self._fast else self._way
        spare_s = USE / config.rate_hz - self._framing.goals(count, telemetry.goal.size) * byte_s

        def read_s(servos: int, length: int) -> float:
            return self._framing.reads(servos, length, way) * byte_s + TURN_S

        self._blocks = count
        if telemetry.error is not None and read_s(count, block) > spare_s:  # other families always read the block
            left_s = spare_s - read_s(count, position)
            self._blocks = max((few for few in range(2, count + 1) if read_s(few, block) <= left_s), default=1)
        single_s = self._framing.reads(1, block, "one by one") * byte_s + _TURNAROUND_S
        self._many = max(1, int(_IN_TURN_SHARE / config.rate_hz / single_s))
        first_s = read_s(count if self._grouped else 1, position if self._blocks < count else block)
        self.budget_s = max(spare_s, first_s + self.read_deadline_s + TURN_S)

    @property
    def _way(self) -> Way:
        return "together" if self._grouped else "one by one"

    def _bytes(self, servos: int, length: int) -> int:
        """Return the bytes on the wire to read `length` bytes of each servo, by one request if the wire supports it."""
        return self._framing.reads(servos, length, self._way)

    def measure(self, now_s: float) -> None:
        """Read the full status block of each listed servo once, without updating miss counters."""
        where = self._telemetry.block
        self._take(where, self.read_some("blocks", where, self._listed()), now_s)

    def step(self, now_s: float) -> bool:
        """Read all listed servos, and probe others; return whether any answered. Raises BusError if the port fails."""
        telemetry, listed = self._telemetry, self._listed()
        whole = not self._grouped or self._blocks >= len(self._members)
        where = telemetry.block if whole else telemetry.position
        outcome = self._read_all(where, listed) if self._grouped else self._read_in_turn(listed)
        answers = outcome.answers
        self._counts["errors"] += len(outcome.gaps) + len(outcome.missed)
        for servo in self._missing & answers.keys():
            self._by_id[servo].answered()
        self._missing -= answers.keys()
        fresh = self._take(where, answers, now_s)
        self._suspect(outcome, now_s)
        self._look(list(answers), now_s)
        self._look_at_alerts(fresh, now_s)
        self._answered = [] if whole else list(answers)
        return self._probe(now_s) or bool(answers)

    def blocks(self, now_s: float) -> None:
        """Read the full block of some servos in the rest of the poll, if it has no time for the blocks of all."""
        where = self._telemetry.block
        count = self.fitting("blocks", where[1], self._blocks) if self._answered else 0
        if count:
            chosen = self._rotation.take(self._answered, count)
            fresh = self._take(where, self.read_some("blocks", where, chosen), now_s)
            self._look_at_alerts(fresh, now_s)

    # --- requests -----------------------------------------------------------------------------------------------

    def _listed(self) -> list[int]:
        return [member.id for member in self._members if member.listed]

    def fitting(self, purpose: str, length: int, most: int) -> int:
        """Return how many servos, `most` at most, can be asked for `length` bytes in the rest of the poll.

        This is one servo if the purpose has waited for too long.
        """
        if most <= 0:
            return 0
        if not self._grouped:
            return int(self.link.grants(purpose, self._bytes(1, length), alone=True))
        while most > 1 and not self.link.affords(self._bytes(most, length)):
            most -= 1
        return most if self.link.grants(purpose, self._bytes(most, length)) else 0

    def read_some(self, purpose: str, where: Block, ids: Sequence[int]) -> Mapping[int, Answer]:
        """Read as many of `ids` as there is time for, by one request if the wire supports it; return the answers."""
        if self._grouped:
            ids = ids[: self.fitting(purpose, where[1], len(ids))]
            if not ids:
                return {}
            self._counts["reads"] += 1
            return self.link.read_many(*where, ids, self._fast and len(ids) > 1 and where == self._telemetry.block)
        answers: Answers = {}
        for servo in ids:
            if not self.link.grants(purpose, self._bytes(1, where[1]), alone=True):
                break
            self._counts["reads"] += 1
            if (answer := self.link.read(servo, *where)) is not None:
                answers[servo] = answer
        return answers

    def _read_all(self, where: Block, ids: Sequence[int]) -> PollOutcome:
        """Read all by one request, and those behind a silent servo by another; see the table of the module."""
        out = PollOutcome()
        # Behind a dead first servo all are silent, so after a quiet poll another servo is asked first.
        start = self.quiet_polls * (len(ids) // QUIET_POLLS or 1) % max(1, len(ids))
        rest = [*ids[start:], *ids[:start]]
        for attempt in range(_REQUESTS):
            # If the wire was also quiet in the last poll, make only one request: most likely all servos are gone.
            if not rest or (attempt > 0 and not out.answers and self.quiet_polls > 0):
                break
            if attempt > 0 and not self.link.affords(self._bytes(len(rest), where[1])):
                break
            self._counts["retries"] += attempt > 0
            self._counts["reads"] += 1
            fast = self._fast and attempt == 0 and len(rest) > 1
            got = self.link.read_many(*where, rest, fast)
            out.answers.update(got)
            out.judged |= self.link.judged
            if fast and not got:
                if self._fast_proven:  # the first servo is the likely cause: one silence in a poll is enough
                    out.missed, rest = rest[:1], rest[1:]
                else:  # either the first servo or the fast read is the cause: read the others first
                    rest = [*rest[1:], rest[0]]
                continue
            if self._fast and attempt == 1 and len(out.answers) == len(got):
                self._count_against_fast(len(got) == len(rest))
            elif fast:
                self._fast_failures = 0
                self._fast_proven |= len(got) == len(rest)
            last = max((i for i, servo in enumerate(rest) if servo in got), default=-1)
            out.missed += [servo for servo in rest[: last + 1] if servo not in got]
            if self.link.judged:
                out.gaps += rest[last + 1 : last + 2]
            rest = rest[last + 2 :]
        if not out.answers:
            out.missed = []  # on a quiet wire no answer counts as missed
        return out

    def _count_against_fast(self, all_there: bool) -> None:
        """Count an unanswered fast read; reset the count unless all then answered a plain read."""
        self._fast_failures = self._fast_failures + 1 if all_there else 0
        if self._fast_failures >= _FAST_FAILURES:
            self._fast = False
            self._plan()
            log.warning("bus %r: fast sync read is not answered; plain sync read from now on", self._bus)

    def _read_in_turn(self, ids: Sequence[int]) -> PollOutcome:
        """Read servos one by one, as many per poll as its share of a tick allows; begin where the last poll ended."""
        out, where = PollOutcome(), self._telemetry.block
        count = len(self._members)
        order = sorted(ids, key=lambda servo: (self._by_id[servo].index - self._turn) % count)
        for number, servo in enumerate(order[: self._many]):
            if number and not self.link.affords(self._bytes(1, where[1]), alone=True):
                break
            self._turn = (self._by_id[servo].index + 1) % count
            self._counts["reads"] += 1
            if (answer := self.link.read(servo, *where)) is not None:
                out.answers[servo] = answer
            elif self.link.judged:
                out.gaps.append(servo)
                if len(out.gaps) >= _SILENCES:
                    break
        out.judged = bool(out.gaps)
        if not out.answers:  # servo or wire is the cause; a servo that misses the next round, too, is suspect
            out.missed, out.gaps = out.gaps, []
        return out

    # --- missing servos -----------------------------------------------------------------------------------------

    def _suspect(self, outcome: PollOutcome, now_s: float) -> None:
        """Notify the members that missed an answer or are suspect after a read of all."""
        if outcome.answers:
            self.quiet_polls = 0
            found = outcome.gaps
        else:
            self.quiet_polls += outcome.judged
            found = self._listed() if self.quiet_polls >= QUIET_POLLS else []
        self._missing |= {*outcome.missed, *found}
        for servo in outcome.missed:
            self._by_id[servo].unanswered(now_s)
        for servo in found:
            self._by_id[servo].suspect(now_s)

    def _probe(self, now_s: float) -> bool:
        """Probe members that are not listed and have waited long enough, one by one, until one does not answer."""
        answered = False
        where = self._telemetry.position if self._grouped else self._telemetry.block
        request = self._bytes(1, self._telemetry.block[1])
        for _ in range(_PROBES):
            waiting = [member for member in self._members if not member.listed and member.probe_s <= now_s]
            if not waiting or not self.link.grants("probe", request, alone=True, late_s=AWAY_LATE_S):
                return answered
            member = min(waiting, key=lambda each: each.probe_s)
            self._counts["retries"] += 1
            self._counts["reads"] += 1
            if self._grouped:
                answer = self.link.read_many(*where, [member.id]).get(member.id)
            else:
                answer = self.link.read(member.id, *where)
            if answer is None:
                member.probe_failed(now_s)
                return answered
            answered = True
            member.answered()
            self._missing.discard(member.id)
            self._take(where, {member.id: answer}, now_s)
            for other in self._members:
                if not other.listed:
                    other.hurry(now_s)
            self._take_health(self.read_some("health", self._telemetry.health, [member.id]), now_s)
            member.back(now_s)
        return answered

    # --- reports ------------------------------------------------------------------------------------------------

    def _take(self, where: Block, answers: Mapping[int, Answer], now_s: float) -> list[int]:
        """Pass on values and status of answers; return ids whose alert bit was newly set."""
        telemetry, length, alert = self._telemetry, where[1], self._telemetry.error is not None
        members, flagged = self._by_id, self._flagged
        good: list[int] = []
        data: list[bytes] = []
        fresh: list[int] = []
        for servo, (error, content) in answers.items():
            member = members[servo]
            if len(content) != length or (alert and error & ~ALERT):
                self._counts["errors"] += 1  # the servo refuses
            else:
                good.append(member.index)
                data.append(content)
            if error or servo in flagged:
                status = error & self._error_bits[member.index]
                if alert and status:  # the alert only reports that there is a fault, which is read once
                    if servo not in flagged:
                        fresh.append(servo)
                elif status or servo in flagged:
                    member.take_bits(status, telemetry.measured(member.index), now_s)
                (flagged.add if status else flagged.discard)(servo)
        if good:
            telemetry.take(where, good, data, now_s)
            if where == telemetry.block:
                self.judge_loads(good, now_s)
        return fresh

    def judge_loads(self, indices: Sequence[int], now_s: float) -> None:
        """Compare the present currents of servos that have just reported them with their load rules."""
        currents = self._telemetry.currents_mA()
        for index in indices:
            member = self._members[index]
            if abs(currents[index]) > member.lowest_mA or member.over_load:
                member.take_current(currents[index], now_s)

    def _look(self, ids: Sequence[int], now_s: float) -> None:
        """Read what is outside the block of a few servos: torque, error status, a current at another address."""
        if not ids:
            return
        self._polls += 1
        tells = [servo for servo in ids if servo in self._tells] if self._tells else []
        if tells and (self._grouped or self._polls % 2):
            self._look_at_current(self._currents.take(tells, 1)[0], now_s)
        due = self._polls % _HEALTH_POLLS == 0 if self._grouped else not (tells and self._polls % 2)
        count = self.fitting("health", self._telemetry.health[1], _HEALTH_SHARE) if due else 0
        if count:
            chosen = self._looks.take(ids, count)
            self._take_health(self.read_some("health", self._telemetry.health, chosen), now_s)

    def _look_at_current(self, servo: int, now_s: float) -> None:
        index = self._by_id[servo].index
        register = self._telemetry.currents[index]
        if register is None or not self.link.grants("current", self._bytes(1, register.size), alone=True):
            return
        answer = self.link.read(servo, register.address, register.size)
        if answer is not None and len(answer.data) == register.size:
            self._telemetry.take_current(index, register, answer.data)
            self.judge_loads([index], now_s)

    def _look_at_alerts(self, fresh: Sequence[int], now_s: float) -> None:
        """Read the faults of servos whose alert bit was newly set; servos left out are read in the next poll."""
        asked = fresh[:_ALERTS_READ]
        answers = self.read_some("alerts", self._telemetry.health, asked) if asked else {}
        self._flagged -= set(fresh) - answers.keys()
        self._take_health(answers, now_s)

    def _take_health(self, answers: Mapping[int, Answer], now_s: float) -> None:
        telemetry = self._telemetry
        for servo, answer in answers.items():
            if len(answer.data) == telemetry.health[1]:
                member = self._by_id[servo]
                torque, bits = telemetry.health_of(answer.data)
                if telemetry.error is not None:
                    member.take_bits(bits, telemetry.measured(member.index), now_s)
                member.take_torque(torque, now_s)


class Rotation:
    """Rotation of turns among servos, `count` at a time."""

    _next = 0

    def take(self, servos: Sequence[int], count: int) -> list[int]:
        """Return the next `count` of `servos`, in their order. No turn is spent on a servo that is missing."""
        if count >= len(servos):
            return list(servos)
        start = self._next % len(servos)
        self._next = start + count
        chosen = {servos[(start + k) % len(servos)] for k in range(count)}
        return [servo for servo in servos if servo in chosen]
