"""Where each value of a head's joints comes from.

Its own line, its twin, the defaults of the head, or nowhere; over those, what was measured or fitted on this build.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from sfms_robot.config.base import Model
from sfms_robot.config.head import NOT_SHARED, load_head
from sfms_robot.config.joint import Joint
from sfms_robot.config.overlay import CALIBRATE, FIT, head_hash, layered, load_overlay
from sfms_robot.config.yaml_file import read
from sfms_robot.data import find

SHOWN: Final = (
    "bus", "id", "model", "zero_ticks", "sign", "ratio", "min_deg", "rest_deg", "max_deg", "limits", "lag_ms", "unit",
    "drive",
)  # fmt: skip
MEASURED: Final = ("zero_ticks", "sign", "min_deg", "max_deg")  # what a calibration gives
OWN, DEFAULTS, BUILT_IN = "head file", "joint_defaults", "built in"


def provenance(name: str) -> dict[str, dict[str, tuple[Any, str]]]:
    """Per joint and key, the value and its origin.

    Measurements count here whichever servos are plugged in now. Raises ConfigError for a head that is not sound.
    """
    head = load_head(name)
    raw = read(find("heads", name, "head.yaml") / "head.yaml")
    joints, shared = raw["joints"], raw.get("joint_defaults") or {}
    overlay = load_overlay(head)
    layers = layered(head, overlay, head_hash(name))
    measured = overlay.calibrate.joints if overlay.calibrate is not None else {}
    told: dict[str, dict[str, tuple[Any, str]]] = {}
    for joint, config in layers.head.joints.items():
        above: dict[str, str] = {}
        if joint in layers.calibrated:
            above |= dict.fromkeys(MEASURED, f"{CALIBRATE} {measured[joint].date}")
        if joint in layers.fitted and overlay.fit is not None:
            above |= {"drive": f"{FIT} {overlay.fit.date}"}
        told[joint] = {
            key: (
                _value(config, key),
                above.get(key) or _origin(key, head.joints[joint], joints[joint], joints, shared),
            )
            for key in SHOWN
        }
    return told


def refusals(name: str) -> list[str]:
    """One line for each measurement and fit that is there and does not hold."""
    head = load_head(name)
    layers = layered(head, load_overlay(head), head_hash(name))
    return [f"{joint}: its calibration does not hold: {why}" for joint, why in layers.refused.items()] + [*layers.notes]


def _value(config: Joint, key: str) -> Any:
    value = getattr(config, key)
    return value.model_dump(mode="json", exclude_defaults=True) if isinstance(value, Model) else value


def _origin(
    key: str, config: Joint, own: Mapping[str, Any], joints: Mapping[str, Any], shared: Mapping[str, Any]
) -> str:
    if key in own:
        return OWN
    mirrored = key not in NOT_SHARED or key == "drive"
    if config.mirror_of is not None and mirrored and (key in joints[config.mirror_of] or key == "sign"):
        return f"mirror of {config.mirror_of}"
    return DEFAULTS if key in shared else BUILT_IN
