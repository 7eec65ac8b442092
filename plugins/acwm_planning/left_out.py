"""What is left out of a table of episodes, so that one that fails does not end the others."""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Generator
from dataclasses import dataclass, field
from typing import Any

from acwm_core.env.task import SolvedAtStartError
from acwm_core.errors import AcwmWarning, RecipeError, is_for_users, sentence
from acwm_core.files import disk_error
from acwm_planning.scripts import NoSolutionError


def _is_shared(error: Exception) -> bool:
    """Whether an error is of the settings, the disk or acwm, so that no episode would do better."""
    return bool(isinstance(error, RecipeError) or disk_error(error)) or not is_for_users(error)


@contextlib.contextmanager
def passed_over() -> Generator[None]:
    """Pass over an episode that fails in the block; it is reported where it counts."""
    try:
        yield
    except SolvedAtStartError:
        pass
    except Exception as error:
        if _is_shared(error):
            raise


@dataclass
class LeftOut:
    """What was left out.

    Attributes:
        rows: rows that the task does not have.
        solved: seeds whose goal is reached at the start.
        failed: row (or policy) and seed of episodes in which something failed, and why.
        error: the first of the errors; it ends a command whose episodes all fail.
    """

    rows: set[str] = field(default_factory=set[str])
    solved: set[int] = field(default_factory=set[int])
    failed: dict[tuple[str, int], str] = field(default_factory=dict[tuple[str, int], str])
    error: Exception | None = None

    @contextlib.contextmanager
    def trying(self, row: str, seed: int) -> Generator[None]:
        """Leave out an episode that fails in the block, and warn of it.

        Errors of settings and of the disk, which all episodes share, are raised.
        """
        try:
            yield
        except NoSolutionError as error:
            self.rows.add(row)
            self.error = self.error or error
        except SolvedAtStartError as error:
            self.solved.add(seed)
            self._warn(f"{error}: it is left out", error)
        except Exception as error:
            if _is_shared(error):
                raise
            self.failed[row, seed] = sentence(error)
            self._warn(f"{row} with seed {seed} is left out: {sentence(error)}", error)

    def _warn(self, message: str, error: Exception) -> None:
        self.error = self.error or error
        warnings.warn(message, AcwmWarning, stacklevel=4)

    def facts(self) -> dict[str, Any]:
        """It as JSON types."""
        failed = [[*episode, why] for episode, why in self.failed.items()]
        facts = {"left_out": sorted(self.rows), "solved_at_start": sorted(self.solved)}
        return {**facts, "failed": failed} if failed else facts
