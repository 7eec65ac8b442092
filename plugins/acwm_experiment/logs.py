"""What steps of an experiment printed, and what becomes of them here."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class StepLogs:
    """Small files for each step: what it printed, and what becomes of it on this machine.

    ``STEP.log`` has all attempts one after the other, each after a line with its command;
    ``STEP.state`` is there while it is ``running``, or once it has ``failed``.
    """

    folder: Path  # where they lie

    def log(self, step: str) -> Path:
        """What the step printed."""
        return self.folder / f"{step}.log"

    def state(self, step: str) -> str:
        """``running``, ``failed``, or ``""`` for a step that is done or to do."""
        file = self.folder / f"{step}.state"
        return file.read_text(encoding="utf-8").strip() if file.exists() else ""

    def set_state(self, step: str, state: str) -> None:
        """Note how far a step is."""
        file = self.folder / f"{step}.state"
        if state:
            file.write_text(f"{state}\n", encoding="utf-8")
        else:
            file.unlink(missing_ok=True)

    def last_line(self, step: str) -> str:
        """The last line of its last attempt, which is where a command says what was wrong."""
        try:
            text = self.log(step).read_text("utf-8", errors="replace")
        except OSError:
            return ""
        last = ["", *text.rstrip().splitlines()][-1].strip()
        return "" if re.match(r"\d[\d-]+ [\d:]+ \$ acwm ", last) else last.removeprefix("acwm: ")
