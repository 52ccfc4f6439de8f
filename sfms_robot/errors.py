"""The tree of errors, and the exit codes of the command line.

RobotError                      base; `exit_code` is what the command line returns
+-- ConfigError          (2)    a file, a flag or a value in it is wrong; names file, key, value, choices
|   +-- MissingExtra     (2)    a feature needs an optional package that is not installed; names the pip install
|   +-- InputError       (2)    a value passed by a program has a wrong shape or range, or is not finite
+-- PortError            (3)    a port cannot be opened, or another program holds it
+-- OutputError          (3)    an output's peer is unreachable, refuses, or does not answer as it should
+-- BusError             (4)    no servo of a bus answers; the bus cannot continue
|   +-- TorqueError      (4)    torque could not be confirmed off; names the joints
+-- ServoError           (4)    a servo contradicts the configuration, or refuses a command
+-- PacketError          (4)    bytes that are not a packet (codecs raise it, buses count it)
+-- ModelError           (5)    weights or model files are missing, corrupt or of another shape
+-- HaltedError          (1)    an emergency stop cannot be ended now, or not from here; names its cause
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

MOST_SAID: Final = 20  # most problems that are logged of one source, so that the log is not flooded
INTERRUPTED: Final = 130  # exit code of a command that Ctrl-C or SIGTERM ended, after the safe stop
CHECKOUT: Final = Path(__file__).resolve().parent.parent  # a checkout only if it has a pyproject.toml
NOTE: Final = 25  # level of a log line that only informs: shown as a plain line. A WARNING calls for action.


class RobotError(Exception):
    """Base class of every error that this package raises on purpose. Its text is one line for the user."""

    exit_code = 1


_MOST_LISTED = 20  # longest list of choices that is printed together with a suggestion


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
        """Return an error `file: key = value problem (valid choices)`, the form of every configuration error."""
        names = [str(choice) for choice in choices]
        meant = did_you_mean(value, names) if len(names) > 1 else ""
        listed = f" ({', '.join(names)})" if names and not (meant and len(names) > _MOST_LISTED) else ""
        return cls(f"{file}: {key} = {value!r} {problem}{listed}{meant}")


def did_you_mean(given: object, choices: Iterable[str]) -> str:
    """Return `; did you mean 'NAME'?` with the choice closest to a misspelt name, or ''; case is ignored."""
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
    """A value passed to a function of this package has a wrong shape or range, or is not finite.

    It is also a ValueError, which Python itself raises for such values.
    """


class PortError(RobotError):
    """A serial port cannot be opened. Example: no such device, no permission, held by another program."""

    exit_code = 3


class OutputError(RobotError):
    """The peer of an output is unreachable, refuses, or is another program. The run continues without it."""

    exit_code = 3


class BusError(RobotError):
    """A bus failed as a whole. One silent servo is never a BusError."""

    exit_code = 4


class TorqueError(BusError):
    """Torque of `joints` could not be confirmed off at the end."""

    def __init__(self, joints: Iterable[str]) -> None:
        super().__init__(
            f"torque of {', '.join(joints)} could not be confirmed off: run sfms-robot servo release or switch off "
            "the supply before you touch it"
        )


class ServoError(RobotError):
    """One servo contradicts the head configuration, or refused a command. The bus continues."""

    exit_code = 4


class PacketError(RobotError):
    """Bytes that are not a packet: bad header, length or checksum. The bus continues."""

    exit_code = 4


class ModelError(RobotError):
    """Weights or a model's files are missing, corrupt, or belong to another configuration."""

    exit_code = 5


class HaltedError(RobotError):
    """An emergency stop cannot be ended: a cause is still active, or must be cleared elsewhere."""


class GroupError(RobotError):
    """A process that trains with this one is gone. The last checkpoint remains valid."""


# Import name of each optional package -> the extra of pyproject.toml that installs it.
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
    """Return the first line of an error's message, or the name of its class if the message is empty."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


class Said(set[str]):
    """Problems of one source that were reported already: each once whatever its numbers, `MOST_SAID` at most."""

    def first(self, problem: str) -> bool:
        """Return whether to report a problem, and note it as reported."""
        kind = re.sub(r"got .*|[\d.]+", "", problem)
        new = kind not in self and len(self) < MOST_SAID
        if new:
            self.add(kind)
        return new


@contextmanager
def optional(feature: str) -> Iterator[None]:
    """Raise MissingExtra if an optional package imported inside is missing. `feature` names the code that needs it."""
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
    """Return the command that adds an extra to this installation, to be typed in the current folder.

    It names the pip of this Python, since plain `pip` is another one if `.venv` is not activated. In a checkout it
    installs the checkout in place; else pip finds sfms-robot installed, and adds only what the extra needs.
    """
    from shutil import which

    here, pip = Path.cwd(), "pip"
    if Path(which("pip") or "").parent != Path(sys.executable).parent:
        pip = f"{quote(_within(here, Path(sys.executable)))} -m pip"
    if (CHECKOUT / "pyproject.toml").is_file():
        return f"{pip} install -e {quote(f'{_within(here, CHECKOUT)}[{extra}]')}"
    return f"{pip} install {quote(f'sfms-robot[{extra}]')}"


def _within(folder: Path, path: Path) -> str:
    """Return `path`, relative to `folder` if it lies inside."""
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)
