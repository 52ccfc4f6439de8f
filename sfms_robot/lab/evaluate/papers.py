"""Behind `evaluate papers`: tables I to IV of SFMS and 1, 2, 4 of ARIG, the papers as written beside ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sfms_robot.errors import ConfigError
from sfms_robot.lab.evaluate.arig_evaluation import TABLES as ARIG_TABLES
from sfms_robot.lab.evaluate.arig_evaluation import AblationOptions, arig_table
from sfms_robot.lab.evaluate.as_written import LABELS, Kind, training_file
from sfms_robot.lab.evaluate.listener_evaluation import listener_table
from sfms_robot.lab.evaluate.tokenizer_evaluation import TableOptions, evaluate_table
from sfms_robot.lab.evaluation.paper.arig_tables import ABLATIONS
from sfms_robot.lab.evaluation.paper.tokenizer_tables import needed

OURS: Final[Mapping[str, str]] = {"sfms": "sfms-small", "arig": "arig-small"}
SFMS_TABLES: Final = ("1", "2")
TOKENIZER_TABLES: Final = ("3", "4")
EVERY: Final = (*SFMS_TABLES, *TOKENIZER_TABLES, *ARIG_TABLES)


@dataclass(frozen=True)
class PapersOptions:
    """What the command line says.

    Attributes:
        data: composed dyads, with speaking/ and interaction/.
        models: folder of what only tables need, trained where it is missing; None: those rows are left out, and
            `not_trained` of a table says how they come about.
        tables: of `EVERY`.
        clips: at most so many dyads a table; samples: answers to every clip of tables 1 and 2.
        steps: of every training, not its file's.
    """

    data: Path
    models: Path | None
    tables: Sequence[str] = EVERY
    clips: int | None = None
    samples: int = 10
    steps: int | None = None
    seed: int = 1


def evaluate_papers(options: PapersOptions, told: Callable[[str, dict[str, Any]], None]) -> dict[str, Any]:
    """Every table; `told` hears its name and what came out as soon as it is there. Raises ConfigError.

    Blocks for minutes; for hours where listeners are to be trained, and goes on where it was interrupted.
    """
    unknown = [name for name in options.tables if name not in EVERY]
    if unknown:
        raise ConfigError(f"--table {unknown[0]}: is not one of {', '.join(EVERY)}")
    tables = {}
    for name in options.tables:
        tables[name] = _table(name, options)
        told(name, tables[name])
    return {"tables": tables}


def _table(name: str, options: PapersOptions) -> dict[str, Any]:
    found = _scored(name, options)
    return found if options.models is not None else {**found, "not_trained": _not_trained(name)}


def _scored(name: str, options: PapersOptions) -> dict[str, Any]:
    if name in TOKENIZER_TABLES:
        folder = None if options.models is None else options.models / "tokenizers"
        return evaluate_table(TableOptions(name, models=folder, steps=options.steps))
    if name in SFMS_TABLES:
        return listener_table(
            int(name), [OURS["sfms"]], options.data, options.samples, options.clips, options.seed,
            models=options.models, steps=options.steps,
        )  # fmt: skip
    names = list(OURS.values())[::-1] if name == "arig-2" else [OURS["arig"]]
    ablations = AblationOptions(options.models, steps=options.steps, train=options.models is not None)
    return arig_table(name, names, options.data, options.clips, options.seed, ablations)


def _not_trained(name: str) -> dict[str, str]:
    """Rows that a table has not, and what makes them."""
    if name in TOKENIZER_TABLES:
        lacking = set(needed(name)) - set(needed(name, shipped=True))
        return {row: f"evaluate tokenizer --table {name} --models DIR, minutes each" for row in sorted(lacking)}
    if name in SFMS_TABLES:
        return {LABELS["sfms"]: f"train tokenizer, then train listener, --config {_shown('sfms')}"}
    rows = [LABELS["arig"]] if name == "arig-2" else ["ARIG", *ABLATIONS[int(name.removeprefix("arig-"))]]
    return {row: f"train listener --config {_shown('arig')}" for row in rows}


def _shown(kind: Kind) -> str:
    return "/".join(training_file(kind).parts[-3:])
