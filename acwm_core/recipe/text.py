"""YAML 1.2, as people expect it: 1e-4 is a number, a date is text; a duplicate key is an error."""

from __future__ import annotations

import re
from typing import Any

import yaml

from acwm_core.errors import RecipeError
from acwm_core.files import parse_yaml


def parse(text: str, origin: str) -> Any:
    """Read YAML.

    Args:
        text: the YAML text.
        origin: where the text is from, for the message.

    Raises:
        RecipeError: it is not valid YAML; says where and why.
    """
    try:
        return parse_yaml(text, _Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        line = f", line {mark.line + 1}" if mark and "\n" in text.strip() else ""
        raise RecipeError(f"{origin}{line} is not valid YAML: {error.problem!s}") from error
    except (yaml.YAMLError, ValueError) as error:  # e.g. a number of 5,000 digits
        why = str(error).splitlines()[0]
        raise RecipeError(f"{origin} is not valid YAML: {why}") from error


def dump(values: dict[str, Any]) -> str:
    """Write YAML that `parse` reads back unchanged, with keys in their order."""
    return yaml.dump(values, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


class _Loader(yaml.SafeLoader):
    pass


class _Dumper(yaml.SafeDumper):
    pass


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    keys = [key.value for key, _ in node.value]
    seen = set[Any]()
    twice = next((key for key in map(str, keys) if key in seen or seen.add(key)), None)
    if twice is not None:
        problem = f"{twice!r} is given twice"
        raise yaml.MarkedYAMLError(problem=problem, problem_mark=node.start_mark)
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:map", _mapping)

_CORE_SCHEMA = {
    "merge": r"<<",
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?[0-9]+|0o[0-7]+|0x[0-9a-fA-F]+",
    "float": r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"
    r"|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)",
}
"""What is not text if it is not quoted: YAML 1.2.2, 10.3.2, and ``<<``. In YAML 1.1, which PyYAML
reads by itself, 010 is 8, 12:30 is 750 and no is false."""

_Loader.yaml_implicit_resolvers = {}
_Dumper.yaml_implicit_resolvers = {
    start: [*pairs] for start, pairs in yaml.SafeDumper.yaml_implicit_resolvers.items()
}  # text that YAML 1.1 would read as something else is quoted, too
for _class in (_Loader, _Dumper):
    for _name, _pattern in _CORE_SCHEMA.items():
        _class.add_implicit_resolver(  # pyright: ignore[reportUnknownMemberType]
            f"tag:yaml.org,2002:{_name}", re.compile(f"(?:{_pattern})$"), None
        )


def _integer(loader: _Loader, node: yaml.ScalarNode) -> int:
    text = str(loader.construct_scalar(node))
    return int(text, 0 if text[:2] in ("0o", "0x") else 10)


_Loader.add_constructor("tag:yaml.org,2002:int", _integer)
