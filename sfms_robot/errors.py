"""The tree of errors, and the exit codes of the command line.

RobotError                      base; `exit_code` is what the command line returns
+-- ConfigError          (2)    a file, a flag or a value in it is wrong; names file, key, value, choices
|   +-- MissingExtra     (2)    a feature needs an optional package that is not installed; names the pip install
|   +-- InputError       (2)    a value that a program handed over: its shape, its range, not finite
+-- PortError            (3)    a port cannot be opened, or another program holds it
+-- OutputError          (3)    an output's peer is away, refuses, or answers in another way than it should
+-- BusError             (4)    no servo of a bus answers; the bus cannot go on
|   +-- TorqueError      (4)    torque could not be confirmed off; names the joints
+-- ServoError           (4)    a servo is not what the configuration says, or refuses a command
+-- PacketError          (4)    bytes that are not a packet (codecs raise it, buses count it)
+-- ModelError           (5)    weights or model files are missing, corrupt or of another shape
+-- HaltedError          (1)    an emergency stop cannot be ended now, or not from here; names what keeps it
+-- GroupError           (1)    a process that trains with this one is gone
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import Final

MOST_SAID: Final = 20  # problems of one source, so that nothing floods the log
INTERRUPTED: Final = 130  # exit code of a command that Ctrl-C or SIGTERM ended, after the safe stop
CHECKOUT: Final = Path(__file__).resolve().parent.parent  # if there is a pyproject.toml in it
NOTE: Final = 25  # level of a log line that informs: shown as a plain line. A WARNING is something to act on.


class RobotError(Exception):
    """Base of every error this package raises on purpose. The text is one line for a person."""

    exit_code = 1


_MOST_LISTED = 20  # choices beside the one that was meant


class ConfigError(RobotError):
    """A configuration file, a data file or a flag holds something that cannot be used."""

    exit_code = 2

    @classmethod
    def at(
        cls,
        file: Path | str,
        key: str,
        value: object,
        problem: str,
        choices: Iterable[object] = (),
    ) -> ConfigError:
        """`file: key = value problem (valid choices)`, the form every configuration error takes."""
        names = [str(choice) for choice in choices]
        meant = did_you_mean(value, names) if len(names) > 1 else ""
        listed = f" ({', '.join(names)})" if names and not (meant and len(names) > _MOST_LISTED) else ""
        return cls(f"{file}: {key} = {value!r} {problem}{listed}{meant}")


def did_you_mean(given: object, choices: Iterable[str]) -> str:
    """Return `; did you mean 'NAME'?` with the choice that a misspelt name is closest to, or ''; case is ignored."""
    from difflib import get_close_matches

    known = {choice.lower(): choice for choice in choices}
    near = get_close_matches(str(given).lower(), known, 1, 0.7)
    return f"; did you mean {known[near[0]]!r}?" if near and known[near[0]] != given else ""


def not_one_of(given: object, what: str, choices: Iterable[str]) -> str:
    """Return `'NAME' is not WHAT (choices)`, and the choice that may have been meant."""
    names = list(choices)
    return f"{given!r} is not {what} ({', '.join(names)}){did_you_mean(given, names)}"


class MissingExtra(ConfigError):
    """A feature needs an optional package that is not installed; names the command that installs it."""


class InputError(ConfigError, ValueError):
    """A value handed to a function of this package cannot be used: its shape, its range, or it is not finite.

    A ValueError too, as Python's own are.
    """


class PortError(RobotError):
    """A serial port cannot be opened. Example: no such device, no permission, held by another program."""

    exit_code = 3


class OutputError(RobotError):
    """The peer of an output is away, refuses, or is something else. The run continues without it."""

    exit_code = 3


class BusError(RobotError):
    """A bus failed as a whole. One silent servo is never a BusError."""

    exit_code = 4


class TorqueError(BusError):
    """Torque of `joints` that could not be confirmed off at the end."""

    def __init__(self, joints: Iterable[str]) -> None:
        super().__init__(
            f"torque of {', '.join(joints)} could not be confirmed off: run sfms-robot servo release or switch off "
            "the supply before you touch it"
        )


class ServoError(RobotError):
    """One servo is not what the head configuration says, or refused a command. The bus continues."""

    exit_code = 4


class PacketError(RobotError):
    """Bytes that are not a packet: bad header, length or checksum. The bus continues."""

    exit_code = 4


class ModelError(RobotError):
    """Weights or a model's files are missing, corrupt, or belong to another configuration."""

    exit_code = 5


class HaltedError(RobotError):
    """An emergency stop that cannot be ended: a cause is still active, or is to be cleared elsewhere."""


class GroupError(RobotError):
    """A process that trains with this one is gone. The last checkpoint stands."""


# Optional packages by the name that is imported, with the extra of pyproject.toml that brings each.
EXTRA_OF: Final[Mapping[str, str]] = {
    "torch": "train",
    "tensorboard": "train",
    "matplotlib": "plots",
    "vtkmodules": "pictures",
    "mediapipe": "webcam",
    "cv2": "webcam",
    "zenoh": "remote",
    "prometheus_client": "remote",
    "onnx": "export",
    "onnx_ir": "export",
    "onnxscript": "export",
    "transformers": "wav2vec2",
    "pyroomacoustics": "bench",
    "pipecat": "pipecat",
    "livekit": "livekit",
    "mcp": "mcp",
}


def first_line(error: BaseException) -> str:
    """Return the first line of what an error says; the name of its class where it says nothing."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


class Said(set[str]):
    """Problems of a source of many that were said, whatever their numbers: each once, and `MOST_SAID` at most."""

    def first(self, problem: str) -> bool:
        """Return whether a problem has not been said, and is to be."""
        kind = re.sub(r"got .*|[\d.]+", "", problem)
        new = kind not in self and len(self) < MOST_SAID
        if new:
            self.add(kind)
        return new


@contextmanager
def optional(feature: str) -> Iterator[None]:
    """Raise MissingExtra where an optional package is missing that is imported inside. `feature` names its user."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").split(".")[0]
        if package not in EXTRA_OF:
            raise
        raise MissingExtra(
            f"{feature} needs {package}, which is not installed: {install_command(EXTRA_OF[package])}"
        ) from error


def install_command(extra: str) -> str:
    """Return the command that adds an extra to this installation, to be typed in the present folder.

    It names the pip of this Python: where `.venv` is not activated, plain `pip` is another one. In a checkout it
    installs that, in place; else pip finds sfms-robot installed, and adds only what the extra needs.
    """
    from shutil import which

    here, pip = Path.cwd(), "pip"
    if Path(which("pip") or "").parent != Path(sys.executable).parent:
        pip = f"{quote(_within(here, Path(sys.executable)))} -m pip"
    if (CHECKOUT / "pyproject.toml").is_file():
        return f"{pip} install -e {quote(f'{_within(here, CHECKOUT)}[{extra}]')}"
    return f"{pip} install {quote(f'sfms-robot[{extra}]')}"


def _within(folder: Path, path: Path) -> str:
    """Return `path`, relative to `folder` where it lies in it."""
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)
