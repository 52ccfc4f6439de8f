"""What `--face webcam` makes of a face that is known: the virtual human's, drawn as a camera sees it.

Every channel goes up and down by itself, with the head straight ahead and turned aside, on pictures with a
camera's noise. Of what comes back, less what comes at rest: does it follow (correlation), how far (slope), what else
moves with it, and how it trembles while nothing moves (standard deviation). Both eyes look together, as people's do.
The drawn face is one face, plain-skinned; people differ from it, and from one another.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.face.drawing import PLACE_M, SIZE_PX, VirtualWebcam
from sfms_robot.frames import BLENDSHAPES, CHANNEL_INDEX, CHANNELS, MOTION_DIM, Doubles, Floats
from sfms_robot.lab.bench.measure import Told, times
from sfms_robot.sources.webcam import Landmarker, Picture, SeenFace, open_webcam

SEEN_CORRELATION: Final = 0.8  # a channel that follows this well, and this far, counts as seen
SEEN_SLOPE: Final = 0.1
PICTURE_HZ: Final = 30
_SHAPE_LEVELS: Final = (1 / 3, 2 / 3, 1.0)
_TURN_LEVELS_RAD: Final = (-0.35, -0.2, -0.1, 0.1, 0.2, 0.35)
_MOVE_LEVELS_M: Final = (-0.1, -0.05, 0.05, 0.1)
_YAWS_RAD: Final = (0.0, 0.15)
_TREMBLE_PICTURES: Final = 20
_NOISE: Final = 4.0  # of 255, 1 sigma
_NOISES: Final = 8  # different ones
_SETTLE: Final = 2  # pictures of one face: MediaPipe follows its landmarks from picture to picture
_TIMED: Final = 100
_VIDEO_S: Final = 4.0
_EYES: Final = {
    "eyeLookOutLeft": "eyeLookInRight", "eyeLookInRight": "eyeLookOutLeft",
    "eyeLookInLeft": "eyeLookOutRight", "eyeLookOutRight": "eyeLookInLeft",
    "eyeLookUpLeft": "eyeLookUpRight", "eyeLookUpRight": "eyeLookUpLeft",
    "eyeLookDownLeft": "eyeLookDownRight", "eyeLookDownRight": "eyeLookDownLeft",
}  # fmt: skip

Row = dict[str, Any]


class _Trial:
    """Shows faces and tells what is seen of them: (58,) motion, then place (3,)."""

    def __init__(self) -> None:
        self._camera, self._landmarker = VirtualWebcam(), Landmarker()
        rng = np.random.default_rng(0)
        self._noises = [rng.normal(0.0, _NOISE, (*SIZE_PX[::-1], 3)).astype(np.float32) for _ in range(_NOISES)]
        self._looked = 0

    def draw(self, motion: Floats, place_m: tuple[float, float, float] = PLACE_M) -> Picture:
        return self._camera.picture(motion, place_m)

    def seen(self, drawn: Picture) -> Doubles:
        """Raises ConfigError where MediaPipe finds no face, since then nothing can be measured."""
        faces: list[SeenFace] = []
        for _ in range(_SETTLE):
            self._looked += 1
            noisy = np.clip(drawn + self._noises[self._looked % _NOISES], 0, 255).astype(np.uint8)
            faces = self._landmarker.faces(noisy, self._looked / PICTURE_HZ)
        if not faces:
            raise ConfigError("bench webcam: MediaPipe sees no face in a picture of the virtual human")
        return np.concatenate([faces[0].motion, faces[0].place_m]).astype(np.float64)

    def close(self) -> None:
        self._landmarker.close()


def face_of(**channels: float) -> Floats:
    """Motion (58,) with these channels; all others are 0."""
    motion = np.zeros(MOTION_DIM, dtype=np.float32)
    for name, value in channels.items():
        motion[CHANNEL_INDEX[name]] = value
    return motion


def webcam(names: Sequence[str] = CHANNELS) -> dict[str, Any]:
    """`channels`, `place` and `timings_ms`. Takes about two minutes of an idle core.

    A channel has correlation, slope, tremble, whether it is seen, and with which other blendshape it moves most and how
    far at its largest; an axis of `place` correlation and slope. Raises MissingExtra without the extras `pictures` and
    `webcam`.
    """
    with closing(_Trial()) as trial:
        channels, place = _followed(trial, names)
    return {"channels": channels, "place": place, "timings_ms": _timings()}


def _followed(trial: _Trial, names: Sequence[str]) -> tuple[dict[str, Row], dict[str, Row]]:
    ahead = trial.draw(face_of())
    still = np.array([trial.seen(ahead) for _ in range(_TREMBLE_PICTURES)])
    rest, tremble = still.mean(axis=0), still.std(axis=0)
    moves = _moves(trial, rest) if set(names) & {"x", "y", "z"} else {}
    rests = {yaw: trial.draw(face_of(yaw=yaw)) for yaw in _YAWS_RAD}
    channels: dict[str, Row] = {}
    for name in names:
        if name in BLENDSHAPES:
            asked, came = _shape(trial, name, rests)
        elif name in moves:
            asked, came = moves[name]
        else:
            asked, came = _turn(trial, name, rest)
        channels[name] = _row(name, asked, came, tremble)
    place = {axis: _fit(*_placed(moves[axis], index)) for index, axis in enumerate("xyz") if axis in moves}
    return channels, place


def _shape(trial: _Trial, name: str, rests: Mapping[float, Picture]) -> tuple[Doubles, Doubles]:
    """A blendshape at several levels and yaws: what was asked (N,), what came beyond rest (N, 61)."""
    asked, came = [], []
    together = [name, _EYES[name]] if name in _EYES else [name]
    for yaw, drawn in rests.items():
        rest = trial.seen(drawn)
        asked.append(0.0)
        came.append(trial.seen(drawn) - rest)
        for level in _SHAPE_LEVELS:
            asked.append(level)
            came.append(trial.seen(trial.draw(face_of(yaw=yaw, **dict.fromkeys(together, level)))) - rest)
    return np.array(asked), np.array(came)


def _turn(trial: _Trial, name: str, rest: Doubles) -> tuple[Doubles, Doubles]:
    came = [trial.seen(trial.draw(face_of(**{name: level}))) - rest for level in _TURN_LEVELS_RAD]
    return np.array(_TURN_LEVELS_RAD), np.array(came)


def _moves(trial: _Trial, rest: Doubles) -> dict[str, tuple[Doubles, Doubles]]:
    """The person moves along an axis of theirs: x towards the camera, y to their own left, z up."""
    out = {}
    for axis, step in (("x", (-1, 0, 0)), ("y", (0, -1, 0)), ("z", (0, 0, 1))):
        places = [tuple(at + level * by for at, by in zip(PLACE_M, step, strict=True)) for level in _MOVE_LEVELS_M]
        came = [trial.seen(trial.draw(face_of(), (place[0], place[1], place[2]))) - rest for place in places]
        out[axis] = np.array(_MOVE_LEVELS_M), np.array(came)
    return out


def _placed(move: tuple[Doubles, Doubles], index: int) -> tuple[Doubles, Doubles]:
    """Asked and come of one axis of `place_m`, whose x and y run against the person's."""
    asked, came = move
    return asked * (-1 if index < 2 else 1), came[:, MOTION_DIM + index]


def _row(name: str, asked: Doubles, came: Doubles, tremble: Doubles) -> Row:
    index = CHANNEL_INDEX[name]
    fit = _fit(asked, came[:, index])
    shapes = came[:, [CHANNEL_INDEX[each] for each in BLENDSHAPES]]
    changes = shapes.T @ asked / (asked @ asked) * np.abs(asked).max()
    own = (name, _EYES.get(name))
    others = {each: float(by) for each, by in zip(BLENDSHAPES, changes, strict=True) if each not in own}
    most = max(others, key=lambda each: abs(others[each]))
    seen = fit["correlation"] >= SEEN_CORRELATION and fit["slope"] >= SEEN_SLOPE
    return {**fit, "tremble": float(tremble[index]), "with": most, "with_change": others[most], "seen": seen}


def _fit(asked: Doubles, came: Doubles) -> Row:
    """Correlation, 0 where nothing came at all, and slope of the line through both means."""
    centred, follows = asked - asked.mean(), came - came.mean()
    spread = float(np.sqrt((centred @ centred) * (follows @ follows)))
    along = float(centred @ follows)
    return {"correlation": along / spread if spread else 0.0, "slope": along / float(centred @ centred)}


# --- time ---------------------------------------------------------------------------------------------------------


def _timings() -> dict[str, Any]:
    """Per picture with one and with three faces looked for; and picture -> sighting of a video in its own process."""
    pictures = list(_nodding())
    stream = iter(range(1_000_000))
    out: dict[str, Any] = {}
    for most_faces in (1, 3):
        landmarker = Landmarker(most_faces)
        ms = times(_look(landmarker, pictures, stream), _TIMED)
        out[f"landmarks_of_{most_faces}"] = {"p50": float(np.median(ms)), "p99": float(np.percentile(ms, 99))}
        landmarker.close()
    out["picture_to_sighting"] = _latency(pictures)
    return out


def _nodding(hz: int = PICTURE_HZ, seconds: float = _VIDEO_S) -> Iterator[Picture]:
    """A person who nods once a second."""
    camera = VirtualWebcam()
    once = [camera.picture(face_of(pitch=0.1 * float(np.sin(2 * np.pi * k / hz)))) for k in range(hz)]
    for k in range(round(seconds * hz)):
        yield once[k % hz]


def _look(landmarker: Landmarker, pictures: Sequence[Picture], stream: Iterator[int]) -> Callable[[], object]:
    def look() -> object:
        number = next(stream)
        return landmarker.faces(pictures[number % len(pictures)], number / PICTURE_HZ)

    return look


def write_video(file: Path, pictures: Sequence[Picture], hz: int = PICTURE_HZ) -> None:
    """Motion JPEG of pictures (H, W, 3), red, green, blue."""
    import cv2

    high, wide = pictures[0].shape[:2]
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), hz, (wide, high))
    for picture in pictures:
        writer.write(picture[..., ::-1])
    writer.release()


def _latency(pictures: Sequence[Picture]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "nods.avi"
        write_video(file, pictures)
        webcam = open_webcam(str(file))
        try:
            origin_s = time.monotonic()
            webcam.start(origin_s)
            while webcam.statistics()["state"] != "finished":
                webcam.at(time.monotonic() - origin_s)
                time.sleep(0.01)
            out: dict[str, Any] = webcam.statistics()["latency_ms"]
            return out
        finally:
            webcam.close()


def measure() -> Told:
    """`webcam`, as `bench` tells it."""
    result = webcam()
    times = [f"{name}: {ms['p50']:.1f} ms (p99 {ms['p99']:.1f})" for name, ms in result["timings_ms"].items()]
    return Told(result, table(result), times)


def table(result: Mapping[str, Any]) -> list[Row]:
    """A row per channel, for people."""
    rows = []
    for name, row in result["channels"].items():
        beside = f"{row['with']} {row['with_change']:+.2f}" if abs(row["with_change"]) >= SEEN_SLOPE else "-"
        figures = {key: round(row[key], 3) for key in ("correlation", "slope", "tremble")}
        rows.append({"channel": name, **figures, "moves also": beside, "seen": "yes" if row["seen"] else "no"})
    return rows
