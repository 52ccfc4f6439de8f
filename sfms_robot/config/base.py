"""YAML files as frozen, strict models, with errors of one line that name file, key, value and valid choices.

Files use the units that people use (degrees, milliseconds where the key says so); properties return radians and
seconds. Code after `load` never handles a plain dict.

Scalars are those of YAML 1.2's core schema. YAML 1.1, the default of pyyaml, reads `yes`, `on` and `no` as booleans,
`023` as 19 and `1:30` as 90. Here only `true` and `false` are booleans, and a number with a leading zero is refused,
because YAML readers disagree about it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Self, TypeVar, get_args

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError

from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError, InputError, did_you_mean, not_one_of

DEEPEST: Final = 100  # levels of nesting; libyaml's composer is recursive and crashes at about 10,000 levels
_LEADING_ZERO: Final = "!leading-zero"

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")]


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("expected printable characters")
    return text


PRINTABLE: Final = AfterValidator(_printable)


Problems = Iterator[str]  # one line per problem


class Model(BaseModel):
    """An immutable section of a file; an unknown key is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @model_validator(mode="wrap")
    @classmethod
    def _known_keys(cls, value: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Report unknown keys with the known ones, and then the other problems of the section."""
        found = []
        for key, given in value.items() if isinstance(value, dict) else ():
            if isinstance(key, (int, float)) and given is None:  # from {min_deg: 25,5}
                found.append(f"{key} stands alone, without a key: a decimal number is written with a point, as 25.5")
            elif key not in cls.model_fields:
                found.append(not_one_of(key, "a known key", cls.model_fields))
            # In Python true equals 1: `id: true` would be servo 1.
            elif isinstance(given, bool) and not _takes_bool(cls.model_fields[key].annotation):
                found.append(f"{key} = {str(given).lower()} is neither a number nor a name")
        if not found:
            return handler(value)
        details = [_detail(text) for text in found]
        try:
            handler({key: value[key] for key in cls.model_fields if key in value})
        except ValidationError as error:
            details += [_detail(each["msg"], each["loc"], each["input"]) for each in error.errors()]
        raise ValidationError.from_exception_data(cls.__name__, details)

    def replaced(self, **values: Any) -> Self:
        """Return the section with other values. Nothing is validated: see `parse`."""
        return self.model_copy(update=values)

    @model_validator(mode="after")
    def _without_contradictions(self) -> Self:
        for problem in self.contradictions():
            raise ValueError(problem)
        return self

    def contradictions(self) -> Iterable[str]:
        """Yield the contradictions between the values of this section. The first one is its error."""
        return ()


def all_of(problems: Iterable[str]) -> ValidationError:
    """Return the error of a model with several problems, for a validator to raise."""
    return ValidationError.from_exception_data("", [_detail(text) for text in problems])


def _detail(text: str, where: tuple[int | str, ...] = (), value: Any = ()) -> InitErrorDetails:
    return InitErrorDetails(type=PydanticCustomError("problem", "{text}", {"text": text}), loc=where, input=value)


def _takes_bool(annotation: Any) -> bool:
    return annotation in (bool, Any) or any(_takes_bool(part) for part in get_args(annotation))


M = TypeVar("M", bound=BaseModel)


def load(model: type[M], file: Path) -> M:
    """Read one YAML file as `model`. Raises a ConfigError of one line."""
    return parse(model, read(file), file)


def parse(model: type[M], raw: object, file: Path | str) -> M:
    """Validate plain data as `model`; a ConfigError begins with the name `file`."""
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        problems = error.errors()
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise ConfigError(f"{file}: {one_line(problems[0])}{more}") from error


def one_line(problem: ErrorDetails) -> str:
    """Return key, value and problem in one line."""
    key = ".".join(map(str, problem["loc"]))
    text = problem["msg"].removeprefix("Value error, ")
    value = problem["input"]
    if problem["type"] in ("model_type", "dict_type"):  # pydantic's message names the Python class
        text = "expected keys with values, as key: value"
        text += ", got a list: leave out the dashes" if isinstance(value, list) else ""
    elif problem["type"] == "literal_error":
        text += did_you_mean(value, re.findall(r"'([^']*)'", problem["ctx"]["expected"]))
    elif isinstance(value, str) and re.fullmatch(r"-?\d+,\d+", value):
        text = f"a decimal number is written with a point: {value.replace(',', '.')}"
    shown = f" = {value!r}" if isinstance(value, (str, int, float, bool)) or value is None else ""
    return f"{key}{shown}: {text}" if key else text


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # libyaml: ten times faster
    """Safe loader that refuses a key given twice instead of keeping the last value."""

    yaml_implicit_resolvers: ClassVar[dict[str, Any]] = {}  # without those of YAML 1.1


# YAML 1.2.2, section 10.3.2; the resolvers of a scalar are looked up by its first character
for _tag, _pattern, _first in (
    ("tag:yaml.org,2002:null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("tag:yaml.org,2002:bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    (_LEADING_ZERO, r"[-+]?0[0-9]+", list("-+0")),
    ("tag:yaml.org,2002:int", r"[-+]?[0-9]+", list("-+0123456789")),
    ("tag:yaml.org,2002:float", r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?", list("-+.0123456789")),
    ("tag:yaml.org,2002:float", r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)", list("-+.")),
    ("tag:yaml.org,2002:merge", r"<<", ["<"]),
):
    _Loader.add_implicit_resolver(_tag, re.compile(f"^(?:{_pattern})$"), _first)


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    seen = set[Any]()
    for key_node, _ in node.value:
        key = loader.construct_object(key_node)
        if key in seen:
            raise yaml.constructor.ConstructorError(None, None, f"{key!r} is given twice", key_node.start_mark)
        seen.add(key)
    return yaml.SafeLoader.construct_mapping(loader, node, deep=True)


def _whole(loader: _Loader, node: yaml.ScalarNode) -> int:
    try:
        return whole_number(node.value)
    except InputError as error:
        raise yaml.constructor.ConstructorError(None, None, str(error), node.start_mark) from error


def _leading_zero(loader: _Loader, node: yaml.ScalarNode) -> None:
    problem = f"{node.value} has a leading zero: write {_whole(loader, node)}, or '{node.value}' for a text"
    raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)


_Loader.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)
_Loader.add_constructor("tag:yaml.org,2002:int", _whole)
_Loader.add_constructor(_LEADING_ZERO, _leading_zero)


def read(file: Path) -> Any:
    """Return the plain data of one YAML file. Raises a ConfigError of one line, with the line of the file."""
    try:
        text = file.read_text(encoding="utf-8")
        depth = 0
        events: Iterable[Any] = yaml.parse(text, Loader=_Loader)
        for event in events:
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > DEEPEST:
                problem = f"nested more than {DEEPEST} levels deep"
                raise yaml.MarkedYAMLError(None, None, problem, event.start_mark)
        return yaml.load(text, Loader=_Loader)
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        problem += "; YAML is indented with spaces, not tabs" if "'\\t'" in problem or "tab" in problem else ""
        raise ConfigError(f"{file}{where}: {problem}") from error


def with_number(text: str, keys: Sequence[str], value: int) -> str:
    """Return `text` with `value` under a path of mapping keys; comments, order and all other values stay unchanged.

    Edits only the text: aliases and merge keys are not followed, so the caller has to check the meaning of the result.
    """
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    missing, new = list(keys), f"{value}"
    while isinstance(node, yaml.MappingNode) and (found := [v for k, v in node.value if [k.value] == missing[:1]]):
        node = found[0]
        del missing[0]
    for key in reversed(missing):
        new = f"{{{key}: {new}}}"
    start, end = node.start_mark.index, node.end_mark.index
    if isinstance(node, yaml.MappingNode):  # the value becomes its first entry
        start = end = start + node.flow_style
        new = new[1:-1] + (", " if node.flow_style else f"\n{' ' * node.start_mark.column}")
    return text[:start] + new + text[end:]
