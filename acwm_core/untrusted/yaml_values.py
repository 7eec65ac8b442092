"""Read YAML safely: bounded, and only with values that JSON also has."""

from __future__ import annotations

from typing import Any, cast

import yaml

from acwm_core.untrusted.files import STEERING, printable

MAX_YAML = 2**20
"""Largest accepted YAML file in bytes, which PyYAML reads in 1 to 10 s. acwm's have thousands."""

MAX_VALUES, MAX_DEPTH = 20_000, 50
"""Limits: values of a YAML file with all aliases expanded, and their nesting depth."""

MAX_DIGITS = 1000
"""Most characters of a number in YAML."""

_TAGS = ("null", "bool", "int", "float", "str", "seq", "map", "merge")
_PLAIN_TAGS = {f"tag:yaml.org,2002:{name}" for name in _TAGS}
"""The YAML types of recipes and cards, which contain no dates, sets or bytes."""


class PlainLoader(yaml.SafeLoader):
    """A YAML loader that bounds size and depth, counted with aliases expanded.

    Raises:
        yaml.YAMLError: the text exceeds the bounds, or is not YAML.
    """

    def __init__(self, stream: str) -> None:
        if len(stream) > MAX_YAML:
            raise yaml.YAMLError(f"it has more than {MAX_YAML} characters")
        self._depth = self._count = 0
        self._sizes: dict[int, int] = {}  # values in each node, with all nested ones
        super().__init__(stream)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose one value; an alias counts as many values as its target."""
        if self._depth == MAX_DEPTH:
            raise yaml.YAMLError(f"it is nested more than {MAX_DEPTH} levels deep")
        alias = cast(Any, self).check_event(yaml.AliasEvent)
        before, self._depth = self._count, self._depth + 1
        node: Any = super().compose_node(parent, index)
        self._depth -= 1
        if alias and id(node) not in self._sizes:
            raise yaml.YAMLError("a value contains itself")
        self._count += self._sizes[id(node)] if alias else 1
        self._sizes[id(node)] = self._count - before
        if self._count > MAX_VALUES:
            raise yaml.YAMLError(f"it has more than {MAX_VALUES} values with its aliases expanded")
        if node.tag not in _PLAIN_TAGS:
            raise yaml.YAMLError(f"it has a {printable(node.tag)[:80]!r}")
        if isinstance(node, yaml.ScalarNode):
            if STEERING.search(node.value):
                raise yaml.YAMLError("it has control characters")
            if len(node.value) > MAX_DIGITS and node.tag.endswith((":int", ":float")):
                raise yaml.YAMLError(f"it has a number of {len(node.value)} characters")
        return node

    def get_single_data(self) -> Any:
        """Parse the text; every exception of the parser becomes a `YAMLError`."""
        try:
            return super().get_single_data()
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error
