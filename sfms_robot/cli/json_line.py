"""The one place where a command prints JSON: what `--json` asks for, and how a command with it failed."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any


def print_json(told: Mapping[str, Any]) -> None:
    """One object as one line of stdout, at once. What cannot be told (NaN, an infinity) is null: JSON has no other."""
    print(json.dumps(_told(told), allow_nan=False), flush=True)


def _told(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _told(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_told(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
