"""``python -m acwm_core.cli``, the same as ``acwm``."""

from acwm_core.cli.main import main

if __name__ == "__main__":
    main(prog_name="acwm")
