"""What a slip of the keyboard breaks, found before anything is loaded.

Names, files and devices, by the very functions that the run will use; `session.run` looks at all the rest. Standard
library only, so the answer takes as long as the interpreter does to start.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from sfms_robot.data import find
from sfms_robot.errors import PortError
from sfms_robot.listeners.plugins import listener_folder
from sfms_robot.servo.discovery import access_problem
from sfms_robot.sources.registry import check_source

if TYPE_CHECKING:
    from sfms_robot.config import Calmness
    from sfms_robot.listeners.process import ListenerProcess


def check_names(
    head: str,
    listener: str,
    port: str = "sim",
    audio: str = "default",
    face: str = "auto",
    agent_audio: str = "none",
    play: str | None = None,
    status: str | None = None,
) -> None:
    """Are there such a head, listener, port and files, and is the status's port free? Raises ConfigError, PortError."""
    find("heads", head, "head.yaml")
    listener_folder(listener)
    check_source(audio, face, agent_audio, play=play)
    if status is not None:
        from sfms_robot.app.listen.status_server import StatusServer  # http.server: only for who wants it

        StatusServer(status).close()
    for part in port.split(","):
        device = part.rpartition("=")[2]
        if device.startswith("/") and (problem := access_problem(device)):
            raise PortError(f"{device}: {problem}")


def begin_listening(listener: str, seed: int, calmness: Calmness | None = None) -> ListenerProcess:
    """The listener's own process, which loads from now on. For `session.run(feed=...)`; closed by the caller."""
    from sfms_robot.listeners.process import ListenerProcess  # numpy: not for who only mistyped a name

    return ListenerProcess(listener, seed, calmness)
