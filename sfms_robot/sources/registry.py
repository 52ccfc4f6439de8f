"""The kinds of sources there are, and what `--audio`, `--face` and `--agent-audio` make of them.

A kind of somebody else's is an entry point of the group `sfms_robot.sources`: a callable that takes what stands behind
the colon of `--audio NAME:ARGUMENT` and the length of the run (or None), and returns a `ports.Source`. Kinds are
imported when they are opened, so that a name that is wrong is found at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Final

from sfms_robot.errors import ConfigError
from sfms_robot.sources.speakers import recorded_files

if TYPE_CHECKING:
    from sfms_robot.ports import Source
    from sfms_robot.sources.validated import ValidatedSource

GROUP: Final = "sfms_robot.sources"
# What `--audio` says when it is neither a file nor a shipped speaker.
SOURCES: Final[Mapping[str, EntryPoint]] = {
    "push": EntryPoint("push", "sfms_robot.sources.push:open_push", GROUP),
}


def source_kinds(others: Iterable[EntryPoint] | None = None) -> dict[str, EntryPoint]:
    """Every kind by name, not yet imported; ours go before those of other packages."""
    found = entry_points(group=GROUP) if others is None else others
    return {each.name: each for each in found} | dict(SOURCES)


def check_source(
    audio: str = "default",
    face: str = "auto",
    agent_audio: str = "none",
    kinds: Mapping[str, EntryPoint] | None = None,
) -> None:
    """Is there such a kind, or such files? Imports and opens nothing. Raises ConfigError."""
    name = audio.partition(":")[0]
    if name not in (source_kinds() if kinds is None else kinds):
        recorded_files(audio, face, agent_audio)
        return
    for flag, value, free in (("--face", face, "auto"), ("--agent-audio", agent_audio, "none")):
        if value not in (free, "none"):
            raise ConfigError(f"{flag} {value}: --audio {name} brings its own ({free})")


def open_source(
    audio: str = "default",
    face: str = "auto",
    duration_s: float | None = None,
    loop: bool = True,
    agent_audio: str = "none",
    kinds: Mapping[str, EntryPoint] | None = None,
) -> ValidatedSource:
    """A source by what a run is told of it: a kind by name, or a recording (`open_recording`).

    Raises ConfigError for what is not there and for files that cannot be used.
    """
    from sfms_robot.sources.recording import open_recording
    from sfms_robot.sources.validated import ValidatedSource

    known = source_kinds() if kinds is None else kinds
    check_source(audio, face, agent_audio, known)
    name, _, argument = audio.partition(":")
    if name in known:
        return ValidatedSource(_opened(known[name], argument, duration_s))
    return ValidatedSource(open_recording(audio, face, duration_s, loop, agent_audio))


def _opened(kind: EntryPoint, argument: str, duration_s: float | None) -> Source:
    try:
        build: Callable[[str, float | None], Source] = kind.load()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"--audio {kind.name}: {kind.value} cannot be imported: {error}") from error
    return build(argument, duration_s)
