"""Where tables go: as wide as the terminal, and as wide as they are where nobody looks (a pipe, a file)."""

from __future__ import annotations

import os
from typing import Any

from rich.console import Console

_UNBROKEN = 1_000  # columns: wider than any table


def screen(**options: Any) -> Console:
    """Standard output. A pipe gets whole rows, so that what reads them finds no row cut or broken up."""
    console = Console(**options)
    if not console.is_terminal and "COLUMNS" not in os.environ:
        console.width = _UNBROKEN
    return console
