"""The microphone: `--audio mic[:DEVICE]`, and what the robot says into it: `--agent-audio device:DEVICE`.

PortAudio, resampling and echo cancellation are in a process of their own (`microphone_worker`), which sends frames of
the loop; here they are only handed on. The process is started again when the device goes away, until it is back.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from typing import Any, Final, Literal

import numpy as np

from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, Floats
from sfms_robot.ports import Voice
from sfms_robot.sources.microphone_worker import Heard, Opened, Recording, Told, listen
from sfms_robot.sources.sound_devices import SoundDevice, choose_device, tell_devices
from sfms_robot.sources.worker import SourceWorker

logger = logging.getLogger(__name__)

MIC_FLAG: Final = "--audio mic"
DEVICE_FLAG: Final = "--agent-audio device"
TOLD_FRAMES: Final = 12  # of the robot's voice at once: the worker may miss half a second of tellings
KEPT_FRAMES: Final = 50
_TOLD_RAD_S: Final = 0.1  # a change of speed that is worth telling
_SILENCE: Final = np.zeros(FRAME_SAMPLES, dtype=np.float32)
_LATENCY_FALLS_S: Final = 1e-4  # a frame, so that a bad second is forgotten in a minute


class Microphone:
    """`ports.Voice` of the worker `listen`. Only `close` blocks.

    Args:
        agent: what the robot says, where a program or a file tells it: it is taken out of what is heard.

    Attributes:
        device: its name.
    """

    duration_s: float | None = None

    def __init__(self, worker: SourceWorker, agent: OwnVoice | None = None) -> None:
        self._worker, self._agent = worker, agent
        self._origin_s: float | None = None
        self._frames: dict[int, Heard] = {}
        self.device = ""
        self._latency_s = 0.0
        self._late_frames = 0
        self._told: Mapping[str, Any] = {}
        self._said: dict[int, Floats | None] = {}
        self._speed_rad_s = self._told_speed_rad_s = 0.0
        self._collect(0.0, 0)

    @property
    def lost(self) -> bool:
        """It gave sound, and gives none any more."""
        return bool(self.device) and self._worker.statistics()["state"] in ("lost", "starting")

    @property
    def latency_s(self) -> float:
        """The longest from the end of a frame to the moment that its worker sent it, lately."""
        return self._latency_s

    def start(self, origin_s: float) -> None:
        self._origin_s = origin_s
        self._worker.tell(Told(origin_s))

    def take(self, index: int) -> Floats | None:
        """See `ports.Voice`."""
        if self._origin_s is None:
            return None
        if self._agent is not None and self._agent.ask(index + 1):
            self._tell(self._origin_s, *self._agent.newest())
        elif self._agent is None and abs(self._speed_rad_s - self._told_speed_rad_s) > _TOLD_RAD_S:
            self._tell(self._origin_s)
        self._collect(self._origin_s + (index + 1) * FRAME_S, index)
        heard = self._frames.pop(index, None)
        self._said[index] = None if heard is None else heard.said
        self._said.pop(index - 2, None)
        return None if heard is None else heard.audio

    def moves(self, speed_rad_s: float) -> None:
        """How fast the joints of the head beside it move, all together: the noise that they make is known by that."""
        self._speed_rad_s = speed_rad_s

    def _tell(self, origin_s: float, first: int = 0, said: Floats | None = None) -> None:
        self._told_speed_rad_s = self._speed_rad_s
        self._worker.tell(Told(origin_s, first, said, self._speed_rad_s))

    def said(self, index: int) -> Floats | None:
        """What the loudspeaker beside it was given in a frame that was taken just now."""
        return self._said.get(index)

    def statistics(self) -> Mapping[str, Any]:
        """Device, latency, frames that came too late, what the worker tells of its process and of the sound."""
        return {
            "device": self.device,
            **self._worker.statistics(),
            **self._told,
            "latency_ms": round(self._latency_s * 1e3, 1),
            "late_frames": self._late_frames,
        }

    def close(self) -> None:
        self._worker.close()

    def _collect(self, now_s: float, wanted: int) -> None:
        for old in [index for index in self._frames if index < wanted]:
            del self._frames[old]
        for message in self._worker.messages(now_s):
            if isinstance(message, Heard):
                self._take_in(message, wanted)
            elif isinstance(message, Opened):
                self.device = message.device
            else:
                self._told = message

    def _take_in(self, heard: Heard, wanted: int) -> None:
        assert self._origin_s is not None
        late_s = heard.known_s - self._origin_s - (heard.index + 1) * FRAME_S
        self._latency_s = max(late_s, self._latency_s - _LATENCY_FALLS_S, 0.0)
        if wanted <= heard.index < wanted + KEPT_FRAMES:
            self._frames[heard.index] = heard
        else:
            self._late_frames += 1


class OwnVoice:
    """`ports.Voice` around what the robot says: the microphone is told of it as soon as the grid is.

    Attributes:
        outlet: the programs behind it.
    """

    def __init__(self, inner: Voice) -> None:
        self._inner = inner
        self.duration_s, self.latency_s = inner.duration_s, inner.latency_s
        self.outlet = getattr(inner, "outlet", None)
        self._early = round(getattr(inner, "early_s", 0.0) * AUDIO_HZ)
        self._frames: dict[int, Floats | None] = {}
        self._asked = 0  # frame

    @property
    def lost(self) -> bool:
        return bool(getattr(self._inner, "lost", False))

    def start(self, origin_s: float) -> None:
        self._inner.start(origin_s)

    def ask(self, index: int) -> bool:
        """Fetch frame `index` and those before it that were not asked for yet; whether there were any."""
        before, self._asked = self._asked, max(index, self._asked)
        for each in range(before + 1, self._asked + 1):
            self._frames[each] = self._inner.take(each)
            self._frames.pop(each - TOLD_FRAMES, None)
        return self._asked > before

    def newest(self) -> tuple[int, Floats]:
        """The first of the newest frames, and their samples; silence where nothing was said. Of a voice that is to be
        told early they come so much sooner, and the last of them are still to be known: silence.
        """
        indices = range(max(0, self._asked + 1 - TOLD_FRAMES), self._asked + 1)
        frames = [self._frames.get(index) for index in indices]
        samples = np.concatenate([_SILENCE if frame is None else frame for frame in frames])
        return indices[0], np.concatenate([samples[self._early :], _SILENCE[: self._early]])

    def take(self, index: int) -> Floats | None:
        self.ask(index)
        return self._frames.get(index)

    def statistics(self) -> Mapping[str, Any]:
        return self._inner.statistics()

    def close(self) -> None:
        self._inner.close()


class Loudspeaker:
    """`ports.Voice` of what the robot says, where a device records it: late, for nobody can record what is to come.

    Args:
        recorder: the microphone beside which it is recorded, or a recorder of its own.
    """

    duration_s: float | None = None
    latency_s = 0.0

    def __init__(self, recorder: Microphone, beside: bool) -> None:
        self._recorder, self._beside = recorder, beside

    @property
    def lost(self) -> bool:
        return self._recorder.lost

    def start(self, origin_s: float) -> None:
        self._recorder.start(origin_s)

    def take(self, index: int) -> Floats | None:
        """What was recorded one frame before, which came with the microphone's; two before, without a microphone."""
        return self._recorder.said(index - 1) if self._beside else self._recorder.take(index - 2)

    def statistics(self) -> Mapping[str, Any]:
        told = self._recorder.statistics()
        return told.get("reference", {}) if self._beside else told

    def close(self) -> None:
        self._recorder.close()


def open_microphone(argument: str) -> Microphone:
    """What stands behind the colon of `--audio mic[:DEVICE]`: a number, a name or a part of one; "" is the default.

    Blocks until it records, a second. Raises ConfigError for a device that is not there and without PortAudio,
    PortError where there is no microphone or it cannot be opened.
    """
    return _opened(Recording(_by_name(argument, MIC_FLAG), MIC_FLAG))


def open_microphone_beside(argument: str, agent: Voice) -> tuple[Microphone, OwnVoice]:
    """As `open_microphone`, without what `agent` says; and the agent's voice to use instead of `agent`."""
    own = OwnVoice(agent)
    return _opened(Recording(_by_name(argument, MIC_FLAG), MIC_FLAG, told=True), own), own


def open_microphone_and_loudspeaker(argument: str, device: str) -> tuple[Microphone, Loudspeaker]:
    """As `open_microphone`, without what `device` records of the robot's voice; and that voice."""
    names = (_by_name(argument, MIC_FLAG), MIC_FLAG, _by_name(device, DEVICE_FLAG), DEVICE_FLAG)
    microphone = _opened(Recording(*names))
    return microphone, Loudspeaker(microphone, beside=True)


def open_loudspeaker(argument: str) -> Loudspeaker:
    """`--agent-audio device:DEVICE` without a microphone. Raises and blocks as `open_microphone`."""
    return Loudspeaker(_opened(Recording(_by_name(argument, DEVICE_FLAG), DEVICE_FLAG)), beside=False)


def sound_devices(what: Literal["recording", "playing"] = "recording") -> list[SoundDevice]:
    """Devices that record, or those that play. Blocks for a second. Raises ConfigError without PortAudio."""
    worker = SourceWorker("sound devices", tell_devices, what)
    try:
        worker.wait()
        return list(worker.messages(time.monotonic())[0])
    finally:
        worker.close()


def _opened(recording: Recording, agent: OwnVoice | None = None) -> Microphone:
    name = "microphone" if recording.flag == MIC_FLAG else "loudspeaker"
    worker = SourceWorker(name, listen, recording)
    worker.wait()
    microphone = Microphone(worker, agent)
    logger.warning("%s: %s", name, microphone.device)
    return microphone


def _by_name(argument: str, flag: str) -> str:
    """Numbers change when something is plugged in, and the worker may be started again then."""
    return choose_device(sound_devices(), argument, flag).name if argument.isdigit() else argument
