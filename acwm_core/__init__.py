"""acwm: action-conditioned video world models, from a simulator to an evaluated model."""


def __getattr__(name: str) -> str:
    """Look up ``__version__`` on first use, as that takes longer than starting `acwm`."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("acwm")
    except PackageNotFoundError:  # a source tree on the path, not installed
        return "0.0.0"


def main() -> None:
    """Entry point of the program `acwm`: handle Ctrl-C, then run the command line."""
    from acwm_core.interrupts import begin_process

    begin_process()
    import importlib

    importlib.import_module("acwm_core.cli").main()  # by name, as the CLI imports this package
