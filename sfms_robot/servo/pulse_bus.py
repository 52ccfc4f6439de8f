"""A board of hobby servos as a bus: it sends pulses and receives no positions.

A hobby servo does not report its position, so this bus reports none, and does not estimate it. The consequences:

1. Torque cannot come on without a jump: a servo moves to the first pulse as fast as it can. So `enable` needs the
   user's confirmation, and switches on one channel at a time, with the pulse that the board already sends, else the
   last goal, else the rest pose. After each channel it waits for the longest time that the servo may take.
2. A line may be slower than the loop: 24 channels take 0.2 s at 9600 baud. Of the goals that arrive while it is busy,
   only the newest is sent. Each time the changed channels are sent, and one other channel in turn, so that a lost
   command is repeated.
3. Once a second the status of the board is requested; a later poll reads the answer. A silent board receives no goals,
   and channels that it switched off meanwhile come on again one at a time, as at the start.
4. Torque off is a latch: from `torque_off` or `stop` until the next `enable` or `resume` no thread sends a pulse, and a
   board that was lost is switched off as soon as it is back.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from contextlib import closing
from typing import Final

import numpy as np

from sfms_robot.config import BusConfig
from sfms_robot.errors import BusError, ConfigError, RobotError
from sfms_robot.frames import Doubles, Reading, Readings
from sfms_robot.ports import STOP_S, Facts, StopPolicy, TickConversion
from sfms_robot.servo.boards import (
    TRIES,
    PulseOutput,
    RateLimitedPort,
    answers,
    board_for,
    board_of,
    board_problem,
    pulses_beyond,
)
from sfms_robot.servo.bus import WireBus
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import OpenPort

log = logging.getLogger(__name__)

_CAPABILITIES: Final = frozenset({"torque"})  # pulses can be switched off, nothing more
_TRAVEL_PARTS: Final = 14  # parts of the wait after a channel came on; the latch is checked before each
_STATUS_EVERY_S: Final = 1.0
_SILENT_AFTER: Final = 3  # requests without an answer
_LEAST_PATIENCE_S: Final = 0.02  # an SSC-32 needs up to 5 ms to answer, an adapter delays its bytes by up to 16 ms
_STOP_S: Final = 0.4  # longest wait of `stop` for the board to confirm that its pulses are off
_LEAST_RECONNECT_S: Final = 5.0  # with one status request a second, the board has several chances to answer
_NO_ANSWER: Final = "no answer"
_TORQUE_LOST: Final = "torque lost"


class PulseBus(WireBus[RateLimitedPort]):
    """A Pololu Maestro or a Lynxmotion SSC-32, as `ports.Bus`.

    Args:
        name, open_port, baud, config: see `WireBus`.
        servos: in joint order; `id` is the channel.
        conversion: joint angles (J,) <-> ticks (J,) of pulse width.
        read_deadline_s: time without an answer after which a request counts as unanswered; at least 20 ms.
        confirmed: True if the user has confirmed that servos may jump when their pulses come on.
        rest_rad: (J,) first goals without a better one; by default 0 rad, or the end of the range nearest to it.

    Raises ConfigError for a channel or a pulse that the board does not have.
    """

    def __init__(
        self,
        name: str,
        servos: Sequence[BusServo],
        conversion: TickConversion,
        open_port: OpenPort,
        baud: int,
        read_deadline_s: float,
        config: BusConfig,
        *,
        confirmed: bool = False,
        rest_rad: Doubles | None = None,
    ) -> None:
        super().__init__(name, servos, conversion, open_port, baud, max(read_deadline_s, _LEAST_PATIENCE_S), config)
        self._reconnect_s = max(config.reconnect_s, _LEAST_RECONNECT_S)
        self.capabilities = dict.fromkeys(self.joints, _CAPABILITIES)
        self._confirmed = confirmed
        table = board_of(name, servos)
        self.model = table.model
        self._table, self._board = table, board_for(table, config.crc)
        if beyond := pulses_beyond(servos, conversion, table, table.pulse_us):
            raise ConfigError(f"bus {name!r}: a {self.model} cannot send the pulses of {beyond}")
        if wide := pulses_beyond(servos, conversion, table, self._board.factory_us):
            log.warning("bus %r: widen the limits stored in the Maestro, over USB, for %s", name, wide)
        rest = np.zeros(len(servos)) if rest_rad is None else np.asarray(rest_rad, np.float64)
        self._ticks = conversion.to_ticks(self._goals.own.nearest(rest))  # last goals; before the first, the rest pose
        self._warned = False  # the warning that servos jump has been logged
        self._counts["deferred"] = 0
        self._fault_log: dict[str, None] = {}
        self._forget()

    def _forget(self) -> None:
        """Reset the state of one connection."""
        self._outputs = [PulseOutput(index, servo) for index, servo in enumerate(self._servos)]
        self._latched = False  # set by `torque_off`: no goals are sent until `enable` or `resume`
        self._off_due = False  # the next poll has to send torque off again
        self._pending = False  # there are goals that have not been sent yet
        self._refresh_index = 0  # index, among the outputs that are on, of the one that is sent even if unchanged
        self._sent_at_s = -math.inf
        self._status_due_s: float | None = None  # time of the next status request
        self._unanswered = 0
        self._next_on_s = -math.inf  # time from which the next waiting output may come on

    def connect(self) -> None:
        """Open the port and find the board; leave its pulses unchanged.

        Raises PortError; BusError if the board does not answer, or if its settings contradict the head's file.
        """
        wire = self._open()
        self._forget()
        self._powered = frozenset()
        try:
            if problem := board_problem(self._table, self._board, wire):
                raise self._absent(wire, problem)
            self._read_pulses(wire)
        except BaseException:
            wire.port.close()
            raise
        self._forget_silence()
        self._link = wire

    def _open(self) -> RateLimitedPort:
        return RateLimitedPort(self._open_port(), self._baud, self._read_deadline_s)

    def _absent(self, wire: RateLimitedPort, problem: str) -> BusError:
        return BusError(f"bus {self.name!r} on {wire.port.name} at {self._baud} baud: {problem}")

    def _check_present(self, wire: RateLimitedPort) -> None:
        """Raise BusError if the board does not answer."""
        if not answers(self._board, wire):
            raise self._absent(wire, f"no {self.model} answers")

    def _read_pulses(self, wire: RateLimitedPort) -> bool:
        """Read the pulses that the board sends; return whether it reported them."""
        pulses = self._board.read_pulses(wire, [output.channel for output in self._outputs])
        if pulses is not None:
            for output in self._outputs:
                output.pulse = pulses[output.channel]
        return pulses is not None

    def enable(self, joints: Sequence[str]) -> Doubles:
        """Switch on the pulses of `joints`, one after the other; return the angles sent, rad, in their order.

        Blocks for up to 0.7 s per joint, and for a few answers. Raises ConfigError unless the user has confirmed that
        joints may jump; BusError if the board does not answer, or if `torque_off` is called meanwhile: then only pulses
        of joints whose safety is hold are on.
        """
        wire = self._connected()
        self._unlatch()
        if not self._confirmed:
            raise ConfigError(
                f"bus {self.name!r}: servos on a {self.model} report no position and jump to {', '.join(joints)} "
                "at rest when they come on; confirm it with --yes"
            )
        if not self._warned:
            warning = "bus %r: servos on a %s report no position; each jumps to its first pose: keep clear"
            log.warning(warning, self.name, self.model)
            self._warned = True
        self._check_present(wire)
        held = [self._switch_on(wire, output) for output in map(self._output, joints)]
        self._check_present(wire)
        self._check_latch()
        return np.array(held)

    def _output(self, joint: str) -> PulseOutput:
        return self._outputs[self.joints.index(joint)]

    def _unlatch(self) -> None:
        """Allow goals again; outputs that torque off switched off stay off until each is switched on."""
        if self._latched:
            for output in self._outputs:
                output.resting |= output.releases
        self._latched = self._off_due = False

    def _check_latch(self) -> None:
        if self._latched:
            for output in self._outputs:
                output.enabled = False
            raise BusError(f"bus {self.name!r}: torque was switched off while joints came on")

    def _switch_on(self, wire: RateLimitedPort, output: PulseOutput) -> float:
        """Switch on the pulses of one joint; return the angle sent, rad. Raises BusError if `torque_off` is called."""
        new, index = not output.enabled, output.index
        self._powered |= {output.channel}
        output.resting = False
        if output.pulse and new:  # the first goal is the pulse that the board already sends, clipped to the limits
            ticks = self._ticks.copy()
            ticks[index] = output.pulse
            self._ticks = self._conversion.to_ticks(self._goals.own.nearest(self._conversion.to_rad(ticks)))
        self._send(wire, [output])
        if new and output.pulse != self._ticks[index]:
            start_s = wire.port.now_s()
            for part in range(_TRAVEL_PARTS):
                if not self._latched:
                    wire.wait(start_s + output.travel_s * (part + 1) / _TRAVEL_PARTS)
        output.enabled = True
        self._check_latch()
        output.waiting, output.fault = False, None
        return float(self._conversion.to_rad(self._ticks)[index])

    # --- torque off ---------------------------------------------------------------------------------------------

    @property
    def _off(self) -> list[int]:
        """Return the channels that have to be off now."""
        return sorted(each.channel for each in self._outputs if each.resting or (self._latched and each.releases))

    def release(self, joints: Sequence[str]) -> None:
        """End the pulses of `joints` now; the others continue. The next `poll` repeats it. Works in any thread."""
        for output in map(self._output, joints):
            output.resting, output.enabled, output.waiting, output.pulse, output.sent = True, False, False, 0, None
            self._off_due = True
        if self._off_due:
            self._send_off(self._off)

    def torque_off(self, policy: StopPolicy) -> None:
        """End the pulses now, except of joints whose safety is hold; send no goal until `enable` or `resume`.

        May be called in any thread or signal handler. Never raises and waits for no answer. Blocks while bytes are
        written to the port and, if the port was lost, while it is opened. `poll` switches off a lost board when it is
        back.
        """
        if policy == "hold":
            return
        self._latched = True  # before anything else
        for output in self._outputs:
            output.waiting, output.sent = False, None
            if output.releases:
                output.pulse = 0
        self._send_off(self._off)

    def resume(self, joints: Sequence[str]) -> None:
        """Switch pulses on again, one channel at a time, at the last goal, to which the servo jumps."""
        off = self._off
        back = [output for output in map(self._output, joints) if output.channel in off and not output.waiting]
        for output in back:
            output.waiting = output.enabled = True  # before `_unlatch`, so that no goal is sent to them yet
        self._unlatch()
        for output in back:
            output.resting = False

    def _send_off(self, channels: Sequence[int], restarted: bool = False) -> None:
        """Send torque off over the open port, else over a port opened only for this: the bus's own may be in use."""
        wire = self._link
        if not channels or (wire is None and not self._lost):
            return
        if wire is not None:
            data = self._board.encode_off(channels, restarted or self._silent)
            if self._attempt(lambda: wire.send(data)) is not None:
                return
        try:
            with closing(self._open_port()) as port:
                port.write(self._board.encode_off(channels, restarted=True))
        except RobotError as error:
            self._count_error(error)
            self._off_due = True

    def stop(self, policy: StopPolicy, within_s: float = STOP_S) -> None:
        """Send torque off, request the pulses from the board, and repeat it; refuse goals. Never raises.

        Blocks for `within_s` at most, including the time for earlier bytes to leave. Called in one thread at a time.
        """
        self.torque_off(policy)
        for output in self._outputs:
            output.enabled = output.waiting = False
        self._pending = False
        if policy == "hold" or not self._off or (self._link is None and not self._lost):
            return
        wire = self._link or self._open_again()
        until_s = wire.port.now_s() + min(_STOP_S, within_s) if wire is not None else 0.0
        for _ in range(TRIES):
            if wire is None:
                break
            try:
                if self._confirm_off(wire, self._off, until_s):
                    return
                break
            except BusError as error:
                self._lose(error, -math.inf)
                wire = self._open_again()
        log.warning("bus %r: the %s does not confirm that its pulses are off", self.name, self.model)

    def _confirm_off(
        self, wire: RateLimitedPort, channels: Sequence[int], until_s: float, restarted: bool = False
    ) -> bool:
        """Request the pulses from the board; while any is on, send torque off again. Return whether all are off."""
        for _ in range(4 * TRIES):  # with a silent board each try blocks for the deadline of an answer
            wire.wait(min(wire.busy_until_s, until_s))
            if wire.port.now_s() >= until_s:
                break
            pulses = self._board.read_pulses(wire, channels)
            on = {channel for channel, ticks in (pulses or {}).items() if ticks}
            # For a board that cannot report pulses, any answer confirms. For another board a lost answer does not.
            if pulses is None and (self._board.reports_pulses or not answers(self._board, wire, 1, True)):
                on = set(channels)
            self._powered &= on
            if not on:
                return True
            self._send_off(channels, restarted)
        return False

    def end_pulses(self, channels: Sequence[int]) -> bool:
        """Open the port, end the pulses of `channels` and close it; return whether the board confirmed it.

        The bus must not be connected. Raises PortError, BusError.
        """
        self._link = wire = self._open()
        try:
            wire.send(self._board.encode_off(channels, restarted=False))
            return self._confirm_off(wire, channels, wire.busy_until_s + _STOP_S, restarted=True)
        finally:
            self.close()

    # --- every tick ---------------------------------------------------------------------------------------------

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Send goals of all joints; goals of joints that are not enabled are left out.

        Raises ValueError, with nothing sent, before `enable` and after `stop`, for a goal that is not finite, or one
        out of range. While the port is gone, and after `torque_off`, nothing is sent and nothing is raised.
        """
        self._check(any(output.enabled or output.resting for output in self._outputs))
        if self._latched:
            return
        enabled = [output.index for output in self._outputs if output.enabled]
        self._ticks = self._goals.ticks(goals_rad, np.array(enabled, np.intp))
        self._pending = True
        try:
            self._counts["deferred"] += not self._flush()
        except BusError as error:
            self._lose(error, now_s)

    def _readings(self, now_s: float) -> Readings:
        """Return faults of the board, and which pulses have come on again; no positions."""
        readings = {}
        for output in self._outputs:
            readings[output.servo.joint] = Reading(None, math.inf, output.fault, rejoined=output.arrived)
            output.arrived = False
        return readings

    def _ask(self, wire: RateLimitedPort, now_s: float) -> bool:
        """Request the status once a second, and send commands that are due; return whether a valid status arrived."""
        answered = False
        if self._off_due:  # raises if the port is gone unnoticed; the port is then opened again
            self._off_due = False
            if channels := self._off:
                wire.send(self._board.encode_off(channels, self._silent))
        if self._status_due_s is None:
            self._status_due_s = now_s + _STATUS_EVERY_S
        if wire.awaiting:
            if (answer := wire.answer()) is not None:
                answered = self._take_status(wire, answer, now_s)
        elif now_s >= self._status_due_s:
            self._status_due_s = now_s + _STATUS_EVERY_S
            self._counts["retries"] += self._unanswered > 0
            self._counts["reads"] += 1
            wire.request(self._board.status_request(self._silent), self._board.status_length)
        waiting = next((output for output in self._outputs if output.waiting), None)
        if waiting is not None and now_s >= self._next_on_s and not self._silent:
            if waiting.fault == _TORQUE_LOST:
                log.warning("%s (channel %d) has lost its pulses", waiting.servo.joint, waiting.channel)
            waiting.waiting, waiting.arrived, waiting.fault = False, True, None
            self._next_on_s = now_s + waiting.travel_s
            self._pending = True
        if self._pending:
            self._flush()
        return answered

    def statistics(self) -> Facts:
        """Return the counters of the report."""
        return {
            **self._counts,
            "silent": sorted(output.channel for output in self._outputs if self._silent),
            "faults": list(self._fault_log),
            "stored_warnings": [],
            **self._unconfirmed(self._latched),
        }

    def _flush(self) -> bool:
        """Send the newest goals; return False, with nothing sent, if the line is busy or the board is silent."""
        wire = self._link
        if wire is None or self._silent or not wire.free:
            return False
        self._pending = False
        on = [output for output in self._outputs if output.enabled and not output.waiting]
        if not on:
            return True
        self._refresh_index = (self._refresh_index + 1) % len(on)
        again = on[self._refresh_index]
        self._send(wire, [each for each in on if each is again or each.sent != self._ticks[each.index]])
        self._counts["writes"] += 1
        return True

    def _send(self, wire: RateLimitedPort, outputs: Sequence[PulseOutput]) -> None:
        """Send goals, unless torque is off; if it was switched off while these bytes left, send torque off again."""
        outputs = [output for output in outputs if not output.resting]
        if self._latched or not outputs:
            return
        ticks = {output.channel: int(self._ticks[output.index]) for output in outputs}
        first = all(output.sent is None for output in self._outputs)
        interval_s = 0.0 if first else max(wire.port.now_s(), wire.busy_until_s) - self._sent_at_s
        self._sent_at_s = wire.send(self._board.encode_goals(ticks, interval_s))
        for output in outputs:
            output.sent = ticks[output.channel]
        off = self._off
        if not ticks.keys().isdisjoint(off):
            for output in outputs:
                output.sent = None
            self._send_off(off)

    def _left(self) -> None:
        self._unanswered = _SILENT_AFTER
        self._report_fault(self._outputs, _NO_ANSWER)

    def _returned(self, wire: RateLimitedPort, now_s: float) -> None:
        self._status_due_s = now_s  # the board has to answer before it receives any goal
        self._send_off_again()

    def _send_off_again(self) -> None:
        """Send torque off again after the board, or the port, was lost: now if it is latched, else by a poll."""
        self._off_due |= any(output.resting for output in self._outputs)
        if self._latched:
            self._send_off(self._off)

    @property
    def _silent(self) -> bool:
        return self._unanswered >= _SILENT_AFTER

    def _take_status(self, wire: RateLimitedPort, answer: bytes, now_s: float) -> bool:
        """Process the answer to a status request, empty if there was none; return whether it is valid."""
        status = self._board.decode_status(answer) if answer else None
        if status is None:
            self._counts["errors"] += 1
            self._unanswered += 1
            if self._unanswered == _SILENT_AFTER:
                self._report_fault(self._outputs, _NO_ANSWER)
                log.warning("bus %r: the %s is silent", self.name, self.model)
            return False
        was_silent, self._unanswered = self._silent, 0
        for output in self._outputs:
            if output.fault != _TORQUE_LOST:
                output.fault = None
            if was_silent or status.went_home:
                output.sent = None  # the board may no longer send this pulse
        if was_silent:
            self._counts["reconnects"] += 1
            log.info("bus %r: the %s answers again", self.name, self.model)
            # Channels that the board switched off during the silence, if it reports them, come on again in turn.
            if self._read_pulses(wire) and not self._latched:
                for output in self._outputs:
                    output.waiting = output.enabled and not output.pulse
                self._next_on_s = now_s
                self._report_fault([output for output in self._outputs if output.waiting], _TORQUE_LOST)
        if was_silent or status.went_home:
            self._send_off_again()
        if status.faults:
            self._counts["errors"] += not status.lasting
            self._report_fault(self._outputs, status.faults, shown=status.lasting)
        return True

    def _report_fault(self, outputs: Sequence[PulseOutput], fault: str, shown: bool = True) -> None:
        """Record a fault of some outputs; `shown` puts it into their readings too."""
        for output in outputs if shown else ():
            output.fault = fault
        named = f"{self.name}: {fault}"
        if outputs and named not in self._fault_log:
            log.warning("bus %r: the %s reports: %s", self.name, self.model, fault)
            self._fault_log[named] = None
