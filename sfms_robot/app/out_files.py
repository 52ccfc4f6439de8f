"""Files that a command will write, looked at before anybody has worked for them."""

from __future__ import annotations

from pathlib import Path

from sfms_robot.errors import ConfigError


def checked_file(file: Path, option: str) -> Path:
    """The file. Raises ConfigError, which names the option, where none can be written."""
    if file.is_dir():
        raise ConfigError(f"{option} {file}: cannot be written: is a folder")
    if not file.parent.is_dir():
        raise ConfigError(f"{option} {file}: cannot be written: no folder {file.parent}")
    return file


def made_folder(folder: Path, option: str) -> Path:
    """The folder, which is there now. Raises ConfigError, which names the option, where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{option} {folder}: cannot be written to: {error.strerror or error}") from error
    return folder
