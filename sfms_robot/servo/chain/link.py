"""Registers over a wire, whatever the protocol: what buses, tools and startup need of a link.

A request to one servo gives None where nobody answered; the error byte of an answer is the protocol's own. A request
blocks until all answers are there, or no byte came for `silence_s` beyond the time that the bytes take on the wire.
Inside `within` all requests share one allowance of silence, so that a poll costs one silence whoever is dead.
Whatever is asked for with `grants` is asked in the end, also on a wire that is too slow for its budget.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Final, NamedTuple

from sfms_robot.config.wire_time import BITS, Framing
from sfms_robot.servo.port import Port

log = logging.getLogger(__name__)

CHUNK: Final = 4096
NO_PATIENCE: Final = 10  # read deadlines that rubbish on the wire may cost before a request is given up
LATE_S: Final = 0.25  # that a purpose waits for room in a budget before it gets a request of its own
AWAY_LATE_S: Final = 0.05  # the same for who is away
_SPENT_LATE_S: Final = 1.0  # the same where the time is there, and others' silence has used it up
_SLACK_S: Final = 0.001  # of a request that is granted, for a busy computer
_ADAPTER_S: Final = 0.05  # the longest that an adapter may hold an answer back
_SAMPLES: Final = 3
_MARGIN: Final = 1.25


class Found(NamedTuple):
    """Who answered a ping. None where the protocol's ping does not tell."""

    model_number: int | None
    firmware: int | None


class Answer(NamedTuple):
    """One servo's answer: the error byte as it came, and the data read (empty for a write)."""

    error: int
    data: bytes


class RegisterLink(ABC):
    """One wire of servos that have registers. Raises BusError when the port is gone, never for a silent servo.

    Args:
        port: owned by the link from now on.
        baud: bits per second, to tell how long bytes take.
        silence_s: how long to wait for the next byte before the servo counts as silent.

    Attributes:
        framing: bytes of its packets.
        judged: whether the last request waited that long. Inside `within` it may not have, and then who did not answer
            may still be there.
    """

    framing: Framing

    def __init__(self, port: Port, baud: int, silence_s: float) -> None:
        self.port = port
        self.silence_s = silence_s
        self.judged = True
        self._byte_s = BITS / baud
        self._end_s = math.inf
        self._left_s = math.inf
        self._refused_s: dict[str, float] = {}  # since when a purpose has found no room

    @abstractmethod
    def ping(self, servo: int) -> Found | None: ...

    @abstractmethod
    def broadcast_ping(self) -> dict[int, Found]:
        """Everybody who answers at this baud, by id; waits the whole window that 253 answers may take."""

    @abstractmethod
    def read(self, servo: int, address: int, length: int) -> Answer | None: ...

    @abstractmethod
    def write(self, servo: int, address: int, data: bytes) -> Answer | None:
        """The acknowledgement, or None when there was none: the servo may have taken it all the same."""

    @abstractmethod
    def refusal(self, answer: Answer) -> str:
        """Why a request was refused, in words; empty when it was done, whatever else the servo complains of."""

    @abstractmethod
    def reboot(self, servo: int) -> Answer | None: ...

    @abstractmethod
    def factory_reset(self, servo: int, option: int) -> Answer | None:
        """0xFF everything; Protocol 2.0 also 1 all but the id, 2 all but id and baud."""

    @abstractmethod
    def sync_write(self, address: int, values: Mapping[int, bytes]) -> None:
        """One packet for all; values have one length. Nothing answers."""

    @contextmanager
    def patient(self, silence_s: float) -> Iterator[None]:
        """Wait at least `silence_s` for answers inside the block."""
        usual, self.silence_s = self.silence_s, max(self.silence_s, silence_s)
        try:
            yield
        finally:
            self.silence_s = usual

    @contextmanager
    def within(self, budget_s: float, silence_s: float) -> Iterator[None]:
        """A time budget for the requests inside the block, which those who make them ask `affords` about.

        Args:
            budget_s: until then all requests are over.
            silence_s: waiting for answers that do not come, all requests together; a request whose turn comes when
                that is used up waits for nothing beyond what its bytes take.
        """
        self._end_s, self._left_s = self.port.now_s() + budget_s, silence_s
        try:
            yield
        finally:
            self._end_s = self._left_s = math.inf
            self.judged = True

    def affords(self, bytes_on_wire: int, alone: bool = False) -> bool:
        """Whether a request that takes so many bytes, answer included, is over in time even when nobody answers.

        `alone`: it asks for somebody who may well be silent, so it is of use only if that can be found out.
        """
        if alone and self._left_s < self.silence_s:
            return False
        allowance_s = min(self.silence_s, self._left_s)
        return self.port.now_s() + bytes_on_wire * self._byte_s + allowance_s <= self._end_s

    def grants(self, purpose: str, bytes_on_wire: int, alone: bool = False, late_s: float = LATE_S) -> bool:
        """As `affords`; and what a purpose has been refused for `late_s` it gets once, whatever is left.

        At 57600 baud, or with an adapter that holds every answer back for 16 ms, the first read uses a budget up, in
        every poll: nobody who was away would ever be found, and no fault be heard of.
        """
        if self.affords(bytes_on_wire, alone):
            self._refused_s.pop(purpose, None)
            return True
        now_s = self.port.now_s()
        patience_s = late_s if self._left_s >= self.silence_s else _SPENT_LATE_S
        if now_s - self._refused_s.setdefault(purpose, now_s) < patience_s:
            return False
        del self._refused_s[purpose]
        self._left_s = max(self._left_s, self.silence_s)
        self._end_s = max(self._end_s, now_s + bytes_on_wire * self._byte_s + self.silence_s + _SLACK_S)
        return True

    def _allowance_s(self) -> float:
        """Silence that the next request may wait for."""
        allowance_s = min(self.silence_s, self._left_s)
        self.judged = allowance_s >= self.silence_s
        return allowance_s

    def _rubbish_s(self) -> float:
        """What bytes that are no answer may cost a request."""
        return NO_PATIENCE * self.silence_s if self._left_s == math.inf else 0.0

    def _waited(self, in_vain_s: float) -> None:
        """A request was not answered by everybody."""
        self._left_s = max(0.0, self._left_s - in_vain_s)

    def wait(self, duration_s: float) -> None:
        """Let so long go by on the port's clock, in virtual time too."""
        if duration_s > 0.0:
            self.port.wait_until(self.port.now_s() + duration_s)

    def rest(self, duration_s: float) -> None:
        """Leave the wire alone for so long; in virtual time that is no time. What comes meanwhile is dropped."""
        end_s = self.port.now_s() + duration_s
        while self.port.read(CHUNK, end_s):
            pass

    def adapt(self, servo: int, address: int, length: int) -> float:
        """Wait longer from now on where the adapter holds answers back: it would make every servo silent.

        Seconds of silence that are waited for now.
        """
        held_s = 0.0
        with self.patient(_ADAPTER_S):
            for _ in range(_SAMPLES):
                asked_s = self.port.now_s()
                if self.read(servo, address, length) is not None:
                    wire_s = self.framing.reads(1, length, "one by one") * self._byte_s
                    held_s = max(held_s, self.port.now_s() - asked_s - wire_s)
        if held_s > self.silence_s:
            self.silence_s = _MARGIN * held_s
            log.warning(
                "%s: an answer is held back for %.1f ms, so a silent servo costs %.1f ms; `sfms-robot doctor` says "
                "what to do",
                self.port.name, held_s * 1e3, self.silence_s * 1e3,
            )  # fmt: skip
        return self.silence_s
