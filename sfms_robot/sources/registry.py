"""What `--audio`, `--face` and `--agent-audio` may say: a kind by name with its argument, a file, a shipped speaker.

A kind of somebody else's is an entry point of the group `sfms_robot.sources`: a callable that takes what stands behind
the colon (NAME:ARGUMENT) and returns a `ports.Voice`, a `ports.Sight`, or, for `--audio`, a whole `ports.Source`. Kinds
are imported when they are opened, so that a name that is wrong is found at once. Any voice goes with any face.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.data import speaker_names
from sfms_robot.errors import ConfigError
from sfms_robot.plugins import plug_in, plugins
from sfms_robot.sources.speakers import DEFAULT_SPEAKER, own_face, voice_file

if TYPE_CHECKING:
    from sfms_robot.ports import Source, Voice
    from sfms_robot.sources.browser import Visitor
    from sfms_robot.sources.spoken import Spoken

GROUP: Final = "sfms_robot.sources"
BROWSER: Final = "browser"  # the kind of a person in front of the page
_HERE: Final = "sfms_robot.sources"
_METHODS: Final = {"voice": "take", "face": "at", "source": "read"}  # by which each is told from the others

Kinds = Mapping[str, EntryPoint]


def _ours(**kinds: str) -> Kinds:
    named = {name.replace("_", "-"): place for name, place in kinds.items()}
    return {name: EntryPoint(name, f"{_HERE}.{place}", GROUP) for name, place in named.items()}


VOICES: Final = _ours(
    mic="microphone:open_microphone", push="net_person:open_net_voice", browser="browser:open_browser_voice"
)
SIGHTS: Final = _ours(
    live_link="live_link:open_live_link", vmc="vmc:open_vmc", webcam="webcam:open_webcam",
    push="net_person:open_net_sight", browser="browser:open_browser_sight",
)  # fmt: skip
AGENT_VOICES: Final = _ours(device="microphone:open_loudspeaker", tcp="net_person:open_net_speech")


@dataclass(frozen=True)
class SourceKinds:
    """Every kind of each flag by name, not yet imported; ours go before those of other packages."""

    voices: Kinds
    sights: Kinds
    agent_voices: Kinds


def source_kinds(others: Iterable[EntryPoint] | None = None) -> SourceKinds:
    """Return every kind of source; `others`: those of other packages, None for what is installed."""
    found = plugins(GROUP) if others is None else {each.name: each for each in others}
    return SourceKinds({**found, **VOICES}, {**found, **SIGHTS}, AGENT_VOICES)


def split_kind(value: str) -> tuple[str, str]:
    """What a flag says -> the kind's name and its argument: `live-link,flip=yaw` has one without a colon."""
    end = min((value.index(mark) for mark in ":," if mark in value), default=len(value))
    return value[:end], value[end:].removeprefix(":")


def check_source(
    audio: str = "default",
    face: str = "auto",
    agent_audio: str = "none",
    kinds: SourceKinds | None = None,
    play: str | None = None,
) -> None:
    """Are there such kinds, or such files, and something to play? Imports and opens nothing. Raises ConfigError with
    the choices.
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
    visitor: Visitor | None = None,
) -> Source:
    """A person by what a run is told of them.

    An audio `default` is `DEFAULT_SPEAKER`, or no voice when a face is named. A face `auto` is the shipped speaker's
    own, else none. `loop`: recordings start again when they end before `duration_s` does. `agent` is what the robot
    says, instead of `agent_audio`. `play`: the device that plays it; None: somebody else does. `visitor`: who is in
    front of the page, where one is served.

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
            own = _played(play, agent or _agent(agent_audio, known, failed), failed)
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
            own = own or _agent(agent_audio, known, failed)
            source = PairedSource(voice, sight, own, duration_s)
        failed.pop_all()
    return source


def _check(flag: str, value: str, kinds: Kinds, file: Path | None, files: Iterable[str]) -> None:
    (name, _), choices = split_kind(value), ", ".join([*kinds, *files])
    if name not in kinds and value not in files and file is None:
        raise ConfigError(f"{flag} {value}: no such file ({choices})")


def _existing(name: str) -> Path | None:
    return Path(name) if Path(name).exists() else None


def _opened(
    flag: str, value: str, kinds: Kinds, wanted: tuple[str, ...], failed: ExitStack, visitor: Visitor | None = None
) -> Any:
    """What a kind opens; None where `value` names none."""
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
    """A microphone, and what the robot says: the one has to know of the other, whose echo it hears."""
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


def _played(device: str, spoken: Spoken, failed: ExitStack) -> Voice:
    from sfms_robot.sources.playback import open_playback

    played = open_playback(device, spoken)
    failed.callback(played.close)
    return played


def _recorded_voice(name: str, loop: bool) -> Any:
    from sfms_robot.signals.audio import AudioFile
    from sfms_robot.sources.recording import RecordedVoice

    file = None if name == "none" else voice_file(name)
    return None if file is None else RecordedVoice(AudioFile(file), loop)


def _recorded_sight(face: str, audio: str, loop: bool, frames: int | None) -> Any:
    from sfms_robot.signals.tracks import read_track
    from sfms_robot.sources.recording import RecordedSight

    file = own_face(audio) if face == "auto" else _existing(face)
    return None if face == "none" or file is None else RecordedSight(read_track(file), loop, frames)
