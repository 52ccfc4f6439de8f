"""The options of a run, and everything that can be checked or started from them before anything is loaded.

`sfms-robot run` and `demo`, `Robot(...)` and the report share one model. The checks use the functions of the run
itself; `session.run` checks the rest. Only the standard library is needed here, so a wrong name is reported as soon
as Python has started.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from sfms_robot.data import NO_HEAD, Names, head_file
from sfms_robot.errors import ConfigError
from sfms_robot.network import Router, check_name
from sfms_robot.plugins import REMOTE, listener_folder
from sfms_robot.servo.discovery import AUTO, check_device
from sfms_robot.sources.registry import BROWSER, check_source, split_kind

if TYPE_CHECKING:
    from sfms_robot.config import Calmness
    from sfms_robot.listeners.engine import EngineName
    from sfms_robot.ports import PlanFeed
    from sfms_robot.runtime.recorder import RecordFormat
    from sfms_robot.viewer.page_process import PageProcess


SIM: Final = "sim"  # the port of emulated servos
ENGINES: Final[tuple[EngineName, ...]] = ("auto", "onnx", "torch")
RECORD_FORMATS: Final[tuple[RecordFormat, ...]] = ("json", "ros2")
FEEDS: Final = ("voice", "face")  # what a run may receive from a person
PAGE: Final = "sfms_robot.app.head.head_scene:main"
_IN_TERMINALS: Final = ("www-browser", "links", "elinks", "lynx", "w3m", "browsh")


@dataclass(frozen=True, kw_only=True)
class HeadOptions:
    """A head and its servos.

    Attributes:
        head: shipped name, or a folder with a head.yaml; for a run also "none": no servos.
        port: "sim", "auto", a device, or NAME=DEVICE[,NAME=DEVICE] for a head of several buses.
        fast: virtual time; needs emulated servos.
        yes: hobby servos may jump when they come on.
        without: joints whose servos are not addressed at all.
        dry_run: for a run: torque stays off.
    """

    head: str = "face28"
    port: str = SIM
    fast: bool = False
    yes: bool = False
    without: Names = ()
    dry_run: bool = False

    @property
    def confirmed(self) -> bool:
        """True if hobby servos may be connected; they jump if torque comes on."""
        return self.yes or self.dry_run


@dataclass(frozen=True, kw_only=True)
class RunOptions(HeadOptions):
    """The options of `sfms-robot run`; None where a default depends on other options.

    `outputs`: KIND or KIND:ADDRESS each, see `outputs.registry`.
    """

    listener: str = "sfms-small"
    audio: str = "default"
    face: str = "auto"
    agent_audio: str = "none"
    play: str | None = None
    duration_s: float | None = None
    seed: int = 0
    engine: EngineName = "auto"
    intensity: Names = ()
    style: Names = ()
    calmness: Calmness | None = None
    record: Path | None = None
    record_format: RecordFormat = "json"
    overwrite: bool = False
    halt_on: str | None = None
    status: str | None = None
    fleet: str | None = None
    fleet_key: Path | None = None
    zenoh: Path | None = None
    insecure: bool = False
    packages: Names = ()
    outputs: Names = ()

    @property
    def router(self) -> Router:
        """Router of a fleet, or of a listener on another machine."""
        return Router(self.zenoh, self.insecure)

    @property
    def hears(self) -> str:
        """`audio`, but the microphone for "default" if the servos are real and the run is not a dry run."""
        return "mic" if self.audio == "default" and self.port != SIM and not self.dry_run else self.audio

    @property
    def listener_name(self) -> str:
        """`listener` without its folder or server, for people."""
        return Path(self.listener).name

    @property
    def visitor_feeds(self) -> list[str]:
        """The `FEEDS` that come from a visitor of the page."""
        given = zip(FEEDS, (self.hears, self.face), strict=True)
        return [feed for feed, kind in given if split_kind(kind)[0] == BROWSER]


_DEFAULTS: Final = RunOptions()


def check_names(options: RunOptions) -> None:
    """Check that head, listener, port and files exist, and that the status port is free.

    Raises ConfigError, PortError.
    """
    if options.head != NO_HEAD:
        head_file(options.head)
    if options.outputs:
        from sfms_robot.outputs.registry import check_outputs

        check_outputs(options.outputs)
    listener_folder(options.listener)
    check_source(options.audio, options.face, options.agent_audio, play=options.play)
    if options.status is not None:
        from sfms_robot.viewer.web_server import status_server

        status_server(options.status).close()
    for part in options.port.split(","):
        device = part.rpartition("=")[2]
        if device not in ("", SIM, AUTO):
            check_device(device, "--port ")


def engine_named(name: str) -> EngineName:
    """Return the engine of that name. Raises ConfigError."""
    if name not in ENGINES:
        raise ConfigError(f"--engine: expected one of {', '.join(ENGINES)}, got {name!r}")
    return name


def record_format_named(name: str) -> RecordFormat:
    """Return the recording format of that name. Raises ConfigError."""
    if name not in RECORD_FORMATS:
        raise ConfigError(f"--record-format: expected one of {', '.join(RECORD_FORMATS)}, got {name!r}")
    return name


def values_by_name(
    option: str, given: Sequence[str], form: str = "REGION=VALUE with a value from 0 to 2"
) -> dict[str, float]:
    """Return the numbers of an option that is given as NAME=NUMBER, several times. Raises ConfigError."""
    values = {}
    for text in given:
        region, _, value = text.partition("=")
        try:
            values[region] = float(value)
        except ValueError:
            raise ConfigError(f"{option} {text!r} is not {form}") from None
    return values


def words_of(values: Mapping[str, float]) -> Names:
    """Return the words NAME=NUMBER that `values_by_name` reads."""
    return tuple(f"{name}={value}" for name, value in values.items())


def calmed(per_minute: Sequence[str], addressed: str) -> Calmness:
    """Return the rates of `--calmness` and `--addressed`. Raises ConfigError for an unknown kind or an invalid rate."""
    from sfms_robot.config import Calmness, parse
    from sfms_robot.frames import EVENT_KINDS

    rates = values_by_name("--calmness", per_minute, "KIND=EVENTS A MINUTE")
    if unknown := [kind for kind in rates if kind not in EVENT_KINDS]:
        raise ConfigError(f"--calmness {unknown[0]}: no kind of event ({', '.join(EVENT_KINDS)})")
    return parse(Calmness, {**rates, "addressed": addressed}, "--calmness, --addressed")


def begin_listening(options: RunOptions) -> PlanFeed:
    """Return the listener, which loads or connects from now on, for `session.run(feed=...)`. The caller closes it.

    A listener on another machine chooses its engine itself. Raises ConfigError, MissingExtra.
    """
    if not options.listener.startswith(REMOTE):
        from sfms_robot.listeners.process import ListenerProcess

        return ListenerProcess(options.listener, options.seed, options.calmness, options.engine)
    from sfms_robot.listeners.remote import RemoteListener, ZenohLink

    served = check_name(options.listener.removeprefix(REMOTE), "listener")
    return RemoteListener(served, ZenohLink(served, options.router), options.seed, options.calmness)


def begin_page(
    address: str | None, certificate: Path | None = None, key: Path | None = None, *, options: RunOptions = _DEFAULTS
) -> PageProcess | None:
    """Return the page's process, which starts from now on; None if no page is wanted. The caller closes it.

    `address`: value of `--view`; a run whose person is a visitor has a page without it. Raises ConfigError for a run
    that no page can show.
    """
    if address is None:
        if not options.visitor_feeds:
            if certificate is not None or key is not None:
                raise ConfigError("--view-cert, --view-key: no page is served (--view)")
            return None
        address = "auto"
    if options.fast:
        raise ConfigError(f"--view {address}: a page shows what takes real time, so --fast is not possible")
    if options.dry_run:
        raise ConfigError(f"--view {address}: nothing moves in a --dry-run")
    from sfms_robot.viewer.page_process import Address, PageProcess  # only for a run with a page

    return PageProcess(Address.parsed(address, certificate, key), PAGE)


def can_open(environment: Mapping[str, str], platform: str) -> bool:
    """Return whether there is a screen, and the user of this program sits in front of it."""
    if "SSH_CONNECTION" in environment:
        return False
    return platform in ("darwin", "win32") or any(environment.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def open_browser(url: str) -> bool:
    """Show `url` in a browser window of this computer; return False if that is impossible. Never blocks or raises."""
    if not can_open(os.environ, sys.platform):
        return False
    import webbrowser  # only for the one command that opens a window

    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return False
    if getattr(browser, "name", "") in _IN_TERMINALS:
        return False
    threading.Thread(target=browser.open, args=(url,), name="browser", daemon=True).start()
    return True
