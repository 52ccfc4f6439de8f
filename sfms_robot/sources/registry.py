"""The kinds of sources there are, and what `--audio`, `--face` and `--agent-audio` make of them.

A kind of somebody else's is an entry point of the group `sfms_robot.sources`: a callable that takes what stands behind
the colon of `--audio NAME:ARGUMENT` and the length of the run (or None), and returns a `ports.Source`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Final

from sfms_robot.errors import ConfigError
from sfms_robot.ports import Source
from sfms_robot.sources.push import PushSource
from sfms_robot.sources.recording import open_recording
from sfms_robot.sources.validated import ValidatedSource

GROUP: Final = "sfms_robot.sources"

Build = Callable[[str, float | None], Source]


def _push(argument: str, duration_s: float | None) -> Source:
    return PushSource(duration_s)


# What `--audio` says when it is neither a file nor a shipped speaker.
SOURCES: Final[Mapping[str, Build]] = {"push": _push}


def source_kinds(found: Callable[[], Mapping[str, EntryPoint]] | None = None) -> dict[str, Build]:
    """Every kind by name; ours go before others'. Those of other packages are imported when they are built."""
    others = {each.name: each for each in entry_points(group=GROUP)} if found is None else found()
    return {name: _lazily(entry) for name, entry in others.items()} | dict(SOURCES)


def open_source(
    audio: str = "default",
    face: str = "auto",
    duration_s: float | None = None,
    loop: bool = True,
    agent_audio: str = "none",
    kinds: Mapping[str, Build] | None = None,
) -> ValidatedSource:
    """A source by what a run is told of it: a kind by name, or a recording (`open_recording`).

    Raises ConfigError for what is not there and for files that cannot be used.
    """
    known = source_kinds() if kinds is None else kinds
    name, _, argument = audio.partition(":")
    if name not in known:
        return ValidatedSource(open_recording(audio, face, duration_s, loop, agent_audio))
    for flag, value, free in (("--face", face, "auto"), ("--agent-audio", agent_audio, "none")):
        if value not in (free, "none"):
            raise ConfigError(f"{flag} {value}: --audio {name} brings its own ({free})")
    return ValidatedSource(known[name](argument, duration_s))


def _lazily(entry: EntryPoint) -> Build:
    def build(argument: str, duration_s: float | None) -> Source:
        try:
            source: Source = entry.load()(argument, duration_s)
        except (ImportError, AttributeError) as error:
            raise ConfigError(f"--audio {entry.name}: {entry.value} cannot be imported: {error}") from error
        return source

    return build
