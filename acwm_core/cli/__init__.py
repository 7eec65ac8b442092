"""The command line, `acwm`. Commands are thin: each passes its arguments to one function."""

from acwm_core.cli.main import main

__all__ = ["main"]
