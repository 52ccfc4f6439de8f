"""Heads, listeners, recorded people, serial ports, sound devices: what there is to choose from, a row with a name and a
description each.
"""

from __future__ import annotations

from typing import Any

from sfms_robot.config import load_head
from sfms_robot.config.listener_kinds import load_listener
from sfms_robot.data import data_dir, head_names, listener_names, speaker_names
from sfms_robot.servo.discovery import ports_data
from sfms_robot.sources.registry import shipped_speaker
from sfms_robot.sources.sound_devices import SoundDevice, sound_devices


def shipped_heads() -> list[dict[str, Any]]:
    """What `head list` shows."""
    heads = [load_head(name) for name in head_names()]
    return [
        {
            "name": head.name,
            "description": head.description,
            "joints": len(head.joints),
            "neck": head.kinematics.kind if head.kinematics else None,
            "buses": {name: bus.family for name, bus in head.buses.items()},
        }
        for head in heads
    ]


def shipped_listeners() -> list[dict[str, Any]]:
    """What `listener list` shows."""
    folder = data_dir("configs") / "listeners"
    rows = []
    for name in listener_names():
        config = load_listener(folder / name / "config.yaml")
        rows.append(
            {
                "name": name,
                "kind": config.kind,
                "weights": (folder / name / "model.safetensors").is_file(),
                "description": config.description,
            }
        )
    return rows


def shipped_speakers() -> list[dict[str, Any]]:
    """What `speaker list` shows; the description is the title of SOURCE.md."""
    import soundfile

    rows = []
    for name in speaker_names():
        speaker = shipped_speaker(name)
        title = (speaker.audio.parent / "SOURCE.md").read_text(encoding="utf-8").splitlines()[0]
        rows.append(
            {
                "name": name,
                "seconds": round(soundfile.info(speaker.audio).duration, 1),
                "face": speaker.face is not None,
                "description": title.partition(": ")[2],
            }
        )
    return rows


def serial_ports() -> list[dict[str, Any]]:
    """What `port list` shows. `name` is what to give to --port."""
    return ports_data()


def microphones() -> list[dict[str, Any]]:
    """What `port list` shows of sound; blocks for half a second. `name` is what to give to --audio mic:NAME.

    Raises ConfigError without PortAudio.
    """
    return [
        {
            **_row(device),
            "description": f"--agent-audio device:{device.name}" if device.monitor else f"--audio mic:{device.name}",
        }
        for device in sound_devices("recording")
    ]


def loudspeakers() -> list[dict[str, Any]]:
    """As `microphones`; `name` is what to give to --play NAME."""
    return [{**_row(device), "description": f"--play {device.name}"} for device in sound_devices("playing")]


def _row(device: SoundDevice) -> dict[str, Any]:
    return {
        "name": device.name,
        "number": None if device.server else str(device.number),
        "default": device.default,
        "channels": device.channels,
        "rate_hz": round(device.rate_hz),
    }
