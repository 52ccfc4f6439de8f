"""Names that a shell can complete. Standard library only: a shell waits for them."""

from __future__ import annotations

from sfms_robot.data import data_dir, shipped_names


def heads() -> list[str]:
    """Shipped heads."""
    return shipped_names(data_dir("configs") / "heads", "head.yaml")


def listeners() -> list[str]:
    """Shipped listeners."""
    return shipped_names(data_dir("configs") / "listeners", "config.yaml")


def speakers() -> list[str]:
    """Shipped speakers."""
    return shipped_names(data_dir("sim") / "speakers", "speech.flac")
