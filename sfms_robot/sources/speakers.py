"""Who is listened to, by name: what `--audio`, `--face` and `--agent-audio` say, as files.

Nothing is opened here and nothing heavy imported, so a name that is wrong is found at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sfms_robot.data import data_dir, shipped_names
from sfms_robot.errors import ConfigError

DEFAULT_SPEAKER = "facegood_1114_3_16"
_AUDIO_LATER = ("mic",)
_FACE_LATER = ("live-link", "vmc", "webcam")


@dataclass(frozen=True)
class RecordedFiles:
    """The files of a recorded person; None where there is none. `agent_audio`: what the robot itself says."""

    audio: Path | None
    face: Path | None
    agent_audio: Path | None


def recorded_files(audio: str = "default", face: str = "auto", agent_audio: str = "none") -> RecordedFiles:
    """What `--audio FILE|SPEAKER|none|default`, `--face FILE|none|auto` and `--agent-audio FILE|none` ask for.

    `default` is `DEFAULT_SPEAKER`, or no voice when a face file is given. A face `auto` is the shipped speaker's
    own, or none beside somebody's sound file. Raises ConfigError for a kind of input that is not there and for files
    that do not exist.
    """
    if audio == "default":
        audio = DEFAULT_SPEAKER if face in ("auto", "none") else "none"
    voice, own_face = _voice(audio)
    return RecordedFiles(voice, own_face if face == "auto" else _face(face), _agent_voice(agent_audio))


@dataclass(frozen=True)
class Speaker:
    """A recorded person that ships with the package: `sim/speakers/NAME/`."""

    name: str
    audio: Path
    face: Path | None


def speakers() -> list[str]:
    """Names of the shipped speakers."""
    return shipped_names(data_dir("sim") / "speakers", "speech.wav")


def shipped_speaker(name: str) -> Speaker:
    """A shipped speaker by name. Raises ConfigError with the names there are."""
    if name not in speakers():
        raise ConfigError(f"--audio {name!r} is not a shipped speaker ({', '.join(speakers())})")
    folder = data_dir("sim") / "speakers" / name
    face = folder / "face.csv.gz"
    return Speaker(name, folder / "speech.wav", face if face.is_file() else None)


def _voice(name: str) -> tuple[Path | None, Path | None]:
    """Sound file, and the face that belongs to it."""
    choices = f"FILE.wav, none, default, {', '.join(speakers())}"
    if name.partition(":")[0] in _AUDIO_LATER:
        raise ConfigError(f"--audio {name}: not available yet ({choices})")
    if name == "none":
        return None, None
    if name in speakers() and not Path(name).is_file():
        speaker = shipped_speaker(name)
        return speaker.audio, speaker.face
    if not Path(name).exists():
        raise ConfigError(f"--audio {name}: no such file ({choices})")
    return Path(name), None


def _agent_voice(name: str) -> Path | None:
    choices = f"FILE.wav, none, {', '.join(speakers())}"
    if name == "loopback":
        raise ConfigError(f"--agent-audio {name}: not available yet ({choices})")
    if name == "none":
        return None
    if name in speakers() and not Path(name).is_file():
        return shipped_speaker(name).audio
    if not Path(name).exists():
        raise ConfigError(f"--agent-audio {name}: no such file ({choices})")
    return Path(name)


def _face(name: str) -> Path | None:
    choices = "FILE.csv, FILE.csv.gz, none, auto"
    if name.partition(":")[0] in _FACE_LATER:
        raise ConfigError(f"--face {name}: not available yet ({choices})")
    if name == "none":
        return None
    if not Path(name).exists():
        raise ConfigError(f"--face {name}: no such file ({choices})")
    return Path(name)
