"""What stands in `--face KIND[:PLACE][,flip=CHANNEL+CHANNEL]`, for every kind that sees a live person.

PLACE is the kind's own: a UDP port, a camera. `flip` turns the sign of pose channels that a tracker has the other way
round: `live-link:11111,flip=yaw+roll`.
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.endpoint import HIGHEST_PORT, LOOPBACK, host_and_port
from sfms_robot.errors import ConfigError
from sfms_robot.frames import POSE_CHANNELS, Floats

_OPTION: Final = re.compile(r",([a-z]+)=([^,=]*)$")


@dataclass(frozen=True)
class FaceArgument:
    """PLACE, "" where none is given, and the pose channels to flip."""

    place: str
    flip: tuple[str, ...] = ()

    @property
    def signs(self) -> Floats:
        """(6,) -1 for every pose channel that is flipped, 1 for the others."""
        return np.array([-1.0 if name in self.flip else 1.0 for name in POSE_CHANNELS], dtype=np.float32)


def parse_face_argument(kind: str, argument: str) -> FaceArgument:
    """What stands behind `KIND:`. Raises ConfigError for another option and a channel that is none."""
    place, flip = argument, ()
    while option := _OPTION.search(place):
        name, value = option.groups()
        channels = tuple(value.split("+"))
        if name != "flip":
            raise ConfigError(f"--face {kind}: option {name!r} is not known (flip)")
        for channel in channels:
            if channel not in POSE_CHANNELS:
                raise ConfigError(f"--face {kind}: flip = {channel!r} is no pose channel ({', '.join(POSE_CHANNELS)})")
        place, flip = place[: option.start()], (*channels, *flip)
    return FaceArgument(place, flip)


def parse_endpoint(kind: str, place: str, port: int) -> tuple[str, int]:
    """PORT, HOST:PORT ([HOST]:PORT for IPv6) or an address alone -> host and port; loopback and `port` where PLACE does
    not say. Raises ConfigError.
    """
    if not place:
        return LOOPBACK, port
    if _is_address(place.strip("[]")):
        return place.strip("[]"), port
    found = host_and_port(place, least=1)
    if found is None:
        choices = f"{kind}, {kind}:PORT, {kind}:HOST:PORT, {kind}:ADDRESS; PORT 1 to {HIGHEST_PORT}"
        raise ConfigError(f"--face {kind}:{place}: {place!r} is no UDP port ({choices})")
    return found


def _is_address(text: str) -> bool:
    try:
        ipaddress.ip_address(text)
    except ValueError:
        return False
    return True
