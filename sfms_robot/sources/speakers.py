"""The people who ship with the package, and the files that `--audio`, `--face` and `--agent-audio` name.

Nothing is opened here and nothing heavy imported, so a name that is wrong is found at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sfms_robot.data import SPEAKER_VOICE, data_dir, speaker_names
from sfms_robot.errors import ConfigError

DEFAULT_SPEAKER = "facegood_1114_3_16"


@dataclass(frozen=True)
class Speaker:
    """A recorded person that ships with the package: `sim/speakers/NAME/`."""

    name: str
    audio: Path
    face: Path | None


def shipped_speaker(name: str) -> Speaker:
    """A shipped speaker by name. Raises ConfigError with the names there are."""
    if name not in speaker_names():
        raise ConfigError(f"--audio {name!r} is not a shipped speaker ({', '.join(speaker_names())})")
    folder = data_dir("sim") / "speakers" / name
    face = folder / "face.csv.gz"
    return Speaker(name, folder / SPEAKER_VOICE, face if face.is_file() else None)


def voice_file(name: str) -> Path | None:
    """A sound file by path, or a speaker's by name; None when there is neither."""
    if name in speaker_names() and not Path(name).is_file():
        return shipped_speaker(name).audio
    return Path(name) if Path(name).exists() else None


def own_face(name: str) -> Path | None:
    """The face that belongs to a voice: a shipped speaker's; None beside somebody's sound file."""
    return shipped_speaker(name).face if name in speaker_names() and not Path(name).is_file() else None
