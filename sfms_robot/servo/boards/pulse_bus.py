"""A board of hobby servos as a bus: pulses go out, nothing comes back.

A hobby servo tells nobody where it is, so this bus reports no positions, and no made-up ones either. What follows:

1. Torque cannot come on without a jump: a servo goes to the first pulse as fast as it can. So `enable` is refused until
   somebody confirmed it, says so in the log, and brings up one channel at a time, at the pulse the board sends already,
   else at the last goal, else at the rest pose. It waits between channels for as long as the slowest servo may take;
   that is all the driver's idea of a servo's speed is used for.
2. A line may be slower than the loop: 24 channels take a fifth of a second at 9600 baud. Goals that come while the
   line is busy replace each other, and the newest goes out when it is free. Only what changed is sent, and one other
   channel in turn, so that a command that got lost does not stay lost.
3. Once a second the board is asked for its status; nobody waits for the answer, later polls look for it. What it says
   becomes a fault. A board that is silent gets no goals, and channels that it switched off meanwhile come on again as
   at start-up, one at a time.
4. Torque off is a latch: from `torque_off` or `stop` until the next `enable` no pulse is sent, whichever thread was
   about to, and a board that was away is switched off as soon as it is back.
"""

from __future__ import annotations

import logging
import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import BusConfig
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import STOP_S, StopPolicy, TickConversion
from sfms_robot.servo.boards.board_protocol import BoardProtocol, BoardStatus, board_of, pulses_beyond
from sfms_robot.servo.boards.rate_limit import RateLimitedPort
from sfms_robot.servo.bus import RECONNECT_S, WireBus
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port
from sfms_robot.servo.registers import Table

log = logging.getLogger(__name__)

_CAPABILITIES: Final = frozenset({"torque"})  # pulses can be switched off, nothing more
_SLOW_RAD_S: Final = 3.5  # a slow hobby servo under load: 0.3 s for 60 degrees
_LONGEST_TRAVEL_S: Final = 0.7  # no joint holds up `enable` for longer
_TRAVEL_PARTS: Final = 14  # of that wait; after each, torque off is looked for
_STATUS_EVERY_S: Final = 1.0
_SILENT_AFTER: Final = 3  # requests without an answer
_LEAST_PATIENCE_S: Final = 0.02  # an SSC-32 thinks for up to 5 ms, an adapter holds its bytes for up to 16
_TRIES: Final = 3
_STOP_S: Final = 0.4  # the longest that `stop` waits for the board to say that its pulses are off
_LEAST_RECONNECT_S: Final = 5.0  # a board that is asked once a second has to have a few chances
_NO_ANSWER: Final = "no answer"
_TORQUE_LOST: Final = "torque lost"


class PulseBus(WireBus[RateLimitedPort]):
    """One board, as `ports.Bus`.

    Args:
        name, open_port, baud: see `WireBus`.
        servos: in joint order; `id` is the channel.
        conversion: joint angles (J,) <-> ticks (J,) of pulse width.
        read_deadline_s: silence after which a question counts as unanswered; at least 20 ms is granted.
        confirmed: somebody knows that servos jump when their pulses come on.
        rest_rad: (J,) where a joint goes first when nobody knows better; 0 rad, inside the limits, unless told.
        config: what the head says of this bus.

    Raises ConfigError for a channel or a pulse that the board does not have.
    """

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: Callable[[], Port],
        baud: int,
        read_deadline_s: float = _LEAST_PATIENCE_S,
        *,
        confirmed: bool = False,
        rest_rad: Doubles | None = None,
        config: BusConfig | None = None,
    ) -> None:
        reconnect_s = config.reconnect_s if config is not None else RECONNECT_S
        patience_s, reconnect_s = max(read_deadline_s, _LEAST_PATIENCE_S), max(reconnect_s, _LEAST_RECONNECT_S)
        super().__init__(name, servos, conversion, open_port, baud, patience_s, reconnect_s)
        self._channels = [servo.id for servo in servos]
        self._confirmed = confirmed
        self._lowest = np.array([servo.min_rad for servo in servos])
        self._highest = np.array([servo.max_rad for servo in servos])
        self._crc = config is not None and config.crc
        table = board_of(name, servos)
        self.model = table.model
        if beyond := pulses_beyond(servos, conversion, table, table.pulse_us or (0.0, 0.0)):
            raise ConfigError(f"bus {name!r}: a {table.model} does not make the pulses of {', '.join(beyond)}")
        self._protocol = self._protocol_of(table)
        rest = np.zeros(len(servos)) if rest_rad is None else np.asarray(rest_rad, np.float64)
        self._ticks = conversion.to_ticks(np.clip(rest, self._lowest, self._highest))  # goals; before any, the rest
        self._warned = False  # that servos jump
        self._counts["deferred"] = 0
        self._fault_log: dict[str, None] = {}
        self._off: tuple[int, ...] | None = None  # since torque off: channels that stay off; None: armed
        self._off_unsent = False  # they could not be told
        self._forget()

    @abstractmethod
    def _protocol_of(self, table: Table) -> BoardProtocol:
        """What the board speaks; pulses that its own settings may keep from it are logged."""

    def _forget(self) -> None:
        """What holds for one connection only."""
        self._enabled: list[int] = []
        self._pulses: dict[int, int] = {}  # channel -> ticks of pulses that the board sent when last asked
        self._sent: dict[int, int] = {}  # channel -> ticks last sent
        self._pending = False  # goals that have not gone out yet
        self._refresh_index = 0  # of the enabled, who is sent though unchanged
        self._sent_at_s = -math.inf
        self._status_due_s: float | None = None  # when to ask the board next
        self._unanswered = 0
        self._switched_off: list[int] = []  # enabled, but the board has switched them off
        self._next_on_s = -math.inf  # when the next of them may come on
        self._faults: dict[int, str] = {}
        self._resting: frozenset[int] = frozenset()  # channels that `release` has switched off
        self._rest_due = False  # and that are to be told so again
        self._arrived: list[int] = []  # whose pulses came on again since the last reading

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return dict.fromkeys(self.joints, _CAPABILITIES)

    # --- start and stop -----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open and find the board, pulses left unchanged.

        Raises PortError; BusError when the board does not answer, or is set otherwise than the head's file says.
        """
        wire = self._open()
        self._forget()
        self._off, self._off_unsent, self._powered = None, False, frozenset()
        try:
            present = self._present(wire)
            if misfit := self._protocol.misfit(wire.exchange, present):
                raise self._absent(wire, f"the {self.model} {misfit}")
            if not present:
                raise self._absent(wire)
            self._pulses = self._protocol.read_pulses(wire.exchange, self._channels) or {}
        except BaseException:
            wire.port.close()
            raise
        self._forget_silence()
        self._link = wire

    def _open(self) -> RateLimitedPort:
        return RateLimitedPort(self._open_port(), self._baud, self._read_deadline_s)

    def _absent(self, wire: RateLimitedPort, problem: str = "") -> BusError:
        problem = problem or f"no {self.model} answers"
        return BusError(f"bus {self.name!r} on {wire.port.name} at {self._baud} baud: {problem}")

    def _present(self, wire: RateLimitedPort) -> bool:
        return any(self._answers(wire, restarted) for _ in range(_TRIES) for restarted in (False, True))

    def _answers(self, wire: RateLimitedPort, restarted: bool) -> bool:
        answer = wire.exchange(self._protocol.status_request(restarted), self._protocol.status_length)
        return answer is not None and self._protocol.decode_status(answer) is not None

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """Pulses on for `joints`, one after the other; angles they were sent to, rad, in the order of `joints`.

        Blocks for 0.7 s a joint, and a few answers of the board more. Raises ConfigError unless the bus was told that
        jumps are understood; BusError when the board does not answer before or after (nothing else tells that it
        heard), or when `torque_off` came meanwhile: then no pulse is on.
        """
        wire = self._connected()
        self._off, self._off_unsent = None, False
        self._warn_of_jumps(joints)
        if not self._present(wire):
            raise self._absent(wire)
        held = [self._switch_on(wire, self.joints.index(joint)) for joint in joints]
        if not self._present(wire):
            raise self._absent(wire)
        self._check_armed()
        return np.array(held)

    def _check_armed(self) -> None:
        if self._off is not None:
            self._enabled = []
            raise BusError(f"bus {self.name!r}: torque was switched off while joints came on")

    def _warn_of_jumps(self, joints: Sequence[str]) -> None:
        if not self._confirmed:
            raise ConfigError(
                f"bus {self.name!r}: servos on a {self.model} report no position and jump to {', '.join(joints)} "
                "at rest when they come on; confirm it with --yes"
            )
        if not self._warned:
            log.warning(
                "bus %r: servos on a %s report no position; each jumps to its first pose: keep clear",
                self.name, self.model,
            )  # fmt: skip
            self._warned = True

    def _switch_on(self, wire: RateLimitedPort, index: int) -> float:
        """Pulses on for one joint; the angle it was sent to, rad. Raises BusError when `torque_off` comes meanwhile."""
        servo = self._servos[index]
        self._powered |= {index}
        self._resting -= {servo.id}
        self._take_over(index)
        self._send(wire, {servo.id: int(self._ticks[index])})
        if self._pulses.get(servo.id) != self._ticks[index] and index not in self._enabled:
            start_s, travel_s = wire.port.now_s(), _travel_s(servo)
            for part in range(_TRAVEL_PARTS):
                if self._off is None:
                    wire.wait(start_s + travel_s * (part + 1) / _TRAVEL_PARTS)
        if index not in self._enabled:
            self._enabled.append(index)
        self._check_armed()
        if index in self._switched_off:
            self._switched_off.remove(index)
        self._faults.pop(index, None)
        return float(self._conversion.to_rad(self._ticks)[index])

    def _take_over(self, index: int) -> None:
        """Where the board sends pulses already, the first goal is those pulses, as far as the limits allow."""
        pulse = self._pulses.get(self._channels[index], 0)
        if not pulse or index in self._enabled:
            return
        ticks = self._ticks.copy()
        ticks[index] = pulse
        angle = self._conversion.to_rad(ticks)
        self._ticks = self._conversion.to_ticks(np.clip(angle, self._lowest, self._highest))

    def release(self, joints: Sequence[str]) -> None:
        """End the pulses of `joints` now; the others go on. Said once more by the next `poll`. From any thread."""
        indices = {self.joints.index(joint) for joint in joints}
        if not indices:
            return
        channels = frozenset(self._servos[index].id for index in indices)
        self._resting, self._rest_due = self._resting | channels, True
        self._enabled = [index for index in self._enabled if index not in indices]
        self._switched_off = [index for index in self._switched_off if index not in indices]
        for sent in (self._pulses, self._sent):
            for channel in channels:
                sent.pop(channel, None)
        self._say_resting()

    def resume(self, joints: Sequence[str]) -> None:
        """As `ports.Bus`: pulses come on again one channel at a time, at the last goal, where the servo jumps to."""
        off = self._resting.union(self._off or ())
        back = [i for i in map(self.joints.index, joints) if self._channels[i] in off and i not in self._switched_off]
        self._switched_off = [*self._switched_off, *back]  # first: no goal is sent to them yet
        self._enabled = [*self._enabled, *(i for i in back if i not in self._enabled)]
        self._resting -= {self._channels[i] for i in back}
        self._off, self._off_unsent = None, False

    def _say_resting(self) -> None:
        wire = self._link
        if wire is not None:
            data = self._protocol.encode_off(tuple(self._resting), self._silent)
            self._rest_due |= self._attempt(lambda: wire.send(data)) is None

    def torque_off(self, policy: StopPolicy) -> None:
        """End the pulses now, but of joints whose safety says hold; goals are withheld until the next `enable`.

        For any thread or signal handler, any time. Never raises, waits for no answer; blocks while bytes are handed
        to the port and, where that was lost, while it is opened. A board that is away is switched off by `poll` when
        it is back. With the policy "hold" nothing happens.
        """
        if policy == "hold":
            return
        self._off = tuple(servo.id for servo in self._servos if servo.safety.stop == "release")  # first of all
        self._sent, self._switched_off = {}, []
        self._pulses = {channel: ticks for channel, ticks in self._pulses.items() if channel not in self._off}
        self._send_off()

    def _send_off(self) -> None:
        """Over the open port, else over one opened for this: another thread may be busy with the bus's own."""
        channels, wire = self._off, self._link
        if not channels or (wire is None and self._lost_s is None):
            return
        if wire is not None:
            data = self._protocol.encode_off(channels, self._silent)
            if self._attempt(lambda: wire.send(data)) is not None:
                return
        self._off_unsent = self._attempt(lambda: self._send_off_anew(channels)) is None

    def _send_off_anew(self, channels: Sequence[int]) -> bool:
        wire = self._open()
        try:
            wire.send(self._protocol.encode_off(channels, restarted=True))
            return True
        finally:
            wire.port.close()

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """As `torque_off`, then ask the board whether its pulses are off, and repeat it; refuse goals. Never raises.

        Blocks for `within_s` at most; what was sent before may take part of that to leave. Only one thread at a time.
        """
        self.torque_off(policy)
        self._enabled, self._switched_off, self._pending = [], [], False
        if policy == "hold" or not self._off or (self._link is None and self._lost_s is None):
            return
        wire = self._link or self._open_again()
        until_s = wire.port.now_s() + min(_STOP_S, within_s) if wire is not None else 0.0
        for _ in range(4 * _TRIES):  # each costs a mute board's patience
            if wire is None:
                break
            try:
                wire.wait(min(wire.busy_until_s, until_s))
                if wire.port.now_s() >= until_s:
                    break
                on = self._still_on(wire)
                self._powered = frozenset(i for i in self._powered if self._channels[i] in on)
                if not on:
                    return
                self._send_off()
            except BusError as error:
                self._lose(error, -math.inf)
                wire = self._open_again()
        log.warning("bus %r: the %s does not confirm that its pulses are off", self.name, self.model)

    def _still_on(self, wire: RateLimitedPort) -> set[int]:
        """Return the channels whose pulses are not confirmed off: none when a board that cannot report them answers."""
        channels = self._off or ()
        pulses = self._protocol.read_pulses(wire.exchange, channels)
        if pulses is None:
            off = not self._protocol.reports_pulses and self._answers(wire, restarted=True)
            return set() if off else set(channels)
        return {channel for channel, ticks in pulses.items() if ticks}

    def end_pulses(self, channels: Sequence[int]) -> bool:
        """Open the port, end the pulses of `channels` and close it; return whether the board confirmed it.

        For a bus that is not connected, whatever the board does. Raises PortError, BusError.
        """
        self._off = tuple(channels)
        wire = self._open()
        try:
            for attempt in range(_TRIES):
                wire.send(self._protocol.encode_off(self._off, restarted=attempt > 0))
                wire.wait(wire.busy_until_s)
                if not self._still_on(wire):
                    return True
            return False
        finally:
            wire.port.close()

    def close(self) -> None:
        """Give the port back. Idempotent."""
        self._enabled = []
        super().close()

    # --- every tick ---------------------------------------------------------------------------------------------

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Goals of all joints; those of joints that are not enabled are left out.

        Raises ValueError, with nothing sent, before `enable` and after `stop`, for a goal that is not finite, or one
        out of range. While the port is gone, and after `torque_off`, nothing is sent and nothing is raised.
        """
        self._check(bool(self._enabled or self._resting))
        if self._off is not None:
            return
        self._ticks = self._goals.ticks(goals_rad, np.array(self._enabled, np.intp))
        self._pending = True
        try:
            self._counts["deferred"] += not self._flush()
        except BusError as error:
            self._lose(error, now_s)

    def _readings(self, now_s: float) -> Mapping[str, Reading]:
        """No positions; faults of the board, and whose pulses have come on again."""
        arrived, self._arrived = self._arrived, []
        return {
            joint: Reading(None, float("inf"), self._faults.get(index), rejoined=index in arrived)
            for index, joint in enumerate(self.joints)
        }

    def _ask(self, wire: RateLimitedPort, now_s: float) -> bool:
        """Ask for faults once a second when the line is free; whether there was an answer to that."""
        answered = False
        if self._off_unsent:  # over a port that was gone, and nobody had noticed: this finds out, and opens it again
            wire.send(self._protocol.encode_off(self._off or (), restarted=True))
            self._off_unsent = False
        if self._rest_due:
            self._rest_due = False
            self._say_resting()
        if self._status_due_s is None:
            self._status_due_s = now_s + _STATUS_EVERY_S
        if wire.awaiting:
            if (answer := wire.answer()) is not None:
                answered = self._take_status(wire, answer, now_s)
        elif now_s >= self._status_due_s:
            self._status_due_s = now_s + _STATUS_EVERY_S
            self._counts["retries"] += self._unanswered > 0
            self._counts["reads"] += 1
            wire.request(self._protocol.status_request(self._silent), self._protocol.status_length)
        if self._switched_off and now_s >= self._next_on_s and not self._silent:
            self._switch_on_again(self._switched_off.pop(0), now_s)
        if self._pending:
            self._flush()
        return answered

    def statistics(self) -> Mapping[str, Any]:
        return {
            **self._counts,
            "silent": sorted(self._channels) if self._silent else [],
            "faults": list(self._fault_log),
            "stored_warnings": [],
            **self._unconfirmed(self._off is not None),
        }

    # --- goals --------------------------------------------------------------------------------------------------

    def _flush(self) -> bool:
        """Send the newest goals, unless the line is busy or nobody listens."""
        wire = self._link
        if wire is None or self._silent or not wire.free:
            return False
        self._pending = False
        on = [index for index in self._enabled if index not in self._switched_off]
        if not on:
            return True
        self._refresh_index = (self._refresh_index + 1) % len(on)
        again = self._channels[on[self._refresh_index]]
        wanted = {self._channels[i]: int(self._ticks[i]) for i in on}
        self._send(wire, {c: ticks for c, ticks in wanted.items() if self._sent.get(c) != ticks or c == again})
        self._counts["writes"] += 1
        return True

    def _send(self, wire: RateLimitedPort, ticks: Mapping[int, int]) -> None:
        """Send goals, unless torque is off; where it was switched off while these bytes left, switch it off again."""
        if self._off is not None:
            return
        ticks = {channel: each for channel, each in ticks.items() if channel not in self._resting}
        if not ticks:
            return
        interval_s = max(wire.port.now_s(), wire.busy_until_s) - self._sent_at_s if self._sent else 0.0
        self._sent_at_s = wire.send(self._protocol.encode_goals(ticks, interval_s))
        self._sent.update(ticks)
        if self._off is not None:
            self._sent = {}
            self._send_off()
        elif self._resting & ticks.keys():
            self._say_resting()

    # --- the port ----------------------------------------------------------------------------------------------

    def _left(self) -> None:
        self._unanswered = _SILENT_AFTER
        self._report_fault(range(len(self.joints)), _NO_ANSWER)

    def _returned(self, wire: RateLimitedPort, now_s: float) -> None:
        self._status_due_s = now_s  # the board is asked before it gets any goal
        self._rest_due = bool(self._resting)
        self._send_off()

    # --- the board ----------------------------------------------------------------------------------------------

    @property
    def _silent(self) -> bool:
        return self._unanswered >= _SILENT_AFTER

    def _take_status(self, wire: RateLimitedPort, answer: bytes, now_s: float) -> bool:
        """Take an answer to the status request, empty when there was none; whether it is one."""
        status = self._protocol.decode_status(answer) if answer else None
        if status is not None:
            self._apply_status(wire, status, now_s)
            return True
        self._counts["errors"] += 1
        self._unanswered += 1
        if self._unanswered == _SILENT_AFTER:
            log.warning("bus %r: the %s is silent", self.name, self.model)
            self._report_fault(range(len(self.joints)), _NO_ANSWER)
        return False

    def _apply_status(self, wire: RateLimitedPort, status: BoardStatus, now_s: float) -> None:
        was_silent, self._unanswered = self._silent, 0
        self._faults = {index: text for index, text in self._faults.items() if text == _TORQUE_LOST}
        if was_silent:
            self._counts["reconnects"] += 1
            log.warning("bus %r: the %s answers again", self.name, self.model)
            self._resume(wire, now_s)
        if status.went_home:
            self._sent = {}  # whatever it does now, it is not what it was told
        if was_silent or status.went_home:
            self._send_off()
            self._rest_due |= bool(self._resting)
        if status.faults:
            self._counts["errors"] += not status.lasting
            self._report_fault(range(len(self.joints)), status.faults, shown=status.lasting)

    def _resume(self, wire: RateLimitedPort, now_s: float) -> None:
        """After a silence: channels that the board has switched off meanwhile come on one at a time, if it tells."""
        self._sent = {}
        pulses = self._protocol.read_pulses(wire.exchange, self._channels)
        if pulses is None or self._off is not None:
            return
        self._pulses = pulses
        self._switched_off = [index for index in self._enabled if not pulses.get(self._channels[index])]
        self._next_on_s = now_s
        self._report_fault(self._switched_off, _TORQUE_LOST)

    def _switch_on_again(self, index: int, now_s: float) -> None:
        servo = self._servos[index]
        if self._faults.pop(index, None) == _TORQUE_LOST:
            log.warning("%s (channel %d) has lost its pulses and comes on again", servo.joint, servo.id)
        self._arrived.append(index)
        self._next_on_s = now_s + _travel_s(servo)
        self._pending = True

    def _report_fault(self, indices: Sequence[int], fault: str, shown: bool = True) -> None:
        """Note a fault of some joints; `shown` puts it into their readings, too."""
        for index in indices:
            if shown:
                self._faults[index] = fault
        named = f"{self.name}: {fault}"
        if indices and named not in self._fault_log:
            log.warning("bus %r: the %s reports: %s", self.name, self.model, fault)
            self._fault_log[named] = None


def _travel_s(servo: BusServo) -> float:
    """How long a slow servo takes from one end of the joint's range to the other, as far as anybody waits for it."""
    return min((servo.max_rad - servo.min_rad) / _SLOW_RAD_S, _LONGEST_TRAVEL_S)
