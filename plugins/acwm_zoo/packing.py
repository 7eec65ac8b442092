"""Packs a run as a small trained model: the files that prediction needs, and a model card."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file

from acwm_core.errors import TrainingError
from acwm_core.evaluation.results import FOLDER, SUMMARY, Summary
from acwm_core.evaluation.storage import EPISODES
from acwm_core.files import made_whole, writing
from acwm_core.model.build import build_codec
from acwm_core.recipe import Recipe
from acwm_core.recipe.compose import with_overrides
from acwm_core.training.run import load_run, read_metadata, save_weights, training_of
from acwm_core.training.run_folder import RunFolder
from acwm_interventions.evaluate import evaluate_run
from acwm_zoo.model_card import model_card
from acwm_zoo.shipped import MODEL_CARD

MAX_BYTES = 8_000_000
"""Largest size of the weights of a trained model, in bytes."""

FILES = ("recipe.yaml", "card.yaml", "model.safetensors", "metrics.csv", MODEL_CARD)
FILES += (f"{FOLDER}/{SUMMARY}", f"{FOLDER}/{EPISODES}", "codec-*.safetensors")
"""All files of a trained model; nothing else is published, fetched or shipped.

They include the scores of every clip, so `acwm report` and `acwm compare` accept it like a run.
"""


def pack(
    run: Path,
    out: Path,
    *,
    name: str | None = None,
    overrides: Sequence[str] = (),
    data: Path | None = None,
) -> Path:
    """Make a trained model from a run, in the new folder `out`. Either all files appear or none.

    The weights are rounded to bfloat16, and these rounded weights are evaluated.

    Args:
        run: a finished run.
        out: the folder to create.
        name: name by which the model will be used; that of the folder by default.
        overrides: overrides of the evaluation, as in `acwm evaluate`, which the packed recipe
            keeps, so that its scores can be made again; those of the codec choose another one with
            the same latents.
        data: the dataset to evaluate on; that of the recipe by default.

    Raises:
        TrainingError: the run is not trained, the folder exists, or the model is too large.
        AcwmError: the evaluation fails.
    """
    if out.exists():
        raise TrainingError(f"{out} already exists: remove it, or choose another name")
    folder = RunFolder(run)
    codec = [each for each in overrides if each.split("=")[0].split(".")[0] == "codec"]
    overrides = [each for each in overrides if each not in codec]
    recipe, _, world_model = load_run(run)
    facts = read_metadata(folder.weights)
    if codec:
        recipe = _with_codec(recipe, codec, facts["codec"], run)
    recipe = Recipe.from_dict(with_overrides(recipe.to_dict(), overrides))
    weights = cast(dict[str, torch.Tensor], cast(Any, load_file)(folder.weights))
    with writing(out), made_whole(out) as partial:
        packed = RunFolder(partial)
        trained = {name for name, _ in world_model.named_parameters()}
        # What was measured, such as the scale of states, keeps its precision.
        rounded = {n: v.bfloat16() if n in trained else v for n, v in weights.items()}
        details = {n: v for n, v in facts.items() if n not in ("format", "codec", "step", "sha256")}
        details |= training_of(folder)
        save_weights(packed.weights, rounded, facts["codec"], facts["step"], **details)
        size = packed.weights.stat().st_size
        if size > MAX_BYTES:  # checked before the evaluation, which takes long
            raise TrainingError(
                f"the weights of {run} have {size / 1e6:.1f} MB, and at most "
                f"{MAX_BYTES / 1e6:.0f} MB ship: train a smaller model"
            )
        for part in ("card", "metrics"):
            if (file := cast(Path, getattr(folder, part))).exists():
                shutil.copyfile(file, getattr(packed, part))
        packed.recipe.write_text(_portable_recipe(recipe, packed.path).to_yaml(), encoding="utf-8")
        evaluate_run(partial, data=data or recipe.data["path"], overrides=overrides)
        summary = Summary.read(partial)
        origin = _portable_facts(summary.provenance, packed.recipe.read_text(encoding="utf-8"))
        summary = replace(summary, videos=[], provenance=origin)  # videos are not packed
        summary.write(partial / FOLDER)
        card = model_card(packed, summary, name or out.name)
        (partial / MODEL_CARD).write_text(card, encoding="utf-8")
        strip(partial)
    return out


def _with_codec(recipe: Recipe, overrides: Sequence[str], latents: str, run: Path) -> Recipe:
    """The recipe with another codec.

    Raises:
        TrainingError: it has other latents than those that the run was trained on.
    """
    chosen = Recipe.from_dict(with_overrides(recipe.to_dict(), overrides))
    if build_codec(chosen.codec).latents_fingerprint() != latents:
        raise TrainingError(
            f"{' '.join(overrides)} decodes other latents than those that {run} was trained on: "
            "train on from it, with training.init_from"
        )
    return chosen


def strip(folder: Path) -> None:
    """Remove everything from a folder except `FILES`."""
    kept = {file for pattern in FILES for file in folder.glob(pattern)}
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_file() and path not in kept:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            path.rmdir()


def _portable_path(data: str) -> str:
    return f"data/{Path(data).name}" if Path(data).is_absolute() else data


def _portable_facts(facts: Mapping[str, Any], recipe: str) -> dict[str, Any]:
    """A summary's facts with the packed recipe, and without this machine's paths."""
    dataset = dict(facts["dataset"])
    place = _portable_path(dataset["path"])
    if command := dataset.get("command"):
        dataset["command"] = command.replace(dataset["path"], place)
    return {**facts, "recipe": recipe, "dataset": {**dataset, "path": place}}


def _portable_recipe(recipe: Recipe, out: Path) -> Recipe:
    """The recipe without this machine's paths and threads; the codec's files are copied to `out`.

    Raises:
        TrainingError: a file of the codec is not safetensors, which could run code.
    """
    sections = recipe.to_dict()
    data, codec = sections["data"], sections["codec"]
    data["path"] = _portable_path(data["path"])
    for name in ("init_from", "ignore_mismatched_sizes"):
        sections["training"].pop(name, None)
    sections["training"]["cpu_threads"] = None
    for name, value in codec.items():
        if isinstance(value, str) and Path(value).is_file():
            try:
                with cast(Any, safe_open)(value, framework="pt"):
                    pass
            except SafetensorError:
                raise TrainingError(
                    f"codec.{name}={value} is not a safetensors file, so it cannot ship: convert it"
                ) from None
            codec[name] = f"codec-{name}.safetensors"
            shutil.copyfile(value, out / codec[name])
    return Recipe.from_dict(sections)
