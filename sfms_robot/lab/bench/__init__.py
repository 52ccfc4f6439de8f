"""`sfms-robot bench`: each part compared with a peer or a baseline that is measured in the same run.

`BENCHES` lists all benches. A new bench is one entry here and the function that the entry names. The function accepts
the options of its entry as keywords and returns rows by name (`measure.row`), or a `measure.BenchResult` with its own
table. A bench module is imported only when it is measured, because shell completion imports this file.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from sfms_robot.errors import ConfigError, RobotError

if TYPE_CHECKING:
    from sfms_robot.lab.bench.measure import BenchResult, Say

ALL: Final = "all"


@dataclass(frozen=True)
class Bench:
    """A bench of the command.

    Attributes:
        place: "module:function" in this folder.
        about: The quantity and its peer.
        in_all: True if the bench is part of `bench all`: it lasts a minute or two and needs no extra package.
        takes: Options that the bench accepts; "say" is a function that prints progress.
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
    "bus": Bench("bus_bench:bus", "write and read of a head, one servo silent, beside the vendor's own calls"),
    "retarget": Bench(
        "motion_bench:retarget", "a face to servo ticks, beside a matrix product of the mapping's size"
    ),
    "lead": Bench("motion_bench:lead", "how late joints are, beside the same with no lead", takes=("head",)),
    "listener": Bench(
        "listener_bench:listener", "a frame on every engine, first plan, memory, beside eager fp32 torch"
    ),
    "memory": Bench(
        "motion_bench:memory", "memory that a run gains per virtual hour, beside what it has", in_all=False,
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
        "view_bench:measure", "a page that three clients read, beside the share allowed; a halt from click to wire",
        in_all=False, takes=("say",),
    ),
    "outputs": Bench(
        "view_bench:outputs", "four outputs of a run, beside the share allowed, and its late ticks beside none",
        in_all=False, takes=("say",),
    ),
    "throttle": Bench(
        "throttle_bench:measure", "a run on a quarter of one core, beside the same on all of this machine; exit code 1 "
        "where a command leaves its limits or the states are not those of docs/safety.md", takes=("say",),
    ),
    "serve": Bench(
        "serve_bench:measure", "heads that one server answers in time, beside one head at a time", in_all=False,
        takes=("say", "device"),
    ),
    "train": Bench(
        "train_bench:measure", "what is not the model in a step of training, beside the step; exit code 1 where "
        "that is more than 15 % (arig)", in_all=False, takes=("say",),
    ),
    "campaign": Bench(
        "campaign:measure", "every fault on every family of servos; exit code 1 where one is not survived",
        in_all=False, takes=("say",),
    ),
}  # fmt: skip


def run_bench(name: str, given: Mapping[str, Any], say: Say) -> BenchResult:
    """Measure the bench `name`, or every bench that belongs to "all"; `say` prints progress.

    Args:
        name: A key of `BENCHES`, or "all".
        given: The given options by name. `against`, the folder of another installation, works with every bench that
            returns rows: that installation becomes the peer, and the two run in turn.
        say: Prints a line.

    Raises ConfigError for an unknown name or an option that the bench does not accept, and the errors of the bench.
    """
    from sfms_robot.lab.bench.measure import BenchResult, compare_installations

    chosen = {key: one for key, one in BENCHES.items() if (one.in_all if name == ALL else key == name)}
    if not chosen:
        raise ConfigError(f'bench: there is no "{name}" ({", ".join([ALL, *BENCHES])})')
    takes = () if name == ALL else BENCHES[name].takes
    if "against" in given and "against" not in takes:
        return BenchResult.of_rows(compare_installations(name, given["against"]))
    for option in given:
        if option not in takes:
            those = " and ".join(f"'bench {key}'" for key, one in BENCHES.items() if option in one.takes)
            raise ConfigError(f"--{option} {given[option]}: only {those} takes it")
    return measure_all(chosen, say) if name == ALL else _measured(chosen[name], given, say)


def measure_all(chosen: Mapping[str, Bench], say: Say) -> BenchResult:
    """Return the rows of all benches `chosen`, measured one after the other.

    A bench that cannot run here is skipped with a message. A bench that fails adds a line, and `passed` of the result
    is False; the others are still measured.
    """
    from sfms_robot.lab.bench.measure import BenchResult

    rows: dict[str, Any] = {}
    failed: list[str] = []
    for key, one in chosen.items():
        say(key)
        began_s = time.monotonic()
        try:
            found = _measured(one, {}, say)
        except ConfigError as error:
            say(f"{key} is left out: {error}")
            continue
        except RobotError as error:
            failed.append(f"{key}: {error}")
            continue
        rows |= {name: each for name, each in found.figures.items() if isinstance(each, Mapping) and "median" in each}
        failed += [] if found.passed else [f"{key}: {line}" for line in found.lines]
        say(f"{key} took {time.monotonic() - began_s:.0f} s")
    return BenchResult.of_rows(rows, failed, passed=not failed)


def _measured(bench: Bench, given: Mapping[str, Any], say: Say) -> BenchResult:
    from sfms_robot.lab.bench.measure import BenchResult

    module, function = bench.place.split(":")
    measure = getattr(importlib.import_module(f"{__name__}.{module}"), function)
    found = measure(**given, **({"say": say} if "say" in bench.takes else {}))
    return found if isinstance(found, BenchResult) else BenchResult.of_rows(found)
