"""What a run measures of itself. Every figure of the report comes from here or from the bus's own counters."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfms_robot.frames import CHANNEL_INDEX, FRAME_S, Doubles, Floats, Plan, SpeakerFrame
from sfms_robot.ports import Audit
from sfms_robot.runtime.clock import Beat

LATE_SHARE = 0.5  # a tick is late when it starts more than this share of a period behind its deadline
_PITCH = CHANNEL_INDEX["pitch"]
_BLINKS = [CHANNEL_INDEX["eyeBlinkLeft"], CHANNEL_INDEX["eyeBlinkRight"]]
_SMILES = [CHANNEL_INDEX["mouthSmileLeft"], CHANNEL_INDEX["mouthSmileRight"]]
SPEECH_RMS = 0.01  # a frame louder than this counts as speech when latency is measured


@dataclass
class RunLog:
    """Filled by the loop, read once at the end. `period_s` is the tick's.

    Hours of running must fit in memory: joints are kept as running figures, and of the face only the three channels
    that are counted (head pitch, blink, smile), as packed doubles.
    """

    joints: Sequence[str]
    period_s: float
    audit: Audit
    late_ms: array[float] = field(default_factory=lambda: array("d"))
    skipped: int = 0
    frames: int = 0
    refused_plans: int = 0
    frame_to_wire_ms: array[float] = field(default_factory=lambda: array("d"))
    speech_to_wire_ms: array[float] = field(default_factory=lambda: array("d"))
    pitch_rad: array[float] = field(default_factory=lambda: array("d"))
    blink: array[float] = field(default_factory=lambda: array("d"))
    smile: array[float] = field(default_factory=lambda: array("d"))
    eased: int = 0
    listened_s: float = 0.0
    min_rad: Doubles | None = None
    max_rad: Doubles | None = None
    travel_rad: Doubles | None = None
    audited: Any = None
    _last_rad: Doubles | None = None
    _waiting: list[Plan] = field(default_factory=list)
    _speech_s: list[float] = field(default_factory=list)

    def start(self, held_rad: Doubles) -> None:
        """Torque came on at `held_rad` (J,)."""
        self.audited = self.audit.start(held_rad)

    def restart(self, joints: NDArray[np.bool_], held_rad: Doubles) -> None:
        """Some `joints` (J,) were away and hold `held_rad` (J,) now."""
        self.audited = self.audit.restart(joints, held_rad, self.audited)

    def heard(self, frame: SpeakerFrame) -> None:
        self.frames += 1
        if len(frame.audio) and float(np.sqrt(np.mean(frame.audio**2))) > SPEECH_RMS:
            self._speech_s.append(frame.time_s)

    def refuse(self) -> None:
        self.refused_plans += 1

    def planned(self, plan: Plan) -> None:
        self._waiting.append(plan)

    def wrote(
        self,
        beat: Beat,
        now_s: float,
        wire_s: float,
        reach_s: float,
        goals_rad: Doubles,
        asked_rad: Doubles,
        motion: Floats,
    ) -> None:
        """The tick of `now_s` is on the wire at `wire_s`; it played the timeline up to `reach_s`."""
        self.listened_s = now_s
        self._beat(beat, goals_rad, asked_rad)
        self.pitch_rad.append(float(motion[_PITCH]))
        self.blink.append(float(motion[_BLINKS].max()))
        self.smile.append(float(motion[_SMILES].mean()))
        used = [plan for plan in self._waiting if plan.times_s[0] <= reach_s]
        for plan in used:
            self._waiting.remove(plan)
            self.frame_to_wire_ms.append((wire_s - plan.made_at_s) * 1e3)
            for spoken_s in [t for t in self._speech_s if t <= plan.made_at_s]:
                self._speech_s.remove(spoken_s)
                self.speech_to_wire_ms.append((wire_s - (spoken_s - FRAME_S)) * 1e3)  # from the frame's first sample

    def ease(self, beat: Beat, goals_rad: Doubles, asked_rad: Doubles) -> None:
        """One tick of the way to rest."""
        self._beat(beat, goals_rad, asked_rad)
        self.eased += 1

    def _beat(self, beat: Beat, goals_rad: Doubles, asked_rad: Doubles) -> None:
        self.late_ms.append((beat.late_s + beat.skipped * self.period_s) * 1e3)
        self.skipped += beat.skipped
        self.audited = self.audit.step(goals_rad, asked_rad, self.audited)
        if self._last_rad is None or self.min_rad is None or self.max_rad is None or self.travel_rad is None:
            self.min_rad, self.max_rad, self.travel_rad = goals_rad.copy(), goals_rad.copy(), np.zeros_like(goals_rad)
        else:
            self.min_rad = np.minimum(self.min_rad, goals_rad)
            self.max_rad = np.maximum(self.max_rad, goals_rad)
            self.travel_rad = self.travel_rad + np.abs(goals_rad - self._last_rad)
        self._last_rad = goals_rad

    def tick_report(self, target_hz: float, elapsed_s: float | None) -> dict[str, Any]:
        """`tick` of the report; wall-clock figures are null where there is no wall clock (`elapsed_s` None)."""
        late = np.asarray(self.late_ms)
        real = elapsed_s is not None
        return {
            "target_hz": target_hz,
            "achieved_hz": round(len(late) / elapsed_s, 2) if elapsed_s else None,
            "late": int(np.sum(late > LATE_SHARE * self.period_s * 1e3)) if real else None,
            "jitter_ms": quantiles(late if real else (), p50=50, p99=99, max=100),
        }

    def joint_report(self) -> dict[str, dict[str, float]]:
        """`joints` of the report: range and way travelled of every goal stream."""
        if self.min_rad is None or self.max_rad is None or self.travel_rad is None:
            return {}
        return {
            name: {
                "min_rad": round(float(low), 5),
                "max_rad": round(float(high), 5),
                "travel_rad": round(float(way), 5),
            }
            for name, low, high, way in zip(self.joints, self.min_rad, self.max_rad, self.travel_rad, strict=True)
        }


def quantiles(values: Sequence[float] | array[float] | Doubles, **percent: float) -> dict[str, float | None]:
    """{"p50": ..., ...}; every value None when nothing was measured."""
    if not len(values):
        return dict.fromkeys(percent)
    return {name: round(float(np.percentile(values, p)), 3) for name, p in percent.items()}
