"""What of the person a head hears while it speaks and moves, and what of itself it takes for the person.

Recorded calls of two people become scenes: the caller in a room, the agent from the head's own loudspeaker, gear noise
after the joint speeds of a recorded run. Who speaks is read off the clean tracks; 100 ms around every change are
excused.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, Floats
from sfms_robot.lab.bench.acoustics import GEAR_SEED, Bools, Call, Scene, read_call, scene, without_person
from sfms_robot.lab.bench.measure import Told
from sfms_robot.signals.echo import EchoCanceller
from sfms_robot.signals.own_voice_gate import OwnVoiceGate

# Never reported on: parameters were chosen on these calls, on gears of this seed that move as another recorded run did.
CHOSEN_ON: Final = ("hvb_01cefd6f5c044a6f", "hvb_02e41649e7c441fd", "hvb_03a17cc36d474151")
CHOSEN_ON_GEAR_SEED: Final = 1
_EXCUSED_FRAMES: Final = 3  # 100 ms, in whole frames


@dataclass(frozen=True)
class Condition:
    """Levels over the person's [dB], None: not there. Without `person` they are the same, but he is not there."""

    room: str
    own_db: float | None
    motors_db: float | None
    talks_over: bool
    person: bool = True

    def __str__(self) -> str:
        over = ", talks over" if self.talks_over else ""
        own = "silent" if self.own_db is None else f"{self.own_db:+.0f} dB{over}"
        motors = "still" if self.motors_db is None else f"{self.motors_db:+.0f} dB"
        there = "" if self.person else ", nobody there"
        return f"{self.room} | own voice {own} | motors {motors}{there}"


CONDITIONS: Final = (
    Condition("office", None, None, False),
    Condition("office", -10.0, None, False),
    Condition("small", 0.0, None, False),
    Condition("office", 0.0, None, False),
    Condition("hall", 0.0, None, False),
    Condition("office", 10.0, None, False),
    Condition("office", 0.0, None, True),
    Condition("office", 10.0, None, True),
    Condition("office", None, -10.0, False),
    Condition("office", None, -10.0, False, person=False),
    Condition("office", None, 0.0, False),
    Condition("office", None, 0.0, False, person=False),
    Condition("office", 0.0, -10.0, False),
    Condition("office", 0.0, 0.0, False),
)


@dataclass
class Counts:
    """Frames of one condition over several calls: how many there are, and how many were judged wrongly."""

    own: int = 0
    own_taken: int = 0
    person: int = 0
    person_missed: int = 0
    both: int = 0
    both_missed: int = 0
    nobody: int = 0
    nobody_taken: int = 0
    cpu_s: float = 0.0
    audio_s: float = 0.0

    def add(self, heard: Scene, voice: Bools, cpu_s: float) -> None:
        n = len(voice)
        person, own = heard.person_speaks[:n], heard.own_speaks[:n]
        counted = ~(_near_change(person) | _near_change(own))
        self.own += int((counted & own & ~person).sum())
        self.own_taken += int((counted & own & ~person & voice).sum())
        self.person += int((counted & person).sum())
        self.person_missed += int((counted & person & ~voice).sum())
        self.both += int((counted & person & own).sum())
        self.both_missed += int((counted & person & own & ~voice).sum())
        self.nobody += int((counted & ~person & ~own).sum())
        self.nobody_taken += int((counted & ~person & ~own & voice).sum())
        self.cpu_s += cpu_s
        self.audio_s += n * FRAME_S

    def shares(self) -> dict[str, float | None]:
        """None where there is no such frame."""
        return {
            "own_voice_taken": _share(self.own_taken, self.own),
            "person_missed": _share(self.person_missed, self.person),
            "person_missed_in_double_talk": _share(self.both_missed, self.both),
            "nobody_taken": _share(self.nobody_taken, self.nobody),
            "core_share": _share(self.cpu_s, self.audio_s),
        }


def own_voice(folder: Path | None = None, conditions: Sequence[Condition] = CONDITIONS) -> dict[str, Any]:
    """Every condition over the calls of `folder` (NAME_caller, NAME_agent), or over the two that ship.

    Calls on which parameters were chosen are left out. Raises ConfigError where none is left.
    """
    folder = data_dir("sim") / "conversations" if folder is None else folder
    calls = [read_call(folder, name) for name in call_names(folder)]
    rows = []
    for condition in conditions:
        counts = Counts()
        for call in calls:
            _listen(call, condition, counts)
        rows.append({"condition": str(condition), **counts.shares()})
    return {
        "calls": [call.name for call in calls],
        "gear_seed": GEAR_SEED,
        "chosen_on": {"calls": list(CHOSEN_ON), "gear_seed": CHOSEN_ON_GEAR_SEED},
        "echo_latency_ms": echo_latency_ms(calls[0]),
        "conditions": rows,
    }


def call_names(folder: Path) -> list[str]:
    """Calls in a folder on which nothing was chosen."""
    names = sorted({path.stem.removesuffix("_caller") for path in folder.glob("*_caller.*")} - set(CHOSEN_ON))
    if not names:
        raise ConfigError(f"{folder}: has no NAME_caller.flac with NAME_agent.flac (or .wav) to report on")
    return names


def echo_latency_ms(call: Call) -> float:
    """Of echo cancellation while own voice talks over: where the person's cross-correlation is highest."""
    heard = scene(call, "office", own_db=0.0, talks_over=True)
    alone = scene(call, "office")
    after = EchoCanceller().push(heard.mic, heard.reference).audio
    before = alone.mic[: len(after)]
    size = 1 << (2 * len(after) - 1).bit_length()
    likeness = np.fft.irfft(np.fft.rfft(after, size) * np.fft.rfft(before, size).conj(), size)
    return float(np.argmax(likeness[: AUDIO_HZ // 10])) / AUDIO_HZ * 1e3


def measure(data: Path | None = None) -> Told:
    """`own_voice` over the calls in folder `data`, as `bench` tells it."""
    result = own_voice(data)
    chosen_on = ", ".join(result["chosen_on"]["calls"])
    lines = [
        f"calls: {', '.join(result['calls'])}; echo cancellation adds {result['echo_latency_ms']:.1f} ms",
        f"parameters were chosen on other calls ({chosen_on}), gears and movements",
    ]
    return Told(result, table(result), lines)


def table(result: Mapping[str, Any]) -> list[dict[str, str]]:
    """Rows for a person to read, in percent."""
    titles = {
        "own_voice_taken": "own voice taken for the person",
        "person_missed": "person missed",
        "person_missed_in_double_talk": "missed in double talk",
        "nobody_taken": "nobody taken for the person",
        "core_share": "of a core",
    }
    return [
        {"condition": row["condition"], **{titles[key]: _percent(row[key]) for key in titles}}
        for row in result["conditions"]
    ]


def _listen(call: Call, condition: Condition, counts: Counts) -> None:
    heard = scene(
        call if condition.person else without_person(call),
        condition.room,
        condition.own_db,
        condition.motors_db,
        condition.talks_over,
    )
    gate = OwnVoiceGate(speaks=condition.own_db is not None)
    began = time.process_time()
    voice = [
        frame.voice
        for k, speed in enumerate(heard.speed_rad_s)
        for frame in gate.push(_frame(heard.mic, k), _frame(heard.reference, k) if gate.latency_s else None, speed)
    ]
    counts.add(heard, np.array(voice), time.process_time() - began)


def _frame(samples: Floats, k: int) -> Floats:
    return samples[k * FRAME_SAMPLES : (k + 1) * FRAME_SAMPLES]


def _near_change(active: Bools) -> Bools:
    near = np.zeros(len(active), bool)
    for change in np.flatnonzero(np.diff(active.astype(np.int8))) + 1:
        near[max(0, change - _EXCUSED_FRAMES) : change + _EXCUSED_FRAMES] = True
    return near


def _share(part: float, whole: float) -> float | None:
    return part / whole if whole else None


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100 * share:.1f} %"
