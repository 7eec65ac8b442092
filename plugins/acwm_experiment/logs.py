"""Logs of the steps of an experiment, and their state on this machine."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class StepLogs:
    """Small files for each step: its output, and its state on this machine.

    ``STEP.log`` holds the output of all attempts, each after a line with its command.
    ``STEP.state`` exists while the step is ``running``, or after it has ``failed``.
    """

    folder: Path  # folder of the files

    def log(self, step: str) -> Path:
        """The log file of a step."""
        return self.folder / f"{step}.log"

    def state(self, step: str) -> str:
        """``running``, ``failed``, or ``""`` for a step that is done or still to do."""
        file = self.folder / f"{step}.state"
        return file.read_text(encoding="utf-8").strip() if file.exists() else ""

    def set_state(self, step: str, state: str) -> None:
        """Save the state of a step."""
        file = self.folder / f"{step}.state"
        if state:
            file.write_text(f"{state}\n", encoding="utf-8")
        else:
            file.unlink(missing_ok=True)

    def last_line(self, step: str) -> str:
        """The last line of a step's last attempt, where a command says what went wrong."""
        try:
            text = self.log(step).read_text("utf-8", errors="replace")
        except OSError:
            return ""
        last = ["", *text.rstrip().splitlines()][-1].strip()
        return "" if re.match(r"\d[\d-]+ [\d:]+ \$ acwm ", last) else last.removeprefix("acwm: ")
