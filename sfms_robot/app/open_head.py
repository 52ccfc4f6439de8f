"""A head and its servos: the half of the composition root that all commands which move one share.

    prepare_head    what can be checked before anything is opened: the head's file, its ports, what is confirmed
    build_motion    what lies between a plan and the bus: timeline, retargeter, limiter, audit, heat
    build_bus       every servo of the head behind one bus, emulated ones and real ones alike
    open_head       all three: emulated servos started, ports opened, every servo identified; torque is untouched

What is played on it, and by whom, is `app.session`'s.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from shlex import quote
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfms_robot.app.calibrated_head import calibrated_head
from sfms_robot.app.wiring import SIM, Opened, calibration_of, devices, firmware_maps, plugged_in, port_of
from sfms_robot.config import FirmwareMap, Head, Joint, load_head
from sfms_robot.config.check import check_registers
from sfms_robot.emulator.launch import Chain, launch
from sfms_robot.errors import ConfigError, PortError
from sfms_robot.frames import Doubles
from sfms_robot.motion.audit import CommandAudit
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.motion.timeline import PlanTimeline
from sfms_robot.ports import Bus, Clock
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.runtime.clock import RealClock, VirtualClock
from sfms_robot.runtime.safety import HeatGuard
from sfms_robot.servo.bus import LEFT_OUT, AbsentBus
from sfms_robot.servo.composite import CompositeBus
from sfms_robot.servo.discovery import access_problem
from sfms_robot.servo.families import family_named
from sfms_robot.servo.policy import BusServo, tells_current, torque_register
from sfms_robot.servo.port import Port
from sfms_robot.servo.stored_settings import JointNeeds, home_ticks

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Motion:
    """What lies between a plan and the bus. `holds` (J,): joints that keep their torque in an emergency stop."""

    timeline: PlanTimeline
    retargeter: HeadRetargeter
    limiter: JerkLimiter
    audit: CommandAudit
    leads_s: Doubles
    rest_rad: Doubles
    holds: NDArray[np.bool_]
    heat: HeatGuard


@dataclass(frozen=True)
class HeadOptions:
    """Which head, on which servos.

    Attributes:
        head: shipped name, or a folder with a head.yaml.
        port: "sim", a device, or NAME=DEVICE[,NAME=DEVICE] for a head of several buses.
        fast: virtual time; needs emulated servos.
        yes: hobby servos may jump when they come on.
        without: joints left out: their servos are not addressed at all.
    """

    head: str = "face28"
    port: str = SIM
    fast: bool = False
    yes: bool = False
    without: tuple[str, ...] = ()


@dataclass(frozen=True)
class OpenHead:
    """A head whose servos are connected; torque is untouched. `rate_hz` is that of its fastest bus."""

    options: HeadOptions
    config: Head
    motion: Motion
    bus: Bus
    clock: Clock
    rate_hz: float
    opened: Opened

    def digests(self) -> dict[str, Any]:
        """What went over each emulated wire: two runs that say the same here sent the same bytes."""
        digests = {name: chain.digest() for name, chain in self.opened.items() if isinstance(chain, Chain)}
        return {name: {"sha256": sha256, "bytes": count} for name, (sha256, count) in digests.items()}


def prepare_head(options: HeadOptions) -> Head:
    """All that can be wrong with a head and its ports before anything is opened. Raises ConfigError, PortError."""
    if options.fast and options.port != SIM:
        raise ConfigError(f"--port {options.port!r}: --fast needs emulated servos, time is virtual (sim)")
    head = load_head(options.head)
    for joint in options.without:
        if joint not in head.joints:
            raise ConfigError(f"--without {joint!r} is no joint of head {head.name!r} ({', '.join(head.joints)})")
    if options.port == SIM:
        return head
    where = devices(head, options.port)
    if (jumping := on_boards(head)) and not options.yes:
        raise ConfigError(
            f"head {head.name!r}: hobby servos report no position, and each jumps to rest when it comes on "
            f"({', '.join(jumping)}); keep clear, and confirm it with --yes"
        )
    for device in where.values():
        if problem := access_problem(device):
            raise PortError(f"{device}: {problem}")
    return head


@contextmanager
def open_wires(head: Head, options: HeadOptions) -> Iterator[Opened]:
    """Where each bus of the head is: emulated servos, which live as long as this does, or devices. Opens no port."""
    with ExitStack() as stack:
        if options.port != SIM:
            yield devices(head, options.port)
            return
        chains = plugged_in(options.head, head)
        yield {name: stack.enter_context(launch(chains[name], options.fast)) for name in chains}


@contextmanager
def open_head(options: HeadOptions) -> Iterator[OpenHead]:
    """Connect to every servo of a head. Blocks for as long as identifying takes. Raises RobotError."""
    prepare_head(options)
    clock: Clock = VirtualClock() if options.fast else RealClock()
    kept: dict[str, Port] = {}
    with ExitStack() as stack:
        stack.callback(_close, kept)
        head = calibrated_head(options.head, options.port, clock, kept)
        rate_hz = max(bus.rate_hz for bus in head.buses.values())
        motion = build_motion(head, rate_hz)
        opened = stack.enter_context(open_wires(head, options))
        doctor = f"sfms-robot doctor --port {options.port} --head {quote(options.head)} --fix"
        bus = build_bus(head, opened, clock, confirmed=options.yes, without=options.without, doctor=doctor, kept=kept)
        stack.callback(bus.close)
        bus.connect()
        if weak := bus.statistics().get("stored_warnings"):
            log.warning("servos protect themselves less than usual: %s; mend it: %s", "; ".join(weak), doctor)
        yield OpenHead(options, head, motion, bus, clock, rate_hz, opened)


def _close(kept: dict[str, Port]) -> None:
    for port in kept.values():
        port.close()


def build_motion(head: Head, rate_hz: float) -> Motion:
    """Timeline, retargeter, limiter and audit at the rate of the loop, which is that of the head's fastest bus."""
    limits = JointLimits.of(head)
    retargeter = HeadRetargeter(head, 1.0 / rate_hz)
    leads_s = np.array([joint.lag_ms / 1e3 for joint in head.joints.values()])
    if len(neck := retargeter.neck_columns):
        leads_s[neck] = leads_s[neck].max()  # its joints show one pose together
    safety = [head.safety_of(joint) for joint in head.joints]
    holds = np.array([each.halt == "hold" for each in safety])
    holds[neck] |= np.array([safety[column].halt is None for column in neck], np.bool_)
    return Motion(
        PlanTimeline(1.0 / rate_hz),
        retargeter,
        JerkLimiter(limits, 1.0 / rate_hz),
        CommandAudit(limits, calibration_of(head.joints), 1.0 / rate_hz),
        leads_s,
        np.array([joint.rest_rad for joint in head.joints.values()]),
        holds,
        HeatGuard(np.array([each.warm_C for each in safety]), np.array([each.hot_C for each in safety]), neck.tolist()),
    )


def on_boards(head: Head) -> list[str]:
    """Joints whose servos report no position, so that they jump when they come on."""
    return [name for name, joint in head.joints.items() if family_named(head.buses[joint.bus].family).board]


def build_bus(
    head: Head,
    opened: Opened,
    clock: Clock,
    *,
    confirmed: bool = False,
    without: Sequence[str] = (),
    doctor: str = BusServo.doctor,
    kept: dict[str, Port] | None = None,
) -> Bus:
    """Return the head's bus, not yet connected.

    `confirmed`: hobby servos may jump when their pulses come on. `without`: joints whose servos are left alone.
    `doctor`: see `BusServo`. `kept`: ports that are open already, by bus; the first connection takes them out.
    """
    buses: dict[str, Bus] = {}
    for name, where in opened.items():
        joints = {key: joint for key, joint in head.joints.items() if joint.bus == name and key not in without}
        if joints:
            buses[name] = build_one(
                head, name, joints, where, clock, confirmed=confirmed, doctor=doctor, kept={} if kept is None else kept
            )
    real = not any(isinstance(where, Chain) and where.virtual for where in opened.values())
    rates = {name: head.buses[name].rate_hz for name in buses} if real and len(buses) > 1 else None
    if without:
        buses[LEFT_OUT] = AbsentBus(_bus_servos(head, {joint: head.joints[joint] for joint in without}, doctor))
        rates = rates and {**rates, LEFT_OUT: max(rates.values())}
    return CompositeBus(buses, list(head.joints), rates)


def _bus_servos(head: Head, joints: Mapping[str, Joint], doctor: str) -> list[BusServo]:
    maps = firmware_maps(dict(joints))
    return [
        BusServo(
            joint=key,
            id=j.id,
            map=maps[j.model],
            min_rad=j.min_rad,
            max_rad=j.max_rad,
            safety=head.safety_of(key),
            doctor=doctor,
        )
        for key, j in joints.items()
    ]


def build_one(
    head: Head,
    name: str,
    joints: dict[str, Joint],
    where: Chain | str,
    clock: Clock,
    *,
    confirmed: bool,
    kept: dict[str, Port],
    doctor: str = BusServo.doctor,
) -> Any:
    """Return the bus `name` with `joints`, of the class of its family, not yet connected."""
    config = head.buses[name]
    check_safety(head, joints, firmware_maps(joints))
    servos = _bus_servos(head, joints, doctor)
    family = family_named(config.family)
    if family.board:
        rest_rad = np.array([joint.rest_rad for joint in joints.values()])
        more: dict[str, Any] = {"confirmed": confirmed or isinstance(where, Chain), "rest_rad": rest_rad}
    else:
        more = {"faults": head.faults}
    deadline_s = config.read_deadline_ms / 1e3
    if isinstance(where, Chain):
        deadline_s = max(deadline_s, where.read_deadline_s)
    return family.build(
        name,
        servos,
        calibration_of(joints),
        lambda: kept.pop(name, None) or port_of(where, config, clock)(),
        config.baud,
        deadline_s,
        config=config,
        **more,
    )


# --- what a head's file asks of its servos, and whether they can ----------------------------------------------------


def check_safety(head: Head, joints: Mapping[str, Joint], maps: Mapping[str, FirmwareMap]) -> None:
    """Check joints against the maps of their models. A rule that no servo keeps is worse than none.

    Raises ConfigError for a limit that a joint's servo cannot keep, a register that a run must not write, or more
    turns than it makes.
    """
    for name, joint in joints.items():
        _limits(head, name, maps[joint.model])
        _turns(head, name, maps[joint.model])
    check_registers(head.name, {name: (head.safety_of(name), maps[joint.model]) for name, joint in joints.items()})


def _limits(head: Head, name: str, table: FirmwareMap) -> None:
    safety, joint = head.safety_of(name), head.joints[name]
    can_limit, can_tell = torque_register(table) is not None, tells_current(table)
    instead = "; torque_limit_percent limits its torque" if can_limit else ""
    impossible: dict[str, tuple[float | None, str]] = {}
    if "goal_current" not in table.registers:
        impossible["current_limit_mA"] = safety.current_limit_mA, f"cannot limit its current{instead}"
    if not can_limit:
        impossible["torque_limit_percent"] = safety.torque_limit_percent, "has no torque limit"
    if not can_tell:
        for key in ("pinch", "strain"):
            rule = getattr(safety, key)
            impossible[key] = rule and rule.current_mA, "does not tell its current in mA"
    for key, (value, why) in impossible.items():
        if value is None:
            continue
        if joint.safety is not None and key in joint.safety.model_fields_set:
            raise ConfigError.at(
                head.name, f"joints.{name}.safety.{key}", value, f"cannot be kept: {joint.model} {why}"
            )
        except_here = f"for {name}: {joint.model} {why} (joints.{name}.safety.{key}: null leaves it out)"
        raise ConfigError.at(head.name, f"safety.{key}", value, f"cannot be kept {except_here}")


def _turns(head: Head, name: str, table: FirmwareMap) -> None:
    """A geared joint may need more than one turn of its servo, and only some models count them."""
    joint, turn = head.joints[name], table.ticks_per_revolution
    ticks = Calibration({name: joint}, np.array([turn]))
    low, high = int(ticks.low_ticks[0]), int(ticks.high_ticks[0])
    if 0 <= low and high <= turn - 1:
        return
    goal = table.registers.get("goal_position")
    if goal is None or not (goal.low <= low and high <= goal.high):
        reach = "one turn" if goal is None or goal.low >= 0 else f"{goal.low}..{goal.high} ticks"
        raise ConfigError.at(
            head.name, f"joints.{name}.ratio", joint.ratio,
            f"needs {low}..{high} ticks of {joint.model}, which makes {reach}: change ratio or range, or take a servo "
            "with extended position control",
        )  # fmt: skip
    first, last = home_ticks(turn, JointNeeds(low, high))
    if first > last:
        raise ConfigError.at(
            head.name, f"joints.{name}.zero_ticks", joint.zero_ticks,
            f"leaves no place where {low}..{high} ticks can be told apart after power-up: bring the middle of the "
            f"range near {table.center_ticks} ticks, or make it less than two turns",
        )  # fmt: skip
