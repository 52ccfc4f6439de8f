"""Adapters for voice agents: a head receives the sound of person and agent, the agent receives the head's events.

    pipecat           a processor and an observer         livekit   taps of a session's sound
    openai_realtime   a conversation over a WebSocket     mcp       a running head as tools of an assistant

The first three need a `sfms_robot.Robot` of this process, `mcp` the address of a run's page. They use only the public
API of this package, as any program may.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Final

import numpy as np

from sfms_robot import ConfigError, ListenerEvent, RobotError

if TYPE_CHECKING:
    from sfms_robot import Robot

log = logging.getLogger(__name__)

KINDS: Final = ("nod", "mm_hm", "smile")  # events that an agent can use; a head also blinks, tilts, looks away, ...
_PCM16: Final = np.dtype("<i2")
_PROBLEMS: Final = 5  # different problems logged for each direction; all are counted


class HeadLink:
    """Link of an agent's event loop to a robot. Unusable sound is left out and logged; the agent continues.

    Args:
        robot: a robot that is running, or will be.
        way: name of the adapter, in logs.

    Attributes:
        refused: count of pieces of sound that were left out, by "voice" (of the person) and "speech" (of the agent).
    """

    def __init__(self, robot: Robot, way: str) -> None:
        self._robot, self._way = robot, way
        self._loop: asyncio.AbstractEventLoop | None = None
        self._named = set[tuple[str, str]]()
        self.refused = Counter[str]()

    def hear(self, pcm: bytes, rate_hz: float, channels: int = 1) -> None:
        """Send the robot the person's present sound, 16-bit little-endian, interleaved. Never blocks or raises."""
        self._hand_over("voice", lambda: self._robot.hear(_mono(pcm, channels), rate_hz))

    def say(self, pcm: bytes, rate_hz: float, channels: int = 1) -> None:
        """Send the robot the agent's next speech, as `hear` does."""
        self._hand_over("speech", lambda: self._robot.say(_mono(pcm, channels), rate_hz))

    def hush(self) -> None:
        """Drop the speech that was not played yet."""
        self._hand_over("speech", self._robot.hush)

    def on(self, kinds: Sequence[str], take: Callable[[ListenerEvent], object]) -> None:
        """Call `take` in the event loop with each event of `kinds`, from `open` until `close`.

        Raises InputError for an unknown kind.
        """

        def arrived(event: ListenerEvent) -> None:
            if self._loop is not None:
                take(event)

        def decided(event: ListenerEvent) -> None:  # in the robot's thread
            loop = self._loop
            if loop is not None:
                with suppress(RuntimeError):  # the loop has ended
                    loop.call_soon_threadsafe(arrived, event)

        for kind in kinds:
            self._robot.on(kind, decided)

    def open(self) -> None:
        """Pass events on from now on, in the running event loop."""
        self._loop = asyncio.get_running_loop()

    def close(self) -> None:
        """Stop passing events on."""
        self._loop = None

    def problem(self, what: str, problem: object) -> None:
        """Count a piece that was left out, and log the problem unless it was logged before."""
        self.refused[what] += 1
        found = (what, str(problem))
        if found not in self._named and sum(each == what for each, _ in self._named) < _PROBLEMS:
            self._named.add(found)
            log.warning("%s: %s: %s (said once)", self._way, *found)

    def _hand_over(self, what: str, hand_over: Callable[[], None]) -> None:
        try:
            hand_over()
        except RobotError as error:  # bad sound, or a robot that accepts no sound of programs
            self.problem(what, error)


async def events(robot: Robot, *kinds: str) -> AsyncIterator[ListenerEvent]:
    """Yield the events of a robot, in an event loop: `async for event in events(robot, "nod", "mm_hm")`.

    Without `kinds`, yields those of `KINDS`. Raises InputError for an unknown kind.
    """
    link, waiting = HeadLink(robot, "events"), asyncio.Queue[ListenerEvent]()
    link.on(kinds or KINDS, waiting.put_nowait)
    link.open()
    try:
        while True:
            yield await waiting.get()
    finally:
        link.close()


def _mono(pcm: bytes, channels: int) -> bytes:
    """Return the mean of interleaved channels. Raises ConfigError if the bytes are not whole samples of each."""
    if channels == 1:
        return pcm
    if not isinstance(channels, int) or channels < 1:
        raise ConfigError(f"channels: expected a whole number of 1 or more, got {channels!r}")
    if not isinstance(pcm, bytes | bytearray | memoryview):
        raise ConfigError(f"pcm: expected bytes, got {type(pcm).__name__}")
    if len(pcm) % (_PCM16.itemsize * channels):
        raise ConfigError(f"pcm: expected 16-bit samples in {channels} channels, got {len(pcm)} bytes")
    mixed: bytes = np.frombuffer(pcm, _PCM16).reshape(-1, channels).mean(axis=1).astype(_PCM16).tobytes()
    return mixed
