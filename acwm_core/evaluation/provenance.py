"""Where results come from: everything needed to reproduce them."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

import torch

import acwm_core
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.shards import file_sha256
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.score import measure_facts
from acwm_core.recipe import Recipe
from acwm_core.training.run import read_metadata
from acwm_core.training.run_folder import RunFolder


def provenance(
    folder: RunFolder, recipe: Recipe, evaluator: Evaluator, datasets: Mapping[str, EpisodeDataset]
) -> dict[str, Any]:
    """Everything needed to reproduce the results, as JSON types."""
    world_model, config, device = evaluator.world_model, evaluator.config, evaluator.device
    dataset = next(iter(datasets.values()))
    card = dataset.card
    facts = read_metadata(folder.weights)
    machine = f"{platform.system()} {platform.machine()}, {torch.get_num_threads()} threads"
    on_gpu = device.type == "cuda"
    trained = [*world_model.model.parameters(), *world_model.conditioner.parameters()]
    return {
        "evaluated": datetime.now(UTC).isoformat(timespec="seconds"),
        "recipe_sha256": file_sha256(folder.recipe),
        "recipe": recipe.to_yaml(),
        "weights_sha256": file_sha256(folder.weights),
        "training_steps": facts["step"],
        "imported": facts.get("imported"),
        "parameters": sum(parameter.numel() for parameter in trained),
        "codec_fingerprint": world_model.codec.fingerprint(),
        "evaluation": asdict(config),
        "sampling_steps": config.steps or world_model.objective.steps or 1,
        "mode": config.mode or world_model.mode,
        "context_frames": evaluator.given,
        "dataset": {
            "path": str(dataset.path),
            "environment": card.environment.name,
            "frame_size": list(card.environment.frame_size),
            "episodes": dict(card.splits),
            "seed": card.seed,
            "options": dict(card.options),
            "source": dict(card.source),
            "command": card.command(dataset.path),
            "factors": dict(card.factors),
            "checksums": {split: each.checksum for split, each in datasets.items()},
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
