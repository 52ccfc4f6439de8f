"""Checks and processes that come before anything is loaded: what a slip of the keyboard breaks, listener, page.

Names, files and devices, by the very functions that the run will use; `session.run` looks at all the rest. Standard
library only, so the answer takes as long as the interpreter does to start.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sfms_robot.data import find
from sfms_robot.errors import ConfigError, PortError
from sfms_robot.plugins import listener_folder
from sfms_robot.servo.discovery import access_problem, is_address
from sfms_robot.sources.registry import BROWSER, check_source, split_kind

if TYPE_CHECKING:
    from sfms_robot.config import Calmness
    from sfms_robot.listeners.engine import EngineName
    from sfms_robot.listeners.open_feed import NamedFeed
    from sfms_robot.viewer.page_process import PageProcess

ENGINES: Final[tuple[EngineName, ...]] = ("auto", "onnx", "torch")
PAGE: Final = "sfms_robot.app.listen.page_scene:main"
_IN_TERMINALS: Final = ("www-browser", "links", "elinks", "lynx", "w3m", "browsh")


def check_names(
    head: str,
    listener: str,
    port: str = "sim",
    audio: str = "default",
    face: str = "auto",
    agent_audio: str = "none",
    play: str | None = None,
    status: str | None = None,
) -> None:
    """Are there such a head, listener, port and files, and is the status's port free? Raises ConfigError, PortError."""
    find("heads", head, "head.yaml")
    listener_folder(listener)
    check_source(audio, face, agent_audio, play=play)
    if status is not None:
        from sfms_robot.viewer.web_server import status_server  # a web server: only where one is asked for

        status_server(status).close()
    for part in port.split(","):
        device = part.rpartition("=")[2]
        if (device.startswith("/") or is_address(device)) and (problem := access_problem(device)):
            raise PortError(f"--port {device}: {problem}")


def engine_named(name: str) -> EngineName:
    """The engine of that name. Raises ConfigError."""
    for known in ENGINES:
        if name == known:
            return known
    raise ConfigError(f"--engine {name}: none of {', '.join(ENGINES)}")


def begin_listening(
    listener: str,
    seed: int,
    calmness: Calmness | None = None,
    zenoh: Path | None = None,
    engine: EngineName = "auto",
    insecure: bool = False,
) -> NamedFeed:
    """Return the listener, which loads or connects from now on, for `session.run(feed=...)`. Closed by the caller."""
    from sfms_robot.listeners.open_feed import open_feed  # numpy: not for who only mistyped a name
    from sfms_robot.network import Router

    return open_feed(listener, seed, calmness, Router(zenoh, insecure), engine)


def begin_page(
    wanted: str | None,
    certificate: Path | None = None,
    key: Path | None = None,
    *,
    audio: str = "default",
    face: str = "auto",
    fast: bool = False,
    dry_run: bool = False,
) -> PageProcess | None:
    """The page's own process, which starts from now on; None where nobody asked for one. Closed by the caller.

    `wanted`: of `--view`; a person in front of the page needs one. Raises ConfigError for what cannot be.
    """
    if wanted is None:
        if BROWSER not in (split_kind(audio)[0], split_kind(face)[0]):
            if certificate is not None or key is not None:
                raise ConfigError("--view-cert, --view-key: no page is served (--view)")
            return None
        wanted = "auto"
    if fast:
        raise ConfigError(f"--view {wanted}: a page shows what takes real time, --fast has none")
    if dry_run:
        raise ConfigError(f"--view {wanted}: nothing moves in a --dry-run")
    from sfms_robot.viewer.page_process import Address, PageProcess  # only for who wants it

    return PageProcess(Address.parsed(wanted, certificate, key), PAGE)


def can_open(environment: Mapping[str, str], platform: str) -> bool:
    """Return whether there is a screen, and the user of this program sits in front of it."""
    if "SSH_CONNECTION" in environment:
        return False
    return platform in ("darwin", "win32") or any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_browser(url: str) -> bool:
    """Show `url` in a browser window of this computer; return whether that can be. Never blocks, raises nothing."""
    if not can_open(os.environ, sys.platform):
        return False
    import webbrowser  # only for the one command that opens a window

    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return False
    if getattr(browser, "name", "") in _IN_TERMINALS:
        return False
    threading.Thread(target=browser.open, args=(url,), name="browser", daemon=True).start()
    return True
