"""One poll of a wire: who answered, who did not, and what the answers say. For every family of the chain.

On a chain each servo waits for the answer of the one before it, so where the answers to one request stop, exactly one
servo is suspect, and those behind it are asked again in the same poll, without it. A single lost answer in the middle
is forgiven once. A wire on which nobody answers blames nobody until it has happened a few times, and then everybody:
the supply may be gone. Who is suspect is probed alone, with growing pauses, until it answers.

**Time.** A poll has a budget, and its requests share one allowance of silence (`RegisterLink.within`): the first read
is always made, everything else only when it would be over in time even if nobody answered. So any number of silent
servos costs a poll one read deadline, once; whom a request had no time to wait for is not blamed.

    budget = the larger of  0.8 / rate - goals,  first read + read deadline + a turn of the adapter

Where that never has room for something (a slow wire, an adapter that holds answers back), it gets one request a few
times a second all the same (`RegisterLink.grants`), and the poll is so much longer.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from sfms_robot.config import BusConfig
from sfms_robot.config.wire_time import BITS, Framing, Way
from sfms_robot.servo.chain.link import AWAY_LATE_S, Answer, RegisterLink
from sfms_robot.servo.chain.member import Member
from sfms_robot.servo.chain.telemetry import Block, Telemetry
from sfms_robot.servo.codecs.dxl2 import ALERT

log = logging.getLogger(__name__)

USE: Final = 0.8  # of a tick; the rest is for probes, retries and a busy computer
TURN_S: Final = 0.001  # of an adapter at every request: USB hands bytes over every millisecond
QUIET_POLLS: Final = 3  # polls without any answer before servos are blamed rather than the wire
_REQUESTS: Final = 3  # for the same thing in one poll at most
_SILENCES: Final = 2  # single reads in one poll that may stay unanswered
_PROBES: Final = 4  # in one poll, as long as they are answered
_FAST_FAILURES: Final = 5
_HEALTH_POLLS: Final = 5  # between two looks at torque and error status, where several are read at once
_HEALTH_SHARE: Final = 8  # servos in one look
_ALERTS_READ: Final = 2  # per poll
_IN_TURN_SHARE: Final = 0.6  # of a tick that reading servos one by one may take
_TURNAROUND_S: Final = 0.0005  # host and servo, between a request and its answer

GroupRead = Callable[[int, int, Sequence[int]], Mapping[int, Answer]]


@dataclass
class Outcome:
    """What asking everybody brought. `gaps`: ids where answers stopped; `missed`: ids that were passed over."""

    answers: dict[int, Answer] = field(default_factory=dict)
    gaps: list[int] = field(default_factory=list)
    missed: list[int] = field(default_factory=list)
    judged: bool = False  # somebody was waited for as long as it takes


class StatusPoll:
    """Asks the members of one bus and tells them what they said.

    Args:
        bus: its name, for messages.
        members: in bus order.
        telemetry: takes positions and the like.
        config: of the bus.
        counts: of the bus: reads, errors and retries are counted up in place.
        framing: bytes of the packets on this wire.

    Attributes:
        read_deadline_s: silence that makes a servo silent on this wire.
        budget_s: time that a poll may take, waiting for answers included; what is granted beside it is not.
        quiet_polls: polls in a row in which nobody answered.
    """

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
        self._members = list(members)
        self._ids = [member.id for member in members]
        self._by_id = {member.id: member for member in members}
        self._telemetry = telemetry
        self._config = config
        self._counts = counts
        self._framing = framing
        self.read_deadline_s = config.read_deadline_ms / 1e3
        self._tells = {each.id for each in members if telemetry.currents[each.index] is not None}
        self._error_bits = [ALERT if telemetry.error is not None else _status_bits(member) for member in members]
        self._restart(None, None)

    def _restart(self, group: GroupRead | None, fast: GroupRead | None) -> None:
        self._group, self._fast = group, fast
        self._fast_proven, self._fast_failures = fast is not None, 0
        self.quiet_polls = 0
        self._rotation, self._looks, self._currents = Rotation(), Rotation(), Rotation()
        self._polls = 0
        self._turn = 0
        self._flagged: set[int] = set()  # whose status says that something is wrong
        self._missing = {member.id for member in self._members}  # who has to be told that it has answered
        self._answered: list[int] = []  # in this poll, and may be asked for more
        self._plan()

    def restart(self, group: GroupRead | None, fast: GroupRead | None = None, proven: bool = True) -> None:
        """Another connection.

        Args:
            group: reads several servos at once; None where they are read one by one, in rotation.
            fast: the same in one packet of all, given up when it fails too often.
            proven: the fast read is known to work here.
        """
        self._restart(group, fast)
        self._fast_proven = proven and fast is not None

    def reconnect(self, group: GroupRead | None, fast: GroupRead | None) -> None:
        """The same wire, opened again: what was found out about it still holds."""
        self._group = group if self._group is not None else None
        self._fast = fast if self._fast is not None else None

    def _plan(self) -> None:
        """How many whole blocks fit into a tick, and the budget of a poll."""
        telemetry, config, count = self._telemetry, self._config, len(self._ids)
        (_, position), (_, block) = telemetry.position, telemetry.block
        byte_s, way = BITS / config.baud, "fast" if self._fast is not None else self._way
        spare_s = USE / config.rate_hz - self._framing.goals(count, telemetry.goal.size) * byte_s

        def read_s(servos: int, length: int) -> float:
            return self._framing.reads(servos, length, way) * byte_s + TURN_S

        self._blocks = count
        if telemetry.error is not None:  # the others are always asked for the block
            self._blocks = blocks_per_tick(count, spare_s, read_s(count, position), partial(read_s, length=block))
        single_s = self._framing.reads(1, block, "one by one") * byte_s + _TURNAROUND_S
        self._many = max(1, int(_IN_TURN_SHARE / config.rate_hz / single_s))
        first_s = read_s(1 if self._group is None else count, position if self._blocks < count else block)
        self.budget_s = max(spare_s, first_s + self.read_deadline_s + TURN_S)

    @property
    def _way(self) -> Way:
        return "one by one" if self._group is None else "together"

    def _bytes(self, servos: int, length: int) -> int:
        """Return the bytes of reading `length` bytes of each, by one request where the wire has one."""
        return self._framing.reads(servos, length, self._way)

    def measure(self, link: RegisterLink, now_s: float) -> None:
        """Everything of everybody who is listed, once; nobody is blamed."""
        where = self._telemetry.block
        self._take(link, where, self.read_some(link, "blocks", where, self._listed()), now_s)

    def step(self, link: RegisterLink, now_s: float) -> bool:
        """Ask; whether anybody answered. Raises BusError when the port fails."""
        telemetry, listed = self._telemetry, self._listed()
        whole = self._group is None or self._blocks >= len(self._ids)
        where = telemetry.block if whole else telemetry.position
        outcome = self._in_turn(link, listed) if self._group is None else self._everybody(link, where, listed)
        answers = outcome.answers
        self._counts["errors"] += len(outcome.gaps) + len(outcome.missed)
        for servo in self._missing & answers.keys():
            self._by_id[servo].answered()
        self._missing -= answers.keys()
        fresh = self._take(link, where, answers, now_s)
        self._blame(outcome, now_s)
        self._look(link, list(answers), now_s)
        self._look_at_alerts(link, fresh, now_s)
        self._answered = [] if whole else list(answers)
        return self._probe(link, now_s) or bool(answers)

    def blocks(self, link: RegisterLink, now_s: float) -> None:
        """What is left of the poll, where it has no time for everything of everybody: everything of some."""
        where = self._telemetry.block
        count = self.fitting(link, "blocks", where[1], self._blocks) if self._answered else 0
        if count:
            chosen = self._rotation.take(self._answered, count)
            fresh = self._take(link, where, self.read_some(link, "blocks", where, chosen), now_s)
            self._look_at_alerts(link, fresh, now_s)

    # --- requests -----------------------------------------------------------------------------------------------

    def _listed(self) -> list[int]:
        return [member.id for member in self._members if member.liveness.listed]

    def fitting(self, link: RegisterLink, purpose: str, length: int, most: int) -> int:
        """How many servos, `most` at most, can be asked for `length` bytes in what is left of the poll; one where
        the purpose has waited for too long."""
        if most <= 0:
            return 0
        if self._group is None:
            return int(link.grants(purpose, self._bytes(1, length), alone=True))
        while most > 1 and not link.affords(self._bytes(most, length)):
            most -= 1
        return most if link.grants(purpose, self._bytes(most, length)) else 0

    def read_some(self, link: RegisterLink, purpose: str, where: Block, ids: Sequence[int]) -> Mapping[int, Answer]:
        """Answers of a few, of as many as there is time for: by one request where the wire has one."""
        if self._group is not None:
            ids = ids[: self.fitting(link, purpose, where[1], len(ids))]
            if not ids:
                return {}
            self._counts["reads"] += 1
            fast = self._fast if len(ids) > 1 and where == self._telemetry.block else None
            return (fast or self._group)(*where, ids)
        answers: dict[int, Answer] = {}
        for servo in ids:
            if not link.grants(purpose, self._bytes(1, where[1]), alone=True):
                break
            self._counts["reads"] += 1
            if (answer := link.read(servo, *where)) is not None:
                answers[servo] = answer
        return answers

    def _everybody(self, link: RegisterLink, where: Block, ids: Sequence[int]) -> Outcome:
        """All by one request, and those behind a silent one by a second."""
        out = Outcome()
        # Behind a dead servo in front everybody is silent: after a quiet poll somebody else is asked first.
        start = self.quiet_polls * (len(ids) // QUIET_POLLS or 1) % max(1, len(ids))
        rest = [*ids[start:], *ids[:start]]
        for attempt in range(_REQUESTS):
            # A wire that was quiet in the last poll as well is asked once: most likely nobody is there.
            if not rest or (attempt > 0 and not out.answers and self.quiet_polls > 0):
                break
            if attempt > 0 and not link.affords(self._bytes(len(rest), where[1])):
                break
            self._counts["retries"] += attempt > 0
            self._counts["reads"] += 1
            fast = self._fast if attempt == 0 and len(rest) > 1 else None
            got = self._request(fast or self._group, where, rest)
            out.answers.update(got)
            out.judged |= link.judged
            if fast is not None and not got:
                if self._fast_proven:  # the first servo is the likely cause: one silence in a poll is enough
                    out.missed, rest = rest[:1], rest[1:]
                else:
                    rest = [*rest[1:], rest[0]]  # was it the first servo, or the fast read? Now the others come first
                continue
            if self._fast is not None and attempt == 1 and len(out.answers) == len(got):
                self._count_against_fast(len(got) == len(rest))
            elif fast is not None:
                self._fast_failures = 0
                self._fast_proven |= len(got) == len(rest)
            last = max((i for i, servo in enumerate(rest) if servo in got), default=-1)
            out.missed += [servo for servo in rest[: last + 1] if servo not in got]
            if link.judged:
                out.gaps += rest[last + 1 : last + 2]
            rest = rest[last + 2 :]
        if not out.answers:
            out.missed = []  # on a quiet wire nobody was passed over
        return out

    def _request(self, read: GroupRead | None, where: Block, ids: Sequence[int]) -> Mapping[int, Answer]:
        return read(*where, ids) if read is not None else {}

    def _count_against_fast(self, all_there: bool) -> None:
        """Silence to a fast read that a plain one then breaks, everybody answering."""
        self._fast_failures = self._fast_failures + 1 if all_there else 0
        if self._fast_failures >= _FAST_FAILURES:
            self._fast = None
            self._plan()
            log.warning("bus %r: fast sync read is not answered; plain sync read from now on", self._bus)

    def _in_turn(self, link: RegisterLink, ids: Sequence[int]) -> Outcome:
        """One by one, as many per poll as its share of a tick allows, going on where the last poll left off."""
        out, where = Outcome(), self._telemetry.block
        place = {servo: i for i, servo in enumerate(self._ids)}
        order = sorted(ids, key=lambda servo: (place[servo] - self._turn) % len(place))
        for number, servo in enumerate(order[: self._many]):
            if number and not link.affords(self._bytes(1, where[1]), alone=True):
                break
            self._turn = (place[servo] + 1) % len(place)
            self._counts["reads"] += 1
            if (answer := link.read(servo, *where)) is not None:
                out.answers[servo] = answer
            elif link.judged:
                out.gaps.append(servo)
                if len(out.gaps) >= _SILENCES:
                    break
        out.judged = bool(out.gaps)
        if not out.answers:  # the servo, or the wire? Whoever does not answer in the next round either is suspect
            out.missed, out.gaps = out.gaps, []
        return out

    # --- who is there -------------------------------------------------------------------------------------------

    def _blame(self, outcome: Outcome, now_s: float) -> None:
        """End of asking everybody: who is suspect now."""
        if outcome.answers:
            self.quiet_polls = 0
            found = outcome.gaps
        else:
            self.quiet_polls += outcome.judged
            found = self._listed() if self.quiet_polls >= QUIET_POLLS else []
        for servo in outcome.missed:
            self._missing.add(servo)
            self._by_id[servo].unanswered(now_s)
        for servo in found:
            self._missing.add(servo)
            self._by_id[servo].suspect(now_s)

    def _probe(self, link: RegisterLink, now_s: float) -> bool:
        """Ask members that are not listed and have waited long enough, one by one, until one does not answer."""
        answered = False
        absent = [member for member in self._members if not member.liveness.listed]
        waiting = [member for member in absent if member.liveness.probe_s <= now_s]
        request = self._bytes(1, self._telemetry.block[1])
        for _ in range(_PROBES):
            if not waiting or not link.grants("probe", request, alone=True, late_s=AWAY_LATE_S):
                return answered
            member = min(waiting, key=lambda each: each.liveness.probe_s)
            waiting.remove(member)
            self._counts["retries"] += 1
            where = self._telemetry.position if self._group is not None else self._telemetry.block
            self._counts["reads"] += 1
            answer = self._group(*where, [member.id]) if self._group is not None else None
            if self._group is None and (single := link.read(member.id, *where)) is not None:
                answer = {member.id: single}
            if not answer:
                member.probe_failed(now_s)
                return answered
            answered = True
            member.answered()
            self._missing.discard(member.id)
            self._take(link, where, answer, now_s)
            absent.remove(member)
            for other in absent:
                other.hurry(now_s)
            waiting = list(absent)
            self._take_health(self.read_some(link, "health", self._telemetry.health, [member.id]), now_s)
            member.back(now_s)
        return answered

    # --- what they say ------------------------------------------------------------------------------------------

    def _take(self, link: RegisterLink, where: Block, answers: Mapping[int, Answer], now_s: float) -> list[int]:
        """Values and status of those who told; ids whose alert has just come on."""
        telemetry, length, alert = self._telemetry, where[1], self._telemetry.error is not None
        members, flagged = self._by_id, self._flagged
        good: list[int] = []
        data: list[bytes] = []
        fresh: list[int] = []
        for servo, (error, told) in answers.items():
            member = members[servo]
            if len(told) != length or (alert and error & ~ALERT):
                self._counts["errors"] += 1  # it refuses to say
            else:
                good.append(member.index)
                data.append(told)
            if error or servo in flagged:
                fresh += self._take_status(member, error & self._error_bits[member.index], alert, now_s)
        if good:
            telemetry.take(where, good, data, now_s)
            if where == telemetry.block:
                self.judge_loads(good, now_s)
        return fresh

    def _take_status(self, member: Member, status: int, alert: bool, now_s: float) -> list[int]:
        """What the error byte of an answer says of the servo; its id when it has to be asked what is wrong."""
        known = member.id in self._flagged
        if not status and not known:
            return []
        (self._flagged.add if status else self._flagged.discard)(member.id)
        if alert and status:
            return [] if known else [member.id]
        member.take_bits(status, self._telemetry.measured(member.index), now_s)
        return []

    def judge_loads(self, indices: Sequence[int], now_s: float) -> None:
        """Present currents of servos that have just told them, against their load rules."""
        currents = self._telemetry.current_mA.tolist()
        for index in indices:
            member = self._members[index]
            if abs(currents[index]) > member.lowest_mA or member.over_load:
                member.take_current(currents[index], now_s)

    def _look(self, link: RegisterLink, ids: Sequence[int], now_s: float) -> None:
        """Of a few, what is not in the block: torque, error status, a current that lies elsewhere."""
        if not ids:
            return
        self._polls += 1
        tells = [servo for servo in ids if servo in self._tells] if self._tells else []
        if tells and (self._group is not None or self._polls % 2):
            self._look_at_current(link, self._currents.take(tells, 1)[0], now_s)
        due = self._polls % _HEALTH_POLLS == 0 if self._group is not None else not (tells and self._polls % 2)
        count = self.fitting(link, "health", self._telemetry.health[1], _HEALTH_SHARE) if due else 0
        if count:
            chosen = self._looks.take(ids, count)
            self._take_health(self.read_some(link, "health", self._telemetry.health, chosen), now_s)

    def _look_at_current(self, link: RegisterLink, servo: int, now_s: float) -> None:
        index = self._by_id[servo].index
        register = self._telemetry.currents[index]
        if register is None or not link.grants("current", self._bytes(1, register.size), alone=True):
            return
        answer = link.read(servo, register.address, register.size)
        if answer is not None and len(answer.data) == register.size:
            self._telemetry.take_current(index, register, answer.data)
            self.judge_loads([index], now_s)

    def _look_at_alerts(self, link: RegisterLink, fresh: Sequence[int], now_s: float) -> None:
        """Ask those whose alert bit has just come on what is wrong; who is not told of now is asked next time."""
        asked = fresh[:_ALERTS_READ]
        told = self.read_some(link, "alerts", self._telemetry.health, asked) if asked else {}
        self._flagged -= set(fresh) - told.keys()
        self._take_health(told, now_s)

    def _take_health(self, answers: Mapping[int, Answer], now_s: float) -> None:
        telemetry = self._telemetry
        for servo, answer in answers.items():
            if len(answer.data) == telemetry.health[1]:
                member = self._by_id[servo]
                torque, bits = telemetry.health_of(answer.data)
                if telemetry.error is not None:
                    member.take_bits(bits, telemetry.measured(member.index), now_s)
                member.take_torque(torque, now_s)


def _status_bits(member: Member) -> int:
    """Bits of a status packet's error byte that are about the servo; the others are about the request."""
    return sum(1 << bit for bit in member.table.status_faults)


def blocks_per_tick(servos: int, spare_s: float, positions_s: float, blocks_s: Callable[[int], float]) -> int:
    """Return how many servos' blocks fit in `spare_s` beside all positions; all where one read does for both.

    Args:
        positions_s: time of reading all positions.
        blocks_s: returns the time of reading so many blocks.
    """
    if blocks_s(servos) <= spare_s:
        return servos
    return max((count for count in range(2, servos + 1) if positions_s + blocks_s(count) <= spare_s), default=1)


class Rotation:
    """Turns of servos, `count` at a time."""

    def __init__(self) -> None:
        self._next = 0

    def take(self, servos: Sequence[int], count: int) -> list[int]:
        """Return the next `count` of `servos`, in their own order; one that is missing from the list loses no turn."""
        if count >= len(servos):
            return list(servos)
        start = self._next % len(servos)
        self._next = start + count
        chosen = {servos[(start + k) % len(servos)] for k in range(count)}
        return [servo for servo in servos if servo in chosen]
