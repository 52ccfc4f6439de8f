"""A person's face from a webcam: `--face webcam[:N|FILE][,flip=...]`.

Camera and MediaPipe are in a process of their own (`webcam_worker`), which is started again when the camera goes away.
Without a face in the picture nothing new is told: the last one ages, and whoever asks judges how old is too old.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from sfms_robot.errors import ConfigError
from sfms_robot.frames import Sighting
from sfms_robot.signals.quantiles import Quantiles
from sfms_robot.sources.live_face import LiveFace, parse_face_argument
from sfms_robot.sources.webcam_worker import Opened, Seen, watch
from sfms_robot.sources.worker import SourceWorker

_NICE: Final = 5  # below the servo loop


class Webcam:
    """`ports.Sight` of the worker `watch`. Only `close` blocks."""

    def __init__(self, worker: SourceWorker, face: LiveFace, duration_s: float | None) -> None:
        self._worker, self._face, self.duration_s = worker, face, duration_s
        self._origin_s: float | None = None
        self._counts = dict.fromkeys(("pictures", "without_face", "dark", "with_others"), 0)
        self._latency_ms = Quantiles()

    @property
    def lost(self) -> bool:
        """The camera is away, or its process."""
        return self._worker.lost

    @property
    def latency_s(self) -> float:
        """Median from a picture taken to its face known; 0 before the first picture."""
        return self._latency_ms.at(50) / 1e3 if len(self._latency_ms) else 0.0

    def start(self, origin_s: float) -> None:
        self._origin_s = origin_s
        self._face.start(origin_s)
        self._worker.tell(origin_s)

    def at(self, time_s: float) -> Sighting | None:
        if self._origin_s is None:
            return None
        for message in self._worker.messages(self._origin_s + time_s):
            if isinstance(message, Seen):
                self._take(message)
        return self._face.at(time_s)

    def statistics(self) -> Mapping[str, Any]:
        """What the worker tells; pictures, of these without a face, dark, and with other people in them; latency."""
        return {
            **self._worker.statistics(),
            **self._counts,
            "latency_ms": self._latency_ms.report(p50=50, p99=99),
        }

    def close(self) -> None:
        self._worker.close()

    def _take(self, seen: Seen) -> None:
        if self._origin_s is None or seen.taken_s < self._origin_s:
            return
        self._counts["pictures"] += 1
        self._counts["without_face"] += seen.face is None
        self._counts["dark"] += seen.dark
        self._counts["with_others"] += seen.others > 0
        self._latency_ms.add((seen.known_s - seen.taken_s) * 1e3)
        if seen.face is not None:
            self._face.put(seen.taken_s, seen.face.motion, seen.face.place_m)


def open_webcam(argument: str) -> Webcam:
    """What stands behind the colon of `--face webcam[:N|FILE]`: a camera's number (default 0) or a recorded video.

    Blocks until it is open and MediaPipe is loaded, a few seconds. Raises ConfigError for what is neither, for a file
    that is no video and (MissingExtra) without the extra `webcam`; PortError for a camera that cannot be opened.
    """
    given = parse_face_argument("webcam", argument)
    place = given.place
    if not place.isdigit() and place and not Path(place).is_file():
        raise ConfigError(f"--face webcam:{place}: no such file, nor the number of a camera (0, 1, ...)")
    source = str(Path(place).absolute()) if place and not place.isdigit() else place or "0"
    worker = SourceWorker(f"webcam {place or 0}", watch, source, nice=_NICE)
    worker.wait()
    opened = worker.messages(0.0)[0]
    return Webcam(worker, LiveFace(given.signs), opened.duration_s if isinstance(opened, Opened) else None)
