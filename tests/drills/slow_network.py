"""A network that delays, jitters and loses, as TCP shows it: a process that passes connections on, chunk by chunk.

    python slow_network.py TARGET_HOST:PORT SETTINGS HOST:PORT [HOST:PORT ...]      SETTINGS: JSON of `Weather`

Every chunk comes `delay_s` +- `jitter_s` later. One that is lost comes after the sender has noticed and sent it again,
a round trip and a frame later, and whatever follows it waits: TCP keeps the order. A line "cut HOST" on stdin stops all
that goes through HOST, "mend HOST" lets it go on: what was under way then comes, new connections are held until then.
Says "ready" when it listens.
"""

import asyncio
import json
import random
import sys
from contextlib import suppress
from dataclasses import dataclass

RESEND_S = 0.040  # until later packets show that one is missing
CHUNK = 65_536


@dataclass(frozen=True)
class Weather:
    delay_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    seed: int = 0


class Way:
    """One direction of a connection."""

    def __init__(self, weather, up, chance, now_s):
        self.weather, self.up, self.chance, self.now_s = weather, up, chance, now_s
        self.last_s = 0.0

    def due_s(self):
        """When a chunk that leaves now arrives."""
        takes_s = self.weather.delay_s + self.chance.uniform(-1, 1) * self.weather.jitter_s
        if self.chance.random() < self.weather.loss:
            takes_s += 2 * self.weather.delay_s + RESEND_S
        self.last_s = max(self.last_s, self.now_s() + max(0.0, takes_s))
        return self.last_s

    async def carry(self, reader, writer):
        """Until one side closes."""
        under_way = asyncio.Queue()
        deliver = asyncio.create_task(self._deliver(under_way, writer))
        with suppress(ConnectionError):
            while data := await reader.read(CHUNK):
                under_way.put_nowait((self.due_s(), data))
        under_way.put_nowait((self.due_s(), b""))
        await deliver

    async def _deliver(self, under_way, writer):
        with suppress(ConnectionError):
            while True:
                due_s, data = await under_way.get()
                await asyncio.sleep(max(0.0, due_s - self.now_s()))
                await self.up.wait()
                if not data:
                    break
                writer.write(data)
                await writer.drain()
        writer.close()


async def main(target, weather, hosts):
    loop, chance = asyncio.get_running_loop(), random.Random(weather.seed)
    up = {host: asyncio.Event() for host, _ in hosts}

    def passing(host):
        async def passed_on(reader, writer):
            await up[host].wait()
            theirs_reader, theirs_writer = await asyncio.open_connection(*target)
            ways = [Way(weather, up[host], chance, loop.time) for _ in range(2)]
            await asyncio.gather(ways[0].carry(reader, theirs_writer), ways[1].carry(theirs_reader, writer))

        return passed_on

    for host, port in hosts:
        up[host].set()
        await asyncio.start_server(passing(host), host, port)
    say("ready")
    commands = asyncio.StreamReader()
    await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(commands), sys.stdin)
    while line := (await commands.readline()).decode().split():
        word, host = line
        up[host].clear() if word == "cut" else up[host].set()
        say(f"{word} {host}")


def say(line):
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def address(text):
    host, _, port = text.rpartition(":")
    return host, int(port)


if __name__ == "__main__":
    asyncio.run(
        main(address(sys.argv[1]), Weather(**json.loads(sys.argv[2])), [address(each) for each in sys.argv[3:]])
    )
