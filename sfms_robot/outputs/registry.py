"""Values of `--output`: KIND or KIND:ADDRESS, a head that accepts a face or a pose instead of joint angles.

A kind of another package is an entry point of the group `sfms_robot.outputs`: a callable that accepts the text after
the colon ("" without one) and returns a `ports.Output`. Kinds are imported when they are opened.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING, Final

from sfms_robot.endpoint import LOOPBACK, port_number
from sfms_robot.errors import ConfigError
from sfms_robot.network import LOCAL, Router
from sfms_robot.plugins import plug_in, plugins, shipped

if TYPE_CHECKING:  # it imports numpy, which checking a name does not need
    from sfms_robot.ports import Output

GROUP: Final = "sfms_robot.outputs"
_ADDRESS: Final = re.compile(r"(\[(?P<bracketed>[^][]+)\]|(?P<name>[^][:/@ ]*))(:(?P<port>\d+))?")


KINDS: Final = shipped(
    GROUP,
    json="json_stream:JsonStream",
    vmc="avatars:VmcOutput",
    vmc_single="avatars:VmcSingleOutput",
    live_link="avatars:LiveLinkOutput",
    vtube_studio="vtube_studio:VtubeStudio",
    vtube_studio_add="vtube_studio:VtubeStudioAdd",
    reachy_mini="reachy_mini:ReachyMini",
    reachy_mini_overlay="reachy_mini:ReachyMiniOverlay",
    furhat="furhat:Furhat",
    ros2="ros2:Ros2Output",
)

DESCRIPTIONS: Final[Mapping[str, str]] = {
    "json": "json[:PORT], 8782: WebSocket server of this machine, a JSON object a frame",
    "vmc": "vmc[:HOST[:PORT]], 39539: avatar software (VSeeFace, VNyan, Warudo, Blender, Unity)",
    "vmc-single": "vmc-single[:HOST[:PORT]], 39539: the same, for receivers that read no bundles",
    "live-link": "live-link[:HOST[:PORT]], 11111: Unreal's MetaHumans, as Live Link Face on an iPhone",
    "vtube-studio": "vtube-studio[:HOST[:PORT]], 8001: VTube Studio (Live2D), in place of its tracking",
    "vtube-studio-add": "vtube-studio-add[:HOST[:PORT]], 8001: the same, added to the streamer's own tracking",
    "reachy-mini": "reachy-mini[:HOST[:PORT]], 8000: Reachy Mini's daemon: head, body and antennas",
    "reachy-mini-overlay": "reachy-mini-overlay[:HOST[:PORT]], 8000: the same daemon, on top of the app that it runs",
    "furhat": "furhat[:HOST[:PORT]], 9000: Furhat's Realtime API: face, eyes and neck",
    "ros2": "ros2[:DOMAIN][,humble], ROS_DOMAIN_ID or 0: a graph of ROS 2 (rmw_zenoh), without ROS installed",
}


def output_kinds() -> Mapping[str, EntryPoint]:
    """Return every kind by name, not yet imported; shipped kinds go before those of other packages."""
    return {**plugins(GROUP), **KINDS}


def check_outputs(values: Sequence[str]) -> None:
    """Check that the kinds exist. Imports and opens nothing. Raises ConfigError that lists the valid kinds."""
    kinds = output_kinds()
    for value in values:
        if value.partition(":")[0] not in kinds:
            raise ConfigError(f"--output {value}: expected KIND or KIND:ADDRESS (valid: {', '.join(kinds)})")


def open_output(value: str, router: Router = LOCAL) -> Output:
    """Return the output of a value of `--output`, which is not connected yet. Raises ConfigError.

    router: the router of ROS 2.
    """
    check_outputs([value])
    kind, _, address = value.partition(":")
    entry = output_kinds()[kind]
    output: Output = plug_in(entry, address, router) if kind == "ros2" else plug_in(entry, address)
    if not callable(getattr(output, "send", None)):
        raise ConfigError(f"--output {kind}: expected an output from {entry.value}, got a {type(output).__name__}")
    return output


def open_outputs(values: Sequence[str], router: Router = LOCAL) -> list[Output]:
    """Return the outputs of a run, in order. Raises ConfigError, also for two that reach one program."""
    opened: dict[tuple[str, str], Output] = {}
    for value in values:
        output = open_output(value, router)
        to = re.sub("-(single|add|overlay)$", "", output.kind), output.peer  # variants reach the same program
        if to in opened:
            raise ConfigError(f"--output {value}: {output.peer} gets {opened[to].kind} already")
        opened[to] = output
    return list(opened.values())


def parse_address(kind: str, text: str, usual_port: int) -> tuple[str, int]:
    """Return host and port of "", PORT, :PORT, HOST, HOST:PORT, [HOST] or [HOST]:PORT (IPv6 in brackets).

    The host is loopback if none is given. Raises ConfigError for another text, also for port 0, where nothing listens.
    """
    found = _ADDRESS.fullmatch(f":{text}" if text.isdigit() else text)
    port = found and (port_number(found["port"], 1) if found["port"] else usual_port)
    if found is None or port is None or not text.isprintable():
        raise ConfigError(f"--output {kind}:{text}: expected HOST:PORT, HOST or :PORT (IPv6 in brackets), got {text!r}")
    return found["bracketed"] or found["name"] or LOOPBACK, port
