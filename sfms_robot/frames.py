"""The values that the parts of the program exchange, and the table of channel names.

Axes are ROS REP-103: x forward, y left, z up. Roll + = right ear down, pitch + = nose down, yaw + = turn to
the head's own left; R = Rz(yaw) Ry(pitch) Rx(roll). Left and right are the head's own, as in ARKit.
Radians, metres and seconds throughout. A *motion* array is (..., 58): pose 6, then blendshapes 52.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Reals = NDArray[np.floating]  # floats of either precision
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Indices = NDArray[np.intp]
Value = TypeVar("Value")

FRAME_HZ: Final = 25
FRAME_S: Final = 1.0 / FRAME_HZ
AUDIO_HZ: Final = 16_000
FRAME_SAMPLES: Final = AUDIO_HZ // FRAME_HZ  # 640
NO_SOUND: Final = np.zeros(0, np.float32)
SILENCE: Final = np.zeros(FRAME_SAMPLES, np.float32)
SILENCE.flags.writeable = False

POSE_CHANNELS: Final = ("roll", "pitch", "yaw", "x", "y", "z")
LATERAL_POSE: Final = ("roll", "yaw", "y")  # pose channels whose sign a mirror image reverses

# The order of Apple's ARKit header (eyes, jaw, mouth, brows, cheeks, nose, tongue).
_APPLE: Final = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeSquintLeft",
    "eyeWideLeft",
    "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight", "eyeLookOutRight", "eyeLookUpRight", "eyeSquintRight",
    "eyeWideRight",
    "jawForward", "jawLeft", "jawRight", "jawOpen",
    "mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight", "mouthSmileLeft", "mouthSmileRight",
    "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft", "mouthDimpleRight", "mouthStretchLeft",
    "mouthStretchRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft",
    "mouthPressRight", "mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight",
    "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight",
    "cheekPuff", "cheekSquintLeft", "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut",
)  # fmt: skip

# ARKit names, alphabetical with tongueOut last: also FaceVerse's working order (identity permutation).
BLENDSHAPES: Final = (*sorted(_APPLE[:-1]), "tongueOut")
CHANNELS: Final = POSE_CHANNELS + BLENDSHAPES
CHANNEL_INDEX: Final[Mapping[str, int]] = {name: index for index, name in enumerate(CHANNELS)}
POSE: Final = slice(0, 6)
SHAPES: Final = slice(6, 58)
MOTION_DIM: Final = len(CHANNELS)  # 58
NEUTRAL: Final = np.zeros(MOTION_DIM, np.float32)  # the motion of a neutral face
NEUTRAL.flags.writeable = False
YAW_PITCH: Final = np.array([CHANNEL_INDEX["yaw"], CHANNEL_INDEX["pitch"]])
BLINKS: Final = slice(CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"] + 1)
SMILE_CORNERS: Final = ("mouthSmileLeft", "mouthSmileRight")  # corners of the mouth, which show a smile

# Columns of each motion space that a listener may use (`listeners.space`); arkit58 is the motion array itself.
_AXES: Final = ("x", "y", "z")
SPACE_CHANNELS: Final[Mapping[str, tuple[str, ...]]] = {
    "arkit58": CHANNELS,
    "faceverse58": (*BLENDSHAPES, *(f"rotation_{a}" for a in _AXES), *(f"translation_{a}" for a in _AXES)),
    "deca56": (*(f"expression_{i}" for i in range(50)), *(f"head_{a}" for a in _AXES), *(f"jaw_{a}" for a in _AXES)),
}

JAW_FULL_OPEN_RAD: Final = math.radians(25.0)  # jaw pitch that corresponds to jawOpen = 1
PITCH_CHANNEL: Final[Mapping[str, str]] = {"arkit58": "pitch", "faceverse58": "rotation_x", "deca56": "head_x"}


_SWAPPED: Final = {"jawLeft": "jawRight", "jawRight": "jawLeft", "mouthLeft": "mouthRight", "mouthRight": "mouthLeft"}

# Name order of each outside format. MediaPipe puts `_neutral` first and has no tongueOut. The Live Link app's CSV
# swaps jaw and mouth left/right against Apple's header; its UDP packet does not.
ORDERS: Final[Mapping[str, tuple[str, ...]]] = {
    "alphabetical": BLENDSHAPES,
    "faceverse": BLENDSHAPES,
    "apple": _APPLE,
    "live_link_udp": _APPLE,
    "live_link_csv": tuple(_SWAPPED.get(name, name) for name in _APPLE),
    "mediapipe": ("_neutral", *BLENDSHAPES[:-1]),
}


def clip_shapes(motion: Reals) -> None:
    """Limit the blendshapes of motion (..., 58) to 0..1, in place."""
    shapes = motion[..., SHAPES]
    np.clip(shapes, 0.0, 1.0, out=shapes)


def changed(value: Value, **fields: object) -> Value:
    """Return a copy with some fields replaced, as `dataclasses.replace` does, in an eighth of its time.

    For classes without checks only. It is used for the memories of streams, which are replaced with every frame.
    """
    made: Value = object.__new__(type(value))
    made.__dict__.update(value.__dict__, **fields)
    return made


@dataclass(frozen=True)
class FaceFrame:
    """One face at one instant.

    Attributes:
        time_s: time of the face.
        pose: (6,) roll, pitch, yaw [rad], x, y, z [m].
        blendshapes: (52,) 0..1, order `BLENDSHAPES`.
        jaw_rad: (3,) axis-angle or None; when present it replaces jawOpen.
    """

    time_s: float
    pose: Floats
    blendshapes: Floats
    jaw_rad: Floats | None = None

    @classmethod
    def of(cls, time_s: float, motion: Reals) -> FaceFrame:
        """Return the face of one motion row (58,)."""
        row = np.asarray(motion, dtype=np.float32)
        return cls(time_s, row[POSE], row[SHAPES])

    @property
    def motion(self) -> Floats:
        """Return the motion (58,): pose, then blendshapes."""
        return np.concatenate([self.pose, self.blendshapes]).astype(np.float32)


@dataclass(frozen=True)
class Sighting:
    """A person as tracked by a camera or a phone.

    Attributes:
        face: pose and blendshapes; its `time_s` is loop time.
        attention: attention of the person to the head, 0..1; None if unknown.
        place_m: (3,) place of the person's eyes in the camera's frame: x out of its lens, y to its left, z up; None if
            unknown.
    """

    face: FaceFrame
    attention: float | None = None
    place_m: Floats | None = None


@dataclass(frozen=True)
class SpeakerFrame:
    """Sound and face of the person in the last 40 ms.

    Attributes:
        time_s: the END of the frame: its samples cover (time_s - 0.04, time_s].
        audio: (n,) mono 16 kHz, -1..1; empty when there is no microphone.
        face: the person's face, or None: a missing modality is normal.
        agent_audio: (n,) voice of the robot itself, or None.
        attention, place_m: see `Sighting`; None without a face. In a meeting that is played back the attention may be
            NaN: several people are present, and the target of this person's gaze was not annotated.
    """

    time_s: float
    audio: Floats
    face: FaceFrame | None = None
    agent_audio: Floats | None = None
    attention: float | None = None
    place_m: Floats | None = None

    @property
    def number(self) -> int:
        """Return the index of the frame in loop time: frame 0 ends at 0.04 s."""
        return round(self.time_s * FRAME_HZ) - 1


# Kinds of events that a listener may decide. A laugh is audible and opens the mouth, a smile is only visible; "mm-hm"
# needs a voice.
EVENT_KINDS: Final = ("nod", "shake", "tilt", "laugh", "smile", "mm_hm", "brow_raise", "blink", "gaze_shift")


@dataclass(frozen=True)
class ListenerEvent:
    """An event that a listener has decided, or that a person showed.

    Attributes:
        kind: one of `EVENT_KINDS`.
        start_s, duration_s: start and length of its motion; a gaze shift lasts until the next one.
        size: peak-to-peak angle [rad] of a nod, a shake, a tilt; 0..1 for an event of the face; angle [rad] of a gaze
            shift.
        swings: number of swings, there and back, of a nod or a shake; 1 for all other kinds.
        target_rad: target (yaw, pitch) in space of a gaze shift, (0, 0) at the person; None for all other kinds.
        probability, draw: probability of the decision at this instant, and the random number in 0..1 that fell below
            it; None for an event that was not drawn.
        evidence: the largest terms of its log-odds, by name.
        origin_s: `time.monotonic` at time 0 of its clock, which is the clock of the run's frames, if the event comes
            from `Robot.on`; 0 in virtual time; None elsewhere.
    """

    kind: str
    start_s: float
    duration_s: float
    size: float
    swings: int = 1
    target_rad: tuple[float, float] | None = None
    probability: float | None = None
    draw: float | None = None
    evidence: Mapping[str, float] = field(default_factory=dict)
    origin_s: float | None = None

    @property
    def end_s(self) -> float:
        return self.start_s + self.duration_s

    @property
    def starts_monotonic_s(self) -> float | None:
        """Return `start_s` on the clock of `time.monotonic`, as `Robot.say(at_s=)` expects it; None without a run."""
        return None if self.origin_s is None else self.origin_s + self.start_s


Events = tuple[ListenerEvent, ...]


@dataclass(frozen=True)
class Plan:
    """The next motion of the robot's face. A newer plan replaces an older one from its first time on.

    Attributes:
        made_at_s: time of the last speaker frame used.
        times_s: (H,) times_s[0] = made_at_s + one frame.
        frames: (H, 58) motion.
        jaw_rad: (H, 3) or None.
        events: events decided since the previous plan, each once; empty for a listener without events.
        hazards_hz: current rate of decisions, by kind; empty for a listener without events.
    """

    made_at_s: float
    times_s: Doubles
    frames: Floats
    jaw_rad: Floats | None = None
    events: Events = ()
    hazards_hz: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Reading:
    """State of one joint as known to its bus.

    Attributes:
        position_rad: None until the servo has answered once, or always for a family without positions.
        age_s: age of the position; inf when there is none.
        fault: named fault or None.
        extra: other values of the family, unit in the key (`current_mA`, `velocity_rad_s`, `voltage_V`).
        rejoined: true once, when the servo was lost and now holds this position, or the newest goal if it reports no
            position. Its goals are left out until they begin there, so ease in from it.
    """

    position_rad: float | None
    age_s: float
    fault: str | None = None
    extra: Mapping[str, float] = field(default_factory=dict)
    rejoined: bool = False


Readings = Mapping[str, Reading]  # readings by joint
