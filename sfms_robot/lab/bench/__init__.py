"""`sfms-robot bench`: each part against a peer or a baseline, both measured in the same run.

`BENCHES` is the table of all of them; a new one is a line there, and the function that it names. That function takes
the options that the line says, as keywords, and returns rows by name (`measure.row`), or `measure.Told` where a table
of its own says more. Nothing is imported before it is measured: a shell that completes names waits for this file.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.errors import ConfigError, RobotError

if TYPE_CHECKING:
    from sfms_robot.lab.bench.measure import Told

ALL: Final = "all"
Say = Callable[[str], None]


@dataclass(frozen=True)
class Bench:
    """One thing to measure.

    Attributes:
        place: "module:function" in this folder.
        about: what is measured, and beside what.
        in_all: whether `bench` without a name measures it too: takes a minute or two, needs nothing but the package.
        takes: options that it understands; "say" is a function that is told what is going on.
    """

    place: str
    about: str
    in_all: bool = True
    takes: tuple[str, ...] = ()


BENCHES: Final[Mapping[str, Bench]] = {
    "startup": Bench(
        "startup_bench:startup", "a command typed to its end, `run` to its first goal, beside a bare Python",
        takes=("against",),
    ),
    "bus": Bench("bus_bench:bus", "write and read of a head, of each family, beside the vendor's own calls"),
    "retarget": Bench(
        "retarget_bench:retarget", "a face to servo ticks, beside a matrix product of the mapping's size",
        takes=("head", "frames"),
    ),
    "lead": Bench("lead:lead", "how late joints are, beside the same with no lead", takes=("head",)),
    "listener": Bench(
        "listener_bench:listener", "a frame on every engine, first plan, memory, beside eager fp32 torch",
        takes=("budget",),
    ),
    "memory": Bench(
        "memory_bench:memory", "memory that a run gains per virtual hour, beside what it has", in_all=False,
        takes=("hours", "head"),
    ),
    "own-voice": Bench(
        "own_voice_bench:measure", "own voice taken for the person, person missed, beside what is so in truth",
        in_all=False, takes=("data",),
    ),
    "webcam": Bench(
        "webcam_bench:measure", "what MediaPipe sees of a face, beside the face that was drawn", in_all=False
    ),
    "live": Bench(
        "torture_bench:measure", "a head that hears a microphone and sees a phone, beside an empty loop and a file",
        in_all=False, takes=("minutes", "audio", "torture", "say"),
    ),
    "view": Bench(
        "view_bench:measure", "a page with three who look, beside the same run without; a halt from click to wire",
        in_all=False, takes=("say",),
    ),
    "throttle": Bench(
        "throttle_bench:measure", "a run on a quarter of one core, beside the same on all of this machine; exit code 1 "
        "where a command leaves its limits or the states are not those of docs/safety.md", takes=("say",),
    ),
    "train": Bench(
        "train_bench:measure", "a step of each stage of training, beside plain products of as many operations",
        takes=("say",),
    ),
    "serve": Bench(
        "serve_bench:measure", "heads that one server answers in time, beside one head at a time", in_all=False,
        takes=("say",),
    ),
    "campaign": Bench(
        "campaign:measure", "every fault on every family of servos; exit code 1 where one is not survived",
        in_all=False, takes=("say",),
    ),
    "fuzz": Bench(
        "fuzz:measure", "random bytes at every family; exit code 1 where they do harm", in_all=False,
        takes=("minutes", "say"),
    ),
}  # fmt: skip


def run_bench(name: str, given: Mapping[str, Any], say: Say) -> Told:
    """Measure `name`, or all that belong to "all"; `say` is told of each.

    Args:
        given: options by name, those that were given. `against`, a folder with another installation, goes with every
            bench of rows: that one becomes the peer, and the two run in turn.

    Raises ConfigError for a name that is none and for an option that means nothing there, and what the bench raises.
    """
    from sfms_robot.lab.bench.measure import Told, beside

    chosen = {key: one for key, one in BENCHES.items() if (one.in_all if name == ALL else key == name)}
    if not chosen:
        raise ConfigError(f'bench: there is no "{name}" ({", ".join([ALL, *BENCHES])})')
    takes = () if name == ALL else BENCHES[name].takes
    if "against" in given and "against" not in takes:
        return Told.of_rows(beside(name, given["against"]))
    for option in given:
        if option not in takes:
            those = " and ".join(f"'bench {key}'" for key, one in BENCHES.items() if option in one.takes)
            raise ConfigError(f"--{option} {given[option]}: only {those} takes it")
    if name != ALL:
        return _measured(chosen[name], given, say)
    return measure_all(chosen, say)


def measure_all(chosen: Mapping[str, Bench], say: Say) -> Told:
    """The rows of these, one after the other; one that cannot be measured here is left out, and that is told.

    One that fails does not cost the others: what went wrong is among the lines, and it has not passed.
    """
    from sfms_robot.lab.bench.measure import Told

    rows: dict[str, Any] = {}
    failed: list[str] = []
    for key, one in chosen.items():
        say(key)
        began_s = time.monotonic()
        try:
            told = _measured(one, {}, say)
        except ConfigError as error:
            say(f"{key} is left out: {error}")
            continue
        except RobotError as error:
            failed.append(f"{key}: {error}")
            continue
        rows |= {name: each for name, each in told.figures.items() if isinstance(each, Mapping) and "median" in each}
        failed += [] if told.passed else [f"{key}: {line}" for line in told.lines]
        say(f"{key} took {time.monotonic() - began_s:.0f} s")
    found = Told.of_rows(rows)
    return replace(found, lines=failed, passed=not failed)


def _measured(bench: Bench, given: Mapping[str, Any], say: Say) -> Told:
    from sfms_robot.lab.bench.measure import Told

    module, function = bench.place.split(":")
    measure = getattr(importlib.import_module(f"{__name__}.{module}"), function)
    found = measure(**given, **({"say": say} if "say" in bench.takes else {}))
    return found if isinstance(found, Told) else Told.of_rows(found)
