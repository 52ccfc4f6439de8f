"""A check of the sound for a head, with a level meter: `run --audio mic --check`. No servo is touched."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager, nullcontext
from typing import Final

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.text import Text

from sfms_robot.app.listen.panel import level_bar
from sfms_robot.data import Report
from sfms_robot.errors import ConfigError
from sfms_robot.frames import FRAME_S, Floats
from sfms_robot.signals.audio import energy_db
from sfms_robot.sources.registry import open_source

CHECK_S: Final = 3.0
CLIPPED: Final = 0.99  # share of full scale
MOST_CLIPPED: Final = 1e-3  # share of the samples
QUIET_DB: Final = -45.0  # relative to full scale; speech of a person at arm's length is at -35 to -15
NOISY_DB: Final = 10.0  # speech closer to the noise than this is hard to understand
SILENT_DB: Final = -95.0  # quieter than any room or microphone
_NOISE_PERCENT, _SPEECH_PERCENT = 10, 95  # percentiles of the frames, by their level
_POLL_S: Final = 0.01
_WIDTH: Final = 40
_LOUD_DB: Final = -12.0


def check_sound(
    audio: str, duration_s: float | None = None, on_level: Callable[[float, bool], None] | None = None
) -> Report:
    """Listen to `audio` (as `run --audio`) for `duration_s` (`CHECK_S`), in real time, and return `judge_sound` of it.

    `on_level` is called for every frame with its level [dB of full scale] and whether it clips. Raises errors of the
    source; ConfigError for "none".
    """
    if audio == "none":
        raise ConfigError("--check: there is nothing to listen to with --audio none (mic, FILE.wav)")
    duration_s = duration_s or CHECK_S
    frames: list[Floats] = []
    with closing(open_source(audio, "none", duration_s)) as source:
        origin_s = time.monotonic()
        source.start(origin_s)
        while len(frames) < round(duration_s / FRAME_S):
            for frame in source.read(time.monotonic() - origin_s):
                frames.append(frame.audio)
                if on_level is not None:
                    on_level(energy_db(frame.audio), bool(np.abs(frame.audio).max(initial=0.0) >= CLIPPED))
            time.sleep(_POLL_S)
        statistics = dict(source.statistics())
    return {"version": 1, "audio": audio, **judge_sound(frames), "source": statistics}


def judge_sound(frames: Sequence[Floats]) -> Report:
    """Judge the quality of frames (640,); an empty frame is a missing one.

    Returns seconds, missing_frames, level_dbfs (of the loudest part: speech), noise_floor_dbfs, peak, clipped (share of
    the samples) and findings: a line for each problem.
    """
    heard = [frame for frame in frames if len(frame)]
    levels = [energy_db(frame) for frame in heard] or [-100.0]
    samples = np.abs(np.concatenate(heard)) if heard else np.zeros(1, np.float32)
    noise_db, speech_db = (float(each) for each in np.percentile(levels, (_NOISE_PERCENT, _SPEECH_PERCENT)))
    found = {
        "seconds": round(len(frames) * FRAME_S, 2),
        "missing_frames": len(frames) - len(heard),
        "level_dbfs": round(speech_db, 1),
        "noise_floor_dbfs": round(noise_db, 1),
        "peak": round(float(samples.max()), 4),
        "clipped": round(float(np.mean(samples >= CLIPPED)), 5),
    }
    return {**found, "findings": _findings(found)}


def _findings(found: Report) -> list[str]:
    if not found["seconds"] or found["missing_frames"] * FRAME_S >= found["seconds"]:
        return ["nothing came: is it plugged in, does another program hold it?"]
    findings = []
    if found["level_dbfs"] < SILENT_DB:
        findings.append("digital silence: it is muted, or another device is the right one (sfms-robot port list)")
    elif found["level_dbfs"] < QUIET_DB:
        findings.append(f"very quiet: no speech, or its gain is too low (speech is above {QUIET_DB:g} dBFS)")
    elif (above := found["level_dbfs"] - found["noise_floor_dbfs"]) < NOISY_DB:
        findings.append(f"speech is {above:.0f} dB above the noise, {NOISY_DB:g} are needed: nearer, or a quieter room")
    if found["clipped"] > MOST_CLIPPED:
        findings.append(f"{found['clipped']:.1%} of the samples clip: turn its gain down")
    if found["missing_frames"]:
        findings.append(f"{found['missing_frames']} frames of 40 ms did not come in time: the computer is too busy")
    return findings


# --- a level meter on one line ----------------------------------------------------------------------------------------


@contextmanager
def level_meter() -> Iterator[Callable[[float, bool], None]]:
    """Show a level meter on stderr while inside, and yield the function that moves it, for `check_sound`.

    Nothing is shown where stderr is not a terminal.
    """
    console, clipped = Console(stderr=True), False
    live = Live(console=console, auto_refresh=False, transient=True)

    def show(level_db: float, clips: bool) -> None:
        nonlocal clipped
        clipped |= clips
        if live.is_started:  # a bar from -60 to 0 dB of full scale, and a note after clipping
            colour = "red" if clipped else "yellow" if level_db > _LOUD_DB else "green"
            bar = (level_bar(level_db, _WIDTH, "█ "), colour)
            note = (" clips" if clipped else "", "bold red")
            live.update(Text.assemble(bar, f" {level_db:6.1f} dBFS", note), refresh=True)

    with live if console.is_terminal else nullcontext():
        yield show
