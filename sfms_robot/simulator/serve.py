"""The process of an emulated chain: a pseudo terminal for the host, a control socket beside it.

Started by `launch`, which writes one JSON line on stdin (see `Description`) and reads one line back:
`ready {"device": ..., "control": ...}`. It ends on SIGTERM, or when stdin closes because its parent is gone.

In real time bytes are answered as they come. In virtual time they wait in the terminal until a client of the control
socket says how many there are and what time it is. Control requests and answers are one line each:

    sync BYTES FROM SECONDS   ack LENGTH           take BYTES in total at SECONDS, then send LENGTH bytes of reply:
                                                   what answers to bytes before FROM is left out
    digest                    digest SHA256 COUNT  of every byte the host sent
    kill ID | revive ID       ok                   the servo falls silent, or answers again
    fault ID BITS             ok                   latch hardware errors
    turn ID TICKS             ok                   somebody turns the shaft by hand
"""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import socket
import sys
import tempfile
import termios
import time
import tty
from dataclasses import dataclass, field
from typing import Any, Final

from sfms_robot.servo.registers import Table
from sfms_robot.simulator.chain import ServoChain
from sfms_robot.simulator.servo import Servo

_BAUDS: Final = {
    getattr(termios, f"B{rate}"): rate
    for rate in (9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 576000, 921600,
                 1000000, 1152000, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000)
    if hasattr(termios, f"B{rate}")
}  # fmt: skip
_CHUNK: Final = 4096
_PATIENCE_S: Final = 1.0  # for bytes that a client said it had written


@dataclass
class _Client:
    """One connection to the control socket. Counts bytes from the moment it was opened."""

    connection: socket.socket
    buffer: bytearray = field(default_factory=bytearray)
    taken: int = 0


class Server:
    """Moves bytes between the terminal, the control socket and the chain."""

    def __init__(self, chain: ServoChain, virtual: bool, folder: str) -> None:
        self._chain = chain
        self._virtual = virtual
        self._master, self._slave = os.openpty()  # the slave stays open, so that hosts may come and go
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.device = os.ttyname(self._slave)
        self.control = os.path.join(folder, "control")
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(self.control)
        self._listener.listen()
        self._clients: dict[int, _Client] = {}
        self._start_s = time.monotonic()
        self._now_s = 0.0

    def run(self) -> None:
        """Serve until stdin closes."""
        stdin, listener = sys.stdin.fileno(), self._listener.fileno()
        while True:
            watched = [stdin, listener, *self._clients] + ([] if self._virtual else [self._master])
            for fd in select.select(watched, [], [])[0]:
                if fd == self._master:
                    self._answer(os.read(self._master, _CHUNK))
                elif fd == listener:
                    connection, _ = self._listener.accept()
                    self._clients[connection.fileno()] = _Client(connection)
                elif fd == stdin:
                    if not os.read(stdin, _CHUNK):
                        return
                else:
                    self._serve(self._clients[fd])

    def _answer(self, data: bytes) -> None:
        self._now_s = time.monotonic() - self._start_s
        reply = self._chain.receive(data, self._host_baud(), self._now_s)
        if reply:
            self._send(reply, 0.0)  # a wire does not wait: what the host leaves lying is lost

    def _host_baud(self) -> int | None:
        return _BAUDS.get(termios.tcgetattr(self._master)[5])

    def _serve(self, client: _Client) -> None:
        data = client.connection.recv(_CHUNK)
        client.buffer += data
        while (end := client.buffer.find(b"\n")) >= 0:
            words = client.buffer[:end].decode().split()
            del client.buffer[: end + 1]
            if words[0] == "sync":
                self._sync(client, int(words[1]), int(words[2]), float(words[3]))
            else:
                client.connection.sendall(self._command(words).encode() + b"\n")
        if not data:
            del self._clients[client.connection.fileno()]
            client.connection.close()

    def _sync(self, client: _Client, count: int, wanted_from: int, now_s: float) -> None:
        self._now_s = now_s
        data = bytearray()
        while client.taken + len(data) < count:
            if not select.select([self._master], [], [], _PATIENCE_S)[0]:
                break
            data += os.read(self._master, count - client.taken - len(data))
        unwanted = max(0, wanted_from - client.taken)
        client.taken += len(data)
        baud = self._host_baud()
        if unwanted:
            self._chain.receive(bytes(data[:unwanted]), baud, now_s)
        reply = self._chain.receive(bytes(data[unwanted:]), baud, now_s)
        client.connection.sendall(b"ack %d\n" % len(reply))
        self._send(reply, _PATIENCE_S)

    def _send(self, reply: bytes, patience_s: float) -> None:
        view = memoryview(reply)
        while view and select.select([], [self._master], [], patience_s)[1]:
            view = view[os.write(self._master, view) :]

    def _command(self, words: list[str]) -> str:
        if words == ["digest"]:
            return f"digest {self._chain.digest()} {self._chain.bytes_seen}"
        servo = self._chain.servo(int(words[1])) if len(words) > 1 else None
        if servo is None:
            return f"error no such servo: {' '.join(words)}"
        if not self._virtual:
            self._now_s = time.monotonic() - self._start_s
        if words[0] in ("kill", "revive"):
            servo.dead = words[0] == "kill"
        elif words[0] == "fault":
            servo.fail(int(words[2]), self._now_s)
        elif words[0] == "turn":
            servo.advance(self._now_s)
            servo.plant.position = float(words[2])
        else:
            return f"error unknown request {words[0]} (sync, digest, kill, revive, fault, turn)"
        return "ok"

    def close(self) -> None:
        for client in self._clients.values():
            client.connection.close()
        self._listener.close()
        os.close(self._master)
        os.close(self._slave)


def _chain(description: dict[str, Any]) -> ServoChain:
    tables = {name: Table.from_plain(plain) for name, plain in description["tables"].items()}
    return ServoChain(
        [
            Servo(row["id"], tables[row["model"]], row["baud"], row["start_ticks"], row["firmware"])
            for row in description["servos"]
        ]
    )


def main() -> None:
    """Read the description from stdin, say `ready`, serve."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the host, which still has to stop its servos
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    line = b""
    while not line.endswith(b"\n"):  # unbuffered: run() watches the same descriptor
        part = os.read(sys.stdin.fileno(), 1 << 16)
        if not part:
            return
        line += part
    description = json.loads(line)
    folder = tempfile.mkdtemp(prefix="sfms-robot-")
    try:
        server = Server(_chain(description), description["virtual"], folder)
        ready = json.dumps({"device": server.device, "control": server.control, "folder": folder})
        sys.stdout.write(f"ready {ready}\n")
        sys.stdout.flush()
        try:
            server.run()
        finally:
            server.close()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
