"""The process of an emulated chain: a pseudo terminal or a TCP port for the host, and a control socket.

Pseudo terminals and sockets in the file system are used on Linux; elsewhere both are TCP ports of loopback. There
`select` waits for sockets only, since Windows supports nothing else; so a thread reads the pipe to the parent.

`launch` starts the process, sends it a description and receives the addresses of the chain, or a ConfigError if the
description is invalid. The process ends on SIGTERM, or when the pipe to its parent ends.

In real time bytes are answered at the times of the wire. In virtual time they wait in the device until a client of the
control socket sends their number and the time. Control requests and answers are one line each:

    sync BYTES FROM SECONDS [UNTIL]  ack LENGTH  read BYTES in total at SECONDS, then send LENGTH bytes of reply, due by
                                                 UNTIL; replies to bytes before FROM are lost unless a fault delays them
    quiet BYTES SECONDS              quiet LENGTH  read BYTES in total and send replies due within SECONDS after the
                                                 last of them: LENGTH bytes in total, both since the client's first
                                                 such request
    time SECONDS                     ok          only advance the time
    digest                           digest SHA256 COUNT  of every byte the host sent
    kill ID | revive ID              ok          the servo falls silent, or answers again
    fault ID BITS                    ok          latch hardware errors
    turn ID TICKS                    ok          turn the shaft by hand to reported position TICKS
    heat ID DEGREES                  ok          set its temperature, which follows its load from then on
    state ID                         json {...}  its true state: position, goal, torque, ...
    inject SPEC                      ok          add a fault (see `faults`), from now on unless it has a START
    clear                            ok          end all faults
    supply VOLTS                     ok          set the supply of all servos
    hangup | return                  ok          the adapter is unplugged, or plugged in again: same name, new device
    stats | stamps | faults          json {...}  counts; the last replies, due and sent; current and future faults
"""

from __future__ import annotations

import json
import os
import select
import signal
import socket
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Final

from sfms_robot.emulator.emulated_wire import EmulatedDevice, EmulatedServo, EmulatedWire
from sfms_robot.emulator.faults import parse_fault
from sfms_robot.emulator.pulse_boards import MaestroBoard, Ssc32Board
from sfms_robot.emulator.servo_chains import Dynamixel2Chain, Protocol1Chain
from sfms_robot.endpoint import LOOPBACK
from sfms_robot.errors import ConfigError
from sfms_robot.processes import ParentPipe, realtime_priority
from sfms_robot.servo.registers import Table

_CHUNK: Final = 4096
_PATIENCE_S: Final = 1.0  # longest wait for bytes that a client has announced
_IDLE_S: Final = 0.25  # longest interval between updates of the motors in real time
_TCGETS2: Final = 0x802C542A  # struct termios2 contains any rate as a number, also unusual rates
_TERMIOS2: Final = struct.Struct("=4IB19s2I")
_OUTPUT_RATE: Final = -1
_KINDS: Final[Mapping[tuple[str, int | None], Any]] = {  # family, protocol
    ("dynamixel", 2): Dynamixel2Chain,
    ("dynamixel", 1): Protocol1Chain,
    ("feetech", 1): Protocol1Chain,
    ("maestro", None): MaestroBoard,
    ("ssc32", None): Ssc32Board,
}


class PseudoTerminal:
    """The open pty of the chain, on Linux.

    `name` is a symbolic link to it, replaced when it is opened and removed when it is closed: the name stays the same
    when the adapter is unplugged and comes back.
    """

    def __init__(self, link: str) -> None:
        import tty

        self.name = link
        self._fd, self._slave = os.openpty()  # the slave stays open, so that hosts may come and go
        tty.setraw(self._slave)
        os.set_blocking(self._fd, False)
        self._path = os.ttyname(self._slave)
        beside = Path(f"{link}.new")
        beside.unlink(missing_ok=True)
        beside.symlink_to(self._path)
        beside.replace(link)

    def watched(self) -> list[Any]:
        """Return the objects for `select` that are readable when there are bytes to `take`."""
        return [self._fd]

    def take(self, count: int, patience_s: float) -> bytes:
        """Return 1 to `count` bytes of hosts as soon as there are any; empty if none came within `patience_s`."""
        return os.read(self._fd, count) if select.select([self._fd], [], [], patience_s)[0] else b""

    def baud(self) -> int:
        """Return the baud rate that the host has set."""
        import fcntl

        raw = fcntl.ioctl(self._fd, _TCGETS2, bytes(_TERMIOS2.size))
        return int(_TERMIOS2.unpack(raw)[_OUTPUT_RATE])

    def send(self, data: bytes, patience_s: float) -> None:
        """Write the bytes that the terminal accepts within `patience_s`; the rest is lost, as on a wire."""
        view = memoryview(data)
        while view and select.select([], [self._fd], [], patience_s)[1]:
            view = view[os.write(self._fd, view) :]

    def close(self) -> None:
        """Close the device, and remove the link unless it now points to another device."""
        if os.path.islink(self.name) and os.readlink(self.name) == self._path:
            os.unlink(self.name)
        os.close(self._fd)
        os.close(self._slave)


class NetworkPort:
    """The TCP port of the chain on loopback, if there is no pty; methods as of `PseudoTerminal`.

    It does not transfer the rate of the host: the line has one rate, like that of a serial server. Several hosts may be
    connected; answers go to the host that wrote last.

    Args:
        name: its address if it was open before, so that it comes back with the same address.
    """

    def __init__(self, baud: int, name: str | None = None) -> None:
        self._baud = baud
        self._listener = socket.create_server((LOOPBACK, int(name.rpartition(":")[2]) if name else 0))
        self.name = f"socket://{LOOPBACK}:{self._listener.getsockname()[1]}"
        self._hosts: list[socket.socket] = []  # the host that wrote last is at the end

    def watched(self) -> list[Any]:
        return [self._listener, *self._hosts]

    def take(self, count: int, patience_s: float) -> bytes:
        while ready := select.select(self.watched(), [], [], patience_s)[0]:
            host = ready[-1]
            if host is self._listener:
                host = self._listener.accept()[0]
                host.setblocking(False)
                host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._hosts.append(host)
                continue
            try:
                data: bytes = host.recv(count)
            except OSError:
                data = b""
            self._hosts.remove(host)
            if data:
                self._hosts.append(host)
                return data
            host.close()  # the host has disconnected
        return b""

    def baud(self) -> int:
        return self._baud

    def send(self, data: bytes, patience_s: float) -> None:
        view = memoryview(data)
        try:
            while view and self._hosts and select.select([], self._hosts[-1:], [], patience_s)[1]:
                view = view[self._hosts[-1].send(view) :]
        except OSError:
            return  # the host has disconnected; the next `take` detects it

    def close(self) -> None:
        for each in self.watched():
            each.close()


Device = PseudoTerminal | NetworkPort


@dataclass
class _Client:
    """One connection to the control socket. Counts bytes from the moment it was opened."""

    connection: socket.socket
    buffer: bytearray = field(default_factory=bytearray)
    taken: int = 0
    wanted_from: int = 0
    since: tuple[int, int] | None = None  # bytes that the wire had received and sent at its first `quiet`

    def reply(self, answer: str) -> None:
        try:
            self.connection.sendall(answer.encode() + b"\n")
        except OSError:
            self.buffer.clear()  # the client is gone; the next read detects the end of its connection


class Server:
    """A server that moves bytes between the device, the control socket and the wire.

    Args:
        plug_in: opens the device, under the name that it had before.
        control: the bound socket for requests. `close` closes it too.
    """

    def __init__(
        self, wire: EmulatedWire, virtual: bool, plug_in: Callable[[str | None], Device], control: socket.socket
    ) -> None:
        self._wire = wire
        self._virtual = virtual
        self._plug_in = plug_in
        self._device: Device | None = plug_in(None)
        self.device = self._device.name
        self._listener = control
        self._listener.listen()
        self._clients: dict[socket.socket, _Client] = {}
        self._start_s = time.monotonic()
        self._now_s = 0.0
        self._idled_s = 0.0
        self._received_s = 0.0  # time at which the last bytes arrived

    def run(self, ended: socket.socket) -> None:
        """Serve until `ended` can be read."""
        while True:
            watched: list[Any] = [ended, self._listener, *self._clients]
            if self._device is not None and not self._virtual:
                watched += self._device.watched()
            patience_s = None if self._virtual else min(max(0.0, self._wire.next_s - self._now()), _IDLE_S)
            for each in select.select(watched, [], [], patience_s)[0]:
                if each is ended:
                    return
                if each is self._listener:
                    connection = self._listener.accept()[0]
                    self._clients[connection] = _Client(connection)
                elif each in self._clients:
                    self._serve(self._clients[each])
                elif self._device is not None and (data := self._device.take(_CHUNK, 0.0)):
                    self._receive(data, self._device)
            if not self._virtual:
                self._deliver()

    def _receive(self, data: bytes, device: Device) -> None:
        self._received_s = self._now()
        self._wire.receive(data, device.baud(), self._received_s)

    def _now(self) -> float:
        if not self._virtual:
            self._now_s = time.monotonic() - self._start_s
        return self._now_s

    def _deliver(self) -> None:
        """Send the answers that are due in real time. Bytes that the host does not accept are lost, as on a wire."""
        self._advance(self._now())
        if self._now_s - self._idled_s >= _IDLE_S:
            self._idled_s = self._now_s
            self._wire.idle(self._now_s)
        outs = self._wire.take(self._now_s)
        if outs and self._device is not None:
            self._device.send(b"".join(out.data for out in outs), 0.0)
            self._wire.sent(outs, self._now())

    def _advance(self, now_s: float) -> None:
        """Advance the wire, then unplug the device or plug it in again, according to its `hung`."""
        self._wire.advance(now_s)
        if self._wire.hung and self._device is not None:
            self._device.close()
            self._device = None
        elif not self._wire.hung and self._device is None:
            self._device = self._plug_in(self.device)

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
                if words[0] == "sync":
                    self._sync(client, int(words[1]), int(words[2]), *map(float, words[3:5]))
                elif words[0] == "quiet":
                    client.reply(self._quiet(client, int(words[1]), float(words[2])))
                else:
                    client.reply(self._command(words))
            except (ValueError, IndexError, TypeError):
                client.reply(f"error not understood: {' '.join(words)}")
            except ConfigError as error:
                client.reply(f"error {error}")
        if not data:
            del self._clients[client.connection]
            client.connection.close()

    def _sync(self, client: _Client, count: int, wanted_from: int, now_s: float, until_s: float | None = None) -> None:
        self._now_s = now_s
        self._advance(now_s)
        device = self._device
        if device is None:
            client.reply("error the adapter is unplugged")
            return
        data = bytearray()
        while client.taken + len(data) < count:
            if not (more := device.take(count - client.taken - len(data), _PATIENCE_S)):
                break
            data += more
        unwanted = max(0, wanted_from - client.taken)
        client.taken += len(data)
        baud = device.baud()
        if unwanted:
            self._wire.receive(bytes(data[:unwanted]), baud, now_s)
        if wanted_from > client.wanted_from:
            self._wire.take(now_s, all_but_late=True)
            client.wanted_from = wanted_from
        if data[unwanted:]:
            self._wire.receive(bytes(data[unwanted:]), baud, now_s)
        outs = self._wire.take(now_s if until_s is None else max(now_s, until_s), all_but_late=until_s is None)
        reply = b"".join(out.data for out in outs)
        client.reply(f"ack {len(reply)}")
        device.send(reply, _PATIENCE_S)
        self._wire.sent(outs, None)

    def _quiet(self, client: _Client, count: int, patience_s: float) -> str:
        """Receive the bytes that a client has written, and send the replies due within `patience_s`.

        After that a silence comes from the servos. Bytes may have arrived here later than they were written;
        `patience_s` counts from their arrival.
        """
        if client.since is None:
            client.since = self._wire.traffic
        received, sent = client.since
        while self._device is not None and self._wire.traffic[0] - received < count:
            if not (data := self._device.take(_CHUNK, _PATIENCE_S)):
                break
            self._receive(data, self._device)
        self._deliver()
        until_s = self._received_s + patience_s
        while self._device is not None and self._now() < until_s and self._wire.next_s <= until_s:
            time.sleep(max(0.0, self._wire.next_s - self._now()))
            self._deliver()
        return f"quiet {self._wire.traffic[1] - sent}"

    def _command(self, words: list[str]) -> str:
        """Execute any other request; return the answer. Raises ValueError for an invalid number."""
        wire = self._wire
        if words[0] == "time":
            self._now_s = float(words[1])
        now_s = self._now()
        match words:
            case ["digest"]:
                return "digest {} {}".format(*wire.digest())
            case ["stats"]:
                return _json(wire.statistics())
            case ["stamps"]:
                return _json(wire.stamps())
            case ["faults"]:
                return _json(wire.faults.texts(now_s))
            case ["kill" | "revive" | "fault" | "turn" | "heat" | "state" as name, servo_id, *value]:
                servo = wire.servo(int(servo_id))
                return "error no such servo" if servo is None else _to_servo(servo, name, value, now_s)
            case ["time", _]:
                pass
            case ["inject", spec]:
                wire.add(parse_fault(spec, now_s))
            case ["clear"]:
                wire.faults.clear(now_s)
            case ["supply", volts]:
                wire.set_supply(float(volts), now_s)
            case ["hangup" | "return" as name]:
                wire.hung = name == "hangup"
            case _:
                return f"error not understood: {' '.join(words)}"
        self._advance(now_s)
        return "ok"

    def close(self) -> None:
        """Close the device, the control socket and all connections to it."""
        for connection in (*self._clients, self._listener):
            connection.close()
        if self._device is not None:
            self._device.close()


def _to_servo(servo: Any, name: str, value: list[str], now_s: float) -> str:
    servo.advance(now_s)
    if name == "state":
        return _json(servo.state(now_s))
    if name in ("kill", "revive"):
        servo.dead = name == "kill"
    elif name == "fault":
        servo.fail(int(value[0]), now_s)
    elif name == "heat":
        servo.plant.temperature_C = float(value[0])
    else:
        servo.turn(float(value[0]), now_s)
    return "ok"


def _json(value: object) -> str:
    return f"json {json.dumps(value)}"


def plugged(
    servos: Sequence[EmulatedServo], tables: Mapping[str, Table], chain_break: bool = True
) -> list[EmulatedDevice]:
    """Return a device for the servos of each protocol, and one for each board; `tables` by model."""
    groups: dict[tuple[Any, str], list[EmulatedServo]] = {}
    for servo in servos:
        table = tables[servo.model]
        board = "" if table.channels is None else table.model
        groups.setdefault((_KINDS[table.family, table.protocol], board), []).append(servo)
    return [
        kind(tables[board], members) if board else kind(members, tables, chain_break)
        for (kind, board), members in groups.items()
    ]


def _bound(description: Mapping[str, Any], folder: str) -> tuple[socket.socket, str, Callable[[str | None], Device]]:
    """Return the control socket, its address, and the function that opens the device."""
    if description["transport"] == "tcp":
        control = socket.create_server((LOOPBACK, 0))
        return control, f"{LOOPBACK}:{control.getsockname()[1]}", partial(NetworkPort, description["servos"][0].baud)
    control, place = socket.socket(socket.AF_UNIX), os.path.join(folder, "control")
    control.bind(place)
    link = description["link"] or os.path.join(folder, "device")
    return control, place, lambda name: PseudoTerminal(link)


def main() -> None:
    """Read the description, report the addresses of the chain, and serve."""
    parent = ParentPipe()  # ignores Ctrl-C, which is meant for the host: the host still has to stop its servos
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    description = parent.receive()
    try:
        devices = plugged(description["servos"], description["tables"], description["behind_silent"] != "skip")
        faults = [parse_fault(text) for text in description["faults"]]
        wire = EmulatedWire(devices, description["timing"], faults, description["seed"])
    except ConfigError as error:
        parent.send(error)
        return
    ended, over = socket.socketpair()
    parent.forward(lambda message: None, over.close)
    with tempfile.TemporaryDirectory(prefix="sfms-robot-", ignore_cleanup_errors=True) as folder:
        control, place, plug_in = _bound(description, folder)
        server = Server(wire, description["virtual"], plug_in, control)
        # A real servo has its own processor: it answers in time under any load of this computer.
        with closing(server), realtime_priority(wanted=not description["virtual"]) as priority:
            parent.send({"device": server.device, "control": place, "folder": folder, "priority": priority})
            server.run(ended)
