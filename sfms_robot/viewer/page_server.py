"""The page over HTTP and its WebSocket, in the page's process: what a run tells goes to all visitors, once encoded.

    /                  the page              /static/...     what it loads
    /ws                the protocol          /human/head.bin the virtual human (`face.human`)
    /robot/robot.urdf  the robot, and beside it the meshes that it names
    /face_landmarker.task  the model by which a page sees its visitor's face
    /runs/last         the run so far, or the last one: its messages, a line of JSON each
    /recording         the file of what was recorded; beyond loopback with ?token=

Pages of others may not connect (`origin`), and a request that calls this machine by a name that is not its own is not
answered: else any page of the web could have itself served from here.
"""

from __future__ import annotations

import asyncio
import gzip
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, Protocol

from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from sfms_robot.data import data_dir
from sfms_robot.errors import PacketError
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.frames import FRAME_HZ
from sfms_robot.origin import host_problem, origin_problem, token_admits
from sfms_robot.viewer.compressed_files import CompressedFiles, human_gz
from sfms_robot.viewer.frame_record import Shown, frame_json, told_json
from sfms_robot.viewer.page_process import Asked
from sfms_robot.viewer.visitor_commands import Command, parse_command
from sfms_robot.viewer.visitors import COMMAND_S, MOST_MALFORMED, PERSON_BYTES_PER_S, PERSON_S, Visitor, Visitors

NewScene = Callable[[], RobotScene | None]
URDF: Final = "robot/robot.urdf"
STATIC: Final = Path(__file__).with_name("static")
KEPT_FRAMES: Final = 600 * FRAME_HZ  # of the run, for /runs/last: ten minutes
_LINES_AT_ONCE: Final = 10  # of a platform each takes a millisecond and a half
_HEADERS: Final = (
    (b"content-security-policy", b"default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; "
     b"worker-src 'self' blob:; connect-src 'self' ws: wss:; img-src 'self' data: blob:; "
     b"style-src 'self' 'unsafe-inline'; frame-ancestors 'none'"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cache-control", b"no-cache"),
)  # fmt: skip


def no_scene() -> RobotScene | None:
    """Of a head without a picture."""
    return None


class Run(Asked, Protocol):
    """A run as the page's server sees it: takes what visitors ask for. Never blocks."""

    def watched(self, visitors: int) -> None:
        """Note how many visitors are connected now."""


class PageServer:
    """One page, whatever runs behind it. All in the thread of one event loop.

    Args:
        run: who does what visitors ask for.
        token: see `Visitors`.
        now: a monotonic clock [s].

    Attributes:
        app: for an ASGI server.
    """

    def __init__(self, run: Run, token: str | None, now: Callable[[], float] = time.monotonic) -> None:
        self._run, self._token, self._now = run, token, now
        self._visitors = Visitors(token, run.left, now)
        self._hello: dict[str, Any] = {}
        self._began = asyncio.Event()  # there is a hello
        self._new_scene: NewScene = no_scene
        self._scene: RobotScene | None = None
        self._human: asyncio.Task[bytes] | None = None
        self._record: Mapping[str, Any] | None = None
        self._recording: Path | None = None
        self._over: Mapping[str, Any] | None = None  # the report
        self._history: deque[tuple[bool, bytes]] = deque(maxlen=KEPT_FRAMES)  # packed pictures, and messages
        self._files = CompressedFiles(STATIC)
        routes = [
            Route("/", self._index),
            Route("/runs/last", self._last_run),
            Route("/recording", self._download),
            Route("/human/head.bin", self._human_mesh),
            Route("/robot/{file:path}", self._robot),
            Route("/face_landmarker.task", self._face_model),
            WebSocketRoute("/ws", self._visit),
            Mount("/static", self._files),
        ]
        self.app: ASGIApp = guarded_app(Starlette(routes=routes))

    # --- what the run tells ---

    def prepare(self) -> None:
        """Make what takes a second, in threads; a page waits for it."""
        self._human = asyncio.create_task(asyncio.to_thread(human_gz))
        self._files.prepare()

    def begin(self, hello: Mapping[str, Any], new_scene: NewScene = no_scene) -> None:
        """A run begins: what a page has to know of it. What is left of the last one is forgotten.

        `new_scene`: makes the picture of its head. One remembers where it was; a replay has its own.
        """
        self._new_scene, self._scene, self._over = new_scene, new_scene(), None
        scene: dict[str, Any] = {} if self._scene is None else {"urdf": URDF, "urdf_joints": self._scene.joints}
        self._hello = {**hello, **scene}
        self._history.clear()
        self._began.set()
        for visitor in self._visitors:
            visitor.tell(self._hello_json(visitor))

    def show(self, record: bytes) -> None:
        """A packed picture, to everybody."""
        self.keep(record)
        if len(self._visitors):
            picture = frame_json(record, _values(self._scene)).decode()
            for visitor in self._visitors:
                visitor.show(picture)

    def keep(self, record: bytes) -> None:
        """A packed picture, for /runs/last alone: a newer one is here already."""
        self._history.append((True, record))

    def tell(self, message: bytes, keep: bool = True) -> None:
        """A message of docs/protocol.md, to everybody; `keep`: it belongs to the run."""
        if keep:
            self._history.append((False, message))
        for visitor in self._visitors:
            visitor.tell(message)

    def end(self, report: Mapping[str, Any]) -> None:
        """Send visitors the report of the run, which is over."""
        self._over = report
        self.tell(told_json(type="over", report=report))

    def answer(self, number: int, message: bytes) -> None:
        """To one visitor, where it is still there."""
        visitor = self._visitors.get(number)
        if visitor is not None:
            visitor.tell(message)

    def recorded(self, file: Path | None, record: Mapping[str, Any] | None) -> None:
        """What /recording gives, and `record` of the hello."""
        self._recording, self._record = file, record
        if record is not None:
            self.tell(told_json(type="record", **record), keep=False)

    # --- over HTTP ---

    async def _index(self, request: Request) -> Response:
        return await self._files.get_response("index.html", request.scope)

    async def _last_run(self, request: Request) -> Response:
        if not self._began.is_set():
            return PlainTextResponse("no run has begun\n", 404)
        return StreamingResponse(self._lines(), media_type="application/x-ndjson")

    async def _lines(self) -> AsyncIterator[bytes]:
        """The hello, then what the run told, oldest first; others get their turn in between."""
        hello, shown = self._hello, _values(self._new_scene())
        yield told_json(type="hello", **hello | {"over": True, "replay": True}) + b"\n"
        kept = list(self._history)
        for first in range(0, len(kept), _LINES_AT_ONCE):
            part = kept[first : first + _LINES_AT_ONCE]
            yield b"".join((frame_json(each, shown) if packed else each) + b"\n" for packed, each in part)
            await asyncio.sleep(0)

    async def _download(self, request: Request) -> Response:
        token = request.query_params.get("token", "")
        if not token_admits(token, self._token):
            return PlainTextResponse("the token is needed for this: /recording?token=\n", 403)
        if self._recording is None:
            return PlainTextResponse("nothing was recorded\n", 404)
        return FileResponse(self._recording, filename=self._recording.name)

    async def _human_mesh(self, request: Request) -> Response:
        if self._human is None:
            self.prepare()
        assert self._human is not None
        packed, headers = await self._human, {"Vary": "Accept-Encoding"}
        if "gzip" in request.headers.get("accept-encoding", ""):
            headers["Content-Encoding"] = "gzip"
        else:
            packed = gzip.decompress(packed)
        return Response(packed, media_type="application/octet-stream", headers=headers)

    async def _robot(self, request: Request) -> Response:
        scene, file = self._scene, request.path_params["file"]
        if scene is None:
            return PlainTextResponse("this head has no picture\n", 404)
        if file == Path(URDF).name:
            return FileResponse(scene.urdf, media_type="application/xml")
        meshes = {name.removeprefix("package://").removeprefix("./"): mesh for name, mesh in scene.meshes.items()}
        return FileResponse(meshes[file]) if file in meshes else PlainTextResponse(f"no mesh {file}\n", 404)

    async def _face_model(self, request: Request) -> Response:
        return FileResponse(data_dir("sim") / "face_landmarker" / "face_landmarker.task")

    # --- over the WebSocket ---

    async def _visit(self, socket: WebSocket) -> None:
        await socket.accept()
        await self._began.wait()
        try:
            visitor = self._visitors.enter()
        except PacketError as error:
            await _refused(socket, str(error))
            return
        visitor.tell(self._hello_json(visitor))
        self._run.watched(len(self._visitors))
        speaking = asyncio.create_task(self._speak(socket, visitor))
        try:
            await self._listen(socket, visitor)
        except WebSocketDisconnect:
            pass  # as they do
        finally:
            speaking.cancel()
            self._visitors.leave(visitor)
            self._run.watched(len(self._visitors))

    async def _speak(self, socket: WebSocket, visitor: Visitor) -> None:
        with suppress(WebSocketDisconnect, RuntimeError):  # it has gone
            while not visitor.behind:
                await socket.send_text(await visitor.next())
            await _refused(socket, "too far behind: messages waited for too long")

    async def _listen(self, socket: WebSocket, visitor: Visitor) -> None:
        while socket.application_state is WebSocketState.CONNECTED:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            text, data = message.get("text"), message.get("bytes") or b""
            cost_s = COMMAND_S if text is not None else PERSON_S + len(data) / PERSON_BYTES_PER_S
            try:
                if text is not None:
                    self._command(visitor, parse_command(text))
                else:
                    self._person(visitor, data)
            except PacketError as error:
                visitor.malformed += 1
                if visitor.malformed > MOST_MALFORMED:
                    await _refused(socket, str(error))
                    return
                visitor.tell(told_json(type="error", error=str(error)))
            pause_s = visitor.pause_s(cost_s, self._now())
            if pause_s:
                await asyncio.sleep(pause_s)

    def _command(self, visitor: Visitor, command: Command) -> None:
        if command.name == "hello":
            self._visitors.greeted(visitor, command)
        elif command.name == "ping":
            visitor.tell(told_json(type="pong", id=command.values["id"]))
        elif command.name == "take":
            self._visitors.take(visitor)
        elif command.name == "give":
            self._visitors.give(visitor)
        else:
            self._visitors.admit(visitor, command)
            self._run.command(visitor.number, command)

    def _person(self, visitor: Visitor, message: bytes) -> None:
        if not self._visitors.holds(visitor):
            raise PacketError("sound and faces are taken of who holds the controls, after `source`")
        self._run.person(visitor.number, message)

    def _hello_json(self, visitor: Visitor) -> bytes:
        return told_json(
            type="hello", **self._hello, controls=self._visitors.controls(visitor), needs_token=not visitor.allowed,
            over=self._over is not None, record=self._record,
            torque_unconfirmed=(self._over or {}).get("torque_unconfirmed", []),
        )  # fmt: skip


def _values(scene: RobotScene | None) -> Shown | None:
    return None if scene is None else scene.values


async def _refused(socket: WebSocket, why: str) -> None:
    """Say why in one line, and close."""
    with suppress(WebSocketDisconnect, RuntimeError):
        await socket.send_text(told_json(type="error", error=why).decode())
        await socket.close(1008, why[:120])


def guarded_app(app: ASGIApp) -> ASGIApp:
    """Requests of strangers' pages are refused before anything else looks at them; answers carry `_HEADERS`."""

    async def guarded(scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await app(scope, receive, send)
            return
        headers = {name: value.decode("latin-1") for name, value in scope["headers"]}
        host = headers.get(b"host", "")
        problem = host_problem(host)
        if problem is None and scope["type"] == "websocket":
            problem = origin_problem(headers.get(b"origin"), host)
        if problem is not None:
            await PlainTextResponse(problem + "\n", 403)(scope, receive, send)
            return

        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *_HEADERS]
            await send(message)

        await app(scope, receive, with_headers if scope["type"] == "http" else send)

    return guarded
