"""Paths of the package's files and of the user's files; types of plain data; writing of whole files."""

from __future__ import annotations

import os
from contextlib import suppress
from importlib.resources import files
from pathlib import Path
from typing import Any, Final, Literal

from sfms_robot.errors import CHECKOUT, ConfigError, did_you_mean

SPEAKER_VOICE: Final = "speech.flac"  # file in the folder of each shipped speaker
_ARCHIVES: Final = {b"PK\x03\x04": "zip", b"7z\xbc\xaf": "7z", b"Rar!": "rar", b"BZh": "bz2", b"\xfd7zXZ": "xz"}

NO_HEAD: Final = "none"  # name of the head without servos, which only outputs show

Names = tuple[str, ...]  # names of joints, channels or causes
Report = dict[str, Any]  # plain data, as --json prints it
Shipped = Literal["configs", "firmware_maps", "sim"]


def data_dir(name: Shipped) -> Path:
    """Return a folder of shipped files: inside the installed package, else next to the package in a checkout.

    Raises FileNotFoundError if neither exists, which means that the installation is broken.
    """
    installed = Path(str(files("sfms_robot"))) / name
    if installed.is_dir():
        return installed
    if (CHECKOUT / "pyproject.toml").is_file() and (CHECKOUT / name).is_dir():
        return CHECKOUT / name
    raise FileNotFoundError(f"the package's own folder {name!r} is missing: reinstall sfms-robot")


def user_dir() -> Path:
    """Return the folder of this user's files: overlays of heads, firmware maps, the key of a fleet."""
    from platformdirs import user_config_path

    return user_config_path("sfms-robot", appauthor=False)


def archive_kind(data: bytes) -> str | None:
    """Return the kind of archive of a file, recognised by its first 300 bytes or more; None for any other file."""
    if data[257:262] == b"ustar":
        return "tar"
    return next((kind for mark, kind in _ARCHIVES.items() if data.startswith(mark)), None)


def shipped_names(folder: Path, marker: str) -> list[str]:
    """Return the names of the folders in `folder` that hold a file called `marker`, sorted."""
    return sorted(path.parent.name for path in folder.glob(f"*/{marker}"))


def head_names() -> list[str]:
    """Return the names of the shipped heads."""
    return shipped_names(data_dir("configs") / "heads", "head.yaml")


def listener_names() -> list[str]:
    """Return the names of the shipped listeners."""
    return shipped_names(data_dir("configs") / "listeners", "config.yaml")


def speaker_names() -> list[str]:
    """Return the names of the shipped speakers."""
    return shipped_names(data_dir("sim") / "speakers", SPEAKER_VOICE)


def head_file(name: str) -> Path:
    """Return the head.yaml of a shipped head by name, or of another head by path. Raises ConfigError."""
    return find("heads", name, "head.yaml") / "head.yaml"


def find(kind: Literal["heads", "listeners"], name: str, marker: str) -> Path:
    """Return the folder of a shipped head or listener by name, or of another one by path. Raises ConfigError."""
    root = data_dir("configs") / kind
    for folder in (root / name, Path(name)):
        if (folder / marker).is_file():
            return folder
    if Path(name).name == marker and Path(name).is_file():
        return Path(name).parent
    choices = shipped_names(root, marker)
    neither = f"is neither a shipped name nor a folder with a {marker} ({', '.join(choices)})"
    raise ConfigError(f"{kind.removesuffix('s')} {name!r} {neither}{did_you_mean(name, choices)}")


def write_whole(file: Path, text: str) -> None:
    """Write a file completely or not at all; its folder is created if needed. Raises ConfigError."""
    new = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with new.open("w", encoding="utf-8", newline="") as out:
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        new.replace(file)
    except OSError as error:
        with suppress(OSError):
            new.unlink()
        raise ConfigError(f"{file}: cannot be written: {error}") from error
