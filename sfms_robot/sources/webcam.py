"""A person's face from a webcam: `--face webcam[:N|FILE][,flip=...]`.

Camera and MediaPipe run in a separate process (`watch`), which is started again when the camera is lost. No picture is
kept, and none leaves that process. MediaPipe (extra `webcam`) finds up to three faces in each picture; the person among
them is chosen here (`choose`). A picture's time is the driver's time stamp if that is on this computer's clock, else
its arrival. A recorded video is played at its own pace from loop time 0 on; late pictures are left out. A picture
without a face reports no new face: the last one ages.
"""

from __future__ import annotations

import importlib.util
import os
import time
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.data import data_dir
from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError, PortError, optional
from sfms_robot.frames import BLENDSHAPES, Floats, Reals, Sighting
from sfms_robot.ports import Facts
from sfms_robot.signals.quantiles import Quantiles
from sfms_robot.signals.rotations import FROM_CAMERA, camera_angles
from sfms_robot.sources.live_face import LiveFace, parse_face_argument
from sfms_robot.sources.worker import SourceWorker

_NICE: Final = 5  # lower priority than the servo loop
MOST_FACES: Final = 3
_PICTURE_PX: Final = (640, 480)  # requested from a camera; a larger picture adds nothing to a face at arm's length
_DARK: Final = 16  # mean of 0..255 below which the lens is covered or the room has no light
_OLDEST_S: Final = 0.5  # an older time stamp of a driver comes from another clock
_ALIVE_S: Final = 0.02
# Point between the eyes, in the axes and centimetres of the matrix: mean of the corners of both eyes (points 33, 133,
# 362 and 263) in `canonical_face_model.obj` of google-ai-edge/mediapipe.
_EYES_CM: Final = (0.0, 2.62, 3.47, 1.0)


NEARER: Final = 0.8  # share of the chosen face's distance below which another face is clearly nearer
TAKE_OVER_S: Final = 1.0  # time without a break for which another face has to be clearly nearer
GONE_S: Final = 0.5  # a face that has not been seen for this long is gone
STEP: Final = 0.25  # largest move of a face from one picture to the next, as a share of its distance

Picture = NDArray[np.uint8]  # (H, W, 3) red, green, blue


@dataclass(frozen=True)
class SeenFace:
    """One face in one picture.

    Attributes:
        motion: (58,) pose in the person's axes (x forward, measured from the lens, so negative), blendshapes.
        place_m: (3,) point between the eyes in the camera's frame: x out of its lens, y to its left, z up.
    """

    motion: Floats
    place_m: Floats


@dataclass(frozen=True)
class WebcamOpened:
    """The first message of `watch`. `duration_s`: length of a recorded video; None for a camera."""

    duration_s: float | None


@dataclass(frozen=True, kw_only=True)
class SeenPicture:
    """The faces found in one picture.

    Attributes:
        taken_s, known_s: times of `time.monotonic` at which it was taken and its face was known.
        face: face of the person, or None.
        others: number of other faces.
        dark: True if the picture was black.
    """

    taken_s: float
    known_s: float
    face: SeenFace | None
    others: int
    dark: bool


class Landmarker:
    """MediaPipe's Face Landmarker over a stream of pictures. Creating one takes a second. Raises MissingExtra."""

    def __init__(self, most_faces: int = MOST_FACES) -> None:
        need_extra()
        import mediapipe
        from mediapipe.tasks.python import BaseOptions, vision

        self._mediapipe = mediapipe
        model = data_dir("sim") / "face_landmarker" / "face_landmarker.task"
        self._landmarker = vision.FaceLandmarker.create_from_options(
            vision.FaceLandmarkerOptions(
                base_options=BaseOptions(model_asset_path=str(model)),
                running_mode=vision.RunningMode.VIDEO,
                num_faces=most_faces,
                output_face_blendshapes=True,
                output_facial_transformation_matrixes=True,
            )
        )
        self._last_ms = -1

    def faces(self, picture: Picture, taken_s: float) -> list[SeenFace]:
        """Return the faces in the next picture of the stream."""
        self._last_ms = max(self._last_ms + 1, round(taken_s * 1e3))  # MediaPipe requires increasing times
        image = self._mediapipe.Image(image_format=self._mediapipe.ImageFormat.SRGB, data=picture)
        found = self._landmarker.detect_for_video(image, self._last_ms)
        return [
            seen_face(matrix, {shape.category_name: shape.score for shape in shapes})
            for matrix, shapes in zip(found.facial_transformation_matrixes, found.face_blendshapes, strict=True)
        ]

    def close(self) -> None:
        self._landmarker.close()


def watch(argument: str) -> Generator[WebcamOpened | SeenPicture | None, float | None, None]:
    """Watch a camera (`argument` is its number) or a recorded video (its file); see `sources.worker`.

    Detection begins when loop time 0 is known, at which a video begins. Raises MissingExtra, ConfigError for a file
    that is not a video, PortError for a camera that cannot be opened or that is lost.
    """
    need_extra()
    video = None if argument.isdigit() else argument
    capture = open_video(argument) if video else open_camera(whole_number(argument))
    taken = None if video else live(capture, argument)
    with closing(Landmarker()) as landmarker:
        begins_s = yield WebcamOpened(_duration_s(capture) if video else None)
        while begins_s is None:
            if taken is None:
                time.sleep(_ALIVE_S)
            else:
                next(taken)
            begins_s = yield None
        before: Choice | None = None
        for taken_s, picture in taken or played(capture, begins_s):
            if picture is None:
                yield None
                continue
            faces = landmarker.faces(picture, taken_s)
            index, before = choose([face.place_m for face in faces], taken_s, before)
            face = None if index is None else faces[index]
            dark = not faces and float(picture.mean()) < _DARK
            others = len(faces) - (face is not None)
            yield SeenPicture(taken_s=taken_s, known_s=time.monotonic(), face=face, others=others, dark=dark)


def need_extra() -> None:
    """Raise MissingExtra if MediaPipe is not installed."""
    with optional("--face webcam"):
        if importlib.util.find_spec("mediapipe") is None:
            raise ModuleNotFoundError(name="mediapipe")


def open_camera(number: int) -> Any:
    """Open camera `number` of this computer. Raises PortError with the likely reason."""
    import cv2

    capture = cv2.VideoCapture(number)
    if not capture.isOpened():
        raise PortError(f"--face webcam: no camera {number} ({_why_not(number)})")
    for key, value in zip((cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT), _PICTURE_PX, strict=True):
        capture.set(key, value)
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # old pictures are useless
    return capture


def open_video(file: str) -> Any:
    """Open a recorded video. Raises ConfigError for a file that is not a video."""
    import cv2

    capture = cv2.VideoCapture(file)
    if not capture.isOpened() or not capture.get(cv2.CAP_PROP_FPS) > 0:
        raise ConfigError(f"--face webcam:{file}: not a video that can be played")
    return capture


def live(capture: Any, name: str) -> Iterator[tuple[float, Picture]]:
    """Yield the times at which pictures of a camera were taken, and the pictures. Raises PortError if it is lost."""
    import cv2

    while True:
        if not capture.grab():
            raise PortError(f"camera {name} went away")
        came_s = time.monotonic()
        stamped_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1e3
        found, picture = capture.retrieve()
        if found:
            yield stamped_s if 0 <= came_s - stamped_s < _OLDEST_S else came_s, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def played(capture: Any, begins_s: float) -> Iterator[tuple[float, Picture | None]]:
    """Yield the times and pictures of a video at its own pace, without late ones; None while waiting for the next."""
    import cv2

    period_s = 1.0 / capture.get(cv2.CAP_PROP_FPS)
    number = 0
    while capture.grab():
        due_s, number = begins_s + number * period_s, number + 1
        if time.monotonic() - due_s > period_s:
            continue
        while (wait_s := due_s - time.monotonic()) > 0:
            yield due_s, None
            time.sleep(min(wait_s, _ALIVE_S))
        found, picture = capture.retrieve()
        if found:
            yield due_s, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)


def _duration_s(capture: Any) -> float | None:
    """Return the length of a video; None if the file does not contain it."""
    import cv2

    pictures = float(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    return pictures / float(capture.get(cv2.CAP_PROP_FPS)) if pictures > 0 else None


def _why_not(number: int) -> str:
    """Return the likely reason why a camera cannot be opened, from the device files of Linux."""
    device = Path(f"/dev/video{number}")
    if device.exists():
        if not os.access(device, os.R_OK | os.W_OK):
            return f"no permission for {device}: sudo usermod -aG video $USER, then log in again"
        return f"{device} is there: another program may hold it, or it gives no pictures"
    others = sorted(path.name.removeprefix("video") for path in Path("/dev").glob("video[0-9]*"))
    return f"there are {', '.join(others)}" if others else "none is plugged in"


# --- one face in the units of this project ------------------------------------------------------------------------
#
# MediaPipe returns 52 blendshapes by name, with `_neutral` and without `tongueOut`; left and right are the person's own
# in a picture that is not mirrored. It also returns a matrix face -> camera: x to the picture's right, y up, z towards
# the viewer, centimetres. With x forward = z, y left = x, z up = y its rotation is our Rz(yaw) Ry(pitch) Rx(roll),
# signs included.
#
# The distance is computed from the face's size for a lens of 63 degrees across the picture's height and a face of
# average size. So it is relative: with a lens of 45 degrees people seem about a third too near. Sideways and up are not
# affected, because there the lens cancels out.


def seen_face(matrix: Reals, shapes: Mapping[str, float]) -> SeenFace:
    """Return a face from its `matrix` (4, 4) face -> camera and its `shapes` by MediaPipe's names, 0 if missing."""
    pose = (*camera_angles(matrix), *matrix[FROM_CAMERA, 3] / 100.0)
    eyes_m = (matrix @ np.array(_EYES_CM))[:3] / 100.0
    return SeenFace(
        np.array([*pose, *(shapes.get(name, 0.0) for name in BLENDSHAPES)], dtype=np.float32),
        np.array([-eyes_m[2], -eyes_m[0], eyes_m[1]], dtype=np.float32),
    )


# --- which of several faces is the person -------------------------------------------------------------------------
#
# The nearest face is the person, but the choice must not change with every small movement. A chosen face stays chosen
# while it is seen. Another face takes its place only when it has been clearly nearer for a while, or when the chosen
# one is gone. A face is recognized by its place, because it does not jump between two pictures.


@dataclass(frozen=True)
class Choice:
    """The person chosen so far: place and time when last seen, and since when another face is clearly nearer."""

    place_m: Floats
    seen_s: float
    rival_since_s: float | None = None


def choose(places_m: Sequence[Floats], time_s: float, before: Choice | None) -> tuple[int | None, Choice | None]:
    """Return the index of the person among faces at places (3,) from the camera, None without one; and the choice.

    `before`: the choice of the last picture, None at first. The order of the faces does not matter.
    """
    same = _same(places_m, before)
    if before is not None and same is None and time_s - before.seen_s < GONE_S:
        return None, replace(before, rival_since_s=None)
    if not places_m:
        return None, None
    distances_m = [float(np.linalg.norm(place)) for place in places_m]
    nearest = int(np.argmin(distances_m))
    if before is None or same is None:
        return nearest, Choice(places_m[nearest], time_s)
    if distances_m[nearest] >= NEARER * distances_m[same]:
        return same, Choice(places_m[same], time_s)
    since_s = time_s if before.rival_since_s is None else before.rival_since_s
    if time_s - since_s < TAKE_OVER_S:
        return same, Choice(places_m[same], time_s, since_s)
    return nearest, Choice(places_m[nearest], time_s)


def _same(places_m: Sequence[Floats], before: Choice | None) -> int | None:
    """Return the index of the face at the place of the chosen one, or None."""
    if before is None or not places_m:
        return None
    steps_m = [float(np.linalg.norm(place - before.place_m)) for place in places_m]
    same = int(np.argmin(steps_m))
    return same if steps_m[same] <= STEP * float(np.linalg.norm(before.place_m)) else None


# --- the run's side --------------------------------------------------------------------------------------------------


class Webcam(LiveFace):
    """A `ports.Sight` of the faces from the worker `watch`. Only `close` blocks.

    Attributes:
        lost: True while the camera or its process is lost.
        latency_s: median time from taking a picture to knowing its face; 0 before the first picture.
    """

    def __init__(self, worker: SourceWorker, signs: Floats, duration_s: float | None) -> None:
        super().__init__(signs)
        self._worker, self.duration_s = worker, duration_s
        self._started = False
        self._counts = dict.fromkeys(("pictures", "without_face", "dark", "with_others"), 0)
        self._latency_ms = Quantiles()

    def start(self, origin_s: float) -> None:
        super().start(origin_s)
        self._started = True
        self._worker.tell(origin_s)

    def at(self, time_s: float) -> Sighting | None:
        if not self._started:
            return None
        for message in self._worker.messages(self._origin_s + time_s):
            if isinstance(message, SeenPicture):
                self._take(message)
        self.lost = self._worker.lost
        return super().at(time_s)

    def statistics(self) -> Facts:
        """Return the worker's state, the latency, and counts of pictures: all, without a face, dark, with others."""
        return {**self._worker.statistics(), **self._counts, "latency_ms": self._latency_ms.report(p50=50, p99=99)}

    def close(self) -> None:
        self._worker.close()

    def _take(self, seen: SeenPicture) -> None:
        if seen.taken_s < self._origin_s:
            return
        self._counts["pictures"] += 1
        self._counts["without_face"] += seen.face is None
        self._counts["dark"] += seen.dark
        self._counts["with_others"] += seen.others > 0
        self._latency_ms.add((seen.known_s - seen.taken_s) * 1e3)
        self.latency_s = self._latency_ms.at(50) / 1e3
        if seen.face is not None:
            self.put(seen.taken_s, seen.face.motion, seen.face.place_m)


def open_webcam(argument: str) -> Webcam:
    """Open `--face webcam[:N|FILE]`: a camera's number (default 0) or a recorded video.

    Blocks until it is open and MediaPipe is loaded, a few seconds. Raises ConfigError for an argument that is neither,
    for a file that is not a video and (MissingExtra) without the extra `webcam`; PortError for a camera that cannot be
    opened.
    """
    place, signs = parse_face_argument("webcam", argument)
    if not place.isdigit() and place and not Path(place).is_file():
        raise ConfigError(f"--face webcam:{place}: no such file, nor the number of a camera (0, 1, ...)")
    source = str(Path(place).absolute()) if place and not place.isdigit() else place or "0"
    worker = SourceWorker(f"webcam {place or 0}", watch, source, nice=_NICE)
    worker.wait()
    return Webcam(worker, signs, worker.messages(time.monotonic())[0].duration_s)
