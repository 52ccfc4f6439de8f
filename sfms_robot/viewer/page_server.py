"""Server of the page, in the page's process: the messages of a run go to all visitors, encoded once.

    /                  the page              /static/...     its files
    /ws                the protocol          /human/head.bin the virtual human (`face.human`)
    /robot/robot.urdf  the robot, and next to it the meshes that it names (`face.robot_scene` says which are served)
    /face_landmarker.task  the model by which a page sees its visitor's face
    /runs/last         the run so far, or the last one: its messages, a line of JSON each
    /recording         the file of the last recording; beyond loopback with ?token=

1. Pictures: only the newest is sent. A visitor that reads slowly receives fewer pictures, not older ones.
2. All other messages wait in order, up to `OUTBOX`; a visitor that is so far behind is disconnected.
3. Controls: the first visitor to request them has them until it gives them back or disconnects, or another visitor
   requests them after `IDLE_S` in which they were not used. Halting needs no controls.
4. If there is a token (bound beyond loopback), a visitor without it can only watch.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from sfms_robot.data import Report, data_dir
from sfms_robot.endpoint import token_admits
from sfms_robot.errors import PacketError
from sfms_robot.face.human import FOLDER as HUMAN
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.frames import FRAME_HZ
from sfms_robot.ports import Facts
from sfms_robot.viewer.page_messages import VERSION, Shown, frame_json, message_json, parse_command
from sfms_robot.viewer.web_server import CompressedFiles, application

URDF: Final = "robot/robot.urdf"
KEPT_FRAMES: Final = 600 * FRAME_HZ  # messages of the run kept for /runs/last: ten minutes of pictures
MOST_VISITORS: Final = 32
OUTBOX: Final = 200
IDLE_S: Final = 30.0
MOST_MALFORMED: Final = 100
COMMAND_S: Final = 0.004  # time allotted to a command, when many arrive
PERSON_S: Final = 0.001  # time allotted to a piece of sound, or a face
PERSON_BYTES_PER_S: Final = 4e6
BURST_S: Final = 0.25
LOAD_S: Final = 30.0  # longest time that a browser may take to load the page
_LOOK_S: Final = 0.05
_LINES_AT_ONCE: Final = 10  # for a platform each line takes 1.5 ms

NewScene = Callable[[], RobotScene | None]
Send = Callable[[int, Facts | bytes], None]


class Visitor:
    """A connected page, or another program that watches.

    Attributes:
        number: number that no earlier visitor had.
        in_browser: whether it is a page in a browser, which fetches a run that is over.
        allowed: whether it has sent the token, or there is none.
        malformed: count of its messages that could not be used.
        used_s: time of its last use of the controls.
        behind: whether it reads so slowly that it has to be disconnected.
    """

    def __init__(self, number: int, in_browser: bool, allowed: bool, now_s: float) -> None:
        self.number, self.in_browser, self.allowed, self.used_s = number, in_browser, allowed, now_s
        self.malformed, self.behind = 0, False
        self._picture = ""
        self._outbox = deque[str]()
        self._something = asyncio.Event()
        self._due_s = 0.0

    def tell(self, message: bytes) -> None:
        """Send a message, after those that still wait."""
        self.behind |= len(self._outbox) >= OUTBOX
        self._outbox.append(message.decode())
        self._something.set()

    def show(self, picture: str) -> None:
        """Send a picture instead of an older one that was not sent yet."""
        self._picture = picture
        self._something.set()

    async def next(self) -> str:
        """Return the next message or picture to send; wait until there is one."""
        await self._something.wait()
        if self._outbox:
            message = self._outbox.popleft()
        else:
            message, self._picture = self._picture, ""
        if not (self._outbox or self._picture):
            self._something.clear()
        return message

    def pause_s(self, cost_s: float, now_s: float) -> float:
        """Return how long to stop reading from the visitor, after a message of this cost."""
        self._due_s = max(self._due_s, now_s - BURST_S) + cost_s
        return max(0.0, self._due_s - now_s)

    def check_allowed(self) -> None:
        """Raise PacketError if the visitor has not sent the token yet."""
        if not self.allowed:
            raise PacketError("the token is needed for this: it was printed when the robot started")


class Visitors:
    """All visitors that are connected, and the one that holds the controls.

    Args:
        token: needed for more than watching; None: not needed.
        left: called with the number of a visitor that has lost the controls.
        now: a monotonic clock [s].
    """

    def __init__(self, token: str | None, left: Callable[[int], None], now: Callable[[], float]) -> None:
        self._token, self._left, self._now = token, left, now
        self._by_number: dict[int, Visitor] = {}
        self._came = 0
        self._holder: Visitor | None = None

    def __len__(self) -> int:
        return len(self._by_number)

    def __iter__(self) -> Iterator[Visitor]:
        return iter(tuple(self._by_number.values()))

    def get(self, number: int) -> Visitor | None:
        """Return a visitor by its number; None if it is not connected any more."""
        return self._by_number.get(number)

    def enter(self, in_browser: bool = False) -> Visitor:
        """Admit another visitor. Raises PacketError when there are too many."""
        if len(self._by_number) >= MOST_VISITORS:
            raise PacketError(f"{MOST_VISITORS} visitors look at this head already")
        self._came += 1
        visitor = self._by_number[self._came] = Visitor(self._came, in_browser, self._token is None, self._now())
        return visitor

    def leave(self, visitor: Visitor) -> None:
        """Remove a visitor that has disconnected."""
        self._by_number.pop(visitor.number, None)
        if visitor is self._holder:
            self._pass_on(None)

    def controls(self, visitor: Visitor) -> str:
        """Return the holder of the controls as `visitor` sees it."""
        return "nobody" if self._holder is None else "you" if visitor is self._holder else "other"

    def greet(self, visitor: Visitor, version: int, token: str) -> None:
        """Check the version of a page, and its token. Raises PacketError if either is wrong."""
        if version != VERSION:
            raise PacketError(f"version: expected {VERSION}, got {version}: load the page again")
        if token:
            if not token_admits(token, self._token):
                raise PacketError("the token is not the one that was printed when the robot started")
            visitor.allowed = True
        visitor.tell(self._controls_json(visitor))

    def take(self, visitor: Visitor) -> None:
        """Give a visitor the controls. Raises PacketError if it cannot have them."""
        visitor.check_allowed()
        now_s, holder = self._now(), self._holder
        if holder is not None and holder is not visitor and now_s - holder.used_s < IDLE_S:
            raise PacketError("another visitor holds the controls")
        visitor.used_s = now_s
        if visitor is not holder:
            self._pass_on(visitor)

    def give(self, visitor: Visitor) -> None:
        """Take the controls back from a visitor."""
        if visitor is self._holder:
            self._pass_on(None)
        else:
            visitor.tell(self._controls_json(visitor))

    def holds(self, visitor: Visitor) -> bool:
        """Return whether a visitor has the controls, which counts as use."""
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
        return message_json(type="controls", held=self.controls(visitor), needs_token=not visitor.allowed)


class PageServer:
    """The server of one page, for any run. All its code runs in the thread of one event loop.

    Args:
        send: function that sends a document, or a visitor's sound, to the run without waiting (see `page_process`).
        token: see `Visitors`.

    Attributes:
        app: application for an ASGI server.
    """

    def __init__(self, send: Send, token: str | None) -> None:
        self._send_run, self._token = send, token
        self._visitors = Visitors(token, lambda number: send(number, {"left": True}), time.monotonic)
        self._hello: Report = {}
        self._began = asyncio.Event()  # set once there is a hello
        self._new_scene: NewScene = lambda: None
        self._scene: RobotScene | None = None
        self._record: Facts | None = None
        self._recording: Path | None = None
        self._over: Facts | None = None  # report of a run that is over
        self._fetched = 0  # how often that run was fetched
        self._loads_until_s = 0.0  # until then a browser that loads the page is a visitor
        self._history = deque[tuple[bool, bytes]](maxlen=KEPT_FRAMES)  # (packed picture or not, message)
        self._files, self._human = CompressedFiles(), CompressedFiles(HUMAN)
        self.app = application(
            [
                Route("/", self._index),
                Route("/runs/last", self._last_run),
                Route("/recording", self._download),
                Route("/robot/{file:path}", self._robot),
                Route("/face_landmarker.task", self._face_model),
                WebSocketRoute("/ws", self._visit),
                Mount("/static", self._files),
                Mount("/human", self._human),
            ]
        )

    def prepare(self) -> None:
        """Start to compress the files that every page loads, in threads; a page waits for them."""
        self._human.prepare("*.xz")
        self._files.prepare()

    # --- from the run ---

    def begin(self, hello: Facts, new_scene: NewScene) -> None:
        """Begin a run: forget the last one, and send its `hello` to all visitors.

        `new_scene`: function that makes the picture of the head. A picture has a memory, so a replay makes its own.
        """
        self._new_scene, self._scene, self._over = new_scene, new_scene(), None
        self._hello = dict(hello)
        if (scene := self._scene) is not None:
            self._hello |= {"urdf": URDF, "urdf_joints": scene.joints, "urdf_generic": scene.generic}
        self._history.clear()
        self._began.set()
        for visitor in self._visitors:
            visitor.tell(self._hello_json(visitor))

    def show(self, record: bytes) -> None:
        """Send a packed picture to all visitors."""
        self.keep(record)
        if len(self._visitors):
            picture = frame_json(record, _values(self._scene)).decode()
            for visitor in self._visitors:
                visitor.show(picture)

    def keep(self, record: bytes) -> None:
        """Keep a packed picture only for /runs/last, because a newer one is here already."""
        self._history.append((True, record))

    def tell(self, message: bytes, keep: bool = True) -> None:
        """Send a message of docs/reference/protocol.md to all visitors; `keep`: whether it belongs to the run."""
        if keep:
            self._history.append((False, message))
        for visitor in self._visitors:
            visitor.tell(message)

    def end(self, report: Facts) -> None:
        """Send the report of the run, which is over, to all visitors."""
        self._over, self._fetched = report, 0
        self.tell(message_json(type="over", report=report))

    async def replayed(self) -> None:
        """Wait until the pages that are open have fetched a run that is over."""
        while self._over is not None and self._fetched < sum(each.in_browser for each in self._visitors):
            await asyncio.sleep(_LOOK_S)

    def answer(self, number: int, message: bytes) -> None:
        """Send a message to one visitor, if it is still connected."""
        if visitor := self._visitors.get(number):
            visitor.tell(message)

    def recorded(self, file: Path | None, record: Facts | None) -> None:
        """Set the file of /recording, and `record` of the hello."""
        self._recording, self._record = file, record
        if record is not None:
            self.tell(message_json(type="record", **record), keep=False)

    # --- over HTTP ---

    async def _index(self, request: Request) -> Response:
        self._loads_until_s = time.monotonic() + LOAD_S
        self._tell_watched()
        asyncio.get_running_loop().call_later(LOAD_S, self._tell_watched)
        return await self._files.get_response("index.html", request.scope)

    async def _last_run(self, request: Request) -> Response:
        if not self._began.is_set():
            return PlainTextResponse("no run has begun\n", 404)
        return StreamingResponse(self._lines(), media_type="application/x-ndjson")

    async def _lines(self) -> AsyncIterator[bytes]:
        """Yield the hello, then the messages of the run, oldest first; other tasks run in between."""
        shown = _values(self._new_scene())
        yield message_json(type="hello", **self._hello | {"over": True, "replay": True}) + b"\n"
        kept = list(self._history)
        for first in range(0, len(kept), _LINES_AT_ONCE):
            part = kept[first : first + _LINES_AT_ONCE]
            yield b"".join((frame_json(each, shown) if packed else each) + b"\n" for packed, each in part)
            await asyncio.sleep(0)
        self._fetched += 1

    async def _download(self, request: Request) -> Response:
        if not token_admits(request.query_params.get("token", ""), self._token):
            return PlainTextResponse("the token is needed for this: /recording?token=\n", 403)
        if self._recording is None:
            return PlainTextResponse("nothing was recorded\n", 404)
        return FileResponse(self._recording, filename=self._recording.name)

    async def _robot(self, request: Request) -> Response:
        scene, file = self._scene, request.path_params["file"]
        if scene is None:
            return PlainTextResponse("no run has begun\n", 404)
        if file == Path(URDF).name:
            return Response(scene.text, media_type="application/xml")
        meshes = {name.removeprefix("package://").removeprefix("./"): mesh for name, mesh in scene.meshes.items()}
        return FileResponse(meshes[file]) if file in meshes else PlainTextResponse(f"no mesh {file}\n", 404)

    async def _face_model(self, request: Request) -> Response:
        return FileResponse(data_dir("sim") / "face_landmarker" / "face_landmarker.task")

    # --- over the WebSocket ---

    async def _visit(self, socket: WebSocket) -> None:
        await socket.accept()
        await self._began.wait()
        try:
            visitor = self._visitors.enter(in_browser="origin" in socket.headers)  # RFC 6455, 4.1: browsers send it
        except PacketError as error:
            await _refuse(socket, str(error))
            return
        visitor.tell(self._hello_json(visitor))
        self._loads_until_s = 0.0
        self._tell_watched()
        sending = asyncio.create_task(self._send(socket, visitor))
        try:
            await self._receive(socket, visitor)
        finally:
            sending.cancel()
            self._visitors.leave(visitor)
            self._tell_watched()

    def _tell_watched(self) -> None:
        """Report the number of visitors to the run, with a browser that loads the page, for `LOAD_S` at most."""
        self._send_run(0, {"watched": len(self._visitors) + (time.monotonic() < self._loads_until_s)})

    async def _send(self, socket: WebSocket, visitor: Visitor) -> None:
        with suppress(WebSocketDisconnect, RuntimeError):  # the visitor has disconnected
            while not visitor.behind:
                await socket.send_text(await visitor.next())
            await _refuse(socket, "too far behind: messages waited for too long")

    async def _receive(self, socket: WebSocket, visitor: Visitor) -> None:
        while socket.application_state is WebSocketState.CONNECTED:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            text, data = message.get("text"), message.get("bytes") or b""
            try:
                if text is not None:
                    self._command(visitor, *parse_command(text))
                elif self._visitors.holds(visitor):
                    self._send_run(visitor.number, data)
                else:
                    raise PacketError("sound and faces are taken from the holder of the controls, after `source`")
            except PacketError as error:
                visitor.malformed += 1
                if visitor.malformed > MOST_MALFORMED:
                    await _refuse(socket, str(error))
                    return
                visitor.tell(message_json(type="error", error=str(error)))
            cost_s = COMMAND_S if text is not None else PERSON_S + len(data) / PERSON_BYTES_PER_S
            await asyncio.sleep(visitor.pause_s(cost_s, time.monotonic()))

    def _command(self, visitor: Visitor, name: str, values: Report) -> None:
        if name == "hello":
            self._visitors.greet(visitor, **values)
        elif name == "ping":
            visitor.tell(message_json(type="pong", id=values["id"]))
        elif name == "take":
            self._visitors.take(visitor)
        elif name == "give":
            self._visitors.give(visitor)
        else:
            if name == "halt":  # needs no controls
                visitor.check_allowed()
            else:
                self._visitors.take(visitor)
            self._send_run(visitor.number, {"command": name, "values": values})

    def _hello_json(self, visitor: Visitor) -> bytes:
        return message_json(
            type="hello", **self._hello, controls=self._visitors.controls(visitor), needs_token=not visitor.allowed,
            over=self._over is not None, record=self._record,
            torque_unconfirmed=(self._over or {}).get("torque_unconfirmed", []),
        )  # fmt: skip


def _values(scene: RobotScene | None) -> Shown | None:
    return None if scene is None else scene.values


async def _refuse(socket: WebSocket, why: str) -> None:
    """Send the reason in one line, and close."""
    with suppress(WebSocketDisconnect, RuntimeError):
        await socket.send_text(message_json(type="error", error=why).decode())
        await socket.close(1008, why[:120])
