"""Everything in which the parts of a head's file do not agree, one line each; a part that is wrong alone is None."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, Final

from sfms_robot.config.joint import Joint
from sfms_robot.config.mapping import Coupling, Expression, Fold, Region
from sfms_robot.config.named_bus import Bus, highest_rate_hz, most_joints
from sfms_robot.frames import CHANNEL_INDEX

MOST_NODES: Final = 2000


def wiring(joints: Mapping[str, Joint | None], buses: Collection[str], limits: Collection[str]) -> list[str]:
    """Every joint that is on no bus, of no limit class, or on another's id, one line each."""
    found: list[str] = []
    seen: dict[tuple[str, int], str] = {}
    for name, joint in joints.items():
        if joint is None:
            continue
        if joint.bus not in buses:
            found.append(f"joints.{name}.bus = {joint.bus!r} is not a bus of this head ({', '.join(buses)})")
        if joint.limits not in limits:
            found.append(f"joints.{name}.limits = {joint.limits!r} is not a limit class ({', '.join(limits)})")
        other = seen.setdefault((joint.bus, joint.id), name)
        if other != name:
            found.append(f"joints.{name}.id = {joint.id} is used twice on bus {joint.bus!r} (also by {other})")
    return found


def rates(joints: Mapping[str, Joint | None], buses: Mapping[str, Bus | None]) -> list[str]:
    """Return a line for every bus whose packets, or whose wire at `rate_hz`, cannot carry the goals of its joints."""
    found: list[str] = []
    for name, bus in buses.items():
        count = sum(joint is not None and joint.bus == name for joint in joints.values())
        most = None if bus is None else most_joints(bus.family)
        if bus is not None and most is not None and count > most:
            found.append(
                f"buses.{name}: expected at most {most} joints (one packet of goals, {bus.family}), got {count}"
            )
        elif bus is not None and bus.rate_hz > (highest := highest_rate_hz(bus.family, bus.baud, count)):
            problem = f"is more than {bus.baud} baud carry for {count} joints (at most {highest:g})"
            found.append(f"buses.{name}.rate_hz = {bus.rate_hz:g} {problem}")
    return found


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
