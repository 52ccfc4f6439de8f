"""The robot's own voice, played: `--play [DEVICE]`, on a loudspeaker in a process of its own (`playback_worker`).

Who plays it knows when it sounds. What is said at a time leaves the loudspeaker `delay_s` later, by the device's own
time stamps (`Playout`), and that is what everybody beside it is told: the listener's lips, the state of the run and
the echo canceller go by what leaves, not by when it was handed over. What did not leave is silence for them too.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np

from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Floats
from sfms_robot.sources.microphone import sound_devices
from sfms_robot.sources.playback_worker import FLAG, PlaybackOpened, Silence, Speech, play
from sfms_robot.sources.sound_devices import choose_device
from sfms_robot.sources.spoken import Spoken
from sfms_robot.sources.worker import SourceWorker

logger = logging.getLogger(__name__)

DEFAULT: Final = "default"  # `--play` without a device
MARGIN_S: Final = 0.08  # before the device wants what is said: a frame, two processes, a tick that is late
HUSH_S: Final = 0.04  # until the worker has heard of it
EARLY_S: Final = 0.02  # of the echo canceller: time stamps are a device's own word, and no echo comes before its sound
AHEAD_FRAMES: Final = 10  # that the worker knows beforehand, where they are known: the loop may be held up
_KEPT: Final = AUDIO_HZ  # samples of what left
_FADE: Final = np.linspace(1.0, 0.0, AUDIO_HZ // 200, dtype=np.float32)  # 5 ms: a voice that is cut off clicks
_NONE: Final = np.zeros(0, np.float32)


class PlayedVoice:
    """`ports.Voice` of what leaves the loudspeaker, of all that `spoken` says. Only `close` blocks.

    Args:
        loudspeaker: the worker of `playback_worker.play`; its first message has arrived.
        now: `time.monotonic`, or a test's.

    Attributes:
        device: its name.
        delay_s: from when something is said until it leaves.
        duration_s: until all that is said has left; None for one without end.
        outlet: the programs behind what is said.
        early_s: by how much an echo canceller is to be told too early.
    """

    latency_s = 0.0
    early_s = EARLY_S

    def __init__(self, loudspeaker: SourceWorker, spoken: Spoken, now: Callable[[], float] = time.monotonic) -> None:
        self._loudspeaker, self._spoken, self._now = loudspeaker, spoken, now
        self.device = ""
        self.delay_s = self._device_s = 0.0
        self._origin_s: float | None = None
        self._turn = threading.Lock()  # of who tells the loudspeaker what to play
        self._next = 0  # frame of `spoken` that is taken next
        self._leaves: tuple[int, Floats] = (0, _NONE)  # from which sample of the loop on, and what
        self._speaks = False
        self._unsaid = 0
        self._told: Mapping[str, Any] = {}
        self._collect()
        self.duration_s = None if spoken.duration_s is None else spoken.duration_s + self.delay_s
        self.outlet = getattr(spoken, "outlet", None)

    @property
    def lost(self) -> bool:
        """It is away, or being looked for: nobody hears the robot."""
        return self._loudspeaker.lost

    def start(self, origin_s: float) -> None:
        self._spoken.start(origin_s)
        with self._turn:
            self._origin_s = origin_s
            self._next, self._leaves = 0, (round(self.delay_s * AUDIO_HZ), _NONE)
            self._tell()

    def take(self, index: int) -> Floats | None:
        """The (640,) that leave in frame `index`, silence where there is none; None until something was said. A frame
        that is still to come is what will leave, as far as that is known.
        """
        if self._origin_s is not None and self._turn.acquire(blocking=False):  # else somebody is at it at this moment
            try:
                self._collect()
                self._tell()
            finally:
                self._turn.release()
        if not self._speaks:
            return None
        begin, leaves = self._leaves
        frame = np.zeros(FRAME_SAMPLES, dtype=np.float32)
        if not self.lost:
            first = index * FRAME_SAMPLES - begin
            part = leaves[max(first, 0) : max(first + FRAME_SAMPLES, 0)]
            frame[max(-first, 0) : max(-first, 0) + len(part)] = part
        return frame

    def said(self) -> None:
        """See `Player`."""
        with self._turn:
            if self._origin_s is not None:
                self._tell()

    def hushed(self) -> None:
        """See `Player`: what is on its way out of the device is the last that is heard."""
        with self._turn:
            if self._origin_s is None:
                return
            self._take_in()
            begin, leaves = self._leaves
            cut = max(self._sample(self._now() + self._device_s + HUSH_S) - begin, 0)
            fading = leaves[cut : cut + len(_FADE)]
            silent = np.zeros(max(len(leaves) - cut - len(_FADE), 0), np.float32)
            self._leaves = (begin, np.concatenate([leaves[:cut], fading * _FADE[: len(fading)], silent]))
            self._tell()

    def statistics(self) -> Mapping[str, Any]:
        """Device, process, delay, times it ran dry, milliseconds of sound that were not heard; and of what is said."""
        return {
            "device": self.device, **self._loudspeaker.statistics(), **self._told,
            "delay_ms": round(self.delay_s * 1e3, 1), "unsaid_ms": round(self._unsaid / AUDIO_HZ * 1e3, 1),
            **self._spoken.statistics(),
        }  # fmt: skip

    def close(self) -> None:
        self._loudspeaker.close()
        self._spoken.close()

    def _tell(self) -> None:
        """The loudspeaker hears what leaves from now on, with what is known of what comes after it."""
        self._take_in()
        assert self._origin_s is not None
        begin, leaves = self._leaves
        first = max(0, self._sample(self._now()) // FRAME_SAMPLES)
        skip = first * FRAME_SAMPLES - begin
        ahead = [self._spoken.upcoming(index) for index in range(self._next, self._next + AHEAD_FRAMES)]
        samples = np.concatenate([np.zeros(max(-skip, 0), np.float32), leaves[max(skip, 0) :], *map(_sounding, ahead)])
        whole = len(samples) // FRAME_SAMPLES * FRAME_SAMPLES
        self._loudspeaker.tell(Speech(self._origin_s, first, samples[:whole]))

    def _take_in(self) -> None:
        """What was said up to the frame that is in progress will leave as it is; what left long ago is forgotten."""
        begin, leaves = self._leaves
        now = self._sample(self._now())
        pieces = []
        while self._next <= now // FRAME_SAMPLES:
            piece = self._spoken.take(self._next)
            self._speaks = self._speaks or piece is not None
            pieces.append(_sounding(piece))
            self._next += 1
        old = min(max(0, now - _KEPT - begin), len(leaves))
        self._leaves = (begin + old, np.concatenate([leaves[old:], *pieces]))

    def _sample(self, time_s: float) -> int:
        """Of the loop, at `time_s` of `time.monotonic`."""
        assert self._origin_s is not None
        return math.floor((time_s - self._origin_s) * AUDIO_HZ)

    def _collect(self) -> None:
        for message in self._loudspeaker.messages(self._now()):
            if isinstance(message, PlaybackOpened):
                if not self.device:  # one that is back may be quicker or slower: what is said keeps its delay
                    self.delay_s = round((message.latency_s + MARGIN_S) * AUDIO_HZ) / AUDIO_HZ
                self.device, self._device_s = message.device, message.latency_s
            elif isinstance(message, Silence):
                self._silence(message)
            else:
                self._told = message

    def _silence(self, silence: Silence) -> None:
        begin, leaves = self._leaves
        first, last = (min(max(at - begin, 0), len(leaves)) for at in (silence.first, silence.last))
        lacks = int(np.count_nonzero(leaves[first:last]))
        if lacks and silence.first and not self._unsaid:  # from the first sample on: it was away, and that is said
            text = "loudspeaker: %s had nothing to play for %.0f ms while the robot spoke (said once)"
            logger.warning(text, self.device, lacks / AUDIO_HZ * 1e3)
        self._unsaid += lacks
        leaves[first:last] = 0.0


def _sounding(piece: Floats | None) -> Floats:
    return np.zeros(FRAME_SAMPLES, np.float32) if piece is None else piece


def open_playback(argument: str, spoken: Spoken) -> PlayedVoice:
    """What `spoken` says, played: on a device by number, name or a part of one; "default" is the default.

    Blocks until it plays, a second. Raises ConfigError for a device that is not there and without PortAudio, PortError
    where there is no loudspeaker or it cannot be opened.
    """
    wanted = "" if argument == DEFAULT else argument
    if wanted.isdigit():  # numbers change when something is plugged in, and the worker may be started again then
        wanted = choose_device(sound_devices("playing"), wanted, FLAG, plays=True).name
    worker = SourceWorker("loudspeaker", play, wanted)
    worker.wait()
    played = PlayedVoice(worker, spoken)
    spoken.played_by(played)
    logger.warning("loudspeaker: %s, %.0f ms after it is said", played.device, played.delay_s * 1e3)
    return played
