"""The page's process: a server, and the two pipes to the run that it shows."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, Final

import orjson

from sfms_robot.child_process import take_pipes
from sfms_robot.errors import RobotError
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.viewer.page_messages import LONGEST_PERSON
from sfms_robot.viewer.page_process import BEAT_S, DOCUMENT, HEADER, PERSON, PICTURE, Address, packed_message
from sfms_robot.viewer.page_server import PageServer
from sfms_robot.viewer.web_server import WebLoop, listen_at, web_server

SceneOf = Callable[[str, Sequence[str]], RobotScene | None]
NICE: Final = 5  # the servo loop goes first
MOST_UNSENT: Final = 2_000_000  # bytes for a run that does not read: a visitor's voice is left out then


class RunPipe:
    """`page_server.Run` at the other end of a pipe."""

    def __init__(self) -> None:
        self._transport: asyncio.WriteTransport | None = None

    async def open(self, pipe: IO[bytes]) -> None:
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.connect_write_pipe(asyncio.BaseProtocol, pipe)

    def command(self, visitor: int, name: str, values: Mapping[str, Any]) -> None:
        self.send(visitor, command=name, values=values)

    def person(self, visitor: int, message: bytes) -> None:
        if self._transport is not None and self._transport.get_write_buffer_size() < MOST_UNSENT:
            self._transport.write(packed_message(PERSON, visitor, message))

    def left(self, visitor: int) -> None:
        self.send(visitor, left=True)

    def watched(self, visitors: int) -> None:
        self.send(0, watched=visitors)

    def send(self, visitor: int, **told: Any) -> None:
        """A document to the run."""
        if self._transport is not None:
            self._transport.write(packed_message(DOCUMENT, visitor, orjson.dumps(told)))


class FromRun(asyncio.Protocol):
    """What the run sends, done as it comes; of pictures that come at once the newest is shown. Ends with the pipe."""

    def __init__(self, page: PageServer, over: asyncio.Event, scene_of: SceneOf) -> None:
        self._page, self._over, self._scene_of = page, over, scene_of
        self._unread = bytearray()

    def data_received(self, data: bytes) -> None:
        self._unread += data
        picture: bytes | None = None
        while len(self._unread) >= HEADER.size:
            length, kind, visitor = HEADER.unpack_from(self._unread)
            end = HEADER.size + length
            if len(self._unread) < end:
                break
            message = bytes(self._unread[HEADER.size : end])
            del self._unread[:end]
            if kind == PICTURE:
                if picture is not None:
                    self._page.keep(picture)
                picture = message
            else:
                if picture is not None:
                    self._page.show(picture)
                    picture = None
                self._document(visitor, orjson.loads(message))
        if picture is not None:
            self._page.show(picture)

    def connection_lost(self, error: Exception | None) -> None:
        self._over.set()

    def _document(self, visitor: int, told: dict[str, Any]) -> None:
        do = told.pop("do")
        if do == "begin":
            self._page.begin(told, partial(self._scene_of, told.pop("scene", ""), told.pop("packages", ())))
        elif do == "end":
            self._page.end(told["report"])
        elif do == "error":
            self._page.answer(visitor, orjson.dumps({"type": "error", "error": told["error"]}))
        elif do == "recorded":
            file = told["file"]
            self._page.recorded(None if file is None else Path(file), told["record"])
        else:
            self._page.tell(orjson.dumps({"type": do, **told}), keep=do != "status")


def main(scene_of: SceneOf = lambda *_: None) -> None:
    """Serve until the pipe ends. The first message says where. `scene_of`: gives the picture of a head by its name."""
    incoming, outgoing = take_pipes()
    first = _first_document(incoming.fileno())
    if first is None:
        return
    if hasattr(os, "nice"):
        os.nice(NICE)
    address, run = Address(**first), RunPipe()
    with asyncio.Runner(loop_factory=WebLoop) as runner:
        runner.run(_serve(address, run, incoming, outgoing, scene_of))


def _first_document(pipe: int) -> dict[str, Any] | None:
    """Byte for byte: what follows it is read by others. None at the end of the pipe."""

    def exactly(length: int) -> bytes:
        data = b""
        while len(data) < length and (more := os.read(pipe, length - len(data))):
            data += more
        return data

    header = exactly(HEADER.size)
    if len(header) < HEADER.size:
        return None
    first: dict[str, Any] = orjson.loads(exactly(HEADER.unpack(header)[0]))
    return first


async def _serve(address: Address, run: RunPipe, incoming: IO[bytes], outgoing: IO[bytes], scene_of: SceneOf) -> None:
    await run.open(outgoing)
    try:
        place = listen_at(address)
    except RobotError as error:
        run.send(0, problem=str(error), of=type(error).__name__)
        return
    over = asyncio.Event()
    page = PageServer(run, place.token)
    loop = asyncio.get_running_loop()
    await loop.connect_read_pipe(lambda: FromRun(page, over, scene_of), incoming)
    server = web_server(
        page.app,
        ws="websockets-sansio",
        ws_max_size=LONGEST_PERSON,
        ws_per_message_deflate=False,
        ssl_certfile=address.certificate,
        ssl_keyfile=address.key,
    )
    serving = asyncio.create_task(server.serve(sockets=[place.socket]))
    page.prepare()
    run.send(0, bound=place.url, token=place.token, taken=place.taken)
    while not over.is_set():
        run.send(0, alive=True)
        with suppress(TimeoutError):
            await asyncio.wait_for(over.wait(), BEAT_S)
    server.should_exit = True
    await serving
