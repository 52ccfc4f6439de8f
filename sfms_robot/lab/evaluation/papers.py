"""`evaluate papers`: tables I to IV of SFMS and 1, 2, 4 of ARIG, the papers as written beside the shipped listeners."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from sfms_robot.errors import ConfigError
from sfms_robot.lab.corpora.collection import Order
from sfms_robot.lab.evaluation import arig_tables
from sfms_robot.lab.evaluation.arig_tables import ABLATIONS, LABELS, AblationOptions, arig_table, as_written
from sfms_robot.lab.evaluation.listener_evaluation import listener_table
from sfms_robot.lab.evaluation.rollout import load_at_hop
from sfms_robot.lab.evaluation.tokenizer_tables import TABLES as TOKENIZER_TABLES
from sfms_robot.lab.evaluation.tokenizer_tables import TableOptions, evaluate_table, needed

_SFMS, _ARIG = "sfms-small", "arig-small"
_SFMS_TABLES: Final = ("1", "2")
EVERY: Final = (*_SFMS_TABLES, *TOKENIZER_TABLES, *arig_tables.TABLES)


@dataclass(frozen=True, kw_only=True)
class PapersOptions:
    """Options of the command.

    Attributes:
        data: Composed dyads, with speaking/ and interaction/.
        models: Folder of listeners and tokenizers for tables alone, trained if missing; None: their rows are left out,
            and `not_trained` of a table lists how to make them.
        tables: Of `EVERY`.
        clips: Most dyads for a table; samples: answers to every clip of tables 1 and 2.
        steps: Of every training, in place of its file's.
    """

    data: Path
    models: Path | None
    tables: Sequence[str] = EVERY
    clips: int | None = None
    samples: int = 10
    steps: int | None = None
    seed: int = 1


def evaluate_papers(options: PapersOptions, each: Callable[[str, dict[str, Any]], None]) -> dict[str, Any]:
    """Return every table; call `each(name, table)` as soon as one is done. Raises ConfigError.

    Blocks for minutes; for hours if listeners have to be trained. An interrupted training is resumed.
    """
    unknown = [name for name in options.tables if name not in EVERY]
    if unknown:
        raise ConfigError(f"--table {unknown[0]}: is not one of {', '.join(EVERY)}")
    tables = {}
    for name in options.tables:
        tables[name] = _table(name, options)
        if options.models is None:
            tables[name] |= {"not_trained": _not_trained(name)}
        each(name, tables[name])
    return {"tables": tables}


def _table(name: str, options: PapersOptions) -> dict[str, Any]:
    models, steps = options.models, options.steps
    if name in TOKENIZER_TABLES:
        return evaluate_table(
            TableOptions(table=name, models=None if models is None else models / "tokenizers", steps=steps)
        )
    if name in _SFMS_TABLES:
        return sfms_table(
            int(name), [_SFMS], options.data, samples=options.samples, limit=options.clips, seed=options.seed,
            models=models, steps=steps,
        )  # fmt: skip
    names = [_ARIG, _SFMS] if name == "arig-2" else [_ARIG]
    ablations = AblationOptions(models, steps=steps, train=models is not None)
    return arig_table(name, names, options.data, options.clips, options.seed, ablations)


def sfms_table(
    number: int,
    names: Sequence[str],
    data: Path,
    *,
    samples: int,
    limit: int | None,
    seed: int,
    order: Order | None = None,
    hop: int | None = None,
    models: Path | None = None,
    steps: int | None = None,
) -> dict[str, Any]:
    """Return table 1 or 2 of SFMS for listeners by name; with a folder `models` also for the paper as written."""
    listeners = {name: load_at_hop(name, hop, "auto") for name in names}
    if models is not None:
        written = as_written("sfms", data, models, steps, order)
        listeners |= {label: load_at_hop(str(folder)) for label, folder in written.items()}
    return listener_table(number, listeners, data, samples=samples, limit=limit, seed=seed, order=order)


def _not_trained(name: str) -> dict[str, str]:
    """Return the missing rows of a table, and what makes them."""

    def file(kind: arig_tables.Kind) -> str:
        return "/".join(arig_tables.training_file(kind).parts[-3:])

    if name in TOKENIZER_TABLES:
        lacking = set(needed(name)) - set(needed(name, shipped=True))
        return {row: f"evaluate tokenizer --table {name} --models DIR, minutes each" for row in sorted(lacking)}
    if name in _SFMS_TABLES:
        return {LABELS["sfms"]: f"train tokenizer, then train listener, --config {file('sfms')}"}
    rows = [LABELS["arig"]] if name == "arig-2" else ["ARIG", *ABLATIONS[int(name.removeprefix("arig-"))]]
    return {row: f"train listener --config {file('arig')}" for row in rows}
