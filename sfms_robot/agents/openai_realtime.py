"""A head for a realtime session, in OpenAI's protocol, also of vLLM-Omni and other servers. Sound is 24 kHz PCM.

    await converse("wss://api.openai.com/v1/realtime?model=gpt-realtime", robot, microphone, key=KEY)

holds a whole conversation over a WebSocket. A program that already has a client keeps it, and passes the events that it
sends and receives to a `RealtimeHead`, as dicts:

    client's event                       server's event                                     the head
    input_audio_buffer.append                                                               hears the person
                                         response.output_audio.delta, response.audio.delta  speaks
                                         input_audio_buffer.speech_started                  hushes
"""

from __future__ import annotations

import asyncio
import base64
import json
import time
from collections.abc import AsyncIterable, Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, ConnectionClosedOK, InvalidStatus, WebSocketException

from sfms_robot import InputError, PortError
from sfms_robot.agents import HeadLink

if TYPE_CHECKING:
    from sfms_robot import Robot

RATE_HZ: Final = 24_000
DELTAS: Final = ("response.output_audio.delta", "response.audio.delta")  # by its present and its older name
_BYTES_PER_S: Final = 2 * RATE_HZ
_LONGEST_MESSAGE: Final = 2**24

Event = Mapping[str, Any]


class RealtimeHead:
    """Reaction of a head to the events of a session. Opens nothing; a bad event is left out and logged.

    Args:
        robot: a robot that is running.
        now: a monotonic clock [s].
    """

    def __init__(self, robot: Robot, now: Callable[[], float] = time.monotonic) -> None:
        self.robot_link = HeadLink(robot, "realtime")
        self._now = now
        self._item: tuple[str, int] | None = None  # id and content index of the present speech
        self._cut: str | None = None  # the item that was interrupted: the rest of it is not spoken
        self._given_s = self._began_s = 0.0

    def sent(self, event: Event) -> None:
        """Process an event of the client, which may hold the person's sound."""
        if event.get("type") == "input_audio_buffer.append":
            pcm = self._decoded("voice", event.get("audio"))
            if pcm:
                self.robot_link.hear(pcm, RATE_HZ)

    def received(self, event: Event) -> tuple[bytes, Event | None]:
        """Process an event of the server. Return PCM to play, b"" if there is none, and an event to send back, or None.

        After an interruption, the returned event reports to the server how much of its answer was played.
        """
        kind = event.get("type")
        if kind in DELTAS:
            return self._speak(event), None
        if kind == "input_audio_buffer.speech_started":
            return b"", self._interrupted()
        if kind == "error":
            error = event.get("error")
            self.robot_link.problem("error", error.get("message") if isinstance(error, Mapping) else error)
        return b"", None

    def _speak(self, event: Event) -> bytes:
        item, pcm = str(event.get("item_id", "")), self._decoded("speech", event.get("delta"))
        if not pcm or (item and item == self._cut):
            return b""
        index = event.get("content_index", 0)
        if self._item != (item, index) or self._unplayed_s() <= 0.0:
            played_before_s = self._given_s if self._item == (item, index) else 0.0
            self._began_s = max(self._now(), self._began_s + self._given_s) - played_before_s
            self._item, self._given_s = (item, index), played_before_s
        self._given_s += len(pcm) / _BYTES_PER_S
        self.robot_link.say(pcm, RATE_HZ)
        return pcm

    def _interrupted(self) -> Event | None:
        self.robot_link.hush()
        item, unplayed_s, given_s = self._item, self._unplayed_s(), self._given_s
        self._item, self._given_s, self._began_s = None, 0.0, 0.0
        if item is None or not item[0] or unplayed_s <= 0.0:
            return None
        self._cut = item[0]
        played_ms = max(0, round(1e3 * (given_s - unplayed_s)))
        place = {"item_id": item[0], "content_index": item[1], "audio_end_ms": played_ms}
        return {"type": "conversation.item.truncate", **place}

    def _unplayed_s(self) -> float:
        """Return how much of the item was not played [s], if it is played from its first piece on."""
        return self._began_s + self._given_s - self._now()

    def _decoded(self, what: str, text: object) -> bytes:
        """Return the bytes of base64; b"" for other text, and for a piece that is not of 16-bit samples."""
        try:
            pcm = base64.b64decode(text, validate=True) if isinstance(text, str) else None
        except ValueError:
            pcm = None
        if pcm is None or len(pcm) % 2:
            got = f"{len(pcm)} bytes" if pcm is not None else repr(text)[:40]
            self.robot_link.problem(what, f"expected base64 of 16-bit samples, got {got}")
            return b""
        return pcm


async def converse(
    url: str,
    robot: Robot,
    microphone: AsyncIterable[bytes],
    *,
    key: str = "",
    session: Event | None = None,
    play: Callable[[bytes], object] | None = None,
    stop: Callable[[], object] | None = None,
    seen: Callable[[Event], object] | None = None,
) -> None:
    """Hold a conversation until the microphone ends, or the server closes it.

    Args:
        url: ws:// or wss:// address of the session.
        robot: a robot that is running; if it was made with `play=`, it plays the answers itself.
        microphone: pieces of the person's sound as they come, 24 kHz, 16-bit, mono, 20 to 100 ms each.
        key: sent as a bearer token.
        session: sent first, as `session.update`.
        play: called with each piece of an answer, 24 kHz PCM, faster than it is played.
        stop: called when the person interrupts: drop what was not played.
        seen: called with every event of the server, for transcripts and tools.

    Raises PortError, in one line, if the server cannot be reached, refuses the key, or breaks off.
    """
    if not isinstance(url, str) or not url.startswith(("ws://", "wss://")):
        raise InputError(f"url: expected ws://... or wss://..., got {url!r}")
    place = url.split("?")[0]
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    try:
        async with connect(url, additional_headers=headers, max_size=_LONGEST_MESSAGE) as socket:
            if session is not None:
                await socket.send(json.dumps({"type": "session.update", "session": session}))
            head = RealtimeHead(robot)

            async def send() -> None:
                async for pcm in microphone:
                    event = {"type": "input_audio_buffer.append", "audio": base64.b64encode(pcm).decode()}
                    head.sent(event)
                    if len(pcm) % 2 == 0:
                        await socket.send(json.dumps(event))

            async def receive() -> None:
                async for text in socket:
                    if not isinstance(event := _plain(text), dict):
                        head.robot_link.problem("message", f"expected a JSON object, got {text[:40]!r}")
                        continue
                    pcm, reply = head.received(event)
                    if pcm and play is not None:
                        play(pcm)
                    if event.get("type") == "input_audio_buffer.speech_started" and stop is not None:
                        stop()
                    if reply is not None:
                        await socket.send(json.dumps(reply))
                    if seen is not None:
                        seen(event)

            tasks = map(asyncio.ensure_future, (send(), receive()))
            done, others = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in others:
                task.cancel()
            await asyncio.gather(*done, *others, return_exceptions=True)
            for task in done:
                task.result()
    except ConnectionClosedOK:
        return
    except InvalidStatus as error:
        status = error.response.status_code
        why = "the key is refused" if status in (401, 403) else "expected a WebSocket of a realtime session"
        raise PortError(f"{place}: HTTP {status}: {why}") from None
    except ConnectionClosed as error:
        raise PortError(f"{place}: the server broke off: {error.rcvd or 'without a reason'}") from None
    except (OSError, WebSocketException) as error:
        raise PortError(f"{place}: cannot connect: {str(error) or type(error).__name__}") from None


def _plain(text: str | bytes) -> Any:
    """Return the value of a JSON text; None for another text."""
    with suppress(ValueError):
        return json.loads(text)
    return None
