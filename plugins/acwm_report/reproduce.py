"""The commands that reproduce an evaluated run, from its data to its report."""

from __future__ import annotations

import shlex
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.remote import origin
from acwm_core.evaluation.config import EvaluationConfig, setting_overrides
from acwm_core.evaluation.results import Summary
from acwm_core.recipe.compose import read_recipe
from acwm_core.recipe.former import current_settings
from acwm_severity.curves import read_severity


def commands(folder: Path, summary: Summary) -> list[str]:
    """The commands for the data, the run, its evaluation, its severity curves and its report.

    Evaluation settings that the run's own recipe already contains are not repeated.
    """
    facts, data = summary.provenance, summary.provenance["dataset"]
    if summary.handed_in:
        own = facts["predictions"], summary.parts["env"], "--tasks", facts["tasks"]
        again = f"{folder.parent}-again"
        score = shlex.join(["acwm", "score", *own, "--data", data["path"], "--out", again])
        made = [] if _is_fetched(data["path"]) or not data["command"] else [_made(data)]
        return [*made, score, shlex.join(["acwm", "report", f"{again}/{folder.name}"])]
    original = folder / "recipe.yaml"
    recipe, again = read_recipe(original), f"{folder}-again"
    trained_on = str(recipe.get("data", {}).get("path", ""))
    is_imported = bool(facts.get("imported"))
    card = None
    if not is_imported and (folder / CARD).is_file() and not _is_fetched(trained_on):
        card = DatasetCard.read(folder / CARD)
    generated, source = _data(data, trained_on, card)
    fit: str = facts.get("imported") or shlex.join(["acwm", "fit", str(original)])
    evaluations = [({**facts["evaluation"], "protocol": summary.protocol}, list[str]())]
    for curve in read_severity(folder, facts["weights_sha256"]):
        evaluations.append((curve.provenance["evaluation"], ["--sweep", curve.text]))
    known = {field.name for field in fields(EvaluationConfig)}  # old recipes may have others
    settings: dict[str, Any] = recipe.get("evaluation") or {}
    given = EvaluationConfig(**{name: v for name, v in settings.items() if name in known}).to_dict()
    lines = [
        [
            "acwm",
            "evaluate",
            again,
            *setting_overrides(given, current_settings(wanted)),
            *source,
            *sweep,
        ]
        for wanted, sweep in evaluations
    ]
    evaluated = map(shlex.join, [*lines, ["acwm", "report", again]])
    return [*generated, f"{fit} {shlex.join(['--out', again])}", *evaluated]


def _data(
    tests: dict[str, Any], trained_on: str, card: DatasetCard | None
) -> tuple[list[str], list[str]]:
    """The commands for the training and test data, and the option that names the latter.

    A run may have been trained and tested on two datasets that lay in the same place one after the
    other; then the test data get another.

    Args:
        tests: the facts of the test data.
        trained_on: the path of the training data.
        card: their card; None if they need no command.
    """
    place = Path(tests["path"])
    url = origin(place)
    elsewhere = trained_on.rstrip("/") != url and Path(trained_on).resolve() != place.resolve()
    if elsewhere:
        own = [] if card is None else [_command(card, trained_on)]
        made = [] if _is_fetched(tests["path"]) else [_made(tests)]
        return [*own, *made], ["--data", url or tests["path"]]
    if _is_fetched(tests["path"]):
        return [], []
    if card is None or card.source or tests.get("source"):
        return [_made(tests)], []
    tested = card.of_tests(tests)
    if card.holds(tested):
        return [card.command(trained_on)], []
    apart = f"{trained_on.rstrip('/')}-test"
    training = replace(card, splits={"train": card.splits.get("train", 0)})
    return [training.command(trained_on), tested.command(apart)], ["--data", apart]


def _made(data: dict[str, Any]) -> str:
    """The command that made data, or a comment if no command did."""
    if data["command"].startswith("acwm "):
        return data["command"]
    return f"# {data['path']} was written by another program: copy it there"


def _command(card: DatasetCard, path: str) -> str:
    return _made({"path": path, "command": card.command(path)})


def _is_fetched(path: str) -> bool:
    return "://" in path or origin(Path(path)) is not None
