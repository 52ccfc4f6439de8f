"""What every joint of a head follows, as one plain expression: sharing, mirrors and folds worked out."""

from __future__ import annotations

from collections.abc import Mapping

from sfms_robot.config.head import Head
from sfms_robot.config.mapping import Expression
from sfms_robot.frames import LATERAL_POSE


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
    if node.channel in LATERAL_POSE:
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
