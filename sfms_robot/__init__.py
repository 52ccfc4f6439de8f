"""A robot head that listens: voice in, servo goals out.

    head = load_head("face28")
    Retargeter(head).angles(face58)                       faces to joint angles
    load_listener("sfms-small").stream(seed=0)            voice and face to plans
    with open_bus(head, "sim") as bus: ...                servos alone
    with Robot("face28", port="sim") as robot: ...        all of it, in its own thread

Each name is loaded when it is first used, so that importing this package costs nothing. docs/reference/api.md lists
all names.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from sfms_robot.app.api.listener_stream import ListenerStream, LoadedListener, load_listener
    from sfms_robot.app.api.robot import Robot
    from sfms_robot.app.api.servos import Servos, open_bus
    from sfms_robot.config import Head, load_head
    from sfms_robot.errors import (
        BusError,
        ConfigError,
        HaltedError,
        InputError,
        MissingExtra,
        ModelError,
        PacketError,
        PortError,
        RobotError,
        ServoError,
    )
    from sfms_robot.frames import BLENDSHAPES, CHANNELS, FaceFrame, ListenerEvent, Plan, Reading, SpeakerFrame
    from sfms_robot.ports import Listener, Source
    from sfms_robot.retarget.head_retargeter import HeadRetargeter as Retargeter

__version__ = "0.2.0.dev0"

__all__ = [
    "BLENDSHAPES",
    "CHANNELS",
    "BusError",
    "ConfigError",
    "FaceFrame",
    "HaltedError",
    "Head",
    "InputError",
    "Listener",
    "ListenerEvent",
    "ListenerStream",
    "LoadedListener",
    "MissingExtra",
    "ModelError",
    "PacketError",
    "Plan",
    "PortError",
    "Reading",
    "Retargeter",
    "Robot",
    "RobotError",
    "ServoError",
    "Servos",
    "Source",
    "SpeakerFrame",
    "load_head",
    "load_listener",
    "open_bus",
]

# Module -> the public names that it defines. `Retargeter` has another name in its module (`_CALLED`).
_NAMES: Final = {
    "app.api.listener_stream": ("ListenerStream", "LoadedListener", "load_listener"),
    "app.api.robot": ("Robot",),
    "app.api.servos": ("Servos", "open_bus"),
    "config": ("Head", "load_head"),
    "errors": (
        "BusError",
        "ConfigError",
        "HaltedError",
        "InputError",
        "MissingExtra",
        "ModelError",
        "PacketError",
        "PortError",
        "RobotError",
        "ServoError",
    ),
    "frames": ("BLENDSHAPES", "CHANNELS", "FaceFrame", "ListenerEvent", "Plan", "Reading", "SpeakerFrame"),
    "ports": ("Listener", "Source"),
    "retarget.head_retargeter": ("Retargeter",),
}
_MODULE_OF: Final = {name: module for module, names in _NAMES.items() for name in names}
_CALLED: Final = {"Retargeter": "HeadRetargeter"}


def __getattr__(name: str) -> Any:
    """Load a public name from its module (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), _CALLED.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
