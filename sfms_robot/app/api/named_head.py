"""A head that a program loaded, as the name or folder that a run opens."""

from __future__ import annotations

from sfms_robot.config import Head, load_head
from sfms_robot.errors import ConfigError


def head_name(head: Head | str) -> str:
    """Name or folder of a head.

    What belongs to one build (its calibration, what is stored in its servos) lies beside the head's file, so a head
    runs from there. Raises ConfigError for one that was changed since it was loaded, or was made without a file.
    """
    if isinstance(head, str):
        return head
    if head.folder is None or load_head(str(head.folder)) != head:
        raise ConfigError(
            f"head {head.name!r} is not what its file says: write it to a folder as head.yaml and name that folder"
        )
    return str(head.folder)
