"""A head and its servos: the half of the composition root that is shared by all commands that move a head.

    prepare_head    checks before anything is opened: the head's file, its ports, what is confirmed
    calibrated_head the head's file with the overlay of this build, for the servos that answer
    build_motion    the parts between a plan and the bus: timeline, retargeter, limiter, heat
    run_log         the figures of a run, with the audit of its commands
    build_bus       every servo of the head behind one bus, both emulated and real
    open_head       all of them: emulated servos started, ports opened, every servo identified; torque is untouched

`app.session` decides what is played on the head.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from shlex import quote
from typing import Any, Final

import numpy as np

from sfms_robot.app.options import SIM, HeadOptions, RunOptions
from sfms_robot.app.servo.serial_line import Wire
from sfms_robot.app.wiring import Opened, calibration_of, devices, open_wires, port_of
from sfms_robot.config import FirmwareMap, Head, Joint, load_firmware_map, load_head
from sfms_robot.config.check import register_problems
from sfms_robot.config.head import held_back
from sfms_robot.config.overlay import Identity, head_hash, layered, load_overlay
from sfms_robot.data import NO_HEAD, Report
from sfms_robot.emulator.launch import Chain
from sfms_robot.errors import ConfigError, ServoError
from sfms_robot.motion.audit import CommandAudit
from sfms_robot.motion.calibration import Calibration
from sfms_robot.motion.limits import JerkLimiter, JointLimits
from sfms_robot.motion.timeline import PlanTimeline
from sfms_robot.ports import Bus, Clock
from sfms_robot.retarget.head_retargeter import HeadRetargeter
from sfms_robot.runtime.clock import RealClock, VirtualClock
from sfms_robot.runtime.log import RunLog
from sfms_robot.runtime.loop import Motion
from sfms_robot.runtime.safety import HeatGuard
from sfms_robot.servo.bus import LEFT_OUT, AbsentBus
from sfms_robot.servo.composite import CompositeBus
from sfms_robot.servo.discovery import check_device
from sfms_robot.servo.families import family_named
from sfms_robot.servo.policy import BusServo, tells_current, torque_register
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table
from sfms_robot.servo.stored_settings import JointNeeds, home_ticks

log = logging.getLogger(__name__)

_REVERSED: Final = 1  # bit of the drive mode: the direction in which ticks rise
NO_BUS_HZ: Final = 50.0  # rate of the loop of a head without servos


@dataclass(frozen=True, kw_only=True)
class OpenHead:
    """A head whose servos are connected; torque is untouched. `opened`: the places of its buses."""

    options: HeadOptions
    config: Head
    motion: Motion
    bus: Bus
    clock: Clock
    opened: Opened

    @property
    def rate_hz(self) -> float:
        """Rate of the loop: that of the head's fastest bus."""
        return fastest_hz(self.config)

    def readings(self) -> Report:
        """Return what the servos report, torque untouched."""
        polled = self.bus.poll(self.clock.now_s()).items()
        return {joint: {"position_rad": each.position_rad, "fault": each.fault} for joint, each in polled}

    def digests(self) -> Report:
        """Return SHA-256 and count of the bytes on each emulated wire, for comparisons of runs."""
        return {
            name: dict(zip(("sha256", "bytes"), chain.digest(), strict=True))
            for name, chain in self.opened.items()
            if isinstance(chain, Chain)
        }


def doctor_command(head: str, port: str) -> str:
    """Return the command line that corrects the stored values of a head's servos."""
    return f"sfms-robot doctor --port {quote(port)} --head {quote(head)} --fix"


def fastest_hz(head: Head) -> float:
    """Return the rate of the head's fastest bus."""
    return max((bus.rate_hz for bus in head.buses.values()), default=NO_BUS_HZ)


def prepare_head(options: HeadOptions) -> Head:
    """Check a head and its ports before anything is opened; return the head. Raises ConfigError, PortError."""
    if options.fast and options.port != SIM:
        raise ConfigError(f"--port {options.port!r}: --fast needs emulated servos, time is virtual (sim)")
    head = load_head(options.head, servos=not isinstance(options, RunOptions))
    if not head.joints and options.port != SIM:
        raise ConfigError(f"--port {options.port!r}: --head {NO_HEAD} has no servos: leave it out")
    for joint in options.without:
        if joint not in head.joints:
            raise ConfigError(
                f"--without: expected a joint of head {head.name!r}, got {joint!r} ({', '.join(head.joints)})"
            )
    if options.port == SIM:
        return head
    where = devices(head, options.port)
    # Hobby servos report no position, so they jump when they come on.
    jumping = [name for name, joint in head.joints.items() if family_named(head.buses[joint.bus].family).board]
    if jumping and not options.confirmed:
        raise ConfigError(
            f"head {head.name!r}: hobby servos report no position, and each jumps to rest when it comes on "
            f"({', '.join(jumping)}); keep clear, and confirm it with --yes"
        )
    for device in where.values():
        check_device(device)
    return head


@contextmanager
def open_head(options: HeadOptions) -> Iterator[OpenHead]:
    """Connect to every servo of a head. Blocks while the servos are identified. Raises RobotError."""
    prepare_head(options)
    clock: Clock = VirtualClock() if options.fast else RealClock()
    kept: dict[str, Port] = {}  # ports by bus, open since their servos were identified
    with ExitStack() as stack:

        @stack.callback
        def close_kept() -> None:
            for port in kept.values():
                port.close()

        head = calibrated_head(options.head, options.port, clock, kept)
        motion = build_motion(head, fastest_hz(head))
        opened = stack.enter_context(open_wires(head, options.port, options.fast))
        doctor = doctor_command(options.head, options.port)
        bus = build_bus(
            head, opened, clock, confirmed=options.confirmed, without=options.without, doctor=doctor, kept=kept
        )
        stack.callback(bus.close)
        bus.connect()
        if weak := bus.statistics().get("stored_warnings"):
            log.warning(
                "protection stored in servos differs from the head's file: %s; to correct it: %s",
                "; ".join(weak),
                doctor,
            )
        yield OpenHead(options=options, config=head, motion=motion, bus=bus, clock=clock, opened=opened)


# --- the head's file, the overlay of this build, and the servos that answer -----------------------------------------


def calibrated_head(name: str, port: str, clock: Clock, kept: dict[str, Port]) -> Head:
    """Return the head with the ranges and speeds that its calibration allows on this port.

    On emulated servos every head counts as calibrated. On real servos each measured servo is identified first. A joint
    whose measurement does not hold moves little and slowly, as does an unmeasured joint of a head that must be
    calibrated first. The ports that are opened for this stay open, by bus, in `kept`: some adapters reset their servos
    at every opening.

    Raises ConfigError, PortError.
    """
    head = load_head(name, servos=False)  # `prepare_head` has checked it
    if not head.joints:
        return head
    overlay, sha256 = load_overlay(head), head_hash(name)
    if port == SIM:
        layers = layered(head, overlay.replaced(calibrate=None, stored=None), sha256)
    else:
        servos = identify(head, overlay.measured, devices(head, port), clock, kept)
        layers = layered(head, overlay, sha256, servos)
    for joint, problem in layers.refused.items():
        log.warning("head %s: the calibration of %s does not hold: %s", head.name, joint, problem)
    for note in layers.notes:
        log.warning("head %s: %s", head.name, note)
    return ready(layers.head, real=port != SIM, calibrated=layers.calibrated, refused=layers.refused)


def ready(head: Head, *, real: bool, calibrated: Collection[str] = (), refused: Collection[str] = ()) -> Head:
    """Return the head; joints that are not measured, or whose measurement is `refused`, move little and slowly."""
    held = [j for j in head.joints if j in refused or (head.calibrate_first and j not in calibrated)]
    if not real or not held:
        return head
    which = "" if len(held) == len(head.joints) else f" in {', '.join(held)}"
    log.warning("head %s is not calibrated%s: 20 %% of its travel, 0.3 of its speed", head.name, which)
    return held_back(head, held)


def identify(
    head: Head,
    joints: Collection[str],
    where: Mapping[str, Chain | str],
    clock: Clock,
    kept: dict[str, Port] | None = None,
) -> dict[str, Identity | None]:
    """Return the servo that answers for each of `joints`, None if none does. Writes nothing. Raises PortError.

    Ports are closed again, or stay open in `kept`, by bus, if it is given.
    """
    servos: dict[str, Identity | None] = {}
    for name, bus in head.buses.items():
        mine = [joint for joint in joints if head.joints[joint].bus == name]
        if family_named(bus.family).board:
            servos |= {j: Identity(id=head.joints[j].id, model=head.joints[j].model) for j in mine}
        elif mine:
            port = port_of(where[name], bus, clock)()
            try:
                wire = Wire(port, bus.family, bus.baud, fixed=True)
                servos |= {joint: _identity(wire, head.joints[joint]) for joint in mine}
            finally:
                if kept is None:
                    port.close()
                else:
                    kept[name] = port
    return servos


def _identity(wire: Wire, joint: Joint) -> Identity | None:
    if (found := wire.ping(joint.id)) is None:
        return None
    seen, stored = found.taken_for(joint.model), {}
    for name in ("homing_offset", "drive_mode"):
        with suppress(ConfigError, ServoError):  # the model has no such register, or the servo is silent
            stored[name] = seen.read(seen.named(name))
    if "drive_mode" in stored:
        stored["drive_mode"] &= _REVERSED
    model = found.model if seen is found else joint.model
    return Identity(id=joint.id, model=model, firmware=seen.firmware, **stored)


# --- the parts between a plan and the bus ---------------------------------------------------------------------------


def build_motion(head: Head, rate_hz: float) -> Motion:
    """Build the parts for a loop at `rate_hz`, the rate of the head's fastest bus."""
    retargeter = HeadRetargeter(head, 1.0 / rate_hz)
    leads_s = np.array([joint.lag_ms / 1e3 for joint in head.joints.values()])
    if len(neck := retargeter.neck_columns):
        leads_s[neck] = leads_s[neck].max()  # the neck's joints show one pose together
    safety = [head.safety_of(joint) for joint in head.joints]
    holds = np.array([each.halt == "hold" for each in safety], np.bool_)
    holds[neck] |= np.array([safety[column].halt is None for column in neck], np.bool_)
    return Motion(
        timeline=PlanTimeline(1.0 / rate_hz),
        retargeter=retargeter,
        limiter=JerkLimiter(JointLimits.of(head), 1.0 / rate_hz),
        leads_s=leads_s,
        rest_rad=head.rest_rad,
        holds=holds,
        heat=HeatGuard(
            np.array([each.warm_C for each in safety]), np.array([each.hot_C for each in safety]), neck.tolist()
        ),
    )


def run_log(head: Head, rate_hz: float) -> RunLog:
    """Return an empty log for `session.drive_head`, which audits commands by the head's limits."""
    audit = CommandAudit(JointLimits.of(head), calibration_of(head.joints), 1.0 / rate_hz)
    return RunLog(list(head.joints), 1.0 / rate_hz, audit)


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
    `doctor`: see `BusServo`. `kept`: ports that are open already, by bus; the first connection removes them from it.
    """
    buses: dict[str, Bus] = {}
    for name, where in opened.items():
        joints = {key: joint for key, joint in head.on_bus(name).items() if key not in without}
        if joints:
            buses[name] = build_one(
                head, name, joints, where, clock, confirmed=confirmed, doctor=doctor, kept=kept or {}
            )
    real = not any(isinstance(where, Chain) and where.virtual for where in opened.values())
    rates = {name: head.buses[name].rate_hz for name in buses} if real and len(buses) > 1 else None
    if without:
        buses[LEFT_OUT] = AbsentBus(bus_servos(head, {joint: head.joints[joint] for joint in without}, doctor))
        rates = rates and {**rates, LEFT_OUT: max(rates.values())}
    return CompositeBus(buses, list(head.joints), rates)


def bus_servos(head: Head, joints: Mapping[str, Joint], doctor: str = BusServo.doctor) -> list[BusServo]:
    """Return the servos of joints; `doctor`: see `BusServo`."""
    return [
        BusServo(
            joint=name,
            id=joint.id,
            table=Table.of(load_firmware_map(joint.model)),
            min_rad=joint.min_rad,
            max_rad=joint.max_rad,
            safety=head.safety_of(name),
            doctor=doctor,
        )
        for name, joint in joints.items()
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
    check_safety(head, joints)
    servos = bus_servos(head, joints, doctor)
    family = family_named(config.family)
    if family.board:
        rest_rad = np.array([joint.rest_rad for joint in joints.values()])
        more: Report = {"confirmed": confirmed or isinstance(where, Chain), "rest_rad": rest_rad}
    else:
        more = {"faults": head.faults}
    deadline_s = config.read_deadline_ms / 1e3
    if isinstance(where, Chain):
        deadline_s = max(deadline_s, where.read_deadline_s)
        if not where.virtual:  # a busy computer would trip the watchdog, and no servo is in danger
            config = config.replaced(watchdog_ms=0)
    open_port = port_of(where, config, clock)  # resolved while the adapter is present: it may return as another ttyUSB
    return family.build(
        name,
        servos,
        calibration_of(joints),
        lambda: kept.pop(name, None) or open_port(),
        config.baud,
        deadline_s,
        config=config,
        **more,
    )


# --- the rules of a head's file that its servos cannot keep ---------------------------------------------------------


def check_safety(head: Head, joints: Mapping[str, Joint]) -> None:
    """Check joints against the firmware maps of their models. A rule that no servo keeps is worse than no rule.

    Raises ConfigError for a limit that a joint's servo cannot keep, a register that a run must not write, or a range
    of more turns than the servo makes.
    """
    for name, joint in joints.items():
        table = load_firmware_map(joint.model)
        _check_limits(head, name, table)
        _check_turns(head, name, table)
        for key, value, problem, choices in register_problems(head.safety_of(name), table):
            raise ConfigError.at(head.name, f"joints.{name}.safety.{key}", value, problem, choices)


def _check_limits(head: Head, name: str, table: FirmwareMap) -> None:
    safety, joint, registers = head.safety_of(name), head.joints[name], Table.of(table)
    limits_torque = torque_register(registers) is not None
    impossible = {}
    if "goal_current" not in table.registers:
        instead = "; torque_limit_percent limits its torque" if limits_torque else ""
        impossible["current_limit_mA"] = safety.current_limit_mA, f"cannot limit its current{instead}"
    if not limits_torque:
        impossible["torque_limit_percent"] = safety.torque_limit_percent, "has no torque limit"
    if not tells_current(registers):
        for key in ("pinch", "strain"):
            rule = getattr(safety, key)
            impossible[key] = rule and rule.current_mA, "does not report its current in mA"
    for key, (value, why) in impossible.items():
        if value is None:
            continue
        if joint.safety is not None and key in joint.safety.model_fields_set:
            raise ConfigError.at(
                head.name, f"joints.{name}.safety.{key}", value, f"cannot be kept: {joint.model} {why}"
            )
        except_here = f"for {name}: {joint.model} {why} (joints.{name}.safety.{key}: null leaves it out)"
        raise ConfigError.at(head.name, f"safety.{key}", value, f"cannot be kept {except_here}")


def _check_turns(head: Head, name: str, table: FirmwareMap) -> None:
    """Raise ConfigError if a geared joint needs more turns than its servo makes; only some models count turns."""
    joint, turn = head.joints[name], table.ticks_per_revolution
    ticks = Calibration({name: joint}, np.array([turn]))
    low, high = int(ticks.low_ticks[0]), int(ticks.high_ticks[0])
    if 0 <= low and high <= turn - 1:
        return
    goal = table.registers.get("goal_position")
    if goal is None or not (goal.low <= low and high <= goal.high):
        reach = "one turn" if goal is None or goal.low >= 0 else f"{goal.low}..{goal.high} ticks"
        problem = (
            f"needs {low}..{high} ticks of {joint.model}, which makes {reach}: change ratio or range, or take a servo "
            "with extended position control"
        )
        raise ConfigError.at(head.name, f"joints.{name}.ratio", joint.ratio, problem)
    first, last = home_ticks(turn, JointNeeds(low, high))
    if first > last:
        problem = (
            f"leaves no place where {low}..{high} ticks can be told apart after power-up: bring the middle of the "
            f"range near {table.center_ticks} ticks, or make it less than two turns"
        )
        raise ConfigError.at(head.name, f"joints.{name}.zero_ticks", joint.zero_ticks, problem)
