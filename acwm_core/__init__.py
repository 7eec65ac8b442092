"""acwm: action-conditioned video world models, from a simulator to an evaluated model."""


def __getattr__(name: str) -> str:
    """``__version__``; looked up when asked for, since that takes longer than to start `acwm`."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("acwm")
    except PackageNotFoundError:  # a source tree on the path, not installed
        return "0.0.0"


def main() -> None:
    """The program `acwm`: its command line, after Ctrl-C is taken care of."""
    from acwm_core.errors import handle_interrupts

    handle_interrupts()
    import importlib

    importlib.import_module("acwm_core.cli").main()  # by its name: all layers import this package
