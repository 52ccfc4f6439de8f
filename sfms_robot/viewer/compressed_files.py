"""The page's files and the virtual human as browsers take them: compressed, each once, by a thread."""

from __future__ import annotations

import asyncio
import gzip
import lzma
from functools import cache
from pathlib import Path
from typing import Final

from starlette.datastructures import Headers
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

_LEVEL: Final = 6
_WITH_GZIP: Final = "gzip"
_OF_PLAIN: Final = ("content-length", "accept-ranges")  # headers that are true of the plain file alone


class CompressedFiles(StaticFiles):
    """The files of a folder; gzip for who takes it, and the plain file for who does not or asks for a part of it.

    What lies there as FILE.xz, to be small where it is installed, is served as FILE, and always whole.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder)
        self._folder = folder
        self._stored = {str(file.relative_to(folder).with_suffix("")) for file in folder.rglob("*.xz")}
        self._packed: dict[tuple[str, float], asyncio.Task[bytes]] = {}  # by file and when it was changed

    def prepare(self) -> None:
        """Compress what lies in the folder itself, ahead of who asks; what lies deeper waits until it is asked for."""
        for file in sorted(self._folder.iterdir()):
            if file.is_file():
                self._gzip(file)

    async def get_response(self, path: str, scope: Scope) -> Response:
        stored = path in self._stored
        plain = await super().get_response(f"{path}.xz" if stored else path, scope)
        asked = Headers(scope=scope)
        if not isinstance(plain, FileResponse) or plain.status_code != 200 or (scope["method"] != "GET" and not stored):
            return plain
        plain.headers["Vary"] = "Accept-Encoding"
        headers = {name: value for name, value in plain.headers.items() if name not in _OF_PLAIN}
        if _WITH_GZIP in asked.get("accept-encoding", "") and (stored or "range" not in asked):
            packed = await self._gzip(Path(plain.path))
            return Response(packed, headers=headers | {"Content-Encoding": _WITH_GZIP})
        return Response(await asyncio.to_thread(_plain, Path(plain.path)), headers=headers) if stored else plain

    def _gzip(self, file: Path) -> asyncio.Task[bytes]:
        key = (str(file), file.stat().st_mtime)
        if key not in self._packed:
            self._packed[key] = asyncio.create_task(asyncio.to_thread(_compressed, file))
        return self._packed[key]


def _compressed(file: Path) -> bytes:
    return gzip.compress(_plain(file), _LEVEL, mtime=0)


def _plain(file: Path) -> bytes:
    return lzma.decompress(file.read_bytes()) if file.suffix == ".xz" else file.read_bytes()


@cache
def human_gz() -> bytes:
    """Return `face.human.packed_human`, compressed. Blocks for a second, once."""
    from sfms_robot.face.human import (
        load_human,  # scipy's trees: in the thread that makes it, not at start-up
        packed_human,
    )

    return gzip.compress(packed_human(load_human()), _LEVEL)
