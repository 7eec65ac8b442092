"""Where results come from: everything needed to reproduce them."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, cast

import torch

import acwm_core
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.shards import file_sha256
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.score import measure_facts
from acwm_core.model.world_model import WorldModel
from acwm_core.recipe import Recipe
from acwm_core.training.run import read_metadata
from acwm_core.training.run_folder import RunFolder


def run_facts(folder: RunFolder, recipe: Recipe, evaluator: Evaluator) -> dict[str, Any]:
    """What predicted, if it is the model of a run, as JSON types."""
    world_model, config = cast(WorldModel, evaluator.world_model), evaluator.config
    facts = read_metadata(folder.weights)
    trained = [*world_model.model.parameters(), *world_model.conditioner.parameters()]
    return {
        "recipe_sha256": file_sha256(folder.recipe),
        "recipe": recipe.to_yaml(),
        "weights_sha256": file_sha256(folder.weights),
        "training_steps": facts["step"],
        "planned_steps": recipe.trainer.get("max_steps"),
        "imported": facts.get("imported"),
        "parameters": sum(parameter.numel() for parameter in trained),
        "sampling_steps": config.steps or world_model.steps or 1,
        "mode": config.mode or world_model.mode,
    }


def provenance(
    evaluator: Evaluator,
    datasets: Mapping[str, EpisodeDataset],
    predictor: Mapping[str, Any],
    *,
    secret: bool = False,
) -> dict[str, Any]:
    """Everything needed to reproduce the results, as JSON types.

    Args:
        predictor: what predicted, see `run_facts`.
        secret: whether to leave out the seed from which the test data can be simulated.
    """
    dataset = next(iter(datasets.values()))
    card, device = dataset.card, evaluator.device
    machine = f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
    on_gpu = device.type == "cuda"
    return {
        "evaluated": datetime.now(UTC).isoformat(timespec="seconds"),
        **predictor,
        "codec_fingerprint": evaluator.world_model.codec.fingerprint(),
        "evaluation": asdict(evaluator.config),
        "draws": evaluator.draws or 1,
        "context_frames": evaluator.given,
        "dataset": {
            "path": str(dataset.path),
            "environment": card.environment.name,
            "frame_size": list(card.environment.frame_size),
            "episodes": dict(card.splits),
            "seed": None if secret else card.seed,
            "options": dict(card.options),
            "source": dict(card.source),
            "command": "" if secret else card.command(dataset.path),
            "factors": dict(card.factors),
            "checksums": {split: episodes.checksum for split, episodes in datasets.items()},
            "versions": dict(card.versions),
        },
        "versions": {
            "acwm": acwm_core.__version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        "device": torch.cuda.get_device_name(device) if on_gpu else f"{device.type} ({machine})",
        **measure_facts(evaluator.metrics, evaluator.estimator),
    }
