"""Who looks at the page, what each is still to be told, and who of them holds the controls.

1. Pictures: the newest wins. Who reads slowly sees fewer of them, not older ones.
2. Everything else waits in order, up to `OUTBOX` messages; who is that far behind is sent away.
3. Controls: whoever asks first has them, until they are given back, the connection ends, or somebody else asks after
   `IDLE_S` in which they were not used. Halting needs no controls.
4. Where there is a token (the server is bound beyond loopback), who has not shown it only looks.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterator
from typing import Final

from sfms_robot.errors import PacketError
from sfms_robot.origin import token_admits
from sfms_robot.viewer.frame_record import told_json
from sfms_robot.viewer.visitor_commands import VERSION, Command

MOST_VISITORS: Final = 32
OUTBOX: Final = 200
IDLE_S: Final = 30.0
MOST_MALFORMED: Final = 100
COMMAND_S: Final = 0.004  # that one command is given, when many come
PERSON_S: Final = 0.001  # and a piece of sound, or a face
PERSON_BYTES_PER_S: Final = 4e6
BURST_S: Final = 0.25
FREE: Final = ("hello", "ping", "take", "give")  # commands that take no controls


class Visitor:
    """One page that is connected, or another program that looks.

    Attributes:
        number: no other one has had it.
        allowed: it has shown the token, or there is none.
        malformed: messages of it that could not be used.
        used_s: when it last did something that takes the controls.
    """

    def __init__(self, number: int, allowed: bool, now_s: float) -> None:
        self.number = number
        self.allowed = allowed
        self.malformed = 0
        self.used_s = now_s
        self.behind = False
        self._picture: str | None = None
        self._outbox: deque[str] = deque()
        self._something = asyncio.Event()
        self._due_s = now_s - BURST_S

    def tell(self, message: bytes) -> None:
        """In order behind what still waits."""
        self.behind = self.behind or len(self._outbox) >= OUTBOX
        self._outbox.append(message.decode())
        self._something.set()

    def show(self, picture: str) -> None:
        """Instead of an older one that was not sent yet."""
        self._picture = picture
        self._something.set()

    async def next(self) -> str:
        """What is to be sent now; waits until there is something."""
        await self._something.wait()
        if self._outbox:
            message = self._outbox.popleft()
        else:
            message, self._picture = self._picture or "", None
        if not self._outbox and self._picture is None:
            self._something.clear()
        return message

    def pause_s(self, cost_s: float, now_s: float) -> float:
        """For how long nothing more of it is to be read, after a message that costs so much."""
        self._due_s = max(self._due_s, now_s - BURST_S) + cost_s
        return max(0.0, self._due_s - now_s)


class Visitors:
    """Everybody who is connected.

    Args:
        token: what who wants more than to look has to show; None: nothing.
        left: is told who has lost the controls, or has gone.
        now: a monotonic clock [s].
    """

    def __init__(self, token: str | None, left: Callable[[int], None], now: Callable[[], float]) -> None:
        self._token = token
        self._left = left
        self._now = now
        self._by_number: dict[int, Visitor] = {}
        self._came = 0
        self._holder: Visitor | None = None

    def __len__(self) -> int:
        return len(self._by_number)

    def __iter__(self) -> Iterator[Visitor]:
        return iter(tuple(self._by_number.values()))

    def get(self, number: int) -> Visitor | None:
        return self._by_number.get(number)

    def enter(self) -> Visitor:
        """Raises PacketError when there are too many."""
        if len(self._by_number) >= MOST_VISITORS:
            raise PacketError(f"{MOST_VISITORS} visitors look at this head already")
        self._came += 1
        visitor = Visitor(self._came, self._token is None, self._now())
        self._by_number[visitor.number] = visitor
        return visitor

    def leave(self, visitor: Visitor) -> None:
        """It has gone."""
        self._by_number.pop(visitor.number, None)
        if visitor is self._holder:
            self._pass_on(None)

    def controls(self, visitor: Visitor) -> str:
        """Who holds them, as `visitor` is told: you, other, nobody."""
        return "nobody" if self._holder is None else "you" if visitor is self._holder else "other"

    def greeted(self, visitor: Visitor, hello: Command) -> None:
        """A page says which version it is of, and shows its token. Raises PacketError where either is wrong."""
        if hello.values["version"] != VERSION:
            raise PacketError(f"this page is of version {hello.values['version']}, not {VERSION}: load it anew")
        token = hello.values["token"]
        if self._token is not None and token:
            if not token_admits(token, self._token):
                raise PacketError("the token is not the one that was printed when the robot started")
            visitor.allowed = True
        visitor.tell(self._controls_json(visitor))

    def take(self, visitor: Visitor) -> None:
        """It asks for the controls. Raises PacketError where it cannot have them."""
        _check_allowed(visitor)
        now_s, holder = self._now(), self._holder
        if holder is not None and holder is not visitor and now_s - holder.used_s < IDLE_S:
            raise PacketError("somebody else holds the controls")
        visitor.used_s = now_s
        if visitor is not holder:
            self._pass_on(visitor)

    def give(self, visitor: Visitor) -> None:
        """It gives them back."""
        if visitor is self._holder:
            self._pass_on(None)
        else:
            visitor.tell(self._controls_json(visitor))

    def admit(self, visitor: Visitor, command: Command) -> None:
        """Whether it may do that now: the controls are taken where nobody has them. Raises PacketError."""
        if command.name == "halt":
            _check_allowed(visitor)
        elif command.name not in FREE:
            self.take(visitor)

    def holds(self, visitor: Visitor) -> bool:
        """Whether it has the controls; that counts as use."""
        if visitor is not self._holder:
            return False
        visitor.used_s = self._now()
        return True

    def _pass_on(self, visitor: Visitor | None) -> None:
        before, self._holder = self._holder, visitor
        if before is not None:
            self._left(before.number)
        for each in self:
            each.tell(self._controls_json(each))

    def _controls_json(self, visitor: Visitor) -> bytes:
        return told_json(type="controls", held=self.controls(visitor), needs_token=not visitor.allowed)


def _check_allowed(visitor: Visitor) -> None:
    if not visitor.allowed:
        raise PacketError("the token is needed for this: it was printed when the robot started")
