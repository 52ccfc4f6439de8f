"""A listener without a robot: 40 ms frames of a person in, a plan out every `hop` frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.errors import InputError
from sfms_robot.frames import FRAME_HZ, FRAME_SAMPLES, MOTION_DIM, NO_SOUND, FaceFrame, Floats, Plan, SpeakerFrame
from sfms_robot.listeners.engine import EngineName
from sfms_robot.ports import Listener
from sfms_robot.signals.audio import check_scale
from sfms_robot.signals.face_units import beyond


def load_listener(name: str | Path, engine: EngineName = "auto") -> LoadedListener:
    """Load a listener by shipped name, folder, or the name under which another package registers its own.

    `engine`: "onnx" or "torch"; "auto": onnxruntime if the listener has graphs for it, as shipped listeners do. Blocks
    while engine and weights load: half a second, two seconds with torch. Raises ConfigError, ModelError.
    """
    from sfms_robot.listeners import registry  # imports an engine

    return LoadedListener(registry.load_listener(name, engine=engine))


class LoadedListener:
    """Weights and the pure functions of a `Listener`; `stream` keeps the state of a conversation.

    Attributes:
        hop: a new plan is made every `hop` frames.
        horizon: frames in a plan.
    """

    def __init__(self, listener: Listener) -> None:
        self._listener = listener
        self.hop, self.horizon = listener.hop, listener.horizon

    def start(self, seed: int) -> Any:
        """Return the memory of a new stream."""
        return self._listener.start(seed)

    def step(self, speaker: SpeakerFrame, memory: Any) -> tuple[Plan | None, Any]:
        """Return a plan or None, and the memory after a frame: see `Listener`."""
        return self._listener.step(speaker, memory)

    def stream(self, seed: int = 0) -> ListenerStream:
        """Return a conversation that begins now. Streams of one listener are independent."""
        return ListenerStream(self, seed)


class ListenerStream:
    """A conversation with one person. Its time is that of the pushed frames: frame i ends at (i + 1) x 40 ms.

    Only one thread at a time may use it.
    """

    def __init__(self, listener: Listener, seed: int) -> None:
        self._listener = listener
        self._memory = listener.start(seed)
        self._frames = 0

    @property
    def time_s(self) -> float:
        """End of the last frame pushed."""
        return self._frames / FRAME_HZ

    def push(
        self, audio: ArrayLike | None, face: FaceFrame | ArrayLike | None = None, agent_audio: ArrayLike | None = None
    ) -> Plan | None:
        """Process the next 40 ms; return a plan on every `hop`-th frame, else None.

        Blocks while the listener computes. A frame that is refused changes nothing.

        Args:
            audio: (640,) mono 16 kHz, -1..1; None or empty without a microphone.
            face: the person's face at the end of the frame, as (58,) motion or a FaceFrame; None if it is not seen.
            agent_audio: (640,) the robot's own speech during the next frame; None when it does not speak.

        Raises InputError for a wrong number of samples or channels, and for values in wrong units or not finite.
        """
        time_s = (self._frames + 1) / FRAME_HZ
        said = None if agent_audio is None else _checked("agent_audio", agent_audio)
        heard = NO_SOUND if audio is None else _checked("audio", audio)
        seen: FaceFrame | None = None
        if face is not None:
            motion = _checked("face", face.motion if isinstance(face, FaceFrame) else face)
            seen = FaceFrame(time_s, motion[:6], motion[6:], getattr(face, "jaw_rad", None))
        plan, self._memory = self._listener.step(SpeakerFrame(time_s, heard, seen, said), self._memory)
        self._frames += 1
        return plan


def _checked(name: str, values: ArrayLike) -> Floats:
    found = np.asarray(values, np.float32)
    size, what = (MOTION_DIM, "pose 6 and blendshapes 52") if name == "face" else (FRAME_SAMPLES, "40 ms, mono, 16 kHz")
    if found.shape != (size,) and (name == "face" or found.shape != (0,)):
        raise InputError(f"{name}: expected shape ({size},) ({what}), got {found.shape}")
    if not np.isfinite(found).all():
        raise InputError(f"{name}[{int(np.argmin(np.isfinite(found)))}] is not finite")
    if name != "face":
        check_scale(name, found)
    elif problem := beyond(found):
        raise InputError(f"face: {problem}")
    return found
