"""A robot that is not started, and keeps what an adapter hands over."""

from concurrent.futures import ThreadPoolExecutor

import sfms_robot as sr

NOD = sr.ListenerEvent("nod", 12.0, 0.6, 0.1, swings=2, probability=0.03)


class Stopped:
    """A clock that stands still."""

    now_s = 100.0

    def __call__(self):
        return self.now_s


class NotedRobot(sr.Robot):
    """A `Robot` that notes the sound it has taken. `decide` hands an event to the callbacks, from another thread."""

    def __init__(self):
        super().__init__("reachy_mini")
        self.heard, self.said, self.hushed, self.callbacks = [], [], 0, []

    def hear(self, pcm, rate_hz):
        super().hear(pcm, rate_hz)
        self.heard.append((bytes(pcm), rate_hz))

    def say(self, pcm, rate_hz, at_s=None):
        super().say(pcm, rate_hz, at_s)
        self.said.append((bytes(pcm), rate_hz))

    def hush(self):
        super().hush()
        self.hushed += 1

    def on(self, kind, callback):
        super().on(kind, callback)
        self.callbacks.append((kind, callback))

    def decide(self, event):
        told = [callback for kind, callback in self.callbacks if kind == event.kind]
        with ThreadPoolExecutor() as threads:
            list(threads.map(lambda callback: callback(event), told))
