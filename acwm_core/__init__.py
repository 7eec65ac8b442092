"""acwm: action-conditioned video world models, from a simulator to an evaluated model."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("acwm")
except PackageNotFoundError:  # a source tree on the path, not installed
    __version__ = "0.0.0"
