"""Bytes and figures that others published, in `assets`; and how a reader of a byte stream is fed."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

ASSETS = Path(__file__).parent / "assets"


def rows(file: str) -> list[dict[str, str]]:
    """Rows of a table, without the lines that say where it is from."""
    lines = (ASSETS / file).read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def byte_by_byte(take: Callable[[bytearray], Any], wire: bytes) -> Any:
    """What `take` finds with the last byte, having found nothing before."""
    buffer = bytearray()
    for byte in wire[:-1]:
        buffer.append(byte)
        assert take(buffer) is None
    buffer.append(wire[-1])
    return take(buffer)
