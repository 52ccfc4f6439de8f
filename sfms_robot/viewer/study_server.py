"""Page of a blind comparison (`evaluate people`): two clips, some questions, one answer after the other.

    /                the page             /static/...      its files
    /clips/...       motion and voices    /human/head.bin  the virtual human
    POST /begin      -> {"participant", "questions"}
    POST /next       {"participant"} -> {"answered", "trials"}; if one is left {"trial", "audio", "left", "right"} too
    POST /answer     {"participant", "trial", "answers": {question: left, right or neither}} -> as /next

Beyond loopback every POST needs the token of the printed address, as `X-Token`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final, Protocol

from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp

from sfms_robot.data import Report
from sfms_robot.endpoint import token_admits
from sfms_robot.errors import ConfigError
from sfms_robot.face.human import FOLDER as HUMAN
from sfms_robot.viewer.page_process import Address
from sfms_robot.viewer.web_server import STATIC, CompressedFiles, application, json_body, listen_at, web_server

MOST_NAME: Final = 64


class Comparison(Protocol):
    """Questions, clips and answers of a study. Raises ConfigError for an invalid answer."""

    @property
    def questions(self) -> Mapping[str, str]: ...

    @property
    def clips(self) -> Path: ...

    def begin(self) -> str: ...

    def next(self, participant: str) -> Report: ...

    def answer(self, participant: str, number: int, chosen: Mapping[str, str]) -> None: ...


def study_app(study: Comparison, token: str | None = None) -> ASGIApp:
    """Return the application for an ASGI server. All its code runs in the thread of one event loop."""

    async def command(request: Request) -> Response:
        if not token_admits(request.headers.get("x-token", ""), token):
            raise ConfigError("the token of the printed address is needed")
        given, path = await json_body(request), request.url.path
        if path == "/begin":
            return JSONResponse({"participant": study.begin(), "questions": dict(study.questions)})
        participant = given.get("participant")
        if not isinstance(participant, str) or not participant.isalnum() or len(participant) > MOST_NAME:
            raise ConfigError("participant: expected the name that /begin returned")
        if path == "/answer":
            number, chosen = given.get("trial"), given.get("answers")
            if not isinstance(number, int) or not isinstance(chosen, dict):
                raise ConfigError("an answer needs a number `trial` and a table `answers`")
            study.answer(participant, number, {str(key): str(value) for key, value in chosen.items()})
        return JSONResponse(study.next(participant))

    async def page(request: Request) -> Response:
        return FileResponse(STATIC / "people.html", media_type="text/html")

    return application(
        [
            Route("/", page),
            *(Route(path, command, methods=["POST"]) for path in ("/begin", "/next", "/answer")),
            Mount("/human", CompressedFiles(HUMAN)),
            Mount("/static", CompressedFiles()),
            Mount("/clips", StaticFiles(directory=study.clips)),
        ]
    )


def serve_study(study: Comparison, address: Address, ready: Callable[[str, int | None], None]) -> None:
    """Serve until interrupted; calls `ready(url, taken port or None)` once. Raises PortError, KeyboardInterrupt."""
    place = listen_at(address)
    ready(place.url, place.taken)
    web_server(study_app(study, place.token), ws="none").run([place.socket])
