"""Sound of a head among people: a person in a room, the head's own loudspeaker, and its own motors.

Everything is float64 at 16 kHz. Levels are root mean squares over the frames in which somebody speaks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from sfms_robot.data import data_dir
from sfms_robot.errors import ConfigError, optional
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Doubles, Floats
from sfms_robot.signals.audio import read_audio
from sfms_robot.signals.own_voice_gate import WINDOW, SpeechProbability

Bools = NDArray[np.bool_]

# Size in metres and the time in which sound decays by 60 dB.
ROOMS: Final[Mapping[str, tuple[tuple[float, float, float], float]]] = {
    "small": ((3.2, 2.8, 2.5), 0.25),
    "office": ((5.0, 4.0, 2.8), 0.4),
    "hall": ((8.0, 6.0, 3.2), 0.6),
}
PERSON_DB: Final = -30.0  # at the microphone
_PERSON_M, _LOUDSPEAKER_M, _MOTORS_M = (1.2, 0.3, 0.2), (0.02, 0.0, -0.12), (0.0, 0.06, -0.05)  # from the microphone
_LOUDSPEAKER_DELAY: Final = 640  # samples from the reference to the loudspeaker, 40 ms
_HISS_DB: Final = -72.0
GEAR_SEED: Final = 0  # of the gears of a scene's head
_ORDER: Final = 30  # of reflections, at most
_TRUTH_GAINS: Final = (2.0, 16.0)  # clean speech; truth does not change with what the gate asks
_ALTERNATE_FRAMES: Final = 100  # own voice goes on and off by this when it talks over the person


@dataclass(frozen=True)
class Call:
    """Two people on one clock: samples (n * 640,); who speaks in each of n frames, by the clean track."""

    name: str
    person: Doubles
    person_speaks: Bools
    own: Doubles
    own_speaks: Bools


@dataclass(frozen=True)
class Scene:
    """What a head's microphone hears. mic, reference (n * 640,) float32; speed_rad_s (n, J); truth (n,)."""

    mic: Floats
    reference: Floats
    speed_rad_s: Doubles
    person_speaks: Bools
    own_speaks: Bools


def read_call(folder: Path, name: str) -> Call:
    """NAME_caller (the person) and NAME_agent (the head) as .flac or .wav. Raises ConfigError where one is missing."""
    person, own = (_track(folder, f"{name}_{who}") for who in ("caller", "agent"))
    n = min(len(person), len(own)) // FRAME_SAMPLES
    person, own = person[: n * FRAME_SAMPLES], own[: n * FRAME_SAMPLES]
    return Call(name, person, speaks(person), own, speaks(own))


def without_person(call: Call) -> Call:
    """The same call with a silent caller."""
    return replace(call, person=np.zeros_like(call.person), person_speaks=np.zeros_like(call.person_speaks))


def speaks(track: Doubles) -> Bools:
    """(n * 640,) clean -> (n,): the network finds speech likely around the middle of the frame."""
    loud = track / max(1e-9, float(np.sqrt(np.mean(track**2)))) * 10 ** (-26 / 20)
    found = np.array(SpeechProbability(_TRUTH_GAINS).push(loud.astype(np.float32)))
    middles = (np.arange(len(track) // FRAME_SAMPLES) + 0.5) * FRAME_SAMPLES / WINDOW - 0.5
    likely: Bools = np.interp(middles, np.arange(len(found)), found) > 0.5
    return likely


def scene(
    call: Call, room: str, own_db: float | None = None, motors_db: float | None = None, talks_over: bool = False
) -> Scene:
    """A call as a head hears it. `own_db`, `motors_db`: over the person's level, None for none of it.

    `talks_over`: the head's voice without its pauses, four seconds on and four off, whatever the person does.
    """
    person_echo, own_echo, motor_echo = _responses(room)
    n = len(call.person_speaks)
    mic = np.random.default_rng(0).standard_normal(n * FRAME_SAMPLES) * 10 ** (_HISS_DB / 20)
    mic += _at_level(_in_room(call.person, person_echo), call.person_speaks, PERSON_DB)
    own, own_speaks, speed = np.zeros(n * FRAME_SAMPLES), np.zeros(n, bool), np.zeros((n, 1))
    if own_db is not None:
        own, own_speaks = _talking_over(call) if talks_over else (call.own, call.own_speaks)
        own = 0.5 * own / np.abs(own).max()
        late = np.concatenate([np.zeros(_LOUDSPEAKER_DELAY), own])[: len(own)]
        mic += _at_level(_in_room(late, own_echo), own_speaks, PERSON_DB + own_db)
    if motors_db is not None:
        speed = joint_speeds(n)
        total = speed.sum(axis=1)
        mic += _at_level(_in_room(gear_noise(speed), motor_echo), total > 0.2 * total.mean(), PERSON_DB + motors_db)
    return Scene(mic.astype(np.float32), own.astype(np.float32), speed, call.person_speaks, own_speaks)


def joint_speeds(n: int) -> Doubles:
    """(n, 28) rad/s that a listening head was told to move at, there and back again for as long as it takes."""
    speed = np.load(data_dir("sim") / "conversations" / "joint_speeds.npz")["speed_rad_s"].astype(np.float64)
    return np.resize(np.concatenate([speed, speed[::-1]]), (n, speed.shape[1]))


def gear_noise(speed_rad_s: Doubles, seed: int = GEAR_SEED) -> Doubles:
    """(n, J) -> (n * 640,): of each joint a whine of four harmonics, its pitch with the speed, and a hiss; both louder
    with the speed."""
    from scipy.signal import lfilter

    rng = np.random.default_rng(seed)
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


def _track(folder: Path, name: str) -> Doubles:
    for suffix in (".flac", ".wav"):
        if (file := folder / (name + suffix)).is_file():
            return read_audio(file).astype(np.float64)
    raise ConfigError(f"{folder}: has no {name}.flac or {name}.wav")


def _talking_over(call: Call) -> tuple[Doubles, Bools]:
    n = len(call.own_speaks)
    talk = call.own.reshape(n, FRAME_SAMPLES)[call.own_speaks]
    on: Bools = np.arange(n) // _ALTERNATE_FRAMES % 2 == 0
    return (np.resize(talk, (n, FRAME_SAMPLES)) * on[:, None]).ravel(), on


def _at_level(sound: Doubles, active: Bools, level_db: float) -> Doubles:
    if not active.any():
        return sound
    loud = sound.reshape(-1, FRAME_SAMPLES)[active]
    return sound * 10 ** (level_db / 20) / max(1e-9, float(np.sqrt(np.mean(loud**2))))


def _in_room(sound: Doubles, response: Doubles) -> Doubles:
    from scipy.signal import fftconvolve

    heard: Doubles = fftconvolve(sound, response)[: len(sound)]
    return heard


@cache
def _responses(room: str) -> tuple[Doubles, Doubles, Doubles]:
    """From the person, the loudspeaker and the motors to the microphone. Image sources, so always the same."""
    with optional("bench own-voice"):
        import pyroomacoustics
    size, decay_s = ROOMS[room]
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
