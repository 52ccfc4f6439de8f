"""A robot, a server and a network between them, in virtual time."""

import heapq
import itertools
from collections import deque

import numpy as np

from sfms_robot.frames import FRAME_S, FaceFrame, ListenerEvent, Plan, SpeakerFrame
from sfms_robot.listeners.remote import RemoteListener
from sfms_robot.listeners.stream_server import StreamServer
from sfms_robot.motion.timeline import PlanTimeline

TICK_S = 0.01
SERVER_CLOCK_S = 1_000.0  # ahead of the robot's
SILENCE = np.zeros(640, np.float32)


def frames(count):
    return [SpeakerFrame((index + 1) * FRAME_S, SILENCE) for index in range(count)]


class Counting:
    """Plans every `hop` frames, of the number of frames that it has heard; nods now and then. Batches."""

    def __init__(self, horizon=8, hop=3):
        self.horizon, self.hop = horizon, hop
        self.sizes = []

    def start(self, seed):
        return (seed, 0)

    def step(self, speaker, memory):
        return self.step_each([speaker], [memory])[0]

    def step_each(self, speakers, memories):
        self.sizes.append(len(speakers))
        return [self._one(*each) for each in zip(speakers, memories, strict=True)]

    def _one(self, speaker, memory):
        seed, heard = memory
        if heard % self.hop:
            return None, (seed, heard + 1)
        times_s = speaker.time_s + FRAME_S * (1 + np.arange(self.horizon))
        frames = np.full((self.horizon, 58), 0.1 * np.sin(0.1 * heard + seed), np.float32)
        events = (ListenerEvent("nod", speaker.time_s + 0.2, 0.4, 0.1),) if heard % (5 * self.hop) == 0 else ()
        return Plan(speaker.time_s, times_s, frames, None, events), (seed, heard + 1)


class Network:
    """Messages take `delay_s` +- `jitter_s`, and are lost at a rate of `loss`; `up` False: nothing comes through."""

    def __init__(self, delay_s=0.0, jitter_s=0.0, loss=0.0, seed=0):
        self.delay_s, self.jitter_s, self.loss = delay_s, jitter_s, loss
        self.up = True
        self.now_s = 0.0
        self._rng = np.random.default_rng(seed)
        self._order = itertools.count()
        self._under_way = []

    def carry(self, arrive, *arguments):
        if self.up and self._rng.random() >= self.loss:
            takes_s = max(0.0, self.delay_s + self._rng.uniform(-self.jitter_s, self.jitter_s))
            heapq.heappush(self._under_way, (self.now_s + takes_s, next(self._order), arrive, arguments))

    def advance(self, now_s):
        while self._under_way and self._under_way[0][0] <= now_s:
            self.now_s, _, arrive, arguments = heapq.heappop(self._under_way)
            if self.up:
                arrive(*arguments)
        self.now_s = now_s


class Server:
    """A `StreamServer` whose batches take `batch_s`."""

    def __init__(self, listener, network, batch_s=0.0, **more):
        self.core = StreamServer(listener, "counting", **more)
        self.network, self.batch_s = network, batch_s
        self.links = {}
        self._at_work = None

    def now_s(self):
        return self.network.now_s + SERVER_CLOCK_S

    def join(self, link, message):
        self.network.carry(link.arrived, self.core.join(message, self.now_s()))

    def receive(self, stream, link, message):
        self.links[stream] = link
        for answer in self.core.receive(stream, message, self.now_s()):
            self.network.carry(link.arrived, answer)
        self.work()

    def work(self):
        """Finish what is due, begin what waits."""
        if self._at_work is not None:
            batch, answers, began_s = self._at_work
            if self.now_s() < began_s + self.batch_s:
                return
            for stream, message in self.core.finish(batch, answers, began_s, self.now_s()):
                self.network.carry(self.links[stream].arrived, message)
            self._at_work = None
        batch = self.core.batch()
        if batch is not None:
            self._at_work = (batch, self.core.step(batch), self.now_s())
            if not self.batch_s:
                self.work()


class Link:
    """`remote.Link`."""

    where, problem = "a network that is not there", None

    def __init__(self, network, server):
        self.network, self.server = network, server
        self.stream = None
        self._came = deque()
        self.closed = False

    def ask(self, message):
        self.network.carry(lambda: self.server.join(self, message))

    def follow(self, stream):
        self.stream = stream

    def send(self, message):
        stream = self.stream
        self.network.carry(lambda: self.server.receive(stream, self, message))

    def arrived(self, message):
        self._came.append((self.network.now_s, message))

    def received(self):
        came = [(self.network.now_s - at_s, message) for at_s, message in self._came]
        self._came.clear()
        return came

    def close(self):
        self.closed = True


class Robot:
    """Frames every 40 ms, ticks every 10; what the timeline shows is judged from outside."""

    def __init__(self, network, server, seed=0):
        self.network, self.server = network, server
        self.link = Link(network, server)
        self.feed = RemoteListener("counting", self.link, seed)
        self.timeline = PlanTimeline(TICK_S)
        self.state = self.timeline.start()
        self.plans, self.states, self.gaps_s = [], [], []
        self._ticks = 0
        self._held_since_s = None

    def run(self, seconds, audio=SILENCE):
        for _ in range(round(seconds / TICK_S)):
            now_s = self._ticks * TICK_S
            self.network.advance(now_s)
            self.server.work()
            if self._ticks % 4 == 0 and self._ticks:
                self.feed.push(SpeakerFrame(now_s, audio, FaceFrame.of(now_s, np.zeros(58))), now_s)
            for plan in self.feed.poll(now_s):
                self.plans.append((now_s, plan))
                self.state = self.timeline.accept(plan, self.state)
            self._judge(now_s)
            self._ticks += 1
        return self

    def _judge(self, now_s):
        counted = self.state.held + self.state.eased
        _, self.state = self.timeline.sample(np.array([now_s]), now_s, self.state)
        starved = self.state.held + self.state.eased > counted
        if starved and self._held_since_s is None:
            self._held_since_s = now_s
        elif not starved and self._held_since_s is not None:
            self.gaps_s.append((self._held_since_s, now_s - self._held_since_s))
            self._held_since_s = None
        state = self.feed._state  # statistics take their time
        if not self.states or self.states[-1][1] != state:
            self.states.append((now_s, state))
