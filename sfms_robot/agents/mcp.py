"""A running head as tools of an assistant, over the Model Context Protocol: `sfms-robot mcp`.

Each tool connects to the page of a run (`run --view`), sends one command of its protocol (docs/reference/protocol.md),
and answers once the pictures after it have arrived, which shows that the run has accepted it, or with the error of the
run. An assistant may halt the head, but cannot resume it: only a person who sees the head may.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from typing import Any, Final
from urllib.parse import urlsplit

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException

from sfms_robot import ConfigError, PortError, RobotError
from sfms_robot.errors import INTERRUPTED, optional

with optional("sfms-robot mcp"):
    from mcp.server import MCPServer
    from mcp.server.mcpserver.exceptions import ToolError

LIMIT_S: Final = 5.0  # to connect, and for an answer
PICTURES: Final = 5  # pictures to wait for, 0.2 s: an error of the run arrives before them
MOST_PICTURES: Final = 50  # pictures to wait for a state, at most
_LONGEST_MESSAGE: Final = 2**24
_INSTRUCTIONS: Final = """Tools that move the face of a robot head which listens to a person by itself.
What a tool shows replaces its listening for some seconds. Motion keeps the head's limits. Call halt when anything
seems wrong; only a person can resume it. status names the expressions and channels of this head."""


class HeadPage:
    """The page of a running head, by its address.

    Args:
        url: ws://HOST:PORT, as `run --view` prints it.
        token: printed by a run whose page is bound beyond loopback.

    Raises ConfigError for an invalid address.
    """

    def __init__(self, url: str, token: str = "") -> None:
        schemes = {"ws": "ws", "http": "ws", "wss": "wss", "https": "wss"}
        try:
            parts = urlsplit(url)
            known = parts.scheme in schemes and parts.hostname and parts.port != 0
        except ValueError:  # a port that is not a number
            known = False
        if not known:
            raise ConfigError(f"--url: expected ws://HOST:PORT, got {url!r}")
        self._url, self._token = f"{schemes[parts.scheme]}://{parts.netloc}/ws", token

    async def status(self) -> dict[str, Any]:
        """Return names, channels and expressions of the head, and the status of the run. Raises RobotError."""
        async with self._connected() as (socket, hello):
            known = {key: hello.get(key) for key in ("head", "listener", "over")}
            known["channels"], known["expressions"] = hello.get("channels"), sorted(hello.get("expressions") or {})
            if not hello.get("over"):
                known |= (await _next(socket, "status"))["status"]
            return known

    async def command(self, name: str, /, until: str | None = None, **values: Any) -> str:
        """Send a command, and return the state of the head once the run has accepted it.

        `until`: wait for this state, 2 s at most. Raises RobotError with the run's own line if it refuses.
        """
        async with self._connected(allowed=True) as (socket, hello):
            if hello.get("over"):
                raise PortError("the run has ended: start another one (sfms-robot run --view)")
            await socket.send(json.dumps({"type": name, **values}))
            state = ""
            for picture in range(PICTURES if until is None else MOST_PICTURES):
                if picture >= PICTURES and state == until:
                    break
                state = str((await _next(socket, "frame")).get("s"))
            return state

    @asynccontextmanager
    async def _connected(self, allowed: bool = False) -> AsyncIterator[tuple[ClientConnection, Mapping[str, Any]]]:
        """Yield a connection and the page's hello; `allowed`: with the right to do more than watch.

        Raises PortError and ConfigError, in one line.
        """
        try:
            async with (
                asyncio.timeout(2 * LIMIT_S),
                connect(self._url, open_timeout=LIMIT_S, max_size=_LONGEST_MESSAGE) as socket,
            ):
                hello = await _next(socket, "hello")
                if allowed and hello.get("needs_token"):
                    if not self._token:
                        raise ConfigError("--token: the page needs the token that the run printed when it started")
                    await socket.send(json.dumps({"type": "hello", "version": 1, "token": self._token}))
                    while (await _next(socket, "controls")).get("needs_token"):
                        pass  # it was sent because of another visitor
                yield socket, hello
        except ConnectionClosed as error:
            raise PortError(f"{self._url}: the run closed the connection: {error.rcvd or 'without a reason'}") from None
        except TimeoutError:
            raise PortError(f"{self._url}: no answer within {LIMIT_S:g} s") from None
        except (OSError, WebSocketException) as error:
            raise PortError(f"{self._url}: no head is there ({error}): start one with sfms-robot run --view") from None


async def _next(socket: ClientConnection, kind: str) -> dict[str, Any]:
    """Return the next message of a kind. Raises PortError for an error of the page, and for another protocol."""
    async with asyncio.timeout(LIMIT_S):
        async for text in socket:
            try:
                message = json.loads(text)
                found = message["type"]
            except (ValueError, TypeError, KeyError):
                raise PortError(f"expected the page of a run, got {text[:40]!r}") from None
            if found == "error":
                raise PortError(str(message.get("error")))
            if found == kind:
                return dict(message)
    raise PortError("the run closed the connection")


def server(page: HeadPage) -> MCPServer:
    """Return an MCP server whose tools move the head behind `page`."""

    async def told(name: str, /, until: str | None = None, **values: Any) -> str:
        try:
            state = await page.command(name, until, **values)
        except RobotError as error:
            raise ToolError(str(error)) from None
        still = ": nothing moves until a person resumes it" if state == "halted" else ""
        return f"{name}: taken; the head is {state}{still}"

    async def show(channels: dict[str, float], seconds: float = 0.5) -> str:
        """Show a face: values by channel (ARKit names 0..1; roll, pitch, yaw in radians), for some seconds."""
        return await told("show", channels=channels, seconds=seconds)

    async def expression(name: str, seconds: float = 2.0) -> str:
        """Show an expression by its name, for some seconds. status lists the names."""
        return await told("expression", name=name, seconds=seconds)

    async def look_at(x_m: float, y_m: float, z_m: float, seconds: float = 2.0) -> str:
        """Look at a place in metres from the middle of the head: x forward, y to the head's left, z up."""
        return await told("look_at", x_m=x_m, y_m=y_m, z_m=z_m, seconds=seconds)

    async def calm(rates: dict[str, float | None]) -> str:
        """Set how often the head does things, in events a minute by kind (nod, smile, ...); null: as people do."""
        return await told("calm", rates=rates)

    async def halt() -> str:
        """Stop all motion at once, in an emergency. Only a person can resume the head."""
        return await told("halt", until="halted")

    async def status() -> dict[str, Any]:
        """Return the head's name, state, joints and faults, and the expressions and channels that it can show."""
        try:
            return await page.status()
        except RobotError as error:
            raise ToolError(str(error)) from None

    made = MCPServer("sfms-robot", instructions=_INSTRUCTIONS, log_level="WARNING")
    for tool in (show, expression, look_at, calm, halt, status):
        made.add_tool(tool)
    return made


def serve(url: str, token: str) -> None:
    """Serve the tools on stdin and stdout until stdin ends, in the main thread.

    Ctrl-C and SIGTERM end the process. Raises ConfigError for an invalid address.
    """
    tools = server(HeadPage(url, token))
    for number in (signal.SIGINT, signal.SIGTERM):  # a thread that waits for stdin cannot be interrupted
        signal.signal(number, lambda *_: os._exit(INTERRUPTED))
    tools.run()
