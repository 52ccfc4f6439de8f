"""Values of `--audio`, `--face` and `--agent-audio`: a kind by name with its argument, a file, a shipped speaker.

A kind of another package is an entry point of the group `sfms_robot.sources`: a callable that takes the text behind the
colon (NAME:ARGUMENT) and returns a `ports.Voice`, a `ports.Sight`, or, for `--audio`, a whole `ports.Source`. Kinds are
imported when they are opened, so that a wrong name is found at once. Any voice goes with any face.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.data import SPEAKER_VOICE, data_dir, speaker_names
from sfms_robot.errors import ConfigError
from sfms_robot.plugins import plug_in, plugins

if TYPE_CHECKING:  # numpy, which a look at a name does not need
    from sfms_robot.ports import Source, Voice
    from sfms_robot.sources.net_person import PageVisitor
    from sfms_robot.sources.push import Spoken

GROUP: Final = "sfms_robot.sources"
DEFAULT_SPEAKER: Final = "facegood_1114_3_16"
BROWSER: Final = "browser"  # the kind of a person in front of the page
_METHODS: Final = {"voice": "take", "face": "at", "source": "read"}  # the method that only this one has

Kinds = Mapping[str, EntryPoint]


def _ours(**kinds: str) -> Kinds:
    named = {name.replace("_", "-"): place for name, place in kinds.items()}
    return {name: EntryPoint(name, f"sfms_robot.sources.{place}", GROUP) for name, place in named.items()}


VOICES: Final = _ours(
    mic="microphone:open_microphone", push="net_person:open_net_voice", browser="net_person:open_browser_voice"
)
SIGHTS: Final = _ours(
    live_link="live_link:open_live_link", vmc="vmc:open_vmc", webcam="webcam:open_webcam",
    push="net_person:open_net_sight", browser="net_person:open_browser_sight",
)  # fmt: skip
AGENT_VOICES: Final = _ours(device="microphone:open_loudspeaker", tcp="net_person:open_net_speech")


@dataclass(frozen=True)
class SourceKinds:
    """Every kind of each flag by name, not yet imported; shipped kinds go before those of other packages."""

    voices: Kinds
    sights: Kinds
    agent_voices: Kinds


def source_kinds(others: Iterable[EntryPoint] | None = None) -> SourceKinds:
    """Return every kind of source; `others`: those of other packages, None for the installed ones."""
    found = plugins(GROUP) if others is None else {each.name: each for each in others}
    return SourceKinds({**found, **VOICES}, {**found, **SIGHTS}, AGENT_VOICES)


def split_kind(value: str) -> tuple[str, str]:
    """Return the kind's name and its argument of the value of a flag: `live-link,flip=yaw` has one without a colon."""
    end = min((value.index(mark) for mark in ":," if mark in value), default=len(value))
    return value[:end], value[end:].removeprefix(":")


@dataclass(frozen=True)
class ShippedSpeaker:
    """A recorded person that ships with the package: `sim/speakers/NAME/`."""

    name: str
    audio: Path
    face: Path | None


def shipped_speaker(name: str) -> ShippedSpeaker:
    """Return a shipped speaker by name. Raises ConfigError with the choices."""
    if name not in speaker_names():
        raise ConfigError(f"--audio {name!r} is not a shipped speaker ({', '.join(speaker_names())})")
    folder = data_dir("sim") / "speakers" / name
    face = folder / "face.csv.gz"
    return ShippedSpeaker(name, folder / SPEAKER_VOICE, face if face.is_file() else None)


def voice_file(name: str) -> Path | None:
    """Return a sound file by path, or a speaker's by name; None when there is neither."""
    speaker = _speaker(name)
    return _existing(name) if speaker is None else speaker.audio


def _speaker(name: str) -> ShippedSpeaker | None:
    """Return a shipped speaker, unless a file has that name."""
    return shipped_speaker(name) if name in speaker_names() and not Path(name).is_file() else None


def check_source(
    audio: str = "default",
    face: str = "auto",
    agent_audio: str = "none",
    kinds: SourceKinds | None = None,
    play: str | None = None,
) -> None:
    """Check that there are such kinds, or such files, and something to play. Imports and opens nothing.

    Raises ConfigError with the choices.
    """
    known = source_kinds() if kinds is None else kinds
    speakers = speaker_names()
    _check("--audio", audio, known.voices, voice_file(audio), ["FILE.wav", "none", "default", *speakers])
    _check("--face", face, known.sights, _existing(face), ["FILE.csv", "FILE.csv.gz", "none", "auto"])
    _check("--agent-audio", agent_audio, known.agent_voices, voice_file(agent_audio), ["FILE.wav", "none", *speakers])
    if play is not None and (agent_audio == "none" or split_kind(agent_audio)[0] == "device"):
        choices = ", ".join(["FILE.wav", "tcp", *speakers])
        raise ConfigError(f"--play {play}: nothing is played of --agent-audio {agent_audio} ({choices})")


def open_source(
    audio: str = "default",
    face: str = "auto",
    duration_s: float | None = None,
    loop: bool = True,
    agent_audio: str = "none",
    kinds: SourceKinds | None = None,
    agent: Spoken | None = None,
    play: str | None = None,
    visitor: PageVisitor | None = None,
) -> Source:
    """Open a person by the flags of a run.

    An audio `default` is `DEFAULT_SPEAKER`, or no voice when a face is named. A face `auto` is the shipped speaker's
    own, else none.

    Args:
        loop: recordings start again when they end before `duration_s` does.
        agent: what the robot says, instead of `agent_audio`.
        play: the device that plays it; None: it is played elsewhere.
        visitor: the person in front of the page, where one is served.

    Raises ConfigError for what is not there and cannot be used; what a kind raises when it is opened.
    """
    from sfms_robot.sources.paired import JudgedSource, PairedSource

    known = source_kinds() if kinds is None else kinds
    check_source(audio, face, agent_audio, known, play if agent is None else None)
    if audio == "default":
        audio = DEFAULT_SPEAKER if face in ("auto", "none") else "none"
    again = loop and duration_s is not None
    with ExitStack() as failed:  # closes what was opened before the one that cannot be
        own: Any = agent
        if play is not None:
            from sfms_robot.sources.playback import open_playback

            own = open_playback(play, agent or _agent(agent_audio, known, failed))
            failed.callback(own.close)
        if split_kind(audio)[0] == "mic" and (own is not None or agent_audio != "none"):
            voice, own = _conversation(audio, own or agent_audio, known, failed)
        else:
            voice = _opened("--audio", audio, known.voices, ("voice", "source"), failed, visitor)
        voice = voice or _recorded_voice(audio, again)
        if voice is not None and hasattr(voice, _METHODS["source"]):
            for flag, value, free in (("--face", face, "auto"), ("--agent-audio", agent_audio, "none")):
                if value not in (free, "none"):
                    raise ConfigError(f"{flag} {value}: --audio {audio} brings its own ({free})")
            source: Source = JudgedSource(voice)
        else:
            sight = _opened("--face", face, known.sights, ("face",), failed, visitor)
            sight = sight or _recorded_sight(face, audio, again, getattr(voice, "frames", None))
            source = PairedSource(voice, sight, own or _agent(agent_audio, known, failed), duration_s)
        failed.pop_all()
    return source


def _check(flag: str, value: str, kinds: Kinds, file: Path | None, files: Iterable[str]) -> None:
    (name, _), choices = split_kind(value), ", ".join([*kinds, *files])
    if name not in kinds and value not in files and file is None:
        raise ConfigError(f"{flag} {value}: no such file ({choices})")


def _existing(name: str) -> Path | None:
    return Path(name) if Path(name).exists() else None


def _opened(
    flag: str, value: str, kinds: Kinds, wanted: tuple[str, ...], failed: ExitStack, visitor: PageVisitor | None = None
) -> Any:
    """Open a kind; None where `value` names none."""
    name, argument = split_kind(value)
    if name not in kinds:
        return None
    kind = kinds[name]
    part = plug_in(kind, argument, visitor) if name == BROWSER else plug_in(kind, argument)
    failed.callback(part.close)
    if not any(hasattr(part, _METHODS[each]) for each in wanted):
        raise ConfigError(f"{flag} {name}: {kind.value} gave a {type(part).__name__}, no {' or '.join(wanted)}")
    return part


def _conversation(audio: str, agent: Voice | str, known: SourceKinds, failed: ExitStack) -> tuple[Any, Any]:
    """Open a microphone, and what the robot says: its echo is taken out of what the microphone hears."""
    from sfms_robot.sources.microphone import open_microphone_and_loudspeaker, open_microphone_beside

    device = split_kind(audio)[1]
    both: tuple[Any, Any]
    if isinstance(agent, str) and split_kind(agent)[0] == "device":
        both = open_microphone_and_loudspeaker(device, split_kind(agent)[1])
    else:
        both = open_microphone_beside(device, _agent(agent, known, failed) if isinstance(agent, str) else agent)
    failed.callback(both[0].close)
    return both


def _agent(value: str, known: SourceKinds, failed: ExitStack) -> Any:
    agent = _opened("--agent-audio", value, known.agent_voices, ("voice",), failed)
    return agent or _recorded_voice(value, False)


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
