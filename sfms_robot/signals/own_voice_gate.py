"""What a head hears of a person while it speaks and moves itself: microphone in, frames of 40 ms for a listener out.

    linear echo off -> rest of the echo off -------------------------------------> what nobody said is turned down
                    -> motor noise and rest of the echo off -> speech probability ->

A frame holds the person's voice when Silero hears speech in what echo filter and motor suppression left. The frame
itself keeps the motors' noise under a voice: only the network hears it suppressed. Causal: a frame is judged by itself
and what came before, the last 10 ms of it with the next one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.errors import InputError
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, Doubles, Floats
from sfms_robot.signals.audio import energy_db
from sfms_robot.signals.echo import BLOCK, ECHO_LATENCY_SAMPLES, EchoCanceller
from sfms_robot.signals.motor_noise import STILL_RAD_S, MotorNoise, total_speed
from sfms_robot.signals.speech_probability import SpeechProbability

# Probabilities from which on somebody speaks, and below which he has stopped: in general, and while own voice sounds
# or joints move.
BEGINS, GOES_ON = 0.4, 0.2
BEGINS_OVER_OWN, GOES_ON_OVER_OWN = 0.6, 0.3
HOLD_FRAMES, HOLD_FRAMES_MOVING = 3, 4  # a voice lasts so long over a dip
MOTORS_LEFT_DB: Final = -15.0  # after motor suppression against before, while joints move: below it is their noise
NOBODY: Final = 0.1  # probability below which motor noise is learned
LEFT_DB: Final = -25.0  # after echo cancellation against before, while own voice is in the room: below it is echo
LEFT_AT_FIRST_DB: Final = -4.0  # while the echo filter still learns the room
LEARNING_FRAMES: Final = 75  # of own voice until it has
ECHO_FRAMES: Final = 8  # for so long after its end own voice is still in the room
OWN_VOICE_DB: Final = -60.0  # of full scale: a reference above it is heard
REJECTED_GAIN: Final = 0.03  # -30 dB, for what is own voice or own motors
_RAMP: Final = 160  # samples over which the gain changes
_NONE: Final = np.zeros(0, np.float32)


@dataclass(frozen=True)
class HeardFrame:
    """40 ms of what a person may have said.

    Attributes:
        audio: (640,) without echo; 30 dB down where own voice or own motors are all there is.
        voice: the person speaks.
        probability: 0..1, of speech of whomever, after echo cancellation and motor suppression.
        mic_db, left_db, reference_db: levels of the microphone, after echo cancellation, of own voice.
    """

    audio: Floats
    voice: bool
    probability: float
    mic_db: float
    left_db: float
    reference_db: float


class OwnVoiceGate:
    """Streams of any block size; frames and decisions do not depend on how they were cut. Memory is fixed.

    `speaks`: the head has a voice of its own, so that there is a reference; frames are then `latency_s` = 8 ms late.
    Without one the microphone passes as it is, at no latency. One instance belongs to one thread.
    """

    def __init__(self, speaks: bool = True) -> None:
        self._echo = EchoCanceller() if speaks else None
        self._speech = SpeechProbability()
        self._motors = MotorNoise()
        self._mic, self._reference, self._left, self._linear = _NONE, _NONE, _NONE, _NONE
        self._residual_power: Doubles = np.zeros((0, BLOCK + 1))
        self._probability = 0.0
        self._hold = 0
        self._echoes = 0
        self._said_frames = 0
        self._gain = 1.0

    @property
    def latency_s(self) -> float:
        """From the microphone's sample to the same sample in a frame, the frame's own length not counted."""
        return ECHO_LATENCY_SAMPLES / AUDIO_HZ if self._echo else 0.0

    def push(self, mic: Floats, reference: Floats | None = None, speed_rad_s: ArrayLike = 0.0) -> list[HeardFrame]:
        """The frames that (n,) more samples complete; blocks for less than a millisecond per 10 ms of sound.

        mic (n,) float32 16 kHz, -1..1; reference (n,) what the loudspeaker is given at the same instants, or None for
        silence; speed_rad_s, one number or (J,): commanded joint speeds, for every frame that these samples complete.
        What is not finite, a sample or a speed, counts as zero: the networks would never forget it.
        Raises InputError where the lengths differ, or where there is a reference and the gate was told of none.
        """
        said = np.zeros_like(mic) if reference is None else reference
        if said.shape != mic.shape:
            raise InputError(f"microphone and reference differ: {len(mic)} and {len(said)} samples")
        if self._echo is None and reference is not None:
            raise InputError("a reference for a gate that was made with speaks=False")
        mic, said = _finite(mic), _finite(said)
        self._mic, self._reference = np.concatenate([self._mic, mic]), np.concatenate([self._reference, said])
        if self._echo is None:
            self._left = np.concatenate([self._left, mic])
        else:
            cancelled = self._echo.push(mic, said)
            self._left = np.concatenate([self._left, cancelled.audio])
            self._linear = np.concatenate([self._linear, cancelled.linear])
            self._residual_power = np.concatenate([self._residual_power, cancelled.residual_power])
        return [self._frame(speed_rad_s) for _ in range(len(self._left) // FRAME_SAMPLES)]

    def _frame(self, speed_rad_s: ArrayLike) -> HeardFrame:
        left, self._left = self._left[:FRAME_SAMPLES], self._left[FRAME_SAMPLES:]
        mic, self._mic = self._mic[:FRAME_SAMPLES], self._mic[FRAME_SAMPLES:]
        reference, self._reference = self._reference[:FRAME_SAMPLES], self._reference[FRAME_SAMPLES:]
        reference_db = energy_db(reference)
        moves = total_speed(speed_rad_s) > STILL_RAD_S
        self._echoes = ECHO_FRAMES if reference_db > OWN_VOICE_DB else max(0, self._echoes - 1)
        self._said_frames += reference_db > OWN_VOICE_DB
        heard = self._speech.push(self._suppressed(left, speed_rad_s), noise=moves or self._echoes > 0)
        self._probability = max(heard, default=self._probability)
        mic_db, left_db = energy_db(mic), energy_db(left)
        is_left = left_db - mic_db > self._least_left_db() and (not moves or self._motors.left_db > MOTORS_LEFT_DB)
        voice = self._judge(is_left, moves)
        if self._probability < NOBODY and not voice and not self._echoes:
            self._motors.learn()
        audio = self._turn(left, REJECTED_GAIN if (self._echoes or moves) and not voice else 1.0)
        return HeardFrame(audio, voice, self._probability, mic_db, left_db, reference_db)

    def _suppressed(self, left: Floats, speed_rad_s: ArrayLike) -> Floats:
        """What the network hears of a frame: (640,) without motors and, where there is a reference, without echo."""
        if self._echo is None:
            return self._motors.suppress(left, speed_rad_s)
        linear, self._linear = self._linear[:FRAME_SAMPLES], self._linear[FRAME_SAMPLES:]
        blocks = FRAME_SAMPLES // BLOCK
        residual_power, self._residual_power = self._residual_power[:blocks], self._residual_power[blocks:]
        return self._motors.suppress(linear, speed_rad_s, residual_power)

    def _least_left_db(self) -> float:
        """How much of the microphone's level a person leaves at least: less is residual echo."""
        if not self._echoes:
            return -math.inf
        return LEFT_AT_FIRST_DB if self._said_frames < LEARNING_FRAMES else LEFT_DB

    def _judge(self, is_left: bool, moves: bool) -> bool:
        """Hysteresis and hold, so that a word does not fall apart."""
        begins, goes_on = (BEGINS_OVER_OWN, GOES_ON_OVER_OWN) if self._echoes or moves else (BEGINS, GOES_ON)
        if self._probability > (goes_on if self._hold else begins) and is_left:
            self._hold = HOLD_FRAMES_MOVING if moves else HOLD_FRAMES
        else:
            self._hold = max(0, self._hold - 1)
        return self._hold > 0

    def _turn(self, left: Floats, gain: float) -> Floats:
        """(640,) with the gain going from the last frame's to `gain` within 10 ms."""
        ramp = np.linspace(self._gain, gain, _RAMP, endpoint=False) if gain != self._gain else np.full(_RAMP, gain)
        self._gain = gain
        out: Floats = (left * np.concatenate([ramp, np.full(FRAME_SAMPLES - _RAMP, gain)])).astype(np.float32)
        return out


def _finite(samples: Floats) -> Floats:
    """The same samples, or a copy with zeros for what is not finite."""
    return samples if np.isfinite(samples).all() else np.where(np.isfinite(samples), samples, np.float32(0))
