"""The command line, `acwm`. Commands are thin: each hands its arguments to one function."""

from acwm_core.cli.main import main

__all__ = ["main"]
