"""Rows of the heads, listeners, recorded people, serial ports and sound devices at hand."""

from __future__ import annotations

from typing import Any, Literal

from sfms_robot.config import load_head
from sfms_robot.config.listener import load_listener
from sfms_robot.data import data_dir, head_names, listener_names, speaker_names
from sfms_robot.outputs.registry import DESCRIPTIONS, output_kinds
from sfms_robot.servo.discovery import ports_data
from sfms_robot.sources.registry import shipped_speaker


def shipped_heads() -> list[dict[str, Any]]:
    """Return the rows of `head list`."""
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
    """Return the rows of `listener list`."""
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
    """Return the rows of `speaker list`; the description is the title of SOURCE.md."""
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


def outputs() -> list[dict[str, Any]]:
    """Return the rows of `output list`, those of other packages too. `name` begins the value for --output."""
    return [
        {"name": name, "description": DESCRIPTIONS.get(name, f"of package {entry.dist.name if entry.dist else '?'}")}
        for name, entry in output_kinds().items()
    ]


def serial_ports() -> list[dict[str, Any]]:
    """Return the rows of `port list`. `name` is the value for --port."""
    return ports_data()


def sound_devices(direction: Literal["recording", "playing"]) -> list[dict[str, Any]]:
    """Return the sound devices of `port list`, whose descriptions name the option for each; block for half a second.

    Raises ConfigError without PortAudio.
    """
    from sfms_robot.sources import sound_devices

    def option(monitor: bool) -> str:
        return "--play " if direction == "playing" else "--agent-audio device:" if monitor else "--audio mic:"

    return [
        {
            "name": device.name,
            "number": None if device.of_server else str(device.number),
            "default": device.default,
            "channels": device.channels,
            "rate_hz": round(device.rate_hz),
            "description": f"{option(device.monitor)}{device.name}",
        }
        for device in sound_devices.sound_devices(direction == "playing")
    ]
