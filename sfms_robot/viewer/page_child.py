"""The page's process: a server, and the two pipes to the run that it shows."""

from __future__ import annotations

import asyncio
import pickle
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

import orjson

from sfms_robot.data import Report
from sfms_robot.errors import RobotError
from sfms_robot.face.robot_scene import RobotScene
from sfms_robot.ports import Facts
from sfms_robot.processes import ParentPipe, PipeWriter, give_way
from sfms_robot.viewer.page_messages import LONGEST_PERSON
from sfms_robot.viewer.page_process import BEAT_S, REPLAY_S, Address
from sfms_robot.viewer.page_server import PageServer
from sfms_robot.viewer.web_server import WebLoop, listen_at, web_server

SceneOf = Callable[[str, Sequence[str]], RobotScene | None]
NICE: Final = 5  # so that the servo loop runs first
MOST_UNSENT: Final = 100  # pieces of voice and face for a run that does not read: older ones are left out


class FromRun:
    """Messages of the run, handled in the server's loop; if several pictures wait, the newest is shown."""

    def __init__(self, page: PageServer, scene_of: SceneOf) -> None:
        self._page, self._scene_of = page, scene_of
        self._loop = asyncio.get_running_loop()
        self._waiting = deque[Any]()

    def put(self, message: Any) -> None:
        """Queue a message; called in the thread that reads."""
        self._waiting.append(message)
        self._loop.call_soon_threadsafe(self._handle)

    def _handle(self) -> None:
        while self._waiting:
            message = self._waiting.popleft()
            if not isinstance(message, bytes):
                self._document(message[0], orjson.loads(message[1]))
            elif self._waiting and isinstance(self._waiting[0], bytes):
                self._page.keep(message)
            else:
                self._page.show(message)

    def _document(self, visitor: int, told: Report) -> None:
        do = told.pop("do")
        if do == "begin":
            self._page.begin(told, partial(self._scene_of, told.pop("scene", ""), told.pop("packages", ())))
        elif do == "end":
            self._page.end(told["report"])
        elif do == "error":
            self._page.answer(visitor, orjson.dumps({"type": "error", "error": told["error"]}))
        elif do == "recorded":
            file = told["file"]
            self._page.recorded(file and Path(file), told["record"])
        else:
            self._page.tell(orjson.dumps({"type": do, **told}), keep=do != "status")


def main(scene_of: SceneOf = lambda *_: None) -> None:
    """Serve until the pipe ends. `scene_of`: function that returns the picture of a head by its name."""
    parent = ParentPipe()
    address = parent.receive()
    give_way(NICE)
    with asyncio.Runner(loop_factory=WebLoop) as runner:
        runner.run(_serve(address, parent, scene_of))


async def _serve(address: Address, parent: ParentPipe, scene_of: SceneOf) -> None:
    writer = PipeWriter(parent.outgoing, MOST_UNSENT, "run")

    def send(visitor: int, content: Facts | bytes) -> None:
        """Send a document, or a piece of a visitor's voice or face, without waiting."""
        (writer.offer if isinstance(content, bytes) else writer.send)(pickle.dumps((visitor, content)))

    try:
        place = listen_at(address)
    except RobotError as error:
        send(0, {"problem": str(error), "of": type(error).__name__})
        return
    over = asyncio.Event()
    page = PageServer(send, place.token)
    loop = asyncio.get_running_loop()
    parent.forward(FromRun(page, scene_of).put, lambda: loop.call_soon_threadsafe(over.set))
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
    send(0, {"bound": place.url, "taken": place.taken})
    while not over.is_set():
        writer.send(pickle.dumps(None))  # a sign of life
        with suppress(TimeoutError):
            await asyncio.wait_for(over.wait(), BEAT_S)
    with suppress(TimeoutError):
        await asyncio.wait_for(page.replayed(), REPLAY_S)
    server.should_exit = True
    await serving
