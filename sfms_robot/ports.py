"""Interfaces between the parts of a run, each with several implementations.

The parts are put together in `app`. All code that depends on time takes `now_s` as an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple, Protocol

import numpy as np

from sfms_robot.data import Names
from sfms_robot.frames import Doubles, Events, Floats, Ints, Plan, Readings, Sighting, SpeakerFrame

StopPolicy = Literal["release", "hold"]  # torque off, or torque kept on, once the rest pose is reached
Facts = Mapping[str, Any]  # figures and states for a report, by name
Document = Callable[[], Facts]  # returns the current facts
STOP_S: Final = 0.5  # longest duration of `Bus.stop`


class Sense(Protocol):
    """A microphone, a camera, or a recording of one. A live one is filled from another thread or process.

    Time stamps are those of `time.monotonic`.
    """

    @property
    def lost(self) -> bool:
        """True if it delivered data before and has stopped (device unplugged); a picture without a person is data."""

    @property
    def duration_s(self) -> float | None:
        """Length of a recording; None for something live."""

    @property
    def latency_s(self) -> float:
        """Time from the end of a frame, or from a face, until it is available; measured, 0 for a recording."""

    def start(self, origin_s: float) -> None:
        """Set loop time 0 to `origin_s` of `time.monotonic`; earlier data is dropped."""

    def statistics(self) -> Facts:
        """Return losses and clock offsets for the report."""

    def close(self) -> None: ...


class Voice(Sense, Protocol):
    """A person's voice in frames: frame i is the 640 samples of 16 kHz of loop time (i x 0.04, (i + 1) x 0.04]."""

    def take(self, index: int) -> Floats | None:
        """Return the samples (640,) of frame `index`, in order; None while they are incomplete. Never blocks."""


class Sight(Sense, Protocol):
    """A camera or a phone that tracks a person."""

    def at(self, time_s: float) -> Sighting | None:
        """Return the newest sighting at or before loop time `time_s`; None before the first. Never blocks."""


class Outlet(Protocol):
    """Another program that receives sound and events of the run. Its methods never block and may drop data."""

    def hears(self, audio: Floats, time_s: float) -> None:
        """Send the listener's samples (640,); `time_s`: loop time of the newest."""

    def tells(self, kind: str, time_s: float, **values: Any) -> None:
        """Send an event, or a state, that begins at loop time `time_s`."""


class Source(Protocol):
    """A source of the person's voice and face, as frames. A subclass has to define only `read`.

    Attributes:
        duration_s: length of a recording; None for something live.
        latency_s: see `Voice`.
        outlets: programs that receive sound and events of the run.
        missing: names of its lost parts; the run is degraded while there are any.
    """

    duration_s: float | None = None
    latency_s: float = 0.0
    outlets: Sequence[Outlet] = ()
    missing: Names = ()

    def start(self, origin_s: float) -> None:
        """Set loop time 0, the first tick after torque came on, to `origin_s` of `time.monotonic`; drop earlier data.

        In virtual time `origin_s` is the time of the virtual clock.
        """
        return None

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        """Return new frames complete at or before loop time `now_s`, oldest first. Must not block."""
        ...

    def moves(self, speed_rad_s: float) -> None:
        """Receive the summed speed of the head's joints at every tick, since the microphone picks up their motors."""
        return None

    def statistics(self) -> Facts:
        """Return losses for the report."""
        return {}

    def close(self) -> None:
        """Close all resources. Idempotent."""
        return None


class Listener(Protocol):
    """A streaming predictor. Holds weights only; the memory of a stream is passed as `memory`."""

    @property
    def hop(self) -> int:
        """Frames between plans."""

    @property
    def horizon(self) -> int:
        """Frames in a plan."""

    def start(self, seed: int) -> Any:
        """Return the memory of a new stream."""

    def step(self, speaker: SpeakerFrame, memory: Any) -> tuple[Plan | None, Any]:
        """Process one frame; return a Plan on every `hop`-th frame, else None. Never changes `memory` in place."""


class PlanFeed(Protocol):
    """The loop's side of a listener: frames in, plans out when they are ready."""

    @property
    def lost(self) -> bool:
        """True if the listener does not answer: hung, restarting, or given up."""

    def push(self, frame: SpeakerFrame, now_s: float) -> None: ...

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Return plans that became visible by `now_s`, oldest first. Never blocks."""

    def statistics(self) -> Facts:
        """Return figures for the report.

        `state` in words, `restarts`, `skipped_frames` (the listener was too slow), `step_ms` p50 and p99; `hop` and
        `budget_ms` (`config.hop`) where they are known.
        """

    def close(self) -> None: ...


class TickConversion(Protocol):
    """Conversion between joint angles of one bus and servo ticks: zero, sign, ratio (`motion.calibration`)."""

    def to_ticks(self, angles_rad: Doubles) -> Ints:
        """Return the nearest ticks (J,) inside the position limits, also after rounding."""

    def to_rad(self, ticks: Ints) -> Doubles:
        """Return the angles (J,) of servo positions, also of those outside the limits."""


class Bus(Protocol):
    """Servos of one or several named buses, addressed by joint.

    A problem of one servo is never raised; it is a named fault in its `Reading`. Except for `torque_off`, only one
    thread at a time may call a bus.
    """

    @property
    def joints(self) -> Sequence[str]:
        """Joint names, in the order of `goals_rad`."""

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        """Capabilities of each joint: position, velocity, current, voltage, temperature, torque."""

    def connect(self) -> None:
        """Open the ports, identify every servo that answers and check it against the head. Torque stays as found.

        Blocks while servos are identified (a few tenths of a second for a silent id). A servo that does not answer
        counts as absent, with a fault in its reading, and is brought in when it appears. Raises PortError; BusError
        when no servo answers; ServoError when a servo contradicts the head's file.
        """

    def enable(self, joints: Sequence[str]) -> Doubles:
        """Switch torque on without a jump: goal := present, verified, then torque. Return the held angles, rad (J,).

        The angles are in the order of `joints`; that of an absent joint is 0 rad, or the end of its range nearest to
        0. Its goals are withheld until it has been brought in, which its reading reports as `rejoined`.

        Blocks for a few exchanges and the stagger time per joint. Raises ServoError for a servo that refuses, BusError
        when the supply or the port fails meanwhile; call `stop` after such an error.
        """

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Send one goal per joint, rad (J,), in one packet; those of joints without torque are withheld.

        Never waits for an answer. Raises ValueError, with nothing sent, before `enable`, and for a wrong shape, a value
        that is not finite, or a goal to be sent that is not in the range in force.
        """

    def poll(self, now_s: float) -> Readings:
        """Return the freshest reading of every joint, and recover servos in trouble.

        Blocks no longer than the bus's time budget, also after losses on the wire: any number of silent servos costs
        one read deadline. Requests that do not fit are left to later polls. Raises BusError when the bus has failed: no
        answer for `reconnect_s`.
        """

    def torque_off(self, policy: StopPolicy) -> None:
        """Send torque-off now, unconfirmed: one packet per wire, only to this head's ids; boards switch pulses off.

        May be called from any thread at any time after `connect`, also while another thread is inside `poll`. Never
        raises, never waits for an answer. No goal is sent from then on, until `enable` or `resume`. With the policy
        "hold" nothing happens.
        """

    def release(self, joints: Sequence[str]) -> None:
        """Switch torque off for `joints` only: their goals are withheld until `resume` or `enable`.

        The command is written at once in one packet per wire, and again in every poll until each servo reports that its
        torque is off. Never waits for an answer; raises nothing. Called in the thread of `write`.
        """

    def resume(self, joints: Sequence[str]) -> None:
        """Bring back those of `joints` that have no torque, after `release`, `torque_off` or a fault.

        This only requests it: later polls bring back a few joints each, as with a servo that was lost, and their
        readings report `rejoined`. Never waits; raises nothing. Called in the thread of `write`.
        """

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """Switch torque off on all buses first, then confirm and repeat, as far as servos answer.

        Joints keep their torque if `policy` or their safety is hold. Goals are refused from now on. Never raises; takes
        `within_s` at most, also with dead servos; idempotent. Joints whose torque came on and could
        not be confirmed off are listed in `statistics` from then on.
        """

    def close(self) -> None:
        """Close the ports. Idempotent."""

    def statistics(self) -> Facts:
        """Return counters for the report: writes, reads, errors, retries, reconnects, silent ids, faults.

        They include `torque_unconfirmed`: joints whose torque the last `torque_off` or `stop` did not confirm off.
        """


class Observer(Protocol):
    """An observer of the loop, which may drop data but never blocks. A subclass overrides the methods that it needs."""

    def tick(self, seen: Tick) -> None:
        return

    def heard(self, frame: SpeakerFrame) -> None:
        return

    def planned(self, plan: Plan) -> None:
        return

    def close(self) -> None:
        return


@dataclass(frozen=True)
class Tick:
    """One turn of the loop, as observers receive it.

    Attributes:
        time_s: nominal time of the tick.
        motion: (58,) the requested face at this instant, without lead.
        goals_rad: (J,) goals written to the bus.
        readings: freshest reading per joint.
        state, why: state of the run, see docs/safety.md; `why` names lost parts, or the causes of a halt.
        written_s: loop time at which the goals were on the wire; None if it was not measured.
        origin_s: loop time 0 in seconds of `time.monotonic`, or of the virtual clock in virtual time; None on the way
            to rest.
        busy: a text if this computer is late, which says by how much; None if it is not.
    """

    time_s: float
    motion: Floats
    goals_rad: Doubles
    readings: Readings
    state: str = "starting"
    why: Names = ()
    written_s: float | None = None
    origin_s: float | None = None
    busy: str | None = None


class ChannelLimit(NamedTuple):
    """Range of a channel of motion [rad, m, or 0..1], and its highest speed [1/s] and acceleration [1/s^2]."""

    low: float
    high: float
    speed: float
    acceleration: float


@dataclass(frozen=True, kw_only=True)
class OutputFrame:
    """A frame of motion for an output, at one instant.

    Attributes:
        time_s: loop time.
        motion: (58,) pose and blendshapes, already eased and limited.
        state: state of the run, see docs/safety.md.
        events: events that have begun since the previous frame.
        goals_rad, joints: (J,) goals of the servos and their names; empty with `--head none`.
    """

    time_s: float
    motion: Floats
    state: str = "starting"
    events: Events = ()
    goals_rad: Doubles = field(default_factory=lambda: np.zeros(0))
    joints: Names = ()


class Output(Protocol):
    """A head that accepts a face or a pose: an avatar, or a robot with a daemon. It is called from one thread.

    A subclass must define everything that has no value here. The constructor does not connect.

    Attributes:
        kind: KIND of `--output`. peer: the address, or another text that distinguishes two outputs of one kind.
        rate_hz: rate of `send`.
        moves: True for a machine, which holds its pose in a halt; an avatar goes neutral.
        limits: limits by channel of motion; the other channels pass unchanged.
        look_at: set by the run; turns head and eyes to x, y, z [m] if the peer requests it. May be called from any
            thread. Raises InputError.
    """

    kind: str
    peer: str
    rate_hz: float = 50.0
    moves: bool = False
    limits: Mapping[str, ChannelLimit] = {}
    look_at: Callable[[float, float, float], object] | None = None

    def open(self) -> None:
        """Connect, and move the peer to neutral: pose 0, blendshapes 0. Called again after a loss.

        May block up to 2 s. Raises OutputError of one line, or OSError.
        """
        ...

    def send(self, frame: OutputFrame, now_s: float) -> None:
        """Send a frame; `now_s`: time of `time.monotonic`. Raises OutputError or OSError when the peer is lost."""
        ...

    def statistics(self) -> Facts:
        """Return figures for the report. May be called from any thread."""
        return {}

    def close(self) -> None:
        """Disconnect; also after `open` or `send` raised. Idempotent."""
        return


class Clock(Protocol):
    """Loop time from 0. A real clock sleeps; a virtual one jumps."""

    @property
    def origin_s(self) -> float:
        """Time 0 of this clock in seconds of `time.monotonic`; 0 in virtual time."""

    def now_s(self) -> float: ...

    def wait_until(self, time_s: float) -> None: ...


class Timeline(Protocol):
    """Plans joined into one motion, which can be sampled at any instant. State is a value."""

    def start(self) -> Any: ...

    def accept(self, plan: Plan, state: Any) -> Any: ...

    def sample(self, times_s: Doubles, now_s: float, state: Any) -> tuple[Floats, Any]:
        """Return motion (N, 58) at (N,) instants, and the state with its counters."""

    def lead_limit_s(self, state: Any) -> float:
        """Return the longest time after a tick [s] that `sample` can look ahead; inf if the whole future is known."""


@dataclass(frozen=True, kw_only=True)
class Watched:
    """The person that the head listens to, as known at a tick.

    Attributes:
        seen_s: loop time of the last sighting; None: never.
        place_m, attention: of that sighting, see `Sighting`.
        said_s: loop time of the last sound of the robot itself; -inf: never.
        by_hand: True if a program turns head or eyes at this tick.
    """

    seen_s: float | None = None
    place_m: Floats | None = None
    attention: float | None = None
    said_s: float = -math.inf
    by_hand: bool = False


class Retargeter(Protocol):
    """Conversion of motion to joint angles of one head. State is a value."""

    @property
    def joints(self) -> Sequence[str]: ...

    def start(self) -> Any: ...

    def step(self, motion: Floats, state: Any, knobs: Any = None) -> tuple[Doubles, Any]:
        """Return angles (J,) [rad] of motion (J, 58), one row per joint and its lead, or (58,) for all.

        `knobs` None: the knobs of the head's file.
        """

    def shown_pose(self, motion: Floats, knobs: Any = None) -> Doubles:
        """Return the pose (N, 6) that the neck shows for motion (N, 58), within the knobs and its range."""
