"""Where numbers come from: hashes, versions, dataset and settings of an evaluation."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from acwm_core import __version__
from acwm_core.data.episodes import EpisodeDataset
from acwm_core.environment import EnvironmentCard
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.recipe import Recipe
from acwm_core.training.run import RunFolder, read_metadata
from acwm_core.world_model import WorldModel


def provenance(
    folder: RunFolder,
    recipe: Recipe,
    world_model: WorldModel,
    config: EvaluationConfig,
    datasets: Mapping[str, EpisodeDataset],
) -> dict[str, Any]:
    """Everything needed to make the same numbers again, of JSON types."""
    dataset = next(iter(datasets.values()))
    card = dataset.card
    facts = read_metadata(folder.weights)
    trained = [*world_model.model.parameters(), *world_model.conditioner.parameters()]
    return {
        "evaluated": datetime.now(UTC).isoformat(timespec="seconds"),
        "recipe_sha256": sha256(folder.recipe),
        "recipe": recipe.to_yaml(),
        "weights_sha256": sha256(folder.weights),
        "training_steps": facts["step"],
        "imported": facts.get("imported"),
        "parameters": sum(parameter.numel() for parameter in trained),
        "codec_fingerprint": world_model.codec.fingerprint(),
        "evaluation": asdict(config),
        "sampling_steps": config.steps or world_model.model.steps,
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
            "acwm": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
        },
        "device": _device_name(world_model.action_low.device),
    }


def environment_facts(card: EnvironmentCard) -> dict[str, Any]:
    """What a report says of the environment."""
    return {
        "name": card.name,
        "summary": card.summary,
        "fps": card.fps,
        "action": asdict(card.action),
        "citation": card.citation,
    }


def sha256(path: Path) -> str:
    """Hash of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _device_name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    machine = f"{platform.system()} {platform.machine()}"
    return f"{device.type} ({machine}, {torch.get_num_threads()} threads)"
