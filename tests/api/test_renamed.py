"""Old names of modules and errors lead to the same objects, with a warning."""

import importlib

import pytest

from acwm_core import errors
from acwm_core.renamed import RENAMED, RENAMED_ATTRIBUTES, RenamedWarning


@pytest.mark.parametrize("old", RENAMED)
def test_a_module_is_found_by_its_old_name(old):
    with pytest.warns(RenamedWarning, match=RENAMED[old]):
        assert importlib.import_module(old) is importlib.import_module(RENAMED[old])


def test_an_error_is_found_by_its_old_name():
    for old, new in RENAMED_ATTRIBUTES["acwm_core.errors"].items():
        with pytest.warns(RenamedWarning, match=f"{old} is now called {new}"):
            assert getattr(errors, old) is getattr(errors, new)
    with pytest.raises(AttributeError, match="NeverError"):
        errors.NeverError  # noqa: B018
