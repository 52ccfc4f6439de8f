"""Values of `--audio`, `--face` and `--agent-audio`: the name of a kind with its argument, a file, a shipped speaker.

A kind of another package is an entry point of the group `sfms_robot.sources`: a callable that accepts the text after
the colon (NAME:ARGUMENT) and returns a `ports.Voice`, a `ports.Sight`, or, for `--audio`, a whole `ports.Source`. Kinds
are imported only when they are opened, so that a wrong name is found at once. Any voice can be used with any face.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.data import SPEAKER_VOICE, data_dir, speaker_names
from sfms_robot.errors import ConfigError
from sfms_robot.network import LOCAL, Router
from sfms_robot.plugins import plug_in, plugins, shipped

if TYPE_CHECKING:  # these import numpy, which the check of a name does not need
    from sfms_robot.ports import Source
    from sfms_robot.sources.net_person import PageVisitor
    from sfms_robot.sources.push import Spoken

GROUP: Final = "sfms_robot.sources"
DEFAULT_SPEAKER: Final = "facegood_1114_3_16"
BROWSER: Final = "browser"  # the kind of a person in front of the page
# By flag: the methods that identify a part, and the name of such a part in errors.
_PARTS: Final[Mapping[str, Mapping[str, str]]] = {
    "--audio": {"take": "voice", "read": "source"},
    "--face": {"at": "face"},
    "--agent-audio": {"take": "voice"},
}

Kinds = Mapping[str, EntryPoint]


KINDS: Final[Mapping[str, Kinds]] = {
    "--audio": shipped(
        GROUP, mic="microphone:open_microphone", push="net_person:NetVoice", browser="net_person:open_browser_voice",
        ros2="ros2:Ros2Voice",
    ),
    "--face": shipped(
        GROUP, live_link="live_link:open_live_link", vmc="vmc:open_vmc", webcam="webcam:open_webcam",
        push="net_person:NetSight", browser="net_person:open_browser_sight", ros2="ros2:Ros2Sight",
    ),
    "--agent-audio": shipped(GROUP, device="microphone:open_loudspeaker", tcp="net_person:NetSpeech"),
}  # fmt: skip


def source_kinds(flag: str) -> Kinds:
    """Return every kind of a flag by name, not yet imported; shipped kinds take precedence over other packages'."""
    return KINDS[flag] if flag == "--agent-audio" else {**plugins(GROUP), **KINDS[flag]}


def split_kind(value: str) -> tuple[str, str]:
    """Split the value of a flag into the kind and its argument, which may lack a colon, as in `live-link,flip=yaw`."""
    end = min((value.index(mark) for mark in ":," if mark in value), default=len(value))
    return value[:end], value[end:].removeprefix(":")


@dataclass(frozen=True)
class ShippedSpeaker:
    """A recorded person that ships with the package: `sim/speakers/NAME/`."""

    audio: Path
    face: Path | None


def shipped_speaker(name: str) -> ShippedSpeaker:
    """Return the shipped speaker `name`, one of `data.speaker_names`."""
    folder = data_dir("sim") / "speakers" / name
    face = folder / "face.csv.gz"
    return ShippedSpeaker(folder / SPEAKER_VOICE, face if face.is_file() else None)


def voice_file(name: str) -> Path | None:
    """Return the sound file with this path, or the sound file of the speaker with this name; None if neither exists."""
    speaker = _speaker(name)
    return _existing(name) if speaker is None else speaker.audio


def _speaker(name: str) -> ShippedSpeaker | None:
    """Return the shipped speaker `name`; None if there is none, or if a file has that name."""
    return shipped_speaker(name) if name in speaker_names() and not Path(name).is_file() else None


def check_source(
    audio: str = "default", face: str = "auto", agent_audio: str = "none", play: str | None = None
) -> None:
    """Check that the kinds or files exist, and that `play` has a voice to play. Imports and opens nothing.

    Raises ConfigError with the valid choices.
    """
    speakers = speaker_names()
    for flag, value, file, files in (
        ("--audio", audio, voice_file(audio), ["FILE.wav", "none", "default", *speakers]),
        ("--face", face, _existing(face), ["FILE.csv", "FILE.csv.gz", "none", "auto"]),
        ("--agent-audio", agent_audio, voice_file(agent_audio), ["FILE.wav", "none", *speakers]),
    ):
        kinds = source_kinds(flag)
        if split_kind(value)[0] not in kinds and value not in files and file is None:
            problem = "sound is not read from a pipe: write it to a file" if value == "-" else "no such file"
            raise ConfigError(f"{flag} {value}: {problem} ({', '.join([*kinds, *files])})")
    if play is not None and (agent_audio == "none" or split_kind(agent_audio)[0] == "device"):
        choices = ", ".join(["FILE.wav", "tcp", *speakers])
        raise ConfigError(f"--play {play}: nothing to play of --agent-audio {agent_audio} ({choices})")


def open_source(
    audio: str = "default",
    face: str = "auto",
    duration_s: float | None = None,
    loop: bool = True,
    agent_audio: str = "none",
    agent: Spoken | None = None,
    play: str | None = None,
    visitor: PageVisitor | None = None,
    router: Router = LOCAL,
) -> Source:
    """Open a person by the flags of a run.

    The audio `default` is `DEFAULT_SPEAKER`, or no voice if a face is named. The face `auto` is the shipped speaker's
    own face, else none. The robot's voice is removed from the sound of a microphone.

    Args:
        loop: True: recordings start again when they end before `duration_s`.
        agent: the robot's voice, instead of `agent_audio`.
        play: the device that plays the robot's voice; None: it is played elsewhere.
        visitor: the person in front of the page, if a page is served.
        router: the router of ROS 2.

    Raises ConfigError for a part that does not exist or cannot be used, and the errors of a kind when it is opened.
    """
    from sfms_robot.sources.paired import JudgedSource, PairedSource

    check_source(audio, face, agent_audio, play if agent is None else None)
    if audio == "default":
        audio = DEFAULT_SPEAKER if face in ("auto", "none") else "none"
    again = loop and duration_s is not None
    with ExitStack() as failed:  # closes the parts already opened if another one fails
        opened = partial(_opened, failed)
        voice: Any
        own: Any = agent
        if own is None and split_kind(audio)[0] == "mic" and split_kind(agent_audio)[0] == "device":
            from sfms_robot.sources.microphone import open_microphone_and_loudspeaker

            voice, own = open_microphone_and_loudspeaker(split_kind(audio)[1], split_kind(agent_audio)[1])
            failed.callback(voice.close)
        else:
            own = own or opened("--agent-audio", agent_audio) or _recorded_voice(agent_audio, False)
            if play is not None:
                from sfms_robot.sources.playback import open_playback

                own = open_playback(play, own)
                failed.callback(own.close)
            voice = opened("--audio", audio, mic=own, browser=visitor, ros2=router) or _recorded_voice(audio, again)
        if voice is not None and hasattr(voice, "read"):
            for flag, value, free in (("--face", face, "auto"), ("--agent-audio", agent_audio, "none")):
                if value not in (free, "none"):
                    raise ConfigError(f"{flag} {value}: --audio {audio} brings its own ({free})")
            source: Source = JudgedSource(voice)
        else:
            sight = opened("--face", face, browser=visitor, ros2=router)
            sight = sight or _recorded_sight(face, audio, again, getattr(voice, "frames", None))
            source = PairedSource(voice, sight, own, duration_s)
        failed.pop_all()
    return source


def _opened(failed: ExitStack, flag: str, value: str, **more: Any) -> Any:
    """Open a kind; None if `value` names none. `more`: a further argument of a kind's callable, by kind."""
    name, argument = split_kind(value)
    kind = source_kinds(flag).get(name)
    if kind is None:
        return None
    part = plug_in(kind, argument, more[name]) if name in more else plug_in(kind, argument)
    if not any(hasattr(part, method) for method in _PARTS[flag]):
        wanted = " or ".join(_PARTS[flag].values())
        raise ConfigError(f"{flag} {name}: expected a {wanted} from {kind.value}, got a {type(part).__name__}")
    failed.callback(part.close)
    return part


def _existing(name: str) -> Path | None:
    return Path(name) if Path(name).exists() else None


def _recorded_voice(name: str, loop: bool) -> Any:
    from sfms_robot.signals.audio import AudioFile
    from sfms_robot.sources.recording import RecordedVoice

    file = None if name == "none" else voice_file(name)
    return None if file is None else RecordedVoice(AudioFile(file), loop)


def _recorded_sight(face: str, audio: str, loop: bool, frames: int | None) -> Any:
    from sfms_robot.signals.tracks import read_track
    from sfms_robot.sources.recording import RecordedSight

    speaker = _speaker(audio)
    file = (None if speaker is None else speaker.face) if face == "auto" else _existing(face)
    return None if face == "none" or file is None else RecordedSight(read_track(file), loop, frames)
