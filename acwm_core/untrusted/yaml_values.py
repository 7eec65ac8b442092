"""YAML: bounded, of the values that JSON has as well."""

from __future__ import annotations

from typing import Any, cast

import yaml

from acwm_core.untrusted.files import STEERING, printable

MAX_YAML = 2**20
"""Bytes of a YAML file: a second or ten of PyYAML. Ours have some thousands."""

MAX_VALUES, MAX_DEPTH = 20_000, 50
"""Values of a YAML file with all its aliases written out, and how deep they may lie."""

MAX_DIGITS = 1000
"""Characters of a number in YAML."""

_TAGS = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
_PLAIN_TAGS = {f"tag:yaml.org,2002:{name}" for name in _TAGS}
"""What recipes and cards are made of; neither has dates, sets or bytes."""


class PlainLoader(yaml.SafeLoader):
    """YAML of bounded size and depth, however its aliases multiply it.

    Raises:
        yaml.YAMLError: it is beyond the bounds, or no YAML.
    """

    def __init__(self, stream: str) -> None:
        if len(stream) > MAX_YAML:
            raise yaml.YAMLError(f"it has more than {MAX_YAML} characters")
        self._depth = self._count = 0
        self._sizes: dict[int, int] = {}  # of nodes with all that is in them
        super().__init__(stream)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """One value; an alias counts as much as what it stands for."""
        if self._depth == MAX_DEPTH:
            raise yaml.YAMLError(f"it has more than {MAX_DEPTH} values in one another")
        alias = cast(Any, self).check_event(yaml.AliasEvent)
        before, self._depth = self._count, self._depth + 1
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        if alias and id(node) not in self._sizes:
            raise yaml.YAMLError("a value holds itself")
        self._count += self._sizes[id(node)] if alias else 1
        self._sizes[id(node)] = self._count - before
        if self._count > MAX_VALUES:
            raise yaml.YAMLError(f"it stands for more than {MAX_VALUES} values")
        if node.tag not in _PLAIN_TAGS:
            raise yaml.YAMLError(f"it has a {printable(node.tag)[:80]!r}")
        if isinstance(node, yaml.ScalarNode):
            if STEERING.search(node.value):
                raise yaml.YAMLError("it has control characters")
            if len(node.value) > MAX_DIGITS and node.tag.endswith((":int", ":float")):
                raise yaml.YAMLError(f"it has a number of {len(node.value)} characters")
        return node

    def get_single_data(self) -> Any:
        """All that the text says; whatever the parser raises of it is a `YAMLError`."""
        try:
            return super().get_single_data()
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error
