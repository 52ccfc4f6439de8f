"""Which channels of a motion space move the head."""

from __future__ import annotations

from collections.abc import Sequence

from sfms_robot.frames import LATERAL_POSE, POSE_CHANNELS

# Channels of any motion space that turn or move the head, and those of them that a mirror turns around.
HEAD = frozenset(
    {*POSE_CHANNELS, *(f"{part}_{axis}" for part in ("rotation", "translation", "head") for axis in "xyz")}
)

LATERAL = frozenset((*LATERAL_POSE, "rotation_y", "rotation_z", "translation_x", "head_y", "head_z"))
SHIFTING = frozenset(("x", "y", "z", *(f"translation_{axis}" for axis in "xyz")))


def head_channels(channels: Sequence[str]) -> list[int]:
    """Which of the channels move the head."""
    return [index for index, name in enumerate(channels) if name in HEAD]


def lateral_channels(channels: Sequence[str]) -> list[int]:
    """Which of the `head_channels` a mirror turns around, by their place among those."""
    return [at for at, index in enumerate(head_channels(channels)) if channels[index] in LATERAL]


def shifting_channels(channels: Sequence[str]) -> list[int]:
    """Which of the `head_channels` move the head without turning it, by their place among those."""
    return [at for at, index in enumerate(head_channels(channels)) if channels[index] in SHIFTING]
