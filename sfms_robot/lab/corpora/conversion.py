"""Conversion of dyads from other motion spaces to `arkit58` at 25 fps, and a measure of the loss.

Nothing is invented: a channel without a source stays at rest. The loss is measured on the data themselves.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.errors import ConfigError
from sfms_robot.frames import CHANNELS, FRAME_HZ, FRAME_S, POSE, SHAPES, Floats
from sfms_robot.lab.corpora.clips import FAU_VALUE, FULL, WITHOUT_SHAPE, Dyad, at_rate, blendshapes_of, samples_of
from sfms_robot.listeners.space import SPACES, FlameMatrix, MotionSpace, rest_of
from sfms_robot.signals.mel import ROWS_PER_FRAME
from sfms_robot.signals.rotations import angle_between
from sfms_robot.signals.tracks import Track, resample

CONVERTIBLE: Final = ("arkit58", "deca56", "faceverse58", "seamless27")
_ANGLES: Final = slice(0, 3)  # roll, pitch, yaw of a pose
_UNITS: Final = slice(3, 3 + len(FAU_VALUE))  # action units of seamless27
_UNSHOWN: Final = [FAU_VALUE.index(unit) for unit in WITHOUT_SHAPE]


FIGURES: Final = {  # meaning of each figure of `Residual.told`
    "pose_round_trip_deg": "head turned back into the source's terms: largest difference, degrees",
    "resampling_rms_deg": "head angles at 25 fps read back at the source's rate: rms difference, degrees",
    "expression_lost_share": "rms of the expression that blendshapes do not show, of the whole",
    "cut_share": "values beyond the range and cut",
    "stored_pose_deg": "head angles as written: largest difference, degrees",
    "stored_blendshape": "blendshapes as written: largest difference",
}


@dataclass(kw_only=True)
class Residual:
    """Loss of the listeners' motion by conversion, over the frames of all clips so far.

    Attributes:
        pose_rad: largest angle between the head in the source and ours converted back to the source's representation.
        resampled_rad2, resampled: sum of the squared angle differences, and their count, between our motion at the
            source's rate and the same at 25 fps, interpolated at the times of the source's frames.
        expression2, left2: sums of squares of the source's expression and of the part that our blendshapes lose.
        beyond, values: number of values that were cut because they lay outside 0..1 (seamless27: above `FULL`), and
            number of all values.
        stored_rad, stored: largest differences between the converted and the written motion: head angles, blendshapes.
    """

    pose_rad: float = 0.0
    resampled_rad2: float = 0.0
    resampled: int = 0
    expression2: float = 0.0
    left2: float = 0.0
    beyond: int = 0
    values: int = 0
    stored_rad: float = 0.0
    stored: float = 0.0
    notes: dict[str, None] = field(default_factory=dict)

    def told(self) -> dict[str, Any]:
        """Return the figures by name, in degrees and shares; None for those that do not apply."""
        figures = (
            math.degrees(self.pose_rad),
            math.degrees(math.sqrt(self.resampled_rad2 / self.resampled)) if self.resampled else None,
            math.sqrt(self.left2 / self.expression2) if self.expression2 else None,
            self.beyond / self.values if self.values else None,
            math.degrees(self.stored_rad),
            self.stored,
        )
        return dict(zip(FIGURES, figures, strict=True))

    def written(self, converted: Dyad, read_back: Dyad) -> None:
        """Update the largest differences with a converted dyad and the same dyad read back from its file."""
        apart = np.abs(converted.listener - read_back.listener)
        self.stored_rad = max(self.stored_rad, float(apart[:, POSE][:, _ANGLES].max()))
        self.stored = max(self.stored, float(apart[:, SHAPES].max()))


def to_ours(dyad: Dyad, residual: Residual, flame: FlameMatrix | None = None) -> Dyad:
    """Return the dyad in `arkit58` at 25 fps, and add the loss to `residual`; a speaker's unknown frames stay unknown.

    Raises ConfigError for a space that cannot be converted to ours, and for a clip shorter than one frame.
    """
    if dyad.space not in CONVERTIBLE:
        raise ConfigError(f"{dyad.name}: {dyad.space} cannot become arkit58 ({', '.join(CONVERTIBLE)})")
    ours = in_arkit(dyad, flame)
    _lost(dyad, ours.listener, residual, flame)
    slower = at_frame_rate(ours)
    if slower is not ours:  # compare at the times of the source's frames; the time of a frame is its end
        theirs_s, ours_s = ((np.arange(len(each.listener)) + 1) / each.fps for each in (ours, slower))
        inside = (theirs_s >= ours_s[0]) & (theirs_s <= ours_s[-1])
        for column in range(_ANGLES.stop):
            back = np.interp(theirs_s[inside], ours_s, slower.listener[:, column])
            residual.resampled_rad2 += float(np.square(back - ours.listener[inside, column]).sum())
            residual.resampled += int(inside.sum())
    return slower


def in_arkit(dyad: Dyad, flame: FlameMatrix | None = None) -> Dyad:
    """Return a dyad of a convertible space in arkit58; a speaker's unknown frames stay unknown."""
    speaker, listener = (in_ours(motion, dyad.space, flame) for motion in (dyad.speaker, dyad.listener))
    return replace(dyad, speaker=speaker, listener=listener, space="arkit58")


def in_ours(motion: Floats, space: str, flame: FlameMatrix | None = None) -> Floats:
    """Return motion (N, D) of a convertible space as (N, 58) arkit58; unknown rows (NaN) stay unknown."""
    known = np.isfinite(motion).all(axis=1)
    out = np.full((len(motion), 58), np.nan, np.float32)
    if space == "arkit58":
        out[known] = motion[known]
    elif space == "seamless27":
        deca = MotionSpace("deca56", rest_of("deca56"))
        turned = np.tile(deca.neutral, (int(known.sum()), 1))
        turned[:, SPACES["deca56"].rotation] = motion[known, _ANGLES]
        out[known] = deca.decode(turned)[0]
        out[known, SHAPES] = blendshapes_of(motion[known, _UNITS])
    else:
        out[known] = MotionSpace(space, rest_of(space), flame=flame).decode(motion[known])[0]
    return out


def _lost(dyad: Dyad, ours: Floats, residual: Residual, flame: FlameMatrix | None) -> None:
    if dyad.space == "arkit58":
        return
    filed, seamless = dyad.listener.astype(np.float64), dyad.space == "seamless27"
    name, turned = ("deca56", _ANGLES) if seamless else (dyad.space, SPACES[dyad.space].rotation)
    known = SPACES[name]  # compare the head of the source with ours converted back
    back = MotionSpace(name, rest_of(name)).encode(ours)[:, known.rotation].astype(np.float64)
    apart_rad = angle_between(known.matrices(filed[:, turned]), known.matrices(back))
    residual.pose_rad = max(residual.pose_rad, float(apart_rad.max(initial=0.0)))
    if dyad.space == "deca56":
        shown = ours[:, SHAPES].astype(np.float64) @ flame.rows if flame is not None else 0.0
        expression = filed[:, SPACES["deca56"].expression]
        lost = expression - shown
        residual.notes |= dict.fromkeys(
            filter(None, [MotionSpace("deca56", rest_of("deca56"), flame=flame).limitation])
        )
    else:
        columns, low, high = (_UNITS, -np.inf, FULL) if seamless else (SPACES[dyad.space].expression, 0.0, 1.0)
        expression = filed[:, columns]
        lost = expression - np.clip(expression, low, high)
        residual.beyond += int((lost != 0).sum())
        residual.values += expression.size
        if seamless:
            lost[:, _UNSHOWN] = expression[:, _UNSHOWN]
    residual.expression2 += float(np.square(expression).sum())
    residual.left2 += float(np.square(lost).sum())


# --- Dyads of other frame rates resampled to 25 fps, the rate at which a listener is streamed ---------------------


def at_frame_rate(dyad: Dyad) -> Dyad:
    """Return the dyad at 25 fps, cut to whole frames: motion linear in time, other rows the latest complete ones.

    Raises ConfigError for another rate in a space other than arkit58, and for a dyad shorter than one frame.
    """
    if dyad.fps == FRAME_HZ:
        return dyad
    if dyad.space != "arkit58":  # in other spaces, interpolating the numbers does not interpolate the motion
        raise ConfigError(f"{dyad.name}: {dyad.fps:g} fps in {dyad.space}, a listener is streamed at {FRAME_HZ}")
    frames = int(len(dyad.listener) * FRAME_HZ / dyad.fps + 1e-6)
    if not frames:
        raise ConfigError(f"{dyad.name}: lasts {len(dyad.listener) / dyad.fps:.3f} s, not one frame of {FRAME_S:g} s")

    def newest(rows: NDArray[Any] | None, a_frame: int = 1) -> Any:
        return None if rows is None else at_rate(rows, a_frame * dyad.fps, a_frame * frames, a_frame * FRAME_HZ)

    def cut(voice: Floats | None) -> Floats | None:
        return None if voice is None else voice[: samples_of(frames, FRAME_HZ)]

    return replace(
        dyad,
        audio=cut(dyad.audio),
        agent_audio=cut(dyad.agent_audio),
        speaker=_motion(dyad.speaker, dyad.fps, frames),
        listener=_motion(dyad.listener, dyad.fps, frames),
        listening=newest(dyad.listening),
        states=newest(dyad.states),
        mel=newest(dyad.mel, ROWS_PER_FRAME),
        features={name: newest(rows) for name, rows in dyad.features.items()},
        fps=float(FRAME_HZ),
    )


def _motion(motion: Floats, fps: float, frames: int) -> Floats:
    """Resample (N, 58) to (frames, 58). The time of frame i is its end, (i + 1) / rate; the first also holds before."""
    ends_s = (np.arange(len(motion)) + 1) / fps
    found = resample(Track(ends_s, motion, frozenset(CHANNELS)), FRAME_HZ, FRAME_S).motion[:frames]
    found[(np.arange(frames) + 1) * FRAME_S < ends_s[0] - 1e-6] = motion[0]
    return found
