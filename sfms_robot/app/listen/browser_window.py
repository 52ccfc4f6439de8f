"""A window of this computer's browser, where somebody sits who would see it."""

from __future__ import annotations

import os
import sys
import threading
import webbrowser
from collections.abc import Mapping
from typing import Final

_IN_TERMINALS: Final = ("www-browser", "links", "elinks", "lynx", "w3m", "browsh")


def can_open(environment: Mapping[str, str], platform: str) -> bool:
    """Whether there is a screen, and it is that of who started this program."""
    if "SSH_CONNECTION" in environment:
        return False
    return platform in ("darwin", "win32") or any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_browser(url: str) -> bool:
    """Show `url` there; whether there is a browser for it. Never blocks, raises nothing."""
    if not can_open(os.environ, sys.platform):
        return False
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return False
    if getattr(browser, "name", "") in _IN_TERMINALS:
        return False
    threading.Thread(target=browser.open, args=(url,), name="browser", daemon=True).start()
    return True
