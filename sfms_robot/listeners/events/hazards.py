"""The chance of each event in the next 80 ms, as a sum of curves that people taught: log-odds are added, by name.

`sim/listeners/events.yaml` holds them: of every kind an intercept and, per evidence (`events.evidence`), either a
number that multiplies it or the values of a curve at its knots, between which it is straight over log(1 + seconds /
0.2). A curve whose last value is 0 forgets. `gaze_shift` is the hazard of looking away from the person.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from pydantic import Field, model_validator

from sfms_robot.config import Model, load
from sfms_robot.config.base import Finite, NonNegative, Positive
from sfms_robot.data import data_dir
from sfms_robot.frames import EVENT_KINDS, Doubles
from sfms_robot.listeners.events.evidence import AT, EVIDENCE, NUMBERS
from sfms_robot.signals.phase import log_time

STEP_FRAMES: Final = 2
STEP_S: Final = 0.08
FILE: Final = "events.yaml"  # in sim/listeners
_BOUND: Final = 30.0  # of log-odds
_LONG_AGO: Final = 50.0  # on the axis of curves, beyond every knot

Curve = Annotated[dict[NonNegative, Finite], Field(min_length=2)]
Quantiles = Annotated[tuple[NonNegative, ...], Field(min_length=2)]


class Hazard(Model):
    """When: one kind of event.

    Attributes:
        learned_from: whose events these are.
        per_minute: how often they do it, in the time in which they may.
        intercept: log-odds of 80 ms when nothing speaks for or against it.
        weights: by evidence.
    """

    learned_from: str
    per_minute: Positive
    intercept: Finite
    weights: Annotated[dict[str, Finite | Curve], Field(min_length=1)]

    @model_validator(mode="after")
    def _known(self) -> Hazard:
        for name, weight in self.weights.items():
            if name not in EVIDENCE:
                raise ValueError(f"weights.{name} is not known evidence ({', '.join(EVIDENCE)})")
            if isinstance(weight, dict) == (name in NUMBERS):
                wanted = "one number" if name in NUMBERS else "values by knot [s]"
                raise ValueError(f"weights.{name} needs {wanted}")
            if isinstance(weight, dict) and list(weight) != sorted(weight):
                raise ValueError(f"weights.{name}: knots have to rise")
        return self


class Shape(Model):
    """How long and how large, drawn evenly from quantiles (the first is the least, the last the greatest).

    Attributes:
        duration_s: of the whole event; of looking away, until the look back.
        size: see `frames.ListenerEvent`; nods, shakes and tilts in degrees, a gaze shift too.
        habit: quantiles of what every stream multiplies its sizes by; drawn once.
        swings_hz: quantiles of the pace of nods and shakes; drawn once.
    """

    duration_s: Quantiles
    size: Quantiles
    habit: Quantiles = (1.0, 1.0)
    swings_hz: Quantiles | None = None

    @model_validator(mode="after")
    def _rising(self) -> Shape:
        for name in ("duration_s", "size", "habit", "swings_hz"):
            values = getattr(self, name)
            if values is not None and list(values) != sorted(values):
                raise ValueError(f"{name}: quantiles have to rise")
        return self


class EventTables(Model):
    """What the file holds: when and how, by kind; every kind has both."""

    hazards: dict[str, Hazard]
    shapes: dict[str, Shape]

    @model_validator(mode="after")
    def _whole(self) -> EventTables:
        for section in ("hazards", "shapes"):
            given = getattr(self, section)
            for kind in [*given, *EVENT_KINDS]:
                if kind not in EVENT_KINDS or kind not in given:
                    problem = "is missing" if kind in EVENT_KINDS else "is not a kind of event"
                    raise ValueError(f"{section}: {kind} {problem} ({', '.join(EVENT_KINDS)})")
        return self


def load_tables(file: Path | None = None) -> EventTables:
    """From a file as `train events` writes it, or the bundled one. Raises a ConfigError of one line."""
    return load(EventTables, data_dir("sim") / "listeners" / FILE if file is None else file)


@dataclass(frozen=True)
class _Knots:
    """Every knot of every curve of every kind, one after the other (K,), and numbers as curves of one knot.

    Attributes:
        column: of the evidence.
        weight: value at the knot.
        left, left_slope, right, right_slope: where on the axis its hat is 0 and how steep it rises from there.
        number: it multiplies a number.
        first: (T,) index of the first knot of each term; `kind`: (H,) index of the first term of each kind.
    """

    column: np.typing.NDArray[np.int64]
    weight: Doubles
    left: Doubles
    left_slope: Doubles
    right: Doubles
    right_slope: Doubles
    number: np.typing.NDArray[np.bool_]
    first: np.typing.NDArray[np.int64]
    kind: np.typing.NDArray[np.int64]


class HazardBank:
    """All hazards at once, of one row of evidence or of many."""

    def __init__(self, hazards: Mapping[str, Hazard]) -> None:
        self.kinds: tuple[str, ...] = tuple(hazards)
        self.terms: tuple[tuple[str, ...], ...] = tuple(tuple(hazards[kind].weights) for kind in self.kinds)
        self._intercepts = np.array([hazards[kind].intercept for kind in self.kinds])
        self._knots = _flat(hazards)
        self._starts = [int(start) for start in self._knots.kind]

    def contributions(self, evidence: Doubles) -> Doubles:
        """(..., len(EVIDENCE)) -> (..., T): what each term adds to the log-odds of its kind; NaN and none add 0."""
        k = self._knots
        value = evidence[..., k.column]
        time = np.minimum(log_time(np.maximum(evidence, 0.0)), _LONG_AGO)[..., k.column]
        hat = np.minimum((time - k.left) * k.left_slope, (k.right - time) * k.right_slope)
        hat = np.minimum(np.maximum(hat, 0.0), 1.0)
        each = np.where(np.isnan(value), 0.0, k.weight * np.where(k.number, value, hat))
        return np.asarray(np.add.reduceat(each, k.first, axis=-1), np.float64)

    def log_odds(self, contributions: Doubles) -> Doubles:
        """(..., T) -> (..., H), always finite."""
        total = self._intercepts + np.add.reduceat(contributions, self._knots.kind, axis=-1)
        return np.asarray(np.minimum(np.maximum(np.where(np.isnan(total), 0.0, total), -_BOUND), _BOUND), np.float64)

    def told(self, contributions: Doubles, kind: str, most: int = 4) -> dict[str, float]:
        """The largest terms of one kind, by evidence, of contributions (T,)."""
        at = self.kinds.index(kind)
        own = contributions[self._starts[at] : self._starts[at] + len(self.terms[at])]
        largest = sorted(range(len(own)), key=lambda index: -abs(own[index]))[:most]
        return {self.terms[at][index]: round(float(own[index]), 3) for index in largest if own[index]}


def _flat(hazards: Mapping[str, Hazard]) -> _Knots:
    rows: list[tuple[float, ...]] = []
    first: list[int] = []
    kind: list[int] = []
    for hazard in hazards.values():
        kind.append(len(first))
        for name, weight in hazard.weights.items():
            first.append(len(rows))
            rows += _curve(AT[name], weight)
    column, weights, left, left_slope, right, right_slope, number = np.array(rows, np.float64).T
    return _Knots(
        column.astype(np.int64), weights, left, left_slope, right, right_slope, number.astype(bool),
        np.array(first), np.array(kind),
    )  # fmt: skip


def _curve(column: int, weight: float | Mapping[float, float]) -> list[tuple[float, ...]]:
    """A row of `_Knots` for each knot. The first hat is 1 before its knot, the last behind it."""
    if not isinstance(weight, Mapping):
        return [(column, weight, 0.0, 0.0, 0.0, 0.0, True)]
    at = log_time(list(weight)).tolist()
    rows: list[tuple[float, ...]] = []
    for index, value in enumerate(weight.values()):
        low, high = index == 0, index == len(at) - 1
        left, left_slope = (-1.0, 1e9) if low else (at[index - 1], 1 / (at[index] - at[index - 1]))
        right, right_slope = (np.inf, 1.0) if high else (at[index + 1], 1 / (at[index + 1] - at[index]))
        rows.append((column, value, left, left_slope, right, right_slope, False))
    return rows
