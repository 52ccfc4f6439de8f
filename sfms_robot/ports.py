"""The seams: what the loop needs from each part, and nothing more.

Concrete parts are put together in `app`; everything that runs in time takes `now_s` as an argument.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import Doubles, Floats, Plan, Reading, Sighting, SpeakerFrame

StopPolicy = Literal["release", "hold"]  # torque off, or torque kept on, once the rest pose is reached
STOP_S: Final = 0.5  # that `Bus.stop` takes at most


class Voice(Protocol):
    """Somebody's voice, cut into frames: frame i is the 640 samples of 16 kHz of loop time (i x 0.04, (i + 1) x 0.04].

    Live voices are filled from another thread or process, whose time stamps are those of `time.monotonic`.
    """

    @property
    def lost(self) -> bool:
        """It has told something, and tells nothing any more: a device that is away."""

    @property
    def duration_s(self) -> float | None:
        """Length of a recording; None for something live."""

    @property
    def latency_s(self) -> float:
        """From the end of a frame to the moment its last sample is at hand; measured, 0 for a recording."""

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`; what was heard before it is dropped."""

    def take(self, index: int) -> Floats | None:
        """The samples (640,) of frame `index`, asked for in order; None while they are not all there. Never blocks."""

    def statistics(self) -> Mapping[str, Any]:
        """What was lost, and how far the clocks are apart: for the report."""

    def close(self) -> None: ...


class Sight(Protocol):
    """What a camera or a phone sees of a person. Time stamps as `Voice`."""

    @property
    def lost(self) -> bool:
        """As of `Voice`. Nobody in the picture is no loss."""

    @property
    def duration_s(self) -> float | None:
        """Length of a recording; None for something live."""

    @property
    def latency_s(self) -> float:
        """From a face to the moment `at` knows of it, as far as it can be measured; 0 for a recording."""

    def start(self, origin_s: float) -> None:
        """Loop time 0 is `origin_s` of `time.monotonic`."""

    def at(self, time_s: float) -> Sighting | None:
        """The newest sighting of loop time `time_s` or before, however old; None before the first. Never blocks."""

    def statistics(self) -> Mapping[str, Any]:
        """What was lost, doubled, refused: for the report."""

    def close(self) -> None: ...


class Outlet(Protocol):
    """Programs beside the run, which are told what it hears and does. Never blocks, may drop."""

    def hears(self, audio: Floats, time_s: float) -> None:
        """The (640,) that the listener is given; `time_s`: loop time of the newest."""

    def tells(self, kind: str, time_s: float, **values: Any) -> None:
        """An event, or a state, that begins at loop time `time_s`."""


class Source(Protocol):
    """Where the person's voice and face come from, as frames. Derive your own from it: all but `read` have defaults.

    Attributes:
        duration_s: length of a recording; None for something live.
        latency_s: as of `Voice`.
        outlets: whom the run is to be told to.
        missing: which parts of it are lost, by name: the run is degraded meanwhile.
    """

    duration_s: float | None = None
    latency_s: float = 0.0
    outlets: Sequence[Outlet] = ()
    missing: tuple[str, ...] = ()

    def start(self, origin_s: float) -> None:
        """Loop time 0, the first tick after torque came on, is `origin_s` of `time.monotonic`; drop what was before.

        In virtual time `origin_s` is the time of the virtual clock.
        """
        return None

    def read(self, now_s: float) -> Sequence[SpeakerFrame]:
        """Frames complete at or before loop time `now_s` and not given yet, oldest first. Must not block."""
        ...

    def moves(self, speed_rad_s: float) -> None:
        """How fast the head's joints move, all together; told at every tick. Its microphone hears their motors."""
        return None

    def statistics(self) -> Mapping[str, Any]:
        """What was lost: for the report."""
        return {}

    def close(self) -> None:
        """Give back what is open. Idempotent."""
        return None


class Listener(Protocol):
    """A predictor, streaming. Holds weights only: what a stream remembers is the `memory` it is handed."""

    @property
    def hop(self) -> int:
        """A new plan is made every `hop` frames."""

    @property
    def horizon(self) -> int:
        """Frames in a plan."""

    def start(self, seed: int) -> Any:
        """Memory of a stream that has heard nothing."""

    def step(self, speaker: SpeakerFrame, memory: Any) -> tuple[Plan | None, Any]:
        """Take one frame; a Plan on every `hop`-th, None between. Never changes `memory` in place."""


class BatchListener(Listener, Protocol):
    """A listener that steps many streams at once: of different people, begun at different times."""

    def step_each(self, speakers: Sequence[SpeakerFrame], memories: Sequence[Any]) -> list[tuple[Plan | None, Any]]:
        """`step` of N streams, one frame and one memory each, in their order; at a fraction of the time of N steps.

        Every stream does what it would alone, in fp32 but for the last digits (sums are added in another order): its
        plan is its own, and None where it is not due. Never changes memories in place. Raises as `step`, for the first
        frame that is refused; then no stream has moved.
        """


class PlanFeed(Protocol):
    """A listener seen from the loop: frames go in, plans come out when they are ready."""

    @property
    def lost(self) -> bool:
        """Whether it does not answer: hung, or being started anew, or given up."""

    def push(self, frame: SpeakerFrame, now_s: float) -> None: ...

    def poll(self, now_s: float) -> Sequence[Plan]:
        """Plans that became visible by `now_s`, oldest first. Never blocks."""

    def statistics(self) -> Mapping[str, Any]:
        """`state` in words, `restarts`, `skipped_frames` (the listener could not keep up), `step_ms` p50 and p99; `hop`
        and `budget_ms` (`config.hop`) where they are known.
        """

    def close(self) -> None: ...


class TickConversion(Protocol):
    """Joint angles of one bus <-> servo ticks: zero, sign, ratio (`motion.calibration`)."""

    def to_ticks(self, angles_rad: Doubles) -> NDArray[np.int64]:
        """Nearest ticks (J,) that lie inside the position limits, whatever the rounding."""

    def to_rad(self, ticks: NDArray[np.int64]) -> Doubles:
        """Angles (J,) of servo positions; a position outside the limits is told as it is."""


class Bus(Protocol):
    """Servos of one or several named buses, addressed by joint. One servo's trouble is never raised: it is a named
    fault in its `Reading`. Except for `torque_off`, one thread at a time calls it.
    """

    @property
    def joints(self) -> Sequence[str]:
        """Joint names, in the order of `goals_rad`."""

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        """Per joint, what its family tells or does: position, velocity, current, voltage, temperature, torque."""

    def connect(self) -> None:
        """Open the ports, identify every servo that answers and check it against the head. Torque stays as found.

        Blocks for as long as identifying takes (a silent id a few tenths of a second). A servo that does not answer
        is left absent, with a fault in its reading, and brought in when it appears. Raises PortError; BusError when
        nobody answers; ServoError when a servo contradicts the head's file.
        """

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """Torque on without a jump: goal := present, verified, then torque. Returns the angles held, rad (J,), in the
        order of `joints`; of a joint that is absent 0 rad, or the end of its range nearest to it: its goals are
        withheld until it has been brought in, which its reading tells by `rejoined`.

        Blocks per joint for a few exchanges and the stagger time. Raises ServoError for a servo that refuses, BusError
        when the supply or the port fails meanwhile; call `stop` then.
        """

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """One goal per joint, rad (J,), sent in one packet; those of joints without torque are withheld.

        Never waits for an answer. Raises ValueError, with nothing sent, before `enable`, and for a shape, a value that
        is not finite, or a goal to be sent that is not in the range in force.
        """

    def poll(self, now_s: float) -> Mapping[str, Reading]:
        """Freshest reading of every joint; whoever is in trouble is looked after.

        Blocks within the bus's time budget, whatever is lost on the wire: silence of any number of servos costs one
        read deadline. What does not fit is left to later polls. Raises BusError when the bus has failed: nobody has
        answered for `reconnect_s`.
        """

    def torque_off(self, policy: StopPolicy) -> None:
        """Send torque-off now, unconfirmed: one packet per wire, to this head's ids alone; pulses off on boards.

        May be called from any thread at any time after `connect`, also while another one is inside `poll`. Never
        raises, never waits for an answer. No goal is sent from then on, until `enable` or `resume`. With the policy
        "hold" nothing happens.
        """

    def release(self, joints: Sequence[str]) -> None:
        """Torque off for `joints` alone: their goals are withheld, until `resume` or `enable`; the others go on.

        Written at once in one packet per wire, and again in every poll until each servo says that it is off. Never
        waits for an answer; raises nothing. Called by who calls `write`.
        """

    def resume(self, joints: Sequence[str]) -> None:
        """Bring back those of `joints` that have no torque, after `release`, `torque_off` or a fault; the others go on.

        Only asked for here: the polls do it, a few joints in each, as with a servo that was away; its reading says
        `rejoined`. Never waits; raises nothing. Called by the caller of `write`.
        """

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """Torque off on all buses first, then confirmed and repeated, as far as servos answer; joints whose safety or
        `policy` says hold keep theirs. Goals are refused from now on.

        Never raises; takes `within_s` at most, whatever is dead; idempotent. Joints whose torque came on and could
        not be confirmed off are listed in `statistics` from then on.
        """

    def close(self) -> None:
        """Give the ports back. Idempotent."""

    def statistics(self) -> Mapping[str, Any]:
        """Return counters for the report: writes, reads, errors, retries, reconnects, silent ids, faults; and
        `torque_unconfirmed`, joints whose torque came on and was not confirmed off by the last `torque_off` or `stop`.
        """


class Observer(Protocol):
    """An observer of the loop, which may drop but never blocks. A subclass overrides the methods that it needs."""

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
    """One turn of the loop, as observers see it.

    Attributes:
        time_s: nominal time of the tick.
        motion: (58,) the face asked for at this instant, without lead.
        goals_rad: (J,) what was written.
        readings: freshest reading per joint.
        state, why: of the run, see docs/safety.md; `why` names what is lost, or what halts it.
        written_s: loop time at which the goals were on the wire; None where it was not measured.
    """

    time_s: float
    motion: Floats
    goals_rad: Doubles
    readings: Mapping[str, Reading]
    state: str = "starting"
    why: tuple[str, ...] = ()
    written_s: float | None = None


class Clock(Protocol):
    """Loop time from 0. Real clocks sleep; a virtual one jumps."""

    @property
    def origin_s(self) -> float:
        """Its 0 in seconds of `time.monotonic`; 0 where time is virtual."""

    def now_s(self) -> float: ...

    def wait_until(self, time_s: float) -> None: ...


class Timeline(Protocol):
    """Joins plans and plays them at any instant. State is a value."""

    def start(self) -> Any: ...

    def accept(self, plan: Plan, state: Any) -> Any: ...

    def sample(self, times_s: Doubles, now_s: float, state: Any) -> tuple[Floats, Any]:
        """Motion (N, 58) at each of (N,) instants, and the state with what was counted."""

    def lead_limit_s(self, state: Any) -> float:
        """How far after a tick [s] `sample` may be asked for; inf where the whole future is known."""


@dataclass(frozen=True)
class Watched:
    """Whom the head listens to, as far as the loop knows at a tick.

    Attributes:
        seen_s: when their face was last seen, in loop time; None: never.
        place_m, attention: of that sighting, see `Sighting`.
        said_s: when the robot itself was last heard; -inf: never.
        by_hand: somebody asks right now where head or eyes are to turn.
    """

    seen_s: float | None = None
    place_m: Floats | None = None
    attention: float | None = None
    said_s: float = -math.inf
    by_hand: bool = False


class SpontaneousMotion(Protocol):
    """What the head does of itself, on top of the face that was asked for. State is a value."""

    def start(self) -> Any: ...

    def step(
        self,
        motion: Floats,
        times_s: Doubles,
        now_s: float,
        state: Any,
        shown_pose: Callable[[Floats], Doubles] | None = None,
        watched: Watched | None = None,
    ) -> tuple[Floats, Any]:
        """Motion (N, 58) at (N,) instants, row 0 at `now_s`; never changes its input.

        `shown_pose`: see `Retargeter`, with the knobs of this tick; None: the neck shows the pose that is asked.
        `watched` None: nobody is looked at, nor away from.
        """


class Retargeter(Protocol):
    """Motion -> joint angles of this head. State is a value."""

    @property
    def joints(self) -> Sequence[str]: ...

    def start(self) -> Any: ...

    def step(self, motion: Floats, state: Any, knobs: Any = None) -> tuple[Doubles, Any]:
        """(J, 58) one motion row per joint (each joint has its own lead), or (58,) for all -> rad (J,).

        `knobs` None: those of the head's file.
        """

    def shown_pose(self, motion: Floats, knobs: Any = None) -> Doubles:
        """Motion (N, 58) -> the pose (N, 6) that the neck shows, as far as the knobs and its range let it."""


class Limiter(Protocol):
    """Position, speed, acceleration and jerk of every joint. State is a value."""

    def start(self, angles_rad: Doubles) -> Any: ...

    def step(self, reference_rad: Doubles, state: Any) -> tuple[Doubles, Any]:
        """Reference (3, J): angle, speed, acceleration one tick ahead -> angles (J,) that may be sent."""

    def brake(self, state: Any) -> tuple[Doubles, Any]:
        """Every joint one tick on its way to a stop, as fast as its limits allow -> angles (J,) that may be sent."""

    def restart(self, joints: NDArray[np.bool_], angles_rad: Doubles, state: Any) -> Any:
        """Some `joints` (J,) came back and stand still at `angles_rad` (J,); the others go on."""


class Audit(Protocol):
    """Judges the command stream from outside the limiter. State is a value with `violations` and `clamped`."""

    def start(self, angles_rad: Doubles) -> Any: ...

    def step(self, angles_rad: Doubles, wanted_rad: Doubles, state: Any) -> Any:
        """One command (J,), and what was wanted of the limiter."""

    def restart(self, joints: NDArray[np.bool_], angles_rad: Doubles, state: Any) -> Any:
        """As `Limiter.restart`: what such a joint did before is not held against it."""
