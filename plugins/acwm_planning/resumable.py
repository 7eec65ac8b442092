"""`ResumableResults`: a folder that keeps the results of episodes as they finish."""

from __future__ import annotations

import contextlib
import json
import warnings
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from acwm_core.errors import AcwmWarning, DataError
from acwm_core.files import held, parse_json, read_json, typed, writing, written_whole

EPISODES_FILE, SETTINGS_FILE = "episodes.jsonl", "settings.json"
"""Files in the folder."""

Line = Mapping[str, Any]
"""The result of a finished episode, JSON-ready."""


@dataclass(frozen=True)
class ResumableResults:
    """A folder of results. Raises `DataError` if it holds results of other settings."""

    folder: Path  # created if missing
    settings: Mapping[str, Any]  # everything that determines the results
    keys: tuple[str, str] = ("row", "seed")  # the keys of a line that identify its episode
    kind: Any = dict[str, Any]  # a dataclass with the types of a line's entries, or several
    file: str = EPISODES_FILE  # name of the file with a line for each episode

    def __post_init__(self) -> None:
        settings, path = json.loads(json.dumps(self.settings)), self.folder / SETTINGS_FILE
        with writing(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            with held(self.folder):  # of two commands with different settings, one is refused
                if not path.exists():
                    with written_whole(path) as partial:
                        partial.write_text(json.dumps(settings, indent=1), encoding="utf-8")
        stored = read_json(path, dict[str, Any], "settings of results")
        differences = sorted(
            name for name in {*settings, *stored} if settings.get(name) != stored.get(name)
        )
        if differences:
            raise DataError(
                f"{self.folder} holds results of another {', '.join(differences)}: choose another "
                "--out, or delete it"
            )

    def finished(self) -> list[Line]:
        """The results of all finished episodes.

        Damaged lines are reported and left out, so that their episodes are played again, as are
        those of lines that a killed command wrote only in part.
        """
        path, lines, damaged = self.folder / self.file, dict[tuple[str, int], Line](), 0
        content = path.read_bytes() if path.exists() else b""
        for text in content.split(b"\n"):
            try:
                line: dict[str, Any] = parse_json(text)
                typed(line, self.kind)
                lines[str(line[self.keys[0]]), int(line[self.keys[1]])] = line
            except (ValueError, LookupError, TypeError):
                damaged += text.endswith((b"}", b"]"))
        if damaged:
            message = f"{path} has damaged lines ({damaged}): their episodes are played again"
            warnings.warn(message, AcwmWarning, stacklevel=2)
        return list(lines.values())

    @contextlib.contextmanager
    def adding(self) -> Generator[None]:
        """Hold the folder against other commands while episodes are added.

        If the block fails before the first episode, which is mostly due to the settings, others may
        be tried in the same folder.
        """
        with held(self.folder):
            try:
                yield
            finally:
                if not (self.folder / self.file).exists():
                    (self.folder / SETTINGS_FILE).unlink(missing_ok=True)

    def add(self, *lines: Line) -> None:
        """Append results at once, on a new line if the last line was cut off."""
        path = self.folder / self.file
        text = "".join(json.dumps(line, allow_nan=False) + "\n" for line in lines)
        with writing(path), path.open("a+b") as file:
            if file.tell() and path.read_bytes()[-1:] != b"\n":
                file.write(b"\n")
            file.write(text.encode())
