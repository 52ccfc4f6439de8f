"""`bench own-voice`: errors while a head speaks and moves: the person missed, its own sound taken for the person.

Recorded calls of two people become scenes: the caller in a room, the agent from the head's loudspeaker, gear noise from
the joint speeds of a recorded run. The clean tracks determine who speaks; 100 ms around every change do not count.
Sound is float64 at 16 kHz. Levels are root mean squares over the frames with speech.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.signal import correlate, fftconvolve, lfilter

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError, optional
from sfms_robot.frames import AUDIO_HZ, FRAME_S, FRAME_SAMPLES, Bools, Doubles, Floats
from sfms_robot.lab.bench.measure import BenchResult
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.echo import EchoCanceller
from sfms_robot.signals.own_voice_gate import WINDOW, OwnVoiceGate, SpeechProbability

# The calls on which the parameters were chosen, with other gears (seed 1) and movements. They are never in the results.
CHOSEN_ON: Final = ("hvb_01cefd6f5c044a6f", "hvb_02e41649e7c441fd", "hvb_03a17cc36d474151")
_NEAR_FRAMES: Final = 3  # 100 ms, in whole frames
# Size in metres and the time in which sound decays by 60 dB.
_ROOMS: Final = {
    "small": ((3.2, 2.8, 2.5), 0.25),
    "office": ((5.0, 4.0, 2.8), 0.4),
    "hall": ((8.0, 6.0, 3.2), 0.6),
}
_PERSON_DB: Final = -30.0  # at the microphone
_PERSON_M, _LOUDSPEAKER_M, _MOTORS_M = (1.2, 0.3, 0.2), (0.02, 0.0, -0.12), (0.0, 0.06, -0.05)  # from the microphone
_LOUDSPEAKER_DELAY: Final = 640  # samples from the reference to the loudspeaker, 40 ms
_HISS_DB: Final = -72.0
_ORDER: Final = 30  # highest order of reflections
_TRUTH_GAINS: Final = (2.0, 16.0)  # for clean speech; independent of the gains of the gate
_ALTERNATE_FRAMES: Final = 100  # a voice that talks over the person is on and off for this many frames each
_TITLES: Final = {
    "own_voice_taken": "own voice taken for the person",
    "person_missed": "person missed",
    "person_missed_in_double_talk": "missed in double talk",
    "nobody_taken": "silence taken for the person",
    "core_share": "of a core",
}


@dataclass(frozen=True, kw_only=True)
class VoiceCondition:
    """Levels relative to the person's [dB]; None: absent. Without `person` the levels stay, but the person is silent.

    `talks_over`: The head's voice without its pauses, four seconds on and four off, regardless of the person.
    """

    room: str = "office"
    own_db: float | None = None
    motors_db: float | None = None
    talks_over: bool = False
    person: bool = True

    def __str__(self) -> str:
        over = ", talks over" if self.talks_over else ""
        own = "silent" if self.own_db is None else f"{self.own_db:+.0f} dB{over}"
        motors = "still" if self.motors_db is None else f"{self.motors_db:+.0f} dB"
        return f"{self.room} | own voice {own} | motors {motors}{'' if self.person else ', no person there'}"


CONDITIONS: Final = (
    VoiceCondition(),
    VoiceCondition(own_db=-10.0),
    VoiceCondition(room="small", own_db=0.0),
    VoiceCondition(own_db=0.0),
    VoiceCondition(room="hall", own_db=0.0),
    VoiceCondition(own_db=10.0),
    VoiceCondition(own_db=0.0, talks_over=True),
    VoiceCondition(own_db=10.0, talks_over=True),
    VoiceCondition(motors_db=-10.0),
    VoiceCondition(motors_db=-10.0, person=False),
    VoiceCondition(motors_db=0.0),
    VoiceCondition(motors_db=0.0, person=False),
    VoiceCondition(own_db=0.0, motors_db=-10.0),
    VoiceCondition(own_db=0.0, motors_db=0.0),
)


def measure(data: Path | None = None) -> BenchResult:
    """Measure every condition over the calls in folder `data`."""
    result = own_voice(data)
    table = [
        {"condition": found["condition"]}
        | {title: "-" if found[key] is None else f"{100 * found[key]:.1f} %" for key, title in _TITLES.items()}
        for found in result["conditions"]
    ]
    lines = [
        f"calls: {', '.join(result['calls'])}; echo cancellation adds {result['echo_latency_ms']:.1f} ms",
        f"parameters were chosen on other calls ({', '.join(CHOSEN_ON)}), gears and movements",
    ]
    return BenchResult(result, table, lines)


def own_voice(folder: Path | None = None, conditions: Sequence[VoiceCondition] = CONDITIONS) -> dict[str, Any]:
    """Measure conditions over the calls of `folder` (NAME_caller, NAME_agent), or over the two shipped calls.

    Calls on which parameters were chosen are left out. Raises ConfigError if no call is left.
    """
    folder = data_dir("sim") / "conversations" if folder is None else folder
    calls = [Call(folder, name) for name in call_names(folder)]
    return {
        "calls": [call.name for call in calls],
        "chosen_on": list(CHOSEN_ON),
        "echo_latency_ms": _echo_latency_ms(calls[0]),
        "conditions": [{"condition": str(each), **_shares(calls, each)} for each in conditions],
    }


def call_names(folder: Path) -> list[str]:
    """Return the calls in a folder, without those on which parameters were chosen."""
    names = sorted({path.stem.removesuffix("_caller") for path in folder.glob("*_caller.*")} - set(CHOSEN_ON))
    if not names:
        raise ConfigError(f"{folder}: has no NAME_caller.flac with NAME_agent.flac (or .wav) to report on")
    return names


def _echo_latency_ms(call: Call) -> float:
    """Return the delay of echo cancellation under own voice: the peak of the person's cross-correlation."""
    heard = HeardScene(call, VoiceCondition(own_db=0.0, talks_over=True))
    after = EchoCanceller().push(heard.mic, heard.reference).audio
    before = HeardScene(call, VoiceCondition()).mic[: len(after)]
    likeness = correlate(after, before, method="fft")[len(before) - 1 :]  # lags from 0 on
    return float(np.argmax(likeness[: AUDIO_HZ // 10])) / AUDIO_HZ * 1e3


def _shares(calls: Sequence[Call], condition: VoiceCondition) -> dict[str, float | None]:
    """Return shares of the frames, over all calls, that the gate judges wrongly; None without such frames."""
    parts, cpu_s = [], 0.0
    for call in calls:
        heard = HeardScene(call, condition)
        gate = OwnVoiceGate(speaks=condition.own_db is not None)
        began_s = time.process_time()
        voice = [
            frame.voice
            for mic, own, speed in zip(_framed(heard.mic), _framed(heard.reference), heard.speed_rad_s, strict=True)
            for frame in gate.push(mic, own if gate.latency_s else None, speed)
        ]
        cpu_s += time.process_time() - began_s
        n = len(voice)
        parts.append(np.stack([np.array(voice), heard.person_speaks[:n], heard.own_speaks[:n]]))
    near = np.concatenate([_near_change(person) | _near_change(own) for _, person, own in parts])
    taken, person, own = np.concatenate(parts, axis=1)

    def share(of: Bools, wrong: Bools) -> float | None:
        frames = of & ~near
        return float((frames & wrong).sum() / frames.sum()) if frames.any() else None

    return {
        "own_voice_taken": share(own & ~person, taken),
        "person_missed": share(person, ~taken),
        "person_missed_in_double_talk": share(person & own, ~taken),
        "nobody_taken": share(~person & ~own, taken),
        "core_share": cpu_s / (len(taken) * FRAME_S) if len(taken) else None,
    }


def _framed(samples: Floats) -> Floats:
    return samples.reshape(-1, FRAME_SAMPLES)


def _near_change(active: Bools) -> Bools:
    """Return a mask (n,) of the `_NEAR_FRAMES` frames before each change and as many from the change on."""
    near = np.zeros(len(active), bool)
    for change in np.flatnonzero(active[1:] != active[:-1]) + 1:
        near[max(0, change - _NEAR_FRAMES) : change + _NEAR_FRAMES] = True
    return near


# --- scenes ---------------------------------------------------------------------------------------------------------


class Call:
    """Two people on one clock: samples (n * 640,), and speech of each person in n frames, from the clean tracks.

    NAME_caller is the person and NAME_agent the head, as .flac or .wav. Raises ConfigError if one is missing.
    """

    def __init__(self, folder: Path, name: str) -> None:
        person, own = (_track(folder, f"{name}_{who}") for who in ("caller", "agent"))
        n = min(len(person), len(own)) // FRAME_SAMPLES * FRAME_SAMPLES
        self.name, self.person, self.own = name, person[:n], own[:n]
        self.person_speaks, self.own_speaks = _speaks(self.person), _speaks(self.own)


def _track(folder: Path, name: str) -> Doubles:
    for suffix in (".flac", ".wav"):
        if (file := folder / (name + suffix)).is_file():
            return read_audio(file).astype(np.float64)
    raise ConfigError(f"{folder}: has no {name}.flac or {name}.wav")


def _speaks(track: Doubles) -> Bools:
    """Return a mask (n,) of a clean track (n * 640,): the network finds speech likely at the middle of the frame."""
    loud = track / max(1e-9, float(np.sqrt(np.mean(track**2)))) * 10 ** (-26 / 20)
    found = np.array(SpeechProbability(_TRUTH_GAINS).push(loud.astype(np.float32)))
    middles = (np.arange(len(track) // FRAME_SAMPLES) + 0.5) * FRAME_SAMPLES / WINDOW - 0.5
    likely: Bools = np.interp(middles, np.arange(len(found)), found) > 0.5
    return likely


class HeardScene:
    """A call as the head's microphone records it.

    Attributes:
        mic, reference: (n * 640,) float32.
        speed_rad_s: (n, J) joint speeds.
        person_speaks, own_speaks: (n,) truth.
    """

    def __init__(self, call: Call, condition: VoiceCondition) -> None:
        person_echo, own_echo, motor_echo = _responses(condition.room)
        n = len(call.person_speaks)
        mic = np.random.default_rng(0).standard_normal(n * FRAME_SAMPLES) * 10 ** (_HISS_DB / 20)
        self.person_speaks = call.person_speaks & condition.person
        mic += _at_level(call.person * condition.person, person_echo, self.person_speaks, 0.0)
        own, self.own_speaks, self.speed_rad_s = np.zeros(n * FRAME_SAMPLES), np.zeros(n, bool), np.zeros((n, 1))
        if condition.own_db is not None:
            own, self.own_speaks = call.own, call.own_speaks
            if condition.talks_over:
                talk = own.reshape(n, FRAME_SAMPLES)[self.own_speaks]
                self.own_speaks = np.arange(n) // _ALTERNATE_FRAMES % 2 == 0
                own = (np.resize(talk, (n, FRAME_SAMPLES)) * self.own_speaks[:, None]).ravel()
            own = 0.5 * own / np.abs(own).max()
            late = np.concatenate([np.zeros(_LOUDSPEAKER_DELAY), own])[: len(own)]
            mic += _at_level(late, own_echo, self.own_speaks, condition.own_db)
        if condition.motors_db is not None:
            file = data_dir("sim") / "conversations" / "joint_speeds.npz"  # commanded speeds of a listening head
            speed = np.load(file)["speed_rad_s"].astype(np.float64)
            to_and_fro = np.concatenate([speed, speed[::-1]])
            self.speed_rad_s = np.resize(to_and_fro, (n, speed.shape[1]))
            total = self.speed_rad_s.sum(axis=1)
            mic += _at_level(gear_noise(self.speed_rad_s), motor_echo, total > 0.2 * total.mean(), condition.motors_db)
        self.mic, self.reference = mic.astype(np.float32), own.astype(np.float32)


def gear_noise(speed_rad_s: Doubles) -> Doubles:
    """Return (n * 640,) noise of gears at speeds (n, J).

    Each joint has a whine of four harmonics, its pitch proportional to the speed, and a hiss; both are louder at speed.
    """
    rng = np.random.default_rng(0)
    frames, joints = speed_rad_s.shape
    at = np.arange(frames * FRAME_SAMPLES) / FRAME_SAMPLES - 0.5
    noise = np.zeros(len(at))
    for joint in range(joints):
        speed = np.interp(at, np.arange(frames), speed_rad_s[:, joint])
        turns = np.cumsum(speed) / AUDIO_HZ * rng.uniform(900, 1600)
        whine = sum(
            size * np.sin(k * turns + rng.uniform(0, 6)) for k, size in ((1, 1.0), (2, 0.6), (3, 0.4), (5, 0.2))
        )
        pole = rng.uniform(0.3, 0.8)
        hiss = lfilter([1 - pole], [1, -pole], rng.standard_normal(len(at)))
        noise += speed / (1 + speed) * (0.5 * whine + hiss) * rng.uniform(0.5, 1.5)
    return noise


def _at_level(sound: Doubles, response: Doubles, active: Bools, over_db: float) -> Doubles:
    """Return the sound in the room, its active frames at a level relative to the person's."""
    heard: Doubles = fftconvolve(sound, response)[: len(sound)]
    if not active.any():
        return heard
    loud = heard.reshape(-1, FRAME_SAMPLES)[active]
    return heard * 10 ** ((_PERSON_DB + over_db) / 20) / max(1e-9, float(np.sqrt(np.mean(loud**2))))


@cache
def _responses(room: str) -> tuple[Doubles, Doubles, Doubles]:
    """Return the responses from the person, the loudspeaker and the motors to the microphone (image sources)."""
    with optional("bench own-voice"):
        import pyroomacoustics
    size, decay_s = _ROOMS[room]
    absorption, order = pyroomacoustics.inverse_sabine(decay_s, size)
    material = pyroomacoustics.Material(absorption)
    shoebox = pyroomacoustics.ShoeBox(size, fs=AUDIO_HZ, materials=material, max_order=min(order, _ORDER))
    microphone = np.array([0.45 * size[0], 0.4 * size[1], 1.2])
    for place in (_PERSON_M, _LOUDSPEAKER_M, _MOTORS_M):
        shoebox.add_source(microphone + place)
    shoebox.add_microphone(microphone)
    shoebox.compute_rir()
    person, loudspeaker, motors = (np.asarray(response, np.float64) for response in shoebox.rir[0])
    return person, loudspeaker, motors
