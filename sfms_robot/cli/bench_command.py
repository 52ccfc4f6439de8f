"""`sfms-robot bench`: speed as a ratio to a peer measured in the same run."""

from __future__ import annotations

import json as json_module
import sys
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

import typer


class Bench(StrEnum):
    all = "all"
    startup = "startup"
    bus = "bus"
    retarget = "retarget"
    lead = "lead"
    listener = "listener"
    memory = "memory"
    own_voice = "own-voice"
    campaign = "campaign"
    fuzz = "fuzz"
    webcam = "webcam"
    live = "live"


class LiveAudio(StrEnum):
    mic = "mic"
    push = "push"


def bench(
    name: Bench = typer.Argument(Bench.all, help="What to measure."),
    head: str | None = typer.Option(None, help="For 'lead', and for 'retarget --frames': this head."),
    frames: int | None = typer.Option(None, min=1, help="For 'retarget': count violations over so many wild frames."),
    minutes: float = typer.Option(
        0.0,
        min=0.0,
        help="For 'fuzz' and 'live': go on for so long; 0 = a million bytes each, 10 min, 30 of torture.",
    ),
    audio: LiveAudio = typer.Option(LiveAudio.mic, help="For 'live': an emulated microphone, or calls."),
    torture: bool = typer.Option(
        False, "--torture", help="For 'live': kill, stop, cut and unplug at random meanwhile."
    ),
    against: Path | None = typer.Option(
        None, help="A folder with another installation: it becomes the peer, and the two run in turn."
    ),
    hours: float = typer.Option(4.0, min=0.1, help="For 'memory': virtual hours."),
    data: Path | None = typer.Option(None, help="For 'own-voice': a folder of calls, NAME_caller and NAME_agent each."),
    json: bool = typer.Option(False, "--json", help="Print one JSON object."),
) -> None:
    """Measure: start of the command line, one bus tick, one retarget tick, one listener plan.

    'campaign' tries every fault on every family of servos, 'fuzz' random bytes; both end with exit code 1 when
    something is not as it should be; 'own-voice' is what a head hears while it speaks and moves, 'webcam' what
    MediaPipe sees of a face that is known, 'live' a head that hears a microphone and sees a phone. They and 'memory'
    are not part of 'all'.
    """
    if data is not None and name is not Bench.own_voice:
        from sfms_robot.errors import ConfigError

        raise ConfigError(f"--data {data}: only 'bench own-voice' takes calls")
    if torture and name is not Bench.live:
        from sfms_robot.errors import ConfigError

        raise ConfigError("--torture: only 'bench live' is tortured")
    if name is Bench.webcam:
        _webcam(json)
        return
    if name is Bench.live:
        _live(minutes, audio, torture, json)
        return
    if name is Bench.own_voice:
        _own_voice(data, json)
        return
    if name in (Bench.campaign, Bench.fuzz):
        _trial(name, minutes, json)
        return
    from sfms_robot.app.bench import run_bench

    result = run_bench(name.value, head, frames, against, hours)
    if json:
        print(json_module.dumps(result))
    else:
        from sfms_robot.cli.show import print_bench

        print_bench(result)


def _tell(result: Any, rows: Sequence[Mapping[str, Any]], lines: Sequence[str], json: bool) -> None:
    """A result as one JSON object, or as a table and what it leaves out."""
    if json:
        print(json_module.dumps(result))
        return
    from sfms_robot.cli.show import print_rows

    print_rows(rows)
    for line in lines:
        print(line)


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _webcam(json: bool) -> None:
    from sfms_robot.app.bench import webcam_bench

    result = webcam_bench.webcam()
    times = [f"{name}: {ms['p50']:.1f} ms (p99 {ms['p99']:.1f})" for name, ms in result["timings_ms"].items()]
    _tell(result, webcam_bench.table(result), times, json)


def _live(minutes: float, audio: LiveAudio, torture: bool, json: bool) -> None:
    from sfms_robot.app.bench import live_bench, torture_bench

    if torture:
        result = torture_bench.torture(minutes or torture_bench.MINUTES, audio.value, _say)
        _tell(result, torture_bench.table(result), torture_bench.words(result), json)
        if not result["passed"]:
            raise typer.Exit(1)
    else:
        result = live_bench.live(minutes or live_bench.MINUTES, audio.value, _say)
        _tell(result, live_bench.table(result), live_bench.words(result), json)


def _own_voice(folder: Path | None, json: bool) -> None:
    from sfms_robot.app.bench import own_voice_bench

    result = own_voice_bench.own_voice(folder)
    chosen_on = ", ".join(result["chosen_on"]["calls"])
    lines = [
        f"calls: {', '.join(result['calls'])}; echo cancellation adds {result['echo_latency_ms']:.1f} ms",
        f"parameters were chosen on other calls ({chosen_on}), gears and movements",
    ]
    _tell(result, own_voice_bench.table(result), lines, json)


def _trial(name: Bench, minutes: float, json: bool) -> None:
    """A campaign or a fuzz, said line by line on stderr while it runs."""
    import logging
    from dataclasses import asdict

    from sfms_robot.app.bench import campaign, fuzz

    logging.getLogger("sfms_robot").setLevel(logging.CRITICAL)  # thousands of faults are said elsewhere
    if name is Bench.campaign:
        outcomes = campaign.run_campaign(progress=_say)
        rows, plain = campaign.table(outcomes), [asdict(each) | {"passed": each.passed} for each in outcomes]
    else:
        fuzzed = fuzz.run_fuzz(minutes, progress=_say)
        rows, plain = fuzz.table(fuzzed), [asdict(each) | {"passed": each.passed} for each in fuzzed]
    passed = all(each["passed"] for each in plain)
    _tell({"passed": passed, "runs": plain}, rows, [], json)
    if not passed:
        raise typer.Exit(1)
