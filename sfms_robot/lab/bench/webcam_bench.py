"""`bench webcam`: the output of `--face webcam` for a known face, the virtual human's, drawn as a camera sees it.

Every channel moves up and down separately, with the head straight ahead and turned aside, on pictures with the noise of
a camera. The bench reports, relative to rest: how well the channel follows (correlation), how far (slope), which other
channel moves with it, and the tremble at rest (standard deviation). Both eyes look together, as people's do. The drawn
face is one plain-skinned face; people differ from it, and from one another.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Final

import numpy as np
from scipy.stats import linregress

from sfms_robot.errors import ConfigError
from sfms_robot.face.drawing import PLACE_M, SIZE_PX, VirtualWebcam
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, CHANNELS, MOTION_DIM, Doubles, Floats
from sfms_robot.lab import Figures
from sfms_robot.lab.bench.measure import BenchResult, Row, Rows, percentiles, times
from sfms_robot.sources.webcam import Landmarker, Picture, SeenFace, open_webcam

SEEN_CORRELATION: Final = 0.8  # a channel counts as seen from this correlation and this slope on
SEEN_SLOPE: Final = 0.1
_PICTURE_HZ: Final = 30
_SHAPE_LEVELS: Final = (0.0, 1 / 3, 2 / 3, 1.0)
_TURN_LEVELS_RAD: Final = (-0.35, -0.2, -0.1, 0.1, 0.2, 0.35)
_MOVE_LEVELS_M: Final = (-0.1, -0.05, 0.05, 0.1)
_MOVES: Final = {"x": (-1, 0, 0), "y": (0, -1, 0), "z": (0, 0, 1)}  # x to the camera, y to the person's left, z up
_YAWS_RAD: Final = (0.0, 0.15)
_TREMBLE_PICTURES: Final = 20
_NOISE: Final = 4.0  # of 255, 1 sigma
_NOISES: Final = 8  # different pictures of noise
_SETTLE: Final = 2  # pictures of one face: MediaPipe tracks its landmarks from picture to picture
_TIMED: Final = 100
_VIDEO_S: Final = 4.0
_EYES: Final = {
    "eyeLookOutLeft": "eyeLookInRight", "eyeLookInRight": "eyeLookOutLeft",
    "eyeLookInLeft": "eyeLookOutRight", "eyeLookOutRight": "eyeLookInLeft",
    "eyeLookUpLeft": "eyeLookUpRight", "eyeLookUpRight": "eyeLookUpLeft",
    "eyeLookDownLeft": "eyeLookDownRight", "eyeLookDownRight": "eyeLookDownLeft",
}  # fmt: skip


class _Sight:
    """A virtual camera that draws faces, with MediaPipe that measures them: motion (58,), then place (3,)."""

    def __init__(self) -> None:
        self._camera, self._landmarker = VirtualWebcam(), Landmarker()
        rng = np.random.default_rng(0)
        self._noises = [rng.normal(0.0, _NOISE, (*SIZE_PX[::-1], 3)).astype(np.float32) for _ in range(_NOISES)]
        self._looked = 0

    def draw(self, motion: Floats, place_m: tuple[float, float, float] = PLACE_M) -> Picture:
        return self._camera.picture(motion, place_m)

    def seen(self, drawn: Picture) -> Doubles:
        """Return motion and place (61,). Raises ConfigError if MediaPipe finds no face: no measurement is possible."""
        faces: list[SeenFace] = []
        for _ in range(_SETTLE):
            self._looked += 1
            noisy = np.clip(drawn + self._noises[self._looked % _NOISES], 0, 255).astype(np.uint8)
            faces = self._landmarker.faces(noisy, self._looked / _PICTURE_HZ)
        if not faces:
            raise ConfigError("bench webcam: MediaPipe sees no face in a picture of the virtual human")
        return np.concatenate([faces[0].motion, faces[0].place_m]).astype(np.float64)

    def close(self) -> None:
        self._landmarker.close()


def measure() -> BenchResult:
    """Measure every channel; takes about two minutes of an idle core."""
    result = webcam()
    table = []
    for name, found in result["channels"].items():
        beside = f"{found['with']} {found['with_change']:+.2f}" if abs(found["with_change"]) >= SEEN_SLOPE else "-"
        figures = {key: round(found[key], 3) for key in ("correlation", "slope", "tremble")}
        table.append({"channel": name, **figures, "moves also": beside, "seen": "yes" if found["seen"] else "no"})
    lines = [f"{name}: {ms['p50']:.1f} ms (p99 {ms['p99']:.1f})" for name, ms in result["timings_ms"].items()]
    return BenchResult(result, table, lines)


def webcam(names: Sequence[str] = CHANNELS) -> Figures:
    """Return `channels`, `place` and `timings_ms`.

    A channel has correlation, slope, tremble, whether it counts as seen, and the other blendshape that moves most with
    it, with its change at the largest level; an axis of `place` has correlation and slope. Raises MissingExtra without
    the extras `pictures` and `webcam`.
    """
    with closing(_Sight()) as sight:
        channels, place = _followed(sight, names)
    return {"channels": channels, "place": place, "timings_ms": _timings()}


def face_of(**channels: float) -> Floats:
    """Return motion (58,) with these channels; all others are 0."""
    motion = np.zeros(MOTION_DIM, dtype=np.float32)
    for name, value in channels.items():
        motion[CHANNEL_INDEX[name]] = value
    return motion


def _followed(sight: _Sight, names: Sequence[str]) -> tuple[Rows, Rows]:
    ahead = sight.draw(face_of())
    still = np.array([sight.seen(ahead) for _ in range(_TREMBLE_PICTURES)])
    rest, tremble = still.mean(axis=0), still.std(axis=0)
    rests = {yaw: sight.draw(face_of(yaw=yaw)) for yaw in _YAWS_RAD}
    channels: Rows = {}
    place: Rows = {}
    for name in names:
        if name in BLENDSHAPES:
            asked = np.tile(_SHAPE_LEVELS, len(rests))
            together, seen = [name, _EYES[name]] if name in _EYES else [name], []
            for yaw, drawn in rests.items():
                turned = sight.seen(drawn)
                seen.append(sight.seen(drawn) - turned)
                for level in _SHAPE_LEVELS[1:]:
                    seen.append(sight.seen(sight.draw(face_of(yaw=yaw, **dict.fromkeys(together, level)))) - turned)
            came = np.array(seen)
        elif name in _MOVES:
            asked = np.array(_MOVE_LEVELS_M)
            spots = np.array(PLACE_M) + np.multiply.outer(asked, _MOVES[name])
            came = np.array([sight.seen(sight.draw(face_of(), (spot[0], spot[1], spot[2]))) - rest for spot in spots])
            axis = "xyz".index(name)  # x and y of `place_m` have the opposite direction of the person's
            place[name] = _fit(asked if name == "z" else -asked, came[:, MOTION_DIM + axis])
        else:
            asked = np.array(_TURN_LEVELS_RAD)
            came = np.array([sight.seen(sight.draw(face_of(**{name: level}))) - rest for level in _TURN_LEVELS_RAD])
        index, own = CHANNEL_INDEX[name], (name, _EYES.get(name))
        fit = _fit(asked, came[:, index])
        changes = (
            came[:, [CHANNEL_INDEX[each] for each in BLENDSHAPES]].T @ asked / (asked @ asked) * np.abs(asked).max()
        )
        others = {each: float(by) for each, by in zip(BLENDSHAPES, changes, strict=True) if each not in own}
        most = max(others, key=lambda each: abs(others[each]))
        channels[name] = {
            **fit,
            "tremble": float(tremble[index]),
            "with": most,
            "with_change": others[most],
            "seen": fit["correlation"] >= SEEN_CORRELATION and fit["slope"] >= SEEN_SLOPE,
        }
    return channels, place


def _fit(asked: Doubles, came: Doubles) -> Row:
    """Return correlation and slope; 0 for both if `came` is constant."""
    if not np.ptp(came):
        return {"correlation": 0.0, "slope": 0.0}
    line = linregress(asked, came)
    return {"correlation": float(line.rvalue), "slope": float(line.slope)}


# --- time -----------------------------------------------------------------------------------------------------------


def _timings() -> Figures:
    """Measure landmarks of a picture for at most one and three faces, and picture to sighting in a child process."""
    camera = VirtualWebcam()  # a person who nods once a second
    once = [camera.picture(face_of(pitch=0.1 * float(np.sin(2 * np.pi * k / _PICTURE_HZ)))) for k in range(_PICTURE_HZ)]
    pictures = [once[k % _PICTURE_HZ] for k in range(round(_VIDEO_S * _PICTURE_HZ))]
    numbers = iter(range(1_000_000))
    out: Figures = {}
    for most_faces in (1, 3):
        with closing(Landmarker(most_faces)) as landmarker:

            def look(landmarker: Landmarker = landmarker) -> object:
                number = next(numbers)
                return landmarker.faces(pictures[number % len(pictures)], number / _PICTURE_HZ)

            out[f"landmarks_of_{most_faces}"] = percentiles(times(look, _TIMED))
    return out | {"picture_to_sighting": _latency(pictures)}


def write_video(file: Path, pictures: Sequence[Picture], hz: int = _PICTURE_HZ) -> None:
    """Write Motion JPEG of pictures (H, W, 3), red, green, blue."""
    import cv2

    high, wide = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), hz, (wide, high))
    for picture in pictures:
        writer.write(picture[..., ::-1])
    writer.release()


def _latency(pictures: Sequence[Picture]) -> Figures:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "nods.avi"
        write_video(file, pictures)
        with closing(open_webcam(str(file))) as webcam:
            origin_s = time.monotonic()
            webcam.start(origin_s)
            while webcam.statistics()["state"] != "finished":
                webcam.at(time.monotonic() - origin_s)
                time.sleep(0.01)
            found: Figures = webcam.statistics()["latency_ms"]
            return found
