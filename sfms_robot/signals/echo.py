"""Echo cancellation: a microphone without what the robot's own loudspeaker says.

An adaptive filter takes away the linear echo, WebRTC's AEC3 (`pywebrtc-audio`) what is left of it. AEC3 alone mutes a
person who talks over a loudspeaker as loud as he is; behind the filter it has little to mute. While nothing was said
for half a second its output is not used at all: its high-pass costs speech detection a lot in low noise of motors.
Who wants to know whether somebody talks over the loudspeaker asks the filter, which mutes nobody.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from sfms_robot.errors import InputError
from sfms_robot.frames import AUDIO_HZ, Doubles, Floats
from sfms_robot.signals.echo_filter import BLOCK, EchoFilter

ECHO_LATENCY_SAMPLES: Final = 128  # of AEC3's filter bank: 8 ms
_TAIL_BLOCKS: Final = 50  # of 10 ms after the reference's end: echoes and AEC3's longest delay
_SILENCE: Final = 1e-3  # of full scale
_NONE: Final = np.zeros(0, np.float32)


@dataclass(frozen=True)
class Cancelled:
    """Whole blocks of 10 ms.

    Attributes:
        audio: (b * 160,) without echo, `ECHO_LATENCY_SAMPLES` late.
        linear: (b * 160,) what the filter alone leaves, not late.
        residual_power: (b, 161) of the echo in each block of `linear`, as the filter expects it (`EchoFilter`).
    """

    audio: Floats
    linear: Floats
    residual_power: Doubles


class EchoCanceller:
    """Streams of any block size; what comes out does not depend on how they were cut.

    Causal; the output is `ECHO_LATENCY_SAMPLES` late and holds whole blocks of 10 ms. Memory is fixed. AEC3 finds a
    loudspeaker's delay by itself, up to half a second; the filter covers the first 250 ms. Without a reference the
    microphone passes unchanged but for the delay.
    """

    def __init__(self) -> None:
        from pywebrtc_audio import EchoCanceller as Aec3

        self._filter = EchoFilter()
        self._suppressor = Aec3(AUDIO_HZ)
        self._mic, self._reference = _NONE, _NONE
        self._past: Floats = np.zeros(ECHO_LATENCY_SAMPLES, np.float32)
        self._silent_blocks = _TAIL_BLOCKS
        self._share = 0.0  # of AEC3 in the output

    def push(self, mic: Floats, reference: Floats) -> Cancelled:
        """(n,) heard and (n,) said at the same instants, 16 kHz, -1..1 -> the blocks that they complete.

        `reference` must not be later than its echo. Raises InputError when the two differ in length.
        """
        if mic.shape != reference.shape:
            raise InputError(f"microphone and reference differ: {len(mic)} and {len(reference)} samples")
        mic, reference = np.concatenate([self._mic, mic]), np.concatenate([self._reference, reference])
        whole = len(mic) // BLOCK * BLOCK
        self._mic, self._reference = mic[whole:], reference[whole:]
        blocks = [self._block(mic[i : i + BLOCK], reference[i : i + BLOCK]) for i in range(0, whole, BLOCK)]
        if not blocks:
            return Cancelled(_NONE, _NONE, np.zeros((0, BLOCK + 1)))
        return Cancelled(
            np.concatenate([each.audio for each in blocks]),
            np.concatenate([each.linear for each in blocks]),
            np.concatenate([each.residual_power for each in blocks]),
        )

    def _block(self, mic: Floats, reference: Floats) -> Cancelled:
        silent = float(np.abs(reference).max()) < _SILENCE
        self._silent_blocks = self._silent_blocks + 1 if silent else 0
        left = self._filter.push(mic.astype(np.float64), reference.astype(np.float64)).astype(np.float32)
        suppressed = self._suppressor.process(np.clip(left, -1.0, 1.0), reference)
        seen = np.concatenate([self._past, left])
        self._past = seen[BLOCK:]
        share = 0.0 if self._silent_blocks >= _TAIL_BLOCKS else 1.0
        ramp = np.linspace(self._share, share, BLOCK, dtype=np.float32)
        self._share = share
        cleaned: Floats = ramp * suppressed + (1 - ramp) * seen[:BLOCK]
        return Cancelled(cleaned, left, self._filter.residual_power[None])
