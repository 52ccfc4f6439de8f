"""`joint_defaults` and `mirror_of` of a head's file, filled into its joints while they still are plain data.

A mirrored drive is the same drive with left and right exchanged. Channels that end in Left or Right change places;
roll, yaw and y, which have one channel for both sides, change sign. A joint whose plus points to the same side of the
head as that of its twin (pan, say) is of the opposite sense: its drive, and its range, are negated as well.
"""

from __future__ import annotations

from typing import Any, Final

NOT_SHARED: Final = ("id", "note", "drive", "mirror_of", "mirror_sense")  # what a twin does not take over


def expanded(raw: Any) -> Any:
    """A head as plain data, with `joint_defaults` and `mirror_of` filled into its joints.

    Whatever has the wrong type is left as it is: the models tell.
    """
    if not isinstance(raw, dict) or not isinstance(raw.get("joints"), dict):
        return raw
    defaults = raw.get("joint_defaults")
    shared = defaults if isinstance(defaults, dict) else {}
    written = raw["joints"]
    joints = {name: {**shared, **joint} if isinstance(joint, dict) else joint for name, joint in written.items()}
    for name, joint in written.items():
        twin = written.get(joint.get("mirror_of")) if isinstance(joint, dict) and _is_name(joint) else None
        if isinstance(twin, dict):
            joints[name] = {**_seen_in_mirror({**shared, **twin}, joint.get("mirror_sense")), **joint}
    return {**raw, "joints": joints}


def _is_name(joint: dict[Any, Any]) -> bool:
    return isinstance(joint.get("mirror_of"), str)


def _seen_in_mirror(twin: dict[str, Any], sense: Any) -> dict[str, Any]:
    out = {key: value for key, value in twin.items() if key not in NOT_SHARED}
    if sense != "opposite":  # a servo on the other side of the head turns the other way for the same motion
        return {**out, "sign": -1 if out.get("sign", 1) == 1 else 1}
    for key, other in (("min_deg", "max_deg"), ("max_deg", "min_deg"), ("rest_deg", "rest_deg")):
        if isinstance(twin.get(other), (int, float)):
            out[key] = -twin[other]
    return out
