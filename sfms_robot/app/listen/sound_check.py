"""How good the sound is that a head would hear: `run --audio mic --check`. No servo is touched."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any, Final

import numpy as np

from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_S, Floats
from sfms_robot.signals.audio import energy_db
from sfms_robot.sources.registry import open_source

CHECK_S: Final = 3.0
CLIPPED: Final = 0.99  # of full scale
MOST_CLIPPED: Final = 1e-3  # of the samples
QUIET_DB: Final = -45.0  # of full scale; speech of a person at arm's length is at -35 to -15
NOISY_DB: Final = 10.0  # speech less far above the noise than this is hard to understand
SILENT_DB: Final = -95.0  # no room and no microphone is as quiet as this
_NOISE_PERCENT, _SPEECH_PERCENT = 10, 95  # of the frames, by their level
_ASK_S: Final = 0.01

OnLevel = Callable[[float, bool], None]  # dB of full scale of the newest frame, and whether it clips


def check_sound(audio: str, duration_s: float = CHECK_S, on_level: OnLevel | None = None) -> dict[str, Any]:
    """Listen to `audio` (as `run --audio`) for `duration_s`, in real time, and judge what came; see `judge_sound`.

    `on_level` is called for every frame. Raises what opening the source raises; ConfigError for "none".
    """
    if audio == "none":
        raise ConfigError("--check: there is nothing to listen to with --audio none (mic, FILE.wav)")
    frames: list[Floats] = []
    with closing(open_source(audio, "none", duration_s)) as source:
        origin_s = time.monotonic()
        source.start(origin_s)
        while len(frames) < round(duration_s / FRAME_S):
            for frame in source.read(time.monotonic() - origin_s):
                frames.append(frame.audio)
                if on_level is not None:
                    on_level(energy_db(frame.audio), _clips(frame.audio))
            time.sleep(_ASK_S)
        told = dict(source.statistics())
    return {"version": 1, "audio": audio, **judge_sound(frames), "source": told}


def judge_sound(frames: Sequence[Floats]) -> dict[str, Any]:
    """Frames (640,), empty where nothing came -> seconds, missing_frames, level_dbfs (of the loudest part: speech),
    noise_floor_dbfs, peak, clipped (share of the samples) and findings: a line for whatever is not as it should be.
    """
    heard = [frame for frame in frames if len(frame)]
    levels = [energy_db(frame) for frame in heard] or [-100.0]
    samples = np.abs(np.concatenate(heard)) if heard else np.zeros(1, np.float32)
    noise_db, speech_db = (float(each) for each in np.percentile(levels, (_NOISE_PERCENT, _SPEECH_PERCENT)))
    told = {
        "seconds": round(len(frames) * FRAME_S, 2),
        "missing_frames": len(frames) - len(heard),
        "level_dbfs": round(speech_db, 1),
        "noise_floor_dbfs": round(noise_db, 1),
        "peak": round(float(samples.max()), 4),
        "clipped": round(float(np.mean(samples >= CLIPPED)), 5),
    }
    return {**told, "findings": _findings(told)}


def _findings(told: dict[str, Any]) -> list[str]:
    if not told["seconds"] or told["missing_frames"] * FRAME_S >= told["seconds"]:
        return ["nothing came: is it plugged in, does another program hold it?"]
    findings = []
    if told["level_dbfs"] < SILENT_DB:
        findings.append("digital silence: it is muted, or another device is the right one (sfms-robot port list)")
    elif told["level_dbfs"] < QUIET_DB:
        findings.append(f"very quiet: nobody spoke, or its gain is too low (speech is above {QUIET_DB:g} dBFS)")
    elif told["level_dbfs"] - told["noise_floor_dbfs"] < NOISY_DB:
        above = told["level_dbfs"] - told["noise_floor_dbfs"]
        findings.append(f"speech is {above:.0f} dB above the noise, {NOISY_DB:g} are needed: nearer, or a quieter room")
    if told["clipped"] > MOST_CLIPPED:
        findings.append(f"{told['clipped']:.1%} of the samples clip: turn its gain down")
    if told["missing_frames"]:
        findings.append(f"{told['missing_frames']} frames of 40 ms did not come in time: the computer is too busy")
    return findings


def _clips(audio: Floats) -> bool:
    return bool(len(audio) and np.abs(audio).max() >= CLIPPED)
