"""The page of a blind comparison (`evaluate people`): two clips, some questions, one answer after the other.

    /                the page             /static/...      what it loads
    /clips/...       motion and voices    /human/head.bin  the virtual human
    POST /begin      -> {"participant", "questions"}
    POST /next       {"participant"} -> {"answered", "trials"}; if one is left {"trial", "audio", "left", "right"} too
    POST /answer     {"participant", "trial", "answers": {question: left, right or neither}} -> as /next

Beyond loopback every POST needs the token of the printed address, as `X-Token`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol

import orjson
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from sfms_robot.errors import ConfigError
from sfms_robot.origin import token_admits
from sfms_robot.viewer.compressed_files import CompressedFiles, human_gz
from sfms_robot.viewer.page_child import listen_at, web_server
from sfms_robot.viewer.page_process import Address
from sfms_robot.viewer.page_server import STATIC, guarded_app

MOST_BYTES: Final = 4096  # of a message
MOST_NAME: Final = 64


class Comparison(Protocol):
    """What is asked, and who keeps the answers. Raises ConfigError for an answer that cannot be one."""

    @property
    def questions(self) -> Mapping[str, str]: ...

    @property
    def clips(self) -> Path: ...

    def begin(self) -> str: ...

    def next(self, participant: str) -> dict[str, Any]: ...

    def answer(self, participant: str, number: int, chosen: Mapping[str, str]) -> None: ...


def study_app(study: Comparison, token: str | None = None) -> ASGIApp:
    """For an ASGI server. All in the thread of one event loop."""

    async def begin(request: Request) -> Response:
        await _document(request, token)
        return _json({"participant": study.begin(), "questions": dict(study.questions)})

    async def following(request: Request) -> Response:
        told = await _document(request, token)
        return _json(study.next(_participant(told)))

    async def answer(request: Request) -> Response:
        told = await _document(request, token)
        number, chosen = told.get("trial"), told.get("answers")
        if not isinstance(number, int) or not isinstance(chosen, dict):
            raise ConfigError("an answer needs a number `trial` and a table `answers`")
        participant = _participant(told)
        study.answer(participant, number, {str(key): str(value) for key, value in chosen.items()})
        return _json(study.next(participant))

    async def page(request: Request) -> Response:
        return FileResponse(STATIC / "people.html", media_type="text/html")

    async def human(request: Request) -> Response:
        return Response(await asyncio.to_thread(human_gz), headers={"content-encoding": "gzip"})

    return guarded_app(
        Starlette(
            routes=[
                Route("/", page),
                Route("/begin", begin, methods=["POST"]),
                Route("/next", following, methods=["POST"]),
                Route("/answer", answer, methods=["POST"]),
                Route("/human/head.bin", human),
                Mount("/static", CompressedFiles(STATIC)),
                Mount("/clips", StaticFiles(directory=study.clips)),
            ],
            exception_handlers={ConfigError: _refused},
        )
    )


def serve_study(study: Comparison, address: Address, ready: Callable[[str, int | None], None]) -> None:
    """Serve until interrupted; `ready(url, taken port or None)` once. Raises PortError, KeyboardInterrupt."""
    place = listen_at(address)
    ready(place.url, place.taken)
    web_server(study_app(study, place.token), ws="none").run(sockets=[place.socket])


async def _refused(request: Request, error: Exception) -> Response:
    return PlainTextResponse(f"{error}\n", 400)


async def _document(request: Request, token: str | None) -> dict[str, Any]:
    if not token_admits(request.headers.get("x-token", ""), token):
        raise ConfigError("the token of the printed address is needed")
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > MOST_BYTES:
            raise ConfigError(f"a message of more than {MOST_BYTES} bytes")
    try:
        told = orjson.loads(body or b"{}")
    except orjson.JSONDecodeError as error:
        raise ConfigError("a message is one JSON object") from error
    if not isinstance(told, dict):
        raise ConfigError("a message is one JSON object")
    return told


def _participant(told: Mapping[str, Any]) -> str:
    name = told.get("participant")
    if not isinstance(name, str) or not name.isalnum() or len(name) > MOST_NAME:
        raise ConfigError("participant is what /begin gave")
    return name


def _json(told: Mapping[str, Any]) -> Response:
    return Response(orjson.dumps(told), media_type="application/json")
