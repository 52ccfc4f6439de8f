"""From what a head's file says to one plain expression per joint: sharing, mirrors and folds worked out.

A mirrored drive is the same drive with left and right exchanged. Channels that end in Left or Right change places;
roll, yaw and y, which have one channel for both sides, change sign. A joint whose plus points to the same side of the
head as that of its twin (pan, say) is of the opposite sense: its drive, and its range, are negated as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sfms_robot.config.mapping import Coupling, Expression, Fold, Region
from sfms_robot.frames import CHANNEL_INDEX

if TYPE_CHECKING:
    from sfms_robot.config.head import Head, Joint

ODD = ("roll", "yaw", "y")
MOST_NODES = 2000
NOT_SHARED = ("id", "note", "drive", "mirror_of", "mirror_sense")  # what a twin does not take over


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


def drives(head: Head) -> dict[str, Expression | None]:
    """What every joint follows, in terms of channels alone; None for a joint that follows nothing."""
    mirrors = {name for name, joint in head.joints.items() if joint.mirror_of is not None and joint.drive is None}
    found = {name: _own(name, joint.drive, head) for name, joint in head.joints.items() if name not in mirrors}
    for name in mirrors:  # one that has learnt a drive of its own does not look at its twin's
        joint = head.joints[name]
        twin = found[joint.mirror_of or ""]
        seen = mirrored(twin) if twin else None
        if seen and joint.mirror_sense == "opposite":
            seen = Expression(sum=(seen,), gain=-1)
        found[name] = _own(name, seen, head)
    return {name: found[name] for name in head.joints}


def _own(name: str, drive: Expression | None, head: Head) -> Expression | None:
    folds = tuple(Expression(channel=fold.channel, gain=fold.gain) for fold in head.folds if fold.into == name)
    terms = ((inlined(drive, head.expressions),) if drive else ()) + folds
    return Expression(sum=terms) if folds else terms[0] if terms else None


def inlined(node: Expression, expressions: Mapping[str, Expression]) -> Expression:
    """The expression with every shared one in the place of its name."""
    if node.use is not None:
        shared = inlined(expressions[node.use], expressions)
        plain = node.model_copy(update={"use": None})
        return shared if node == Expression(use=node.use) else plain.model_copy(update={"sum": (shared,)})
    if node.group is None:
        return node
    return node.model_copy(update={node.group: tuple(inlined(part, expressions) for part in node.parts)})


def mirrored(node: Expression) -> Expression:
    """The expression of the other side of the face."""
    if node.channel in ODD:
        turned = Expression(channel=node.channel, gain=-1)
        return node.model_copy(update={"channel": None, "sum": (turned,)})
    if node.channel is not None:
        return node.model_copy(update={"channel": other_side(node.channel)})
    assert node.group is not None
    return node.model_copy(update={node.group: tuple(mirrored(part) for part in node.parts)})


def other_side(channel: str) -> str:
    """The channel with left and right exchanged."""
    for side, other in (("Left", "Right"), ("Right", "Left")):
        if channel.endswith(side):
            return channel.removesuffix(side) + other
    return channel


def problems(
    joints: Mapping[str, Joint | None],
    expressions: Mapping[str, Expression | None],
    couplings: Sequence[Coupling | None],
    folds: Sequence[Fold | None],
    regions: Mapping[str, Region | None],
) -> list[str]:
    """Everything in which the parts of a mapping do not agree, one line each; parts that are wrong alone are None."""
    found: list[str] = []
    for name, expression in expressions.items():
        if name in CHANNEL_INDEX:
            found.append(f"expressions.{name} has the name of a channel")
        found += _unknown(expression, f"expressions.{name}", expressions)
    for name, joint in joints.items():
        if joint is not None:
            found += _unknown(joint.drive, f"joints.{name}.drive", expressions) + _mirror(name, joint, joints)
    circles = _circles(expressions)
    found += circles
    if not circles:
        found += _too_large(joints, expressions)
    for index, fold in enumerate(folds):
        if fold is not None and fold.into not in joints:
            found.append(f"folds.{index}.into = {_not_a_joint(fold.into, joints)}")
    return found + _couplings(couplings, joints) + _regions(regions, joints)


def _not_a_joint(name: str, joints: Mapping[str, Any]) -> str:
    return f"{name!r} is not a joint of this head ({', '.join(joints)})"


def _unknown(node: Expression | None, where: str, expressions: Mapping[str, Any]) -> list[str]:
    if node is None:
        return []
    if node.use is not None and node.use not in expressions:
        choices = "; ".join(filter(None, (", ".join(expressions), ", ".join(CHANNEL_INDEX))))
        return [f"{where}: {node.use!r} is not a channel, nor an expression of this head ({choices})"]
    return [
        line for i, part in enumerate(node.parts) for line in _unknown(part, f"{where}.{node.group}.{i}", expressions)
    ]


def _mirror(name: str, joint: Joint, joints: Mapping[str, Joint | None]) -> list[str]:
    twin = joint.mirror_of
    if twin is None:
        return []
    if twin not in joints:
        return [f"joints.{name}.mirror_of = {_not_a_joint(twin, joints)}"]
    other = joints[twin]
    if twin == name or (other is not None and other.mirror_of is not None):
        return [f"joints.{name}.mirror_of = {twin!r} is itself a mirror; name the joint that has the drive"]
    if other is not None and other.unit != joint.unit:
        return [f"joints.{name}.unit = {joint.unit!r} is not that of {twin} ({other.unit})"]
    return []


def _names(node: Expression | None) -> set[str]:
    """Shared expressions named below this node."""
    if node is None:
        return set()
    return ({node.use} if node.use else set[str]()).union(*(_names(part) for part in node.parts))


def _circles(expressions: Mapping[str, Expression | None]) -> list[str]:
    found: list[str] = []
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        if name in path:
            circle = (*path[path.index(name) :], name)
            found.append(f"expressions.{name} uses itself: {' -> '.join(circle)}")
        elif name not in done:
            for used in sorted(_names(expressions.get(name))):
                visit(used, (*path, name))
            done.add(name)

    for name in expressions:
        visit(name, ())
    return found


def _too_large(joints: Mapping[str, Joint | None], expressions: Mapping[str, Expression | None]) -> list[str]:
    sizes: dict[str, int] = {}

    def size(node: Expression | None) -> int:
        if node is None:
            return 0
        if node.use is not None and node.use not in sizes:
            sizes[node.use] = size(expressions.get(node.use))
        return 1 + (sizes[node.use] if node.use is not None else sum(size(part) for part in node.parts))

    counts = {name: size(joint.drive) for name, joint in joints.items() if joint is not None}
    return [
        f"joints.{name}.drive has {count} nodes, shared expressions counted where they are used; at most {MOST_NODES}"
        for name, count in counts.items()
        if count > MOST_NODES
    ]


def _couplings(couplings: Sequence[Coupling | None], joints: Mapping[str, Any]) -> list[str]:
    found: list[str] = []
    for index, coupling in enumerate(couplings):
        if coupling is None:
            continue
        found += [f"couplings.{index}.keep: {_not_a_joint(n, joints)}" for n in coupling.keep if n not in joints]
        for other, rival in enumerate(couplings):
            for name in coupling.moving:
                if rival is not None and other != index and rival.keep.get(name):
                    found.append(
                        f"couplings.{index}.moving: {name!r} is also in couplings.{other}, one would undo the other"
                    )
    return found


def _regions(regions: Mapping[str, Region | None], joints: Mapping[str, Any]) -> list[str]:
    found: list[str] = []
    owner: dict[str, str] = {}
    for name, region in regions.items():
        for joint in region.joints if region else ():
            if joint not in joints:
                found.append(f"regions.{name}.joints: {_not_a_joint(joint, joints)}")
            elif owner.setdefault(joint, name) != name:
                found.append(f"regions.{name}.joints: {joint!r} is already in region {owner[joint]}")
    return found
