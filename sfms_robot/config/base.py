"""What every configuration file shares: strict frozen models, and errors of one line.

Files speak the units people use (degrees, milliseconds where the key says so); properties give radians and
seconds. Nothing past `load` handles a plain dict.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

from sfms_robot.config.yaml_file import read
from sfms_robot.errors import ConfigError

UNKNOWN_KEY: Final = "unknown_key"  # type of that problem, its key in the context

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


class Model(BaseModel):
    """Base: immutable, and an unknown key is an error rather than a shrug."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _known_keys(cls, value: Any) -> Any:
        for key, given in value.items() if isinstance(value, dict) else ():
            if key not in cls.model_fields:
                told = {"key": key, "choices": ", ".join(cls.model_fields), "shown": repr(key)}
                raise PydanticCustomError(UNKNOWN_KEY, "{shown} is not a known key ({choices})", told)
            # To Python true is 1: `id: true` would be servo 1.
            if isinstance(given, bool) and not _takes_bool(cls.model_fields[key].annotation):
                told = {"key": key, "shown": str(given).lower()}
                raise PydanticCustomError("bool", "{key} = {shown} is neither a number nor a name", told)
        return value


def _takes_bool(annotation: Any) -> bool:
    return annotation in (bool, Any) or any(_takes_bool(part) for part in get_args(annotation))


M = TypeVar("M", bound=BaseModel)


def load(model: type[M], file: Path) -> M:
    """Read one YAML file into `model`, or raise a ConfigError of one line."""
    return parse(model, read(file), file)


def parse(model: type[M], raw: object, file: Path | str) -> M:
    """Validate plain data; `file` is only for the message."""
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        raise ConfigError(_first(error, file)) from error


def _first(error: ValidationError, file: Path | str) -> str:
    problems = error.errors()
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{file}: {one_line(problems[0])}{more}"


def one_line(problem: ErrorDetails, where: str = "") -> str:
    """Key, value and what is wrong with it; `where` stands before the key."""
    key = ".".join(filter(None, (where, *(str(part) for part in problem["loc"]))))
    text = problem["msg"].removeprefix("Value error, ")
    if problem["type"] == "model_type":  # pydantic names the class
        text = "is no mapping (key: value)"
    value = problem["input"]
    shown = f" = {value!r}" if isinstance(value, (str, int, float, bool)) or value is None else ""
    return f"{key}{shown}: {text}" if key else text
