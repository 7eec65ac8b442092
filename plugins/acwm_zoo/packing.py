"""From a run to a trained model: the few files that prediction needs, small, with a model card."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import torch
from safetensors.torch import load_file

from acwm_core.errors import TrainingError
from acwm_core.evaluation.evaluate import evaluate_run
from acwm_core.evaluation.results import FOLDER, SUMMARY, Summary
from acwm_core.recipe import Recipe
from acwm_core.training.checkpoints import read_details
from acwm_core.training.run import RunFolder, load_run, read_metadata, save_weights
from acwm_zoo.model_card import model_card

MAX_BYTES = 8_000_000
"""A model that ships may be so large, with all its files."""

CARD = "README.md"

FILES = ("recipe.yaml", "card.yaml", "model.safetensors", "metrics.csv", CARD)
FILES += (f"{FOLDER}/{SUMMARY}", "codec-*.safetensors")
"""All that a trained model may consist of; nothing else is published, fetched or shipped."""


def pack(
    run: Path,
    out: Path,
    *,
    name: str | None = None,
    overrides: Sequence[str] = (),
    data: Path | None = None,
) -> Path:
    """Make a trained model of a run, in the folder `out`, which must not be there.

    Its weights are rounded to bfloat16, and evaluated as they then are.

    Args:
        run: a finished run.
        out: the folder to make.
        name: by which the model is to be used; that of the folder by default.
        overrides: of the evaluation, as `acwm evaluate` takes them.
        data: the dataset to evaluate on; that of the recipe by default.

    Raises:
        TrainingError: no trained run, a folder that is taken, or a model that is too large.
        AcwmError: whatever prevents the evaluation.
    """
    if out.exists():
        raise TrainingError(f"{out} is there already: remove it, or choose another name")
    folder, made = RunFolder(run), RunFolder(out)
    recipe = load_run(run).recipe
    facts = read_metadata(folder.weights)
    weights = cast(dict[str, torch.Tensor], cast(Any, load_file)(folder.weights))
    try:
        out.mkdir(parents=True)
        rounded = {name: value.bfloat16() for name, value in weights.items()}
        details = {n: v for n, v in facts.items() if n not in ("format", "codec", "step", "sha256")}
        if folder.last_checkpoint.exists():
            kept = read_details(folder.last_checkpoint).get("callbacks", {})
            details |= kept.get("CpuTime", {})
        save_weights(made.weights, rounded, facts["codec"], facts["step"], **details)
        for part in ("card", "metrics"):
            if (file := cast(Path, getattr(folder, part))).exists():
                shutil.copyfile(file, getattr(made, part))
        made.recipe.write_text(_own(recipe, made.path).to_yaml(), encoding="utf-8")
        evaluate_run(out, data=data or recipe.data["path"], overrides=overrides)
        summary = Summary.read(out)
        (out / CARD).write_text(model_card(made, summary, name or out.name), encoding="utf-8")
        strip(out)
        size = sum(file.stat().st_size for file in out.rglob("*") if file.is_file())
        if size > MAX_BYTES:
            raise TrainingError(
                f"{run} makes a model of {size / 1e6:.1f} MB, and at most {MAX_BYTES / 1e6:.0f} MB "
                "ship: train a smaller one"
            )
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise
    return out


def strip(folder: Path) -> None:
    """Remove from a folder all but `FILES`."""
    kept = {file for pattern in FILES for file in folder.glob(pattern)}
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and path not in kept:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def _own(recipe: Recipe, out: Path) -> Recipe:
    """The recipe without the places of one machine; a file of the codec's is copied to `out`."""
    sections = recipe.to_dict()
    data, codec = sections["data"], sections["codec"]
    if Path(data["path"]).is_absolute():
        data["path"] = f"data/{Path(data['path']).name}"
    sections["training"].pop("init_from", None)
    for name, value in codec.items():
        if isinstance(value, str) and value.endswith(".safetensors") and Path(value).is_file():
            codec[name] = f"codec-{name}.safetensors"
            shutil.copyfile(value, out / codec[name])
    return Recipe.from_dict(sections)
