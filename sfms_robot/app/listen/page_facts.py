"""What a page is told of a run when it begins: the `hello` of docs/protocol.md, but for what visitors differ in."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sfms_robot.app.catalogue import shipped_listeners, shipped_speakers
from sfms_robot.app.listen.knobs import LiveKnobs
from sfms_robot.app.listen.page_commands import NAMED_EXPRESSIONS
from sfms_robot.config import Calmness, Head
from sfms_robot.config.listener import load_listener
from sfms_robot.frames import CHANNELS
from sfms_robot.listeners.events.model import load_tables
from sfms_robot.plugins import listener_folder
from sfms_robot.viewer.visitor_commands import VERSION


def page_facts(
    head: Head,
    *,
    port: str,
    listener: str,
    speaker: str | None,
    seed: int,
    calmness: Calmness,
    people: Mapping[str, float],
    knobs: LiveKnobs,
    source: Mapping[str, bool],
    choices: bool,
) -> dict[str, Any]:
    """`speaker`: name of the recorded person; None: somebody live. `people`: see `people_per_minute`. `source`: what a
    visitor may bring of the person. `choices`: another listener, speaker or seed may be chosen.
    """
    return {
        "version": VERSION,
        "head": head.name,
        "port": port,
        "listener": Path(listener).name,
        "speaker": speaker,
        "seed": seed,
        "listeners": _lines(shipped_listeners()) if choices else [],
        "speakers": _lines(shipped_speakers()) if choices else [],
        "joints": [
            {
                "name": name, "min_rad": joint.min_rad, "max_rad": joint.max_rad, "rest_rad": joint.rest_rad,
                "bus": joint.bus, "id": joint.id, "model": joint.model,
            }
            for name, joint in head.joints.items()
        ],
        "urdf_joints": list(head.joints),
        "urdf": None,
        "channels": list(CHANNELS),
        "regions": list(knobs),
        "expressions": NAMED_EXPRESSIONS,
        "intensity": knobs.values["intensity"],
        "style": knobs.values["style"],
        "calmness": calmness.model_dump(exclude={"addressed"}),
        "people_per_minute": dict(people),
        "human": "human/head.bin",
        "source": dict(source),
        "replay": False,
    }  # fmt: skip


def people_per_minute(listener: str) -> dict[str, float]:
    """Events a minute by kind, as people taught them: what a rate of None asks for. Empty where none are decided.

    A listener of another package or machine may decide them; what it learned is not known here, so it is taken for
    one of ours. Raises ConfigError.
    """
    folder = listener_folder(listener)
    if folder is not None and not load_listener(folder / "config.yaml").events:
        return {}
    return {kind: hazard.per_minute for kind, hazard in load_tables().hazards.items()}


def _lines(rows: list[dict[str, Any]]) -> list[dict[str, str]]:
    return [{"name": row["name"], "line": row["description"]} for row in rows]
