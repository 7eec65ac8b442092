"""Every format that acwm reads, damaged at random: an `AcwmError` of one line, or a result."""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch
import yaml

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset, Manifest
from acwm_core.data.shards import open_shard
from acwm_core.env.card import ActionSpec
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.storage import load_scores
from acwm_core.recipe import compose
from acwm_core.training.checkpoints import read_whole
from acwm_core.training.plain_tensors import load_plain
from acwm_core.training.run import read_metadata, save_weights
from acwm_core.untrusted import read_json
from acwm_dream.rollout import _read_actions
from acwm_experiment.steps import saved_steps
from acwm_experiment.table import Experiment
from acwm_formats.lerobot import LeRobot
from acwm_severity.curves import SeverityCurve
from tests.trust.mutating import changed, damaged, dumped, survives

HERE = Path(__file__).parents[1] / "reference/first_release"
CARD, SHARD = HERE / "data/card.yaml", HERE / "data/ind_test/shard-00000.tar"
MANIFEST = HERE / "data/ind_test/manifest.jsonl"
RUN = HERE / "run"


def place(folder, name, data):
    file = folder / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(data)
    return file


def summary(folder, seed):
    whole = (RUN / "evaluation/summary.json").read_bytes()
    data = damaged(whole, seed) if seed % 3 == 0 else dumped(changed(json.loads(whole), seed))
    Summary.load(place(folder, "summary.json", data))


def curve(folder, seed):
    values = {
        **dict.fromkeys(("description", "unit", "kind"), "continuous"),
        **{"factor": "friction", "train": [0.1, 0.2], "ood": [[0.3, 0.4]], "episodes": 2},
        **{"metrics": {"psnr": {"unit": "dB", "higher_is_better": True}}, "headline": "psnr"},
        **{"left_out": [], "provenance": {}},
        "points": [
            {
                **{"value": 0.1, "severity": 0.0, "in_train": True, "checksum": "a"},
                "scores": {"clips": 1, "rows": {"model": {"psnr": {"value": 1.0}}}, "paired": {}},
            }
        ],
    }
    read_json(place(folder, "x.json", dumped(changed(values, seed))), SeverityCurve, "a curve")


def experiment(folder, seed):
    cell = {"row": "a", "column": "", "recipe": "x", "overrides": ["a=1"], "runs": ["r"]}
    values = {
        **{"format": 1, "name": "n", "title": "t", "caption": "c", "table": None, "rows": ["a"]},
        **{"columns": [""], "groups": {"g": ["a"]}, "seeds": [0], "cells": [cell]},
    }
    place(folder, "experiment.json", dumped(changed(values, seed)))
    Experiment.read(folder)


def card(folder, seed):
    whole = CARD.read_bytes()
    text = yaml.safe_dump(changed(yaml.safe_load(whole), seed), allow_unicode=True).encode()
    place(folder, "card.yaml", damaged(whole, seed) if seed % 4 == 0 else text)
    DatasetCard.read(folder)


def recipe(folder, seed):
    whole = (RUN / "recipe.yaml").read_bytes()
    text = yaml.safe_dump(changed(yaml.safe_load(whole), seed), allow_unicode=True).encode()
    compose(place(folder, "r.yaml", damaged(whole, seed) if seed % 4 == 0 else text))


def weights(folder, seed):
    file = folder / "model.safetensors"
    save_weights(file, {"model.a": torch.zeros(3)}, "codec", 3)
    whole = file.read_bytes()
    if seed % 2:
        facts = changed({"format": 1, "step": 3, "codec": "x", "imported": "y"}, seed)
        whole = safetensors.torch.save({"a": torch.zeros(2)}, {"acwm": dumped(facts).decode()})
    else:
        whole = damaged(whole, seed)
    file.write_bytes(whole)
    saved_steps(folder)
    read_metadata(file)


def checkpoint(folder, seed):
    buffer = io.BytesIO()
    state = {"a": torch.zeros(4, 4), "b": torch.ones(3, dtype=torch.bfloat16)}
    torch.save({"global_step": 3, "state_dict": state, "list": [1, (2.0, "x")]}, buffer)
    file = place(folder, "last.ckpt", damaged(buffer.getvalue(), seed))
    (load_plain if seed % 2 else read_whole)(file)


def checkpoint_folder(folder, seed):
    from tests.training.test_checkpoint_code import folder as make

    path = make(folder / "last.ckpt")
    names = sorted(each.name for each in path.iterdir())
    file = path / names[seed % len(names)]
    file.write_bytes(damaged(file.read_bytes(), seed))
    read_whole(path)


def npy(folder, seed):
    buffer = io.BytesIO()
    np.save(buffer, np.zeros((20, 2), np.float32))
    spec = ActionSpec(("x", "y"), ("", ""), (-1.0, -1.0), (1.0, 1.0), "absolute")
    _read_actions(place(folder, "a.npy", damaged(buffer.getvalue()[:200], seed)), spec)


def tar(folder, seed):
    whole = SHARD.read_bytes()
    data = damaged(whole, seed) if seed % 2 else damaged(whole[:4096], seed) + whole[4096:]
    reader = open_shard(place(folder, f"shard-{seed}.tar", data))
    for position in range(len(reader)):
        reader.about(position)
        reader.array(position, "actions.npy")
    reader.episode(0)


def manifest(folder, seed):
    whole = MANIFEST.read_bytes()
    lines = [dumped(changed(json.loads(line), seed)) for line in whole.splitlines()]
    data = damaged(whole, seed) if seed % 3 == 0 else b"\n".join([*lines, b""])
    for split in ("ind_test", "ood_test"):
        shutil.copytree(HERE / "data" / split, folder / split)
    shutil.copy(CARD, folder)
    place(folder, "ind_test/manifest.jsonl", data)
    Manifest(folder / "ind_test")
    episodes = EpisodeDataset(folder, "ind_test")
    episodes.actions(0)


def parquet(folder, seed):
    whole = (RUN / "evaluation/episodes.parquet").read_bytes()
    footer = whole[:-3000] + damaged(whole[-3000:], seed)
    load_scores(place(folder, "x.parquet", damaged(whole, seed) if seed % 2 else footer))


def lerobot(folder, seed):
    kind = "video" if seed % 2 else "image"
    root = shutil.copytree(HERE.parent / "lerobot" / kind, folder / "root")
    files = sorted(path for path in root.rglob("*") if path.is_file() and path.name != "stats.json")
    file = files[seed % len(files)]
    if file.suffix == ".json" and seed % 4:
        file.write_bytes(dumped(changed(json.loads(file.read_bytes()), seed)))
    else:
        file.write_bytes(damaged(file.read_bytes(), seed))
    found = LeRobot().read(root)
    for recordings in found.splits.values():
        recordings[0]


FORMATS = {
    each.__name__: (each, cases)
    for each, cases in (
        *((summary, 40), (curve, 40), (experiment, 40), (card, 25), (recipe, 25), (weights, 40)),
        *((checkpoint, 40), (checkpoint_folder, 25), (npy, 60), (tar, 30), (manifest, 40)),
        *((parquet, 40), (lerobot, 40)),
    )
}


def fuzz(name, tmp_path, seeds):
    read, _ = FORMATS[name]
    for seed in seeds:
        folder = tmp_path / str(seed)
        folder.mkdir()
        try:
            with survives():
                read(folder, seed)
        except BaseException as error:
            raise AssertionError(f"{name}, seed {seed}: {type(error).__name__}: {error}") from error
        shutil.rmtree(folder)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", FORMATS)
def test_damage_is_one_sentence(name, tmp_path):
    fuzz(name, tmp_path, range(FORMATS[name][1]))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("part", range(4))
@pytest.mark.parametrize("name", FORMATS)
def test_much_damage_is_one_sentence(name, part, tmp_path):
    fuzz(name, tmp_path, range(1000 + 300 * part, 1300 + 300 * part))
