"""Observers of a run: the list that the loop calls, the status document, and systemd.

An observer that raises is detached and logged once, so that observing never ends a run.
"""

from __future__ import annotations

import logging
import math
import os
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from sfms_robot.data import Names, Report
from sfms_robot.frames import NO_SOUND, Plan, SpeakerFrame
from sfms_robot.ports import Document, Facts, Observer, Tick
from sfms_robot.runtime.states import RUNNING, RunState
from sfms_robot.signals.audio import energy_db

IDLE_S: Final = 1.0  # period of `ServiceManager.alive` without a watchdog
_DIGITS: Final = 4
_NOTES: Final[Mapping[str, str]] = {
    "starting": "joints are led into the face",
    "idle": "no person is seen or heard: the listener's answers are not shown",
    "halted": "halted: nothing is followed until every cause is cleared",
    "stopping": "the head comes to rest",
}

log = logging.getLogger(__name__)


class Observers:
    """The `ports.Observer`s of a run, called in order.

    Attributes:
        detached: name of each observer that raised, and its error.
    """

    def __init__(self, observers: Sequence[Observer]) -> None:
        self._attached = list(observers)
        self.detached: dict[str, str] = {}

    def tick(self, seen: Tick) -> None:
        self._each(lambda observer: observer.tick(seen))

    def heard(self, frame: SpeakerFrame) -> None:
        self._each(lambda observer: observer.heard(frame))

    def planned(self, plan: Plan) -> None:
        self._each(lambda observer: observer.planned(plan))

    def _each(self, call: Callable[[Observer], None]) -> None:
        for observer in tuple(self._attached):
            try:
                call(observer)
            except Exception as error:
                self._attached.remove(observer)
                name = type(observer).__name__
                self.detached[name] = f"{type(error).__name__}: {error}"
                log.warning("%s raised and is detached: %s", name, self.detached[name], exc_info=True)


class RunStatus(Observer):
    """Observer that returns the present state of a run as one document, for terminal panel, `--status` and the page.

    Keeps the newest tick, frame and plan time. The document is built on request, in the requesting thread, so that the
    loop only makes three assignments a tick.

    Args:
        joints: names, in the order of `Tick.goals_rad`.
        facts: constant entries, such as head and port.
        figures: function that returns further entries of each document.
    """

    def __init__(
        self,
        joints: Sequence[str],
        facts: Facts,
        figures: Document = dict,
    ) -> None:
        self._joints, self._facts, self._figures = tuple(joints), dict(facts), figures
        self._tick: Tick | None = None
        self._ended: Report = {}
        self._frame = SpeakerFrame(0.0, NO_SOUND)
        self._planned_s: float | None = None

    def tick(self, seen: Tick) -> None:
        self._tick = seen

    def heard(self, frame: SpeakerFrame) -> None:
        self._frame = frame

    def planned(self, plan: Plan) -> None:
        self._planned_s = plan.made_at_s

    def ended(self, state: RunState) -> None:
        """Set the last state of the run, shown from now on: torque is off, or could not be confirmed off."""
        self._ended = {"state": state.name, "why": list(state.why)}

    def document(self) -> Report:
        """Return the document that `--status` serves. From any thread. inf and NaN, which JSON lacks, become null."""
        seen, frame = self._tick, self._frame
        document: Report = {
            "version": 1,
            **self._facts,
            "state": "starting",
            "why": [],
            "torque_unconfirmed": [],
            "time_s": 0.0,
        }
        if seen is not None:
            document |= {"state": seen.state, "why": list(seen.why), "time_s": _number(seen.time_s)}
            document |= _servos(seen, self._joints)
        document |= self._ended
        why = document["why"]
        special = {"degraded": f"continues without {', '.join(why)}", "fault": "; ".join(why)}
        document["note"] = {**_NOTES, **special}.get(document["state"])
        document["person"] = _person(frame)
        document["planned_s"] = self._planned_s
        return document | dict(self._figures())


def _person(frame: SpeakerFrame) -> Report:
    """Return the content of the newest frame: of the person, and of the robot's own voice."""
    return {
        "voice_db": round(energy_db(frame.audio), 1) if len(frame.audio) else None,
        "seen": frame.face is not None,
        "attention": _number(frame.attention),
        "own_voice_db": None if frame.agent_audio is None else round(energy_db(frame.agent_audio), 1),
    }


def _servos(seen: Tick, names: Sequence[str]) -> Report:
    """Return joints, faults by name, and the hottest servo."""
    joints = {}
    for joint, goal_rad in zip(names, seen.goals_rad.tolist(), strict=True):
        if (reading := seen.readings.get(joint)) is not None:
            read = {"present_rad": reading.position_rad, "age_s": reading.age_s, **reading.extra}
            joints[joint] = {name: _number(value) for name, value in {"goal_rad": goal_rad, **read}.items()}
    warmth = {joint: reading.extra.get("temperature_C", math.nan) for joint, reading in seen.readings.items()}
    known = {joint: degrees for joint, degrees in warmth.items() if math.isfinite(degrees)}
    hottest = max(known, key=lambda joint: known[joint], default=None)
    return {
        "joints": joints,
        "faults": {joint: reading.fault for joint, reading in seen.readings.items() if reading.fault},
        "hottest": None if hottest is None else {"joint": hottest, "temperature_C": _number(known[hottest])},
    }


def _number(value: float | None) -> float | None:
    return round(float(value), _DIGITS) if value is not None and math.isfinite(value) else None


class ServiceManager:
    """The notifications that a service manager expects: ready, alive, stopping (sd_notify(3), sd_watchdog_enabled(3)).

    They are datagrams of lines, sent to the unix socket that NOTIFY_SOCKET names ("@" begins an abstract name); without
    this variable nothing is sent. WATCHDOG_USEC is the longest silence allowed; systemd advises half of it as period.
    Never raises, so that a lost datagram does not end a run.

    Attributes:
        wanted: whether there is a service manager.
        every_s: period at which `alive` is to be called.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        microseconds = environment.get("WATCHDOG_USEC", "")
        mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.wanted = bool(self._address)
        self._watched = bool(self._address) and microseconds.isdigit() and int(microseconds) > 0 and mine
        self.every_s = int(microseconds) / 2e6 if self._watched else IDLE_S

    def ready(self, status: str) -> None:
        """Report that the start is complete."""
        self._send(f"READY=1\nSTATUS={status}")

    def alive(self) -> None:
        """Feed the watchdog. Called every `every_s`, by the code that must not hang."""
        if self._watched:
            self._send("WATCHDOG=1")

    def status(self, status: str) -> None:
        """Set the line of `systemctl status`."""
        self._send(f"STATUS={status}")

    def stopping(self) -> None:
        """Report that the program ends on purpose."""
        self._send("STOPPING=1")

    def _send(self, lines: str) -> None:
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            sender.setblocking(False)
            sender.sendto(lines.encode(), address)


@dataclass(eq=False)
class NotifyingObserver(Observer):
    """Observer that reports a run as ready when its joints are led into the face, and as alive while it ticks.

    The service manager therefore restarts a loop that hangs, even if other parts of the program still run.
    """

    manager: ServiceManager
    _next_s: float = 0.0
    _ready: bool = False
    _shown: tuple[str, Names] | None = None

    def tick(self, seen: Tick) -> None:
        """Send changes of state and the watchdog's message, in most ticks at most one datagram, without waiting."""
        if (seen.state, seen.why) != self._shown:
            self._shown = seen.state, seen.why
            words = ": ".join([seen.state, *([", ".join(seen.why)] if seen.why else [])])
            if not self._ready and seen.state in RUNNING:
                self._ready = True
                self.manager.ready(words)
            elif seen.state == "stopping":
                self.manager.stopping()
            else:
                self.manager.status(words)
        if seen.time_s >= self._next_s:
            self._next_s = seen.time_s + self.manager.every_s
            self.manager.alive()
