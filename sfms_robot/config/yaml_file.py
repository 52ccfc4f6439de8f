"""YAML in: the scalars of YAML 1.2's core schema, no key twice, no depth that a parser could break on.

YAML 1.1, which pyyaml reads by default, takes `yes`, `on` and `no` for booleans, `023` for 19 and `1:30` for 90. Here
only `true` and `false` are booleans, and a number with a leading zero is refused: readers do not agree on it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Final

import yaml

from sfms_robot.endpoint import whole_number
from sfms_robot.errors import ConfigError, InputError

DEEPEST: Final = 100  # levels; libyaml's composer recurses, and ends the process at some 10,000
_LEADING_ZERO: Final = "!leading-zero"


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]  # libyaml's is ten times faster
    """Safe YAML that refuses a key given twice instead of keeping the last."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (none of YAML 1.1)


# YAML 1.2.2, section 10.3.2; a scalar is looked up by its first character
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
    seen: set[Any] = set()
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
    """The plain data of one YAML file. Raises a ConfigError of one line, with the line of the file."""
    try:
        text = file.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{file}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {error}") from error
    try:
        _check_depth(text)
        return yaml.load(text, Loader=_Loader)  # noqa: S506  (a SafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark else ""
        problem = " ".join(str(getattr(error, "problem", None) or error).split())
        raise ConfigError(f"{file}{where}: {problem}") from error


def with_number(text: str, keys: Sequence[str], value: int) -> str:
    """Return `text` with `value` under a path of mapping keys; comments, order and all other values stay.

    Only what is written there is edited: aliases and merge keys are not followed, so look at what the result means.
    """
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    missing, new = list(keys), f"{value}"
    while isinstance(node, yaml.MappingNode) and (found := [v for k, v in node.value if [k.value] == missing[:1]]):
        node = found[0]
        del missing[0]
    for key in reversed(missing):
        new = f"{{{key}: {new}}}"
    start, end = node.start_mark.index, node.end_mark.index
    if isinstance(node, yaml.MappingNode):  # as its first entry
        start = end = start + node.flow_style
        new = new[1:-1] + (", " if node.flow_style else f"\n{' ' * node.start_mark.column}")
    return text[:start] + new + text[end:]


def _check_depth(text: str) -> None:
    depth = 0
    events: Iterable[Any] = yaml.parse(text, Loader=_Loader)
    for event in events:
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > DEEPEST:
                mark: Any = event.start_mark
                raise yaml.MarkedYAMLError(None, None, f"nested more than {DEEPEST} levels deep", mark)
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
