"""Where each value of a head's joints comes from: its own line, its twin, the defaults of the head, or nowhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from sfms_robot.config.base import find, read
from sfms_robot.config.drives import NOT_SHARED
from sfms_robot.config.head import Joint, load_head

SHOWN: Final = (
    "bus", "id", "model", "zero_ticks", "sign", "ratio", "min_deg", "rest_deg", "max_deg", "limits", "lag_ms", "unit",
)  # fmt: skip
OWN, DEFAULTS, BUILT_IN = "head file", "joint_defaults", "built in"


def origins(name: str) -> dict[str, dict[str, tuple[Any, str]]]:
    """Per joint and key, the value and its origin. Raises ConfigError for a head that is not sound."""
    head = load_head(name)
    raw = read(find("heads", name, "head.yaml") / "head.yaml")
    joints, shared = raw["joints"], raw.get("joint_defaults") or {}
    return {
        joint: {key: (getattr(config, key), _origin(key, config, joints[joint], joints, shared)) for key in SHOWN}
        for joint, config in head.joints.items()
    }


def _origin(
    key: str, config: Joint, own: Mapping[str, Any], joints: Mapping[str, Any], shared: Mapping[str, Any]
) -> str:
    if key in own:
        return OWN
    if config.mirror_of is not None and key not in NOT_SHARED and (key in joints[config.mirror_of] or key == "sign"):
        return f"mirror of {config.mirror_of}"
    return DEFAULTS if key in shared else BUILT_IN
