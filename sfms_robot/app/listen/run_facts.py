"""What a recording says of its run, beside what happened in it: enough to know what ran, on what, and how."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import yaml

from sfms_robot import __version__
from sfms_robot.config import Head
from sfms_robot.errors import ConfigError
from sfms_robot.plugins import listener_folder

LONG: Final = ("joints", "head_yaml", "listener_config", "options")  # texts that are not for one line


def run_facts(head: Head, listener: str, options: Mapping[str, Any]) -> dict[str, str]:
    """Text by text, for `Recorder(about=...)`.

    `head_yaml` is the head as it was used, calibration included, and a head's file itself. Of a listener that is a
    folder there are its configuration and the SHA-256 of its weights.
    """
    shown = {name: value for name, value in options.items() if value not in (None, (), False)}
    return {
        "head": head.name,
        "listener": Path(listener).name,
        **{name: str(options[name]) for name in ("seed", "port")},
        "audio": Path(options["audio"]).name,
        "version": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "options": json.dumps(shown, default=str),
        "head_yaml": yaml.safe_dump(head.model_dump(mode="json", exclude_defaults=True), sort_keys=False),
        **_listener(listener),
    }


def _listener(name: str) -> dict[str, str]:
    try:
        folder = listener_folder(name)
    except ConfigError:  # an object that a program handed over
        return {}
    if folder is None:
        return {}
    facts = {"listener_config": (folder / "config.yaml").read_text(encoding="utf-8")}
    if (weights := folder / "model.safetensors").is_file():
        with weights.open("rb") as file:
            facts["listener_sha256"] = hashlib.file_digest(file, "sha256").hexdigest()
    return facts
