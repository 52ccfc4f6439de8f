"""Rows of the available heads, listeners, recorded people, serial ports and sound devices; export of a listener."""

from __future__ import annotations

from pathlib import Path
from typing import cast, get_args

from sfms_robot.app.output_paths import made_folder
from sfms_robot.app.progress import bar
from sfms_robot.config import load_head, load_listener
from sfms_robot.data import Report, data_dir, find, head_names, listener_names, speaker_names
from sfms_robot.errors import ConfigError, RobotError, optional
from sfms_robot.listeners.checkpoint import WEIGHTS, Bits, read_weights, write_tensors
from sfms_robot.outputs.registry import DESCRIPTIONS, output_kinds
from sfms_robot.servo.discovery import ports_data
from sfms_robot.sources.registry import shipped_speaker


def shipped_heads() -> list[Report]:
    """Return the rows of `head list`."""
    return [
        {
            "name": head.name,
            "description": head.description,
            "joints": len(head.joints),
            "neck": head.kinematics.kind if head.kinematics else None,
            "buses": {name: bus.family for name, bus in head.buses.items()},
        }
        for head in map(load_head, head_names())
    ]


def shipped_listeners() -> list[Report]:
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


def shipped_speakers() -> list[Report]:
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


def outputs() -> list[Report]:
    """Return the rows of `output list`, with those of other packages. The value of --output begins with `name`."""
    return [
        {"name": name, "description": DESCRIPTIONS.get(name, f"of package {entry.dist.name if entry.dist else '?'}")}
        for name, entry in output_kinds().items()
    ]


def ports() -> Report:
    """Return the tables of `port list`; the name of a serial port is the value for --port. Blocks for a second.

    The description of a sound device contains the option for it. `microphone_problem` reports a missing PortAudio.
    """
    found: Report = {"ports": ports_data(), "microphones": [], "loudspeakers": [], "microphone_problem": None}
    try:
        found |= {"microphones": _sound_devices(playing=False), "loudspeakers": _sound_devices(playing=True)}
    except RobotError as error:
        found["microphone_problem"] = str(error)
    return found


def _sound_devices(playing: bool) -> list[Report]:
    from sfms_robot.sources import sound_devices

    def option(monitor: bool) -> str:
        return "--play " if playing else "--agent-audio device:" if monitor else "--audio mic:"

    return [
        {
            "name": device.name,
            "number": None if device.of_server else str(device.number),
            "default": device.default,
            "channels": device.channels,
            "rate_hz": round(device.rate_hz),
            "description": f"{option(device.monitor)}{device.name}",
        }
        for device in sound_devices.sound_devices(playing)
    ]


# --- export -------------------------------------------------------------------------------------------------------


def export_listener(name: str, out: Path | None, int8: bool, weight_bits: int | None) -> list[Path]:
    """Write the graphs of a listener, by shipped name or folder, into its folder or `out`, and return the files.

    `int8`: also graphs with large layers in 8 bits. `weight_bits`: also the weights, stored in 8, 16 or 32 bits (see
    `checkpoint.write_tensors`). Takes a minute. Raises ConfigError, MissingExtra, ModelError.
    """
    if weight_bits not in (None, *get_args(Bits)):
        raise ConfigError(f"--weight-bits {weight_bits}: must be 8, 16 or 32")
    folder = find("listeners", name, "config.yaml")
    target = folder if out is None else made_folder(out, "--out")
    weights = None if weight_bits is None else read_weights(folder / WEIGHTS)
    with optional("sfms-robot export"):
        from sfms_robot.listeners.torch_engine import export
    with bar(f"exporting {name}") as moved:
        files = export(folder, target, int8, moved)
    if weights is not None:
        write_tensors(target / WEIGHTS, weights, cast("Bits", weight_bits))
        files = [*files, target / WEIGHTS]
    return files
