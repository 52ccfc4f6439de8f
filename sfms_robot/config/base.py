"""What every configuration file shares: strict frozen models, safe YAML, and errors of one line.

Files speak the units people use (degrees, milliseconds where the key says so); properties give radians and
seconds. Nothing past `load` handles a plain dict.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator
from pydantic_core import ErrorDetails, PydanticCustomError

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
        for key in value if isinstance(value, dict) else ():
            if key not in cls.model_fields:
                told = {"key": key, "choices": ", ".join(cls.model_fields), "shown": repr(key)}
                raise PydanticCustomError(UNKNOWN_KEY, "{shown} is not a known key ({choices})", told)
        return value


M = TypeVar("M", bound=BaseModel)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # libyaml's is ten times faster
    """Safe YAML that refuses a key given twice instead of keeping the last."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen: set[Any] = set()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node)
        if key in seen:
            raise yaml.constructor.ConstructorError(None, None, f"{key!r} is given twice", key_node.start_mark)
        seen.add(key)
    return yaml.SafeLoader.construct_mapping(loader, node, deep=True)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def load(model: type[M], file: Path) -> M:
    """Read one YAML file into `model`, or raise a ConfigError of one line."""
    return parse(model, read(file), file)


def read(file: Path) -> Any:
    """The plain data of one YAML file. Raises a ConfigError of one line."""
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    try:
        return yaml.load(text, Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        raise ConfigError(f"{file}{where}: {problem}") from error


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
    value = problem["input"]
    shown = f" = {value!r}" if isinstance(value, (str, int, float, bool)) or value is None else ""
    return f"{key}{shown}: {text}" if key else text
