"""The program `acwm`: the command line, after Ctrl-C is taken care of."""

from acwm_core.interrupts import handle_interrupts


def main() -> None:
    """Run the command line of this process."""
    handle_interrupts()
    from acwm_core.cli import main as run

    run()
