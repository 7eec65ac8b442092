"""Small files beside a step's log that say what becomes of it, written here or by SLURM jobs.

logs/STEP.log      what it printed, all attempts one after the other
logs/STEP.running  the process that does it here
logs/STEP.job      the SLURM job that does it
logs/STEP.failed   the exit code of its last attempt
logs/STEP.seconds  how long it took, if it was done in one go
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

TAIL = 2000
"""Bytes at the end of a log in which its last sentence is looked for."""


@dataclass(frozen=True)
class Ledger:
    """The files of all steps.

    Attributes:
        folder: where they lie.
    """

    folder: Path

    def log(self, step: str) -> Path:
        """What the step printed."""
        return self.folder / f"{step}.log"

    def running(self, step: str) -> Path:
        """There while the step is done on this machine."""
        return self.folder / f"{step}.running"

    def job(self, step: str) -> Path:
        """Holds the id of the step's SLURM job."""
        return self.folder / f"{step}.job"

    def failed(self, step: str) -> Path:
        """There after a failure, until the step is begun again."""
        return self.folder / f"{step}.failed"

    def seconds(self, step: str) -> Path:
        """How long the step took."""
        return self.folder / f"{step}.seconds"

    def job_of(self, step: str) -> str | None:
        """The id of the SLURM job that was submitted last for the step."""
        file = self.job(step)
        return file.read_text().strip() if file.exists() else None

    def seconds_of(self, step: str) -> float | None:
        """How long the step took, if it was measured."""
        try:
            return float(self.seconds(step).read_text())
        except (OSError, ValueError):
            return None

    def last_words(self, step: str) -> str:
        """The last line of the step's log, which is where a command says what was wrong."""
        try:
            with self.log(step).open("rb") as file:
                file.seek(max(0, file.seek(0, 2) - TAIL))
                text = file.read().decode(errors="replace")
        except OSError:
            return ""
        since_start = re.split(r"^\d[\d-]+ [\d:]+ \$ acwm .*$", text, flags=re.MULTILINE)[-1]
        lines = [line.strip() for line in re.split(r"[\r\n]+", since_start) if line.strip()]
        return lines[-1].removeprefix("acwm: ") if lines else ""
