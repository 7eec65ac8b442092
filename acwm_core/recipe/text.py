"""YAML as people expect it: 1e-4 is a number, a date is text, a duplicate key is an error."""

from __future__ import annotations

import re
from typing import Any

import yaml

from acwm_core.errors import RecipeError


def parse(text: str, origin: str) -> Any:
    """Read YAML.

    Args:
        text: the YAML text.
        origin: where the text is from, for the message.

    Raises:
        RecipeError: it is not valid YAML; says where and why.
    """
    try:
        return yaml.load(text, _Loader)
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

_RESOLVERS = {
    start: [(tag, pattern) for tag, pattern in resolvers if not tag.endswith(":timestamp")]
    for start, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
for _class in (_Loader, _Dumper):
    _class.yaml_implicit_resolvers = {start: [*pairs] for start, pairs in _RESOLVERS.items()}
    _class.add_implicit_resolver(  # pyright: ignore[reportUnknownMemberType]
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
        list("-+.0123456789"),
    )
