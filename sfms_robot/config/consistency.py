"""Contradictions between the parts of a head's file, one line each."""

from __future__ import annotations

from collections.abc import Mapping
from graphlib import CycleError, TopologicalSorter
from typing import Any, Final

from sfms_robot.config.base import Problems
from sfms_robot.config.joint import Expression
from sfms_robot.config.kinematics import SerialNeck
from sfms_robot.config.wire_time import BITS, FRAMINGS
from sfms_robot.errors import did_you_mean, not_one_of
from sfms_robot.frames import CHANNEL_INDEX

MOST_NODES: Final = 2000
HIGHEST_RATE_HZ: Final = 1000.0
JOINT: Final = "a joint of this head"


def problems(head: Any) -> list[str]:
    """Return every contradiction between the parts of a `config.Head`."""
    return [*_wiring(head), *_rates(head), *_drives(head), *_parts(head), *_neck(head), *_description(head)]


def _wiring(head: Any) -> Problems:
    """Yield joints with an unknown bus or limit class, or with the id of another joint of their bus."""
    seen: dict[tuple[str, int], str] = {}
    for name, joint in head.joints.items():
        if joint.bus not in head.buses:
            yield f"joints.{name}.bus = {not_one_of(joint.bus, 'a bus of this head', head.buses)}"
        if joint.limits not in head.limits:
            yield f"joints.{name}.limits = {not_one_of(joint.limits, 'a limit class', head.limits)}"
        other = seen.setdefault((joint.bus, joint.id), name)
        if other != name:
            yield f"joints.{name}.id = {joint.id} is used twice on bus {joint.bus!r} (also by {other})"


def highest_rate_hz(family: str, baud: int, joints: int) -> float:
    """Return the highest rate at which goals for `joints` servos fit on a wire of `baud`, without answers.

    The rate is a whole number, at most 1000. A board sends changes when its wire is free, so its wire sets no limit.
    """
    framing = FRAMINGS.get(family)
    if framing is None or not framing.answer:
        return HIGHEST_RATE_HZ
    return min(HIGHEST_RATE_HZ, max(1.0, float(baud // (BITS * framing.goals(joints)))))


def _rates(head: Any) -> Problems:
    """Yield buses whose packets, or whose wire at `rate_hz`, cannot carry the goals of their joints."""
    for name, bus in head.buses.items():
        count = len(head.on_bus(name))
        framing = FRAMINGS.get(bus.family)  # None for a family of another package
        longest = framing.longest if framing else 0  # 0: a board, which has no packet of all goals
        most = (longest - framing.write) // (framing.write_each + framing.goal) if framing and longest else count
        if count > most:
            yield f"buses.{name}: expected at most {most} joints (one packet of goals, {bus.family}), got {count}"
        elif bus.rate_hz > (highest := highest_rate_hz(bus.family, bus.baud, count)):
            problem = f"is more than {bus.baud} baud carry for {count} joints (at most {highest:g})"
            yield f"buses.{name}.rate_hz = {bus.rate_hz:g} {problem}"


def _drives(head: Any) -> Problems:
    """Yield unknown names, wrong mirrors, circles, and drives that are too large."""
    for name in head.expressions:
        if name in CHANNEL_INDEX:
            yield f"expressions.{name} has the name of a channel"
    trees = {f"expressions.{name}": tree for name, tree in head.expressions.items()}
    trees |= {f"joints.{name}.drive": joint.drive for name, joint in head.joints.items() if joint.drive}
    for where, tree in trees.items():
        for node in tree.nodes():
            if node.use and node.use not in head.expressions:
                choices = "; ".join(filter(None, (", ".join(head.expressions), ", ".join(CHANNEL_INDEX))))
                yield (
                    f"{where}: {node.use!r} is not a channel, nor an expression of this head ({choices})"
                    f"{did_you_mean(node.use, [*head.expressions, *CHANNEL_INDEX])}"
                )
    for name, joint in head.joints.items():
        if (twin := joint.mirror_of) is None:
            continue
        other = head.joints[twin]  # `head.expanded` has checked that it exists
        if twin == name or other.mirror_of is not None:
            yield f"joints.{name}.mirror_of = {twin!r} is itself a mirror; name the joint that has the drive"
        elif other.unit != joint.unit:
            yield f"joints.{name}.unit = {joint.unit!r} is not that of {twin} ({other.unit})"
    uses = {name: {node.use for node in tree.nodes() if node.use} for name, tree in head.expressions.items()}
    sizes: dict[str | None, int] = {}  # nodes of shared expressions, including those of the expressions that they use
    try:
        for used in TopologicalSorter(uses).static_order():
            sizes[used] = _size(head.expressions[used], sizes) if used in head.expressions else 0
    except CycleError as error:
        circle = error.args[1][::-1]
        yield f"expressions.{circle[0]} uses itself: {' -> '.join(circle)}"
        return
    for name, joint in head.joints.items():
        if joint.drive and (count := _size(joint.drive, sizes)) > MOST_NODES:
            counted = "shared expressions counted where they are used"
            yield f"joints.{name}.drive has {count} nodes, {counted}; at most {MOST_NODES}"


def _size(tree: Expression, sizes: Mapping[str | None, int]) -> int:
    return sum(1 + sizes.get(node.use, 0) for node in tree.nodes())


def _parts(head: Any) -> Problems:
    """Yield the joints of folds, couplings and regions that are unknown or claimed twice."""
    for index, fold in enumerate(head.folds):
        if fold.into not in head.joints:
            yield f"folds.{index}.into = {not_one_of(fold.into, JOINT, head.joints)}"
    for index, coupling in enumerate(head.couplings):
        for name in coupling.keep:
            if name not in head.joints:
                yield f"couplings.{index}.keep: {not_one_of(name, JOINT, head.joints)}"
        for other, rival in enumerate(head.couplings):
            for name in coupling.moving:
                if other != index and rival.keep.get(name):
                    yield f"couplings.{index}.moving: {name!r} is also in couplings.{other}, one would undo the other"
    owner: dict[str, str] = {}
    for name, region in head.regions.items():
        for joint in region.joints:
            if joint not in head.joints:
                yield f"regions.{name}.joints: {not_one_of(joint, JOINT, head.joints)}"
            elif owner.setdefault(joint, name) != name:
                yield f"regions.{name}.joints: {joint!r} is already in region {owner[joint]}"


def _neck(head: Any) -> Problems:
    """Yield the neck's joints that are unknown, have a drive or a fold, or do not rest where the neck is at home."""
    if (neck := head.kinematics) is None:
        return
    for index, fold in enumerate(head.folds):
        if fold.into in neck.joints():
            yield f"folds.{index}.into = {fold.into!r}: the neck moves this joint (kinematics)"
    for name in neck.joints():
        if (joint := head.joints.get(name)) is None:
            yield f"kinematics: {not_one_of(name, JOINT, head.joints)}"
            continue
        if joint.drive is not None:
            yield f"joints.{name}.drive: the neck moves this joint (kinematics), leave its drive out"
        if not isinstance(neck, SerialNeck):
            continue
        if not joint.min_rad <= 0.0 <= joint.max_rad:
            yield f"joints.{name}: its range leaves out 0, where the neck stands at home"
        elif joint.rest_deg != 0:
            yield f"joints.{name}.rest_deg = {joint.rest_deg:g}: the neck rests at 0; shift zero_ticks instead"


def _description(head: Any) -> Problems:
    """Yield the joints of the URDF section that the head lacks, and URDF joints that two of its joints would move."""
    if head.urdf is None:
        return
    owner: dict[str, str] = {}
    for name, follows in head.urdf.joints.items():
        if name not in head.joints:
            yield f"urdf.joints: {not_one_of(name, JOINT, head.joints)}"
        if owner.setdefault(follows.joint, name) != name:
            yield f"urdf.joints.{name}.joint = {follows.joint!r} already follows {owner[follows.joint]}"
