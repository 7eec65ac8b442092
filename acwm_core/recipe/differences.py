"""What of two recipes would bend a loss curve."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, cast

from acwm_core.recipe.recipe import Recipe

FREE_TO_CHANGE = (
    "data.batch_size",
    "data.skip_damaged",
    "data.workers",
    "evaluation.",
    "trainer.accelerator",
    "trainer.accumulate_grad_batches",
    "trainer.devices",
    "trainer.enable_progress_bar",
    "trainer.log_every_n_steps",
    "trainer.max_steps",
    "trainer.max_time",
    "trainer.num_nodes",
    "trainer.strategy",
    "training.activation_checkpointing",
    "training.checkpoint_every_n_steps",
    "training.compile",
    "training.cpu_threads",
    "training.validation_rollouts",
)
"""What a resumed run may do otherwise than before; all else would bend its loss curve.

The devices may change as long as an optimiser step takes as many clips as before: `ClipData` sees
to that.
"""


def recipe_differences(before: Recipe, now: Recipe) -> list[str]:
    """What a resumed run would do otherwise, as ``"model.layers was 4, is 6"``."""
    old, new = dict(_flat(before.to_dict())), dict(_flat(now.to_dict()))
    return [
        f"{name} was {old.get(name, 'not set')}, is {new.get(name, 'not set')}"
        for name in sorted({*old, *new})
        if old.get(name) != new.get(name) and not name.startswith(FREE_TO_CHANGE)
    ]


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(cast(Mapping[str, Any], value), f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
