"""The process of an emulated chain: a pseudo terminal for the host, and a control socket.

Started by `launch`, which sends a description and receives where the chain is, or the ConfigError that refuses it. The
process ends on SIGTERM, or when the pipe to its parent does.

In real time bytes are answered when the wire says. In virtual time they wait in the terminal until a client of the
control socket says how many there are and what time it is. Control requests and answers are one line each:

    sync BYTES FROM SECONDS [UNTIL]  ack LENGTH  take BYTES in total at SECONDS, then send LENGTH bytes of reply, those
                                                 due by UNTIL; what came by SECONDS for bytes before FROM is lost
    time SECONDS                     ok          only advance the time
    digest                           digest SHA256 COUNT  of every byte the host sent
    kill ID | revive ID              ok          the servo falls silent, or answers again
    fault ID BITS                    ok          latch hardware errors
    turn ID TICKS                    ok          turn the shaft by hand to where its position reads TICKS
    heat ID DEGREES                  ok          set its temperature, which follows its load from then on
    state ID                         json {...}  its true state: position, goal, torque, ...
    inject SPEC                      ok          a fault (see `faults`), from now on unless it says
    clear                            ok          no more faults
    supply VOLTS                     ok          of all servos
    hangup | return                  ok          the adapter is unplugged, or plugged in again: same link, new terminal
    stats | stamps | faults          json {...}  counts; the last replies, due and sent; faults that last or are to come
"""

from __future__ import annotations

import fcntl
import json
import os
import select
import shutil
import signal
import socket
import struct
import sys
import tempfile
import time
import tty
from collections.abc import Mapping
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, Final

from sfms_robot.emulator.device import EmulatedServo, plugged
from sfms_robot.emulator.emulated_wire import EmulatedWire
from sfms_robot.emulator.faults import parse_fault
from sfms_robot.errors import ConfigError
from sfms_robot.processes import ParentPipe, realtime_priority
from sfms_robot.servo.registers import Table

_CHUNK: Final = 4096
_PATIENCE_S: Final = 1.0  # for bytes that a client said it had written
_IDLE_S: Final = 0.25  # the longest that motors are left alone in real time
_TCGETS2: Final = 0x802C542A  # struct termios2 tells any rate as a number, odd ones too
_TERMIOS2: Final = struct.Struct("=4IB19s2I")
_OUTPUT_RATE: Final = -1


class PseudoTerminal:
    """The open pty that the chain sits behind.

    `link` is a symbolic link to it, replaced when it is opened and removed when it is closed: the name stays when the
    adapter is hung up and comes back.
    """

    def __init__(self, link: str) -> None:
        self.link = link
        self.fd, self._slave = os.openpty()  # the slave stays open, so that hosts may come and go
        tty.setraw(self._slave)
        os.set_blocking(self.fd, False)
        self.path = os.ttyname(self._slave)
        beside = f"{link}.new"
        if os.path.lexists(beside):
            os.unlink(beside)
        os.symlink(self.path, beside)
        os.replace(beside, link)

    def baud(self) -> int:
        """Return the baud rate that the host has set."""
        raw = fcntl.ioctl(self.fd, _TCGETS2, bytes(_TERMIOS2.size))
        return int(_TERMIOS2.unpack(raw)[_OUTPUT_RATE])

    def send(self, data: bytes, patience_s: float) -> None:
        """Write what the terminal takes within `patience_s`; the rest is lost, as on a wire."""
        view = memoryview(data)
        while view and select.select([], [self.fd], [], patience_s)[1]:
            view = view[os.write(self.fd, view) :]

    def close(self) -> None:
        """Close the device, and remove the link unless it points to another one by now."""
        if os.path.islink(self.link) and os.readlink(self.link) == self.path:
            os.unlink(self.link)
        os.close(self.fd)
        os.close(self._slave)


@dataclass
class _Client:
    """One connection to the control socket. Counts bytes from the moment it was opened."""

    connection: socket.socket
    buffer: bytearray = field(default_factory=bytearray)
    taken: int = 0
    wanted_from: int = 0


class Server:
    """Moves bytes between the terminal, the control socket and the wire."""

    def __init__(self, wire: EmulatedWire, virtual: bool, folder: str, link: str) -> None:
        self._wire = wire
        self._virtual = virtual
        self._terminal: PseudoTerminal | None = PseudoTerminal(link)
        self._link = link
        self.control = os.path.join(folder, "control")
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(self.control)
        self._listener.listen()
        self._clients: dict[int, _Client] = {}
        self._start_s = time.monotonic()
        self._now_s = 0.0
        self._idled_s = 0.0

    def run(self, parent: int) -> None:
        """Serve until the pipe `parent` (a file descriptor) ends."""
        listener = self._listener.fileno()
        while True:
            watched = [parent, listener, *self._clients]
            if self._terminal is not None and not self._virtual:
                watched.append(self._terminal.fd)
            ready = select.select(watched, [], [], self._patience_s())[0]
            for fd in ready:
                if self._terminal is not None and fd == self._terminal.fd:
                    self._wire.receive(os.read(fd, _CHUNK), self._terminal.baud(), self._now())
                elif fd == listener:
                    connection, _ = self._listener.accept()
                    self._clients[connection.fileno()] = _Client(connection)
                elif fd == parent:
                    if not os.read(parent, _CHUNK):
                        return
                elif fd in self._clients:
                    self._serve(self._clients[fd])
            if not self._virtual:
                self._deliver()

    def _patience_s(self) -> float | None:
        return None if self._virtual else min(max(0.0, self._wire.next_s - self._now()), _IDLE_S)

    def _now(self) -> float:
        if not self._virtual:
            self._now_s = time.monotonic() - self._start_s
        return self._now_s

    def _deliver(self) -> None:
        """In real time: send what is due. A wire does not wait: what the host leaves lying is lost."""
        self._wire.advance(self._now())
        if self._now_s - self._idled_s >= _IDLE_S:
            self._idled_s = self._now_s
            self._wire.idle(self._now_s)
        self._plug()
        outs = self._wire.take(self._now_s)
        if outs and self._terminal is not None:
            self._terminal.send(b"".join(out.data for out in outs), 0.0)
            self._wire.sent(outs, self._now())

    def _plug(self) -> None:
        """Hang up, or come back, as the wire says."""
        if self._wire.hung and self._terminal is not None:
            self._terminal.close()
            self._terminal = None
        elif not self._wire.hung and self._terminal is None:
            self._terminal = PseudoTerminal(self._link)

    # --- control ------------------------------------------------------------------------------------------------

    def _serve(self, client: _Client) -> None:
        try:
            data = client.connection.recv(_CHUNK)
        except ConnectionError:
            data = b""
        client.buffer += data
        while (end := client.buffer.find(b"\n")) >= 0:
            words = client.buffer[:end].decode(errors="replace").split()
            del client.buffer[: end + 1]
            try:
                self._request(client, words)
            except (ValueError, IndexError, KeyError):
                self._tell(client, f"error not understood: {' '.join(words)}")
            except ConfigError as error:
                self._tell(client, f"error {error}")
        if not data:
            del self._clients[client.connection.fileno()]
            client.connection.close()

    def _request(self, client: _Client, words: list[str]) -> None:
        if words[0] == "sync":
            now_s = float(words[3])
            self._sync(client, int(words[1]), int(words[2]), now_s, float(words[4]) if len(words) > 4 else None)
        else:
            self._tell(client, self._command(words))

    def _tell(self, client: _Client, answer: str) -> None:
        try:
            client.connection.sendall(answer.encode() + b"\n")
        except OSError:
            client.buffer.clear()  # it is gone; the end of its connection is seen next

    def _sync(self, client: _Client, count: int, wanted_from: int, now_s: float, until_s: float | None) -> None:
        self._now_s = now_s
        self._wire.advance(now_s)
        self._plug()
        terminal = self._terminal
        if terminal is None:
            self._tell(client, "error the adapter is unplugged")
            return
        data = bytearray()
        while client.taken + len(data) < count:
            if not select.select([terminal.fd], [], [], _PATIENCE_S)[0]:
                break
            data += os.read(terminal.fd, count - client.taken - len(data))
        unwanted = max(0, wanted_from - client.taken)
        client.taken += len(data)
        baud = terminal.baud()
        if unwanted:
            self._wire.receive(bytes(data[:unwanted]), baud, now_s)
        if wanted_from > client.wanted_from:
            self._wire.take(now_s, all_but_late=True)
            client.wanted_from = wanted_from
        if data[unwanted:]:
            self._wire.receive(bytes(data[unwanted:]), baud, now_s)
        if until_s is None:
            outs = self._wire.take(now_s, all_but_late=True)
        else:
            outs = self._wire.take(max(now_s, until_s))
        reply = b"".join(out.data for out in outs)
        self._tell(client, f"ack {len(reply)}")
        terminal.send(reply, _PATIENCE_S)
        self._wire.sent(outs, None)

    def _command(self, words: list[str]) -> str:
        wire, name = self._wire, words[0]
        if name == "time":
            self._now_s = float(words[1])
        now_s = self._now()
        if name == "digest":
            return "digest {} {}".format(*wire.digest())
        if name == "stats":
            return f"json {json.dumps(wire.statistics())}"
        if name == "stamps":
            return f"json {json.dumps(wire.stamps())}"
        if name == "faults":
            return f"json {json.dumps(wire.faults(now_s))}"
        if name in ("time", "inject", "clear", "supply", "hangup", "return"):
            self._happen(words, now_s)
            wire.advance(now_s)
            self._plug()
            return "ok"
        if name not in ("kill", "revive", "fault", "turn", "heat", "state"):
            return f"error unknown request {name}"
        servo = wire.servo(int(words[1]))
        if servo is None:
            return f"error no such servo: {' '.join(words)}"
        servo.advance(now_s)
        if name == "state":
            return f"json {json.dumps(servo.state(now_s))}"
        if name in ("kill", "revive"):
            servo.dead = name == "kill"
        elif name == "fault":
            servo.fail(int(words[2]), now_s)
        elif name == "heat":
            servo.plant.temperature_C = float(words[2])
        else:
            servo.turn(float(words[2]), now_s)
        return "ok"

    def _happen(self, words: list[str], now_s: float) -> None:
        if words[0] == "inject":
            self._wire.inject(words[1], now_s)
        elif words[0] == "clear":
            self._wire.clear(now_s)
        elif words[0] == "supply":
            self._wire.set_supply(float(words[1]), now_s)
        elif words[0] in ("hangup", "return"):
            self._wire.hung = words[0] == "hangup"

    def close(self) -> None:
        for client in self._clients.values():
            client.connection.close()
        self._listener.close()
        if self._terminal is not None:
            self._terminal.close()


def _wire(description: Mapping[str, Any]) -> EmulatedWire:
    """Return the wire with its servos and faults."""
    tables = {name: Table.from_plain(plain) for name, plain in description["tables"].items()}
    servos = [EmulatedServo(**row) for row in description["servos"]]
    devices = plugged(servos, tables, description["behind_silent"] != "skip")
    faults = [parse_fault(text) for text in description["faults"]]
    return EmulatedWire(devices, description["timing"], faults, description["seed"])


def main() -> None:
    """Read the description, report where the chain is, serve."""
    parent = ParentPipe()  # ignores Ctrl-C, which is for the host: it still has to stop its servos
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    description = parent.receive()
    try:
        wire = _wire(description)
    except ConfigError as error:
        parent.send(error)
        return
    folder = tempfile.mkdtemp(prefix="sfms-robot-")
    link = description["link"] or os.path.join(folder, "device")
    try:
        server = Server(wire, description["virtual"], folder, link)
        # A servo has a processor of its own: it answers in time whatever else this computer does.
        with closing(server), realtime_priority(wanted=not description["virtual"]) as priority:
            parent.send({"device": link, "control": server.control, "folder": folder, "priority": priority})
            server.run(parent.incoming.fileno())
    finally:
        shutil.rmtree(folder, ignore_errors=True)
