"""Tests that need what an extra installs; nothing is imported to find out."""

import importlib.util

import pytest


def needs(*modules):
    """A mark: skip where one of these modules is not installed."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"not installed: {', '.join(missing)}")
