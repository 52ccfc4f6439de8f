"""A board of hobby servos as a bus: pulses go out, nothing comes back.

A hobby servo tells nobody where it is, so this bus reports no positions, and no made-up ones either. What follows:

1. Torque cannot come on without a jump: a servo goes to the first pulse as fast as it can. So `enable` is refused until
   somebody confirmed it, says so aloud, and brings up one channel at a time, at the pulse the board sends already, else
   at the last goal, else at the rest pose. It waits between channels for as long as the slowest servo may take; that
   is all the driver's idea of a servo's speed is used for.
2. A wire may be slower than the loop: 24 channels take a fifth of a second at 9600 baud. Goals that come while the
   wire is busy replace each other, and the newest goes out when it is free. Only what changed is sent, and one other
   channel in turn, so that a command that got lost does not stay lost.
3. Once a second the board is asked how it is; nobody waits for the answer, later polls look for it. What it says
   becomes a fault. A board that is silent gets no goals, and channels that it switched off meanwhile come on again as
   at start-up, one at a time.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.config import Bus as BusConfig
from sfms_robot.errors import BusError, ConfigError
from sfms_robot.frames import Doubles, Reading
from sfms_robot.ports import StopPolicy, TickConversion
from sfms_robot.servo.boards.board_protocol import BoardProtocol, Health, board_of, pulses_beyond
from sfms_robot.servo.boards.rate_limit import RateLimitedPort
from sfms_robot.servo.bus import RECONNECT_S, WireBus
from sfms_robot.servo.policy import BusServo
from sfms_robot.servo.port import Port

log = logging.getLogger(__name__)

_CAPABILITIES: Final = frozenset({"torque"})  # pulses can be switched off, nothing more
_SLOW_RAD_S: Final = 3.5  # a slow hobby servo under load: 0.3 s for 60 degrees
_ASK_EVERY_S: Final = 1.0
_SILENT_AFTER: Final = 3  # questions without an answer
_LEAST_PATIENCE_S: Final = 0.02  # an SSC-32 thinks for up to 5 ms, an adapter holds its bytes for up to 16
_TRIES: Final = 3
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
        dialect: of the board.
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
        read_deadline_s: float,
        *,
        dialect: BoardProtocol,
        confirmed: bool = False,
        rest_rad: Doubles | None = None,
        config: BusConfig | None = None,
    ) -> None:
        reconnect_s = config.reconnect_s if config is not None else RECONNECT_S
        patience_s, reconnect_s = max(read_deadline_s, _LEAST_PATIENCE_S), max(reconnect_s, _LEAST_RECONNECT_S)
        super().__init__(name, servos, conversion, open_port, baud, patience_s, reconnect_s)
        self._channels = [servo.id for servo in servos]
        self._dialect = dialect
        self._confirmed = confirmed
        self._lowest = np.array([servo.min_rad for servo in servos])
        self._highest = np.array([servo.max_rad for servo in servos])
        table = board_of(name, servos)
        self.model = table.model
        if beyond := pulses_beyond(servos, conversion, table, table.pulse_us or (0.0, 0.0)):
            raise ConfigError(f"bus {name!r}: a {table.model} does not make the pulses of {', '.join(beyond)}")
        rest = np.zeros(len(servos)) if rest_rad is None else np.asarray(rest_rad, np.float64)
        self._ticks = conversion.to_ticks(np.clip(rest, self._lowest, self._highest))  # goals; before any, the rest
        self._said = False
        self._counts["deferred"] = 0
        self._fault_log: dict[str, None] = {}
        self._forget()

    def _forget(self) -> None:
        """What holds for one connection only."""
        self._enabled: list[int] = []
        self._lit: dict[int, int] = {}  # channel -> ticks of pulses that the board sent when last asked
        self._sent: dict[int, int] = {}  # channel -> ticks last sent
        self._pending = False  # goals that have not gone out yet
        self._turn = 0
        self._sent_at_s = float("-inf")
        self._ask_at_s: float | None = None  # when to ask the board next
        self._unanswered = 0
        self._dark: list[int] = []  # enabled, but the board has switched them off
        self._light_at_s = float("-inf")  # when the next of them may come on
        self._faults: dict[int, str] = {}

    @property
    def capabilities(self) -> Mapping[str, frozenset[str]]:
        return dict.fromkeys(self.joints, _CAPABILITIES)

    # --- start and stop -----------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Open and find the board. Pulses are left as they are. Raises PortError, or BusError when nobody answers."""
        wire = self._open()
        self._forget()
        try:
            if not self._there(wire):
                raise self._absent(wire)
            self._lit = self._dialect.pulses(wire.ask, self._channels) or {}
        except BaseException:
            wire.port.close()
            raise
        self._forget_silence()
        self._link = wire

    def _open(self) -> RateLimitedPort:
        return RateLimitedPort(self._open_port(), self._baud, self._read_deadline_s)

    def _absent(self, wire: RateLimitedPort) -> BusError:
        return BusError(f"bus {self.name!r} on {wire.port.name} at {self._baud} baud: no {self.model} answers")

    def _there(self, wire: RateLimitedPort) -> bool:
        return any(self._found(wire, lost) for _ in range(_TRIES) for lost in (False, True))

    def _found(self, wire: RateLimitedPort, lost: bool) -> bool:
        answer = wire.ask(self._dialect.question(lost), self._dialect.answer_length)
        return answer is not None and self._dialect.health(answer) is not None

    def enable(self, joints: Sequence[str]) -> NDArray[np.float64]:
        """Pulses on for `joints`, one after the other; angles they were sent to, rad, in the order of `joints`.

        Raises ConfigError unless the bus was told that this is understood, BusError when the board does not answer
        before or after: nothing else tells that it heard.
        """
        wire = self._connected()
        if not self._confirmed:
            raise ConfigError(
                f"bus {self.name!r}: servos on a {self.model} report no position and jump to {', '.join(joints)} "
                "at rest when they come on; confirm it with --yes"
            )
        if not self._said:
            log.warning(
                "bus %r: servos on a %s report no position; each jumps to its first pose: keep clear",
                self.name, self.model,
            )  # fmt: skip
            self._said = True
        if not self._there(wire):
            raise self._absent(wire)
        held = []
        for joint in joints:
            index = self.joints.index(joint)
            servo = self._servos[index]
            self._take_over(index)
            self._send(wire, {servo.id: int(self._ticks[index])})
            if self._lit.get(servo.id) != self._ticks[index] and index not in self._enabled:
                wire.wait(wire.port.now_s() + _travel_s(servo))
            if index not in self._enabled:
                self._enabled.append(index)
            if index in self._dark:
                self._dark.remove(index)
            self._faults.pop(index, None)
            held.append(float(self._conversion.to_rad(self._ticks)[index]))
        if not self._there(wire):
            raise self._absent(wire)
        return np.array(held)

    def _take_over(self, index: int) -> None:
        """Where the board sends pulses already, the first goal is those pulses, as far as the limits allow."""
        lit = self._lit.get(self._channels[index], 0)
        if not lit or index in self._enabled:
            return
        ticks = self._ticks.copy()
        ticks[index] = lit
        angle = self._conversion.to_rad(ticks)
        self._ticks = self._conversion.to_ticks(np.clip(angle, self._lowest, self._highest))

    def stop(self, policy: StopPolicy) -> None:
        """End the pulses, but of joints whose safety says hold; refuse goals from now on. Never raises."""
        self._enabled, self._dark, self._pending = [], [], False
        wire = self._link
        limp = [servo.id for servo in self._servos if policy == "release" and servo.safety.stop == "release"]
        if wire is None or not limp:
            return
        self._lit = {channel: ticks for channel, ticks in self._lit.items() if channel not in limp}
        self._sent = {}
        for _ in range(2):  # nothing confirms it, so it is said twice
            self._attempt(lambda: wire.send(self._dialect.off(limp)))
        self._attempt(lambda: wire.wait(wire.busy_until_s))

    def close(self) -> None:
        """Give the port back. Idempotent."""
        self._enabled = []
        super().close()

    # --- every tick ---------------------------------------------------------------------------------------------

    def write(self, goals_rad: Doubles, now_s: float) -> None:
        """Goals of all joints; those of joints that are not enabled are left out.

        Raises ValueError, with nothing sent, before `enable`, for a goal that is not finite, or one out of range.
        While the port is gone nothing is sent and nothing is raised.
        """
        self._check(goals_rad, bool(self._enabled))
        self._ticks = self._conversion.to_ticks(goals_rad)
        self._pending = True
        try:
            self._counts["deferred"] += not self._flush()
        except BusError as error:
            self._lose(error, now_s)

    def _readings(self, now_s: float) -> Mapping[str, Reading]:
        """No positions; faults of the board."""
        return {joint: Reading(None, float("inf"), self._faults.get(index)) for index, joint in enumerate(self.joints)}

    def _ask(self, wire: RateLimitedPort, now_s: float) -> bool:
        """Ask for faults once a second when the wire is free; whether there was an answer to that."""
        heard = False
        if self._ask_at_s is None:
            self._ask_at_s = now_s + _ASK_EVERY_S
        if wire.listening:
            if (answer := wire.heard()) is not None:
                heard = self._judge(wire, answer, now_s)
        elif now_s >= self._ask_at_s:
            self._ask_at_s = now_s + _ASK_EVERY_S
            self._counts["retries"] += self._unanswered > 0
            self._counts["reads"] += 1
            wire.question(self._dialect.question(self._silent), self._dialect.answer_length)
        if self._dark and now_s >= self._light_at_s and not self._silent:
            self._light(self._dark.pop(0), now_s)
        if self._pending:
            self._flush()
        return heard

    def statistics(self) -> Mapping[str, Any]:
        return {
            **self._counts,
            "silent": sorted(self._channels) if self._silent else [],
            "faults": list(self._fault_log),
        }

    # --- goals --------------------------------------------------------------------------------------------------

    def _flush(self) -> bool:
        """Send the newest goals, unless the wire is busy or nobody listens."""
        wire = self._link
        if wire is None or self._silent or not wire.free:
            return False
        self._pending = False
        lit = [index for index in self._enabled if index not in self._dark]
        if not lit:
            return True
        self._turn = (self._turn + 1) % len(lit)
        again = self._channels[lit[self._turn]]
        wanted = {self._channels[i]: int(self._ticks[i]) for i in lit}
        self._send(wire, {c: ticks for c, ticks in wanted.items() if self._sent.get(c) != ticks or c == again})
        self._counts["writes"] += 1
        return True

    def _send(self, wire: RateLimitedPort, ticks: Mapping[int, int]) -> None:
        interval_s = max(wire.port.now_s(), wire.busy_until_s) - self._sent_at_s if self._sent else 0.0
        self._sent_at_s = wire.send(self._dialect.goals(ticks, interval_s))
        self._sent.update(ticks)

    # --- the port ----------------------------------------------------------------------------------------------

    def _left(self) -> None:
        self._unanswered = _SILENT_AFTER
        self._blame(range(len(self.joints)), _NO_ANSWER)

    def _returned(self, wire: RateLimitedPort, now_s: float) -> None:
        self._ask_at_s = now_s  # the board is asked before it gets any goal

    # --- the board ----------------------------------------------------------------------------------------------

    @property
    def _silent(self) -> bool:
        return self._unanswered >= _SILENT_AFTER

    def _judge(self, wire: RateLimitedPort, answer: bytes, now_s: float) -> bool:
        """Take an answer to the question how it is, empty when there was none; whether it is one."""
        health = self._dialect.health(answer) if answer else None
        if health is not None:
            self._answered(wire, health, now_s)
            return True
        self._counts["errors"] += 1
        self._unanswered += 1
        if self._unanswered == _SILENT_AFTER:
            log.warning("bus %r: the %s is silent", self.name, self.model)
            self._blame(range(len(self.joints)), _NO_ANSWER)
        return False

    def _answered(self, wire: RateLimitedPort, health: Health, now_s: float) -> None:
        lost, self._unanswered = self._silent, 0
        self._faults = {index: text for index, text in self._faults.items() if text == _TORQUE_LOST}
        if lost:
            self._counts["reconnects"] += 1
            log.warning("bus %r: the %s answers again", self.name, self.model)
            self._resume(wire, now_s)
        if health.went_home:
            self._sent = {}  # whatever it does now, it is not what it was told
        if health.faults:
            self._counts["errors"] += not health.lasting
            self._blame(range(len(self.joints)), health.faults, shown=health.lasting)

    def _resume(self, wire: RateLimitedPort, now_s: float) -> None:
        """After a silence: channels that the board has switched off meanwhile come on one at a time, if it tells."""
        self._sent = {}
        lit = self._dialect.pulses(wire.ask, self._channels)
        if lit is None:
            return
        self._lit = lit
        self._dark = [index for index in self._enabled if not lit.get(self._channels[index])]
        self._light_at_s = now_s
        self._blame(self._dark, _TORQUE_LOST)

    def _light(self, index: int, now_s: float) -> None:
        servo = self._servos[index]
        log.warning("%s (channel %d) has lost its pulses and comes on again", servo.joint, servo.id)
        self._faults.pop(index, None)
        self._light_at_s = now_s + _travel_s(servo)
        self._pending = True

    def _blame(self, indices: Sequence[int], fault: str, shown: bool = True) -> None:
        """Note a fault of some joints; `shown` puts it into their readings, too."""
        for index in indices:
            if shown:
                self._faults[index] = fault
        named = f"{self.name}: {fault}"
        if indices and named not in self._fault_log:
            log.warning("bus %r: the %s reports: %s", self.name, self.model, fault)
            self._fault_log[named] = None


def _travel_s(servo: BusServo) -> float:
    """How long a slow servo takes from one end of the joint's range to the other."""
    return (servo.max_rad - servo.min_rad) / _SLOW_RAD_S
