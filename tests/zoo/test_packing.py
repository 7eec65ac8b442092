"""A run becomes a trained model: small, whole, without the places of one machine, and usable."""

import re
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from click.testing import CliRunner
from safetensors.torch import load_file

from acwm_codecs.compact import Compact
from acwm_codecs.compact_reference import CompactReference
from acwm_codecs.train_codec import save
from acwm_core.cli import main
from acwm_core.errors import TrainingError
from acwm_core.evaluation.results import Summary
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe
from acwm_core.training.fit import fit
from acwm_core.training.run import all_training, load_run, read_metadata, save_weights
from acwm_core.training.run_folder import RunFolder
from acwm_zoo import packing
from acwm_zoo.packing import pack
from tests import tiny
from tests.evaluation.test_given_frames import QUICK

KEPT = {
    "README.md",
    "card.yaml",
    "evaluation/episodes.parquet",
    "evaluation/summary.json",
    "metrics.csv",
    "model.safetensors",
    "recipe.yaml",
}


def files(folder):
    return {str(f.relative_to(folder)) for f in folder.rglob("*") if f.is_file()}


@pytest.fixture(scope="module")
def packed(run, data, tmp_path_factory):
    return pack(run, tmp_path_factory.mktemp("models") / "drifting", data=data)


@pytest.fixture
def named(packed, monkeypatch, tmp_path):
    """The model under its name, in an empty folder to work in."""

    monkeypatch.chdir(tmp_path)
    registry = catalog().registry("trained_model")
    before = registry.components()
    registry.registering("test", None)
    registry.add("drifting", f"{__name__}:place", summary="a square", folder=str(packed))
    yield packed
    registry.restore(before)


def place(folder):
    return Path(folder)


def invoke(*words):
    return CliRunner().invoke(main, [str(word) for word in words])


def test_it_has_the_files_that_prediction_needs_and_no_others(run, packed):
    assert files(packed) == KEPT
    assert len(files(run)) > len(KEPT)


def test_its_weights_are_those_of_the_run_in_bfloat16(run, packed):
    ours, theirs = (load_file(RunFolder(each).weights) for each in (packed, run))
    assert ours.keys() == theirs.keys()
    for name, value in ours.items():
        assert value.dtype == torch.bfloat16
        assert torch.equal(value, theirs[name].bfloat16())
    before, now = (read_metadata(RunFolder(each).weights) for each in (run, packed))
    assert before.pop("sha256") != now.pop("sha256")
    assert now.pop("cpu_seconds") > 0
    assert before == now


def test_it_names_no_place_of_this_machine(packed, data):
    for name in ("recipe.yaml", "README.md"):
        assert str(data.parent) not in (packed / name).read_text()
    assert Recipe.from_yaml(packed / "recipe.yaml").data["path"] == f"data/{data.name}"


def test_its_card_says_what_it_is_how_it_was_made_and_how_good_it_is(packed):
    text = (packed / "README.md").read_text()
    assert re.search(r"seed\s+0, \d+\.\d CPU-hours", text)
    head = yaml.safe_load(text.split("---")[1])
    assert head["library_name"] == "acwm"
    assert "# a square that drifts by its action: 32×32, " in text
    assert "acwm rollout drifting" in text
    assert "6 training episodes, `acwm generate drift" in text
    assert "6 steps of 2 clips of up to\n  9 frames, 1 of them given, seed\n  0" in text
    curve = re.findall(r"^\| (\d+) \| ([\d.e+-]+) \|", text, re.MULTILINE)
    assert [int(step) for step, _ in curve] == [2, 4, 6]
    summary = Summary.read(packed)
    for split in ("ind_test", "ood_test"):
        value = summary.splits[split].scores.rows["model"]["psnr"].value
        assert f"{value:.4g}" in text
    assert "5 episodes in distribution and 4 episodes out of distribution" in text


def test_its_scores_are_those_of_the_weights_that_ship(packed, data):
    summary = Summary.read(packed)
    again = CliRunner().invoke(main, ["evaluate", str(packed), "--data", str(data)])
    assert again.exit_code == 0, again.output
    fresh = Summary.read(packed)
    assert fresh.provenance["weights_sha256"] == summary.provenance["weights_sha256"]
    assert fresh.splits["ind_test"].scores.rows == summary.splits["ind_test"].scores.rows
    packing.strip(packed)
    assert files(packed) == KEPT


def test_what_came_before_is_told(run, packed, data, tmp_path):
    """The steps and hours of the weights that a run started from, and of those before them."""
    before = {"name": "first", "step": 30, "cpu_seconds": 3600}
    second, third = tmp_path / "second", tmp_path / "third"
    shutil.copytree(run, second)
    shutil.rmtree(second / "checkpoints")  # as of a model that ships
    file = RunFolder(second).weights
    facts = {"cpu_seconds": 7200, "init_from": before}
    save_weights(file, load_file(file), read_metadata(file)["codec"], 12, **facts)
    sections = Recipe.from_yaml(RunFolder(run).recipe).to_dict()
    sections["training"] |= {"init_from": str(second), "ignore_mismatched_sizes": True}
    sections["trainer"]["max_steps"] = 1
    fit(Recipe.from_dict(sections), third)
    shutil.rmtree(second)
    shutil.copytree(third, second)  # another run of that name
    made = pack(third, tmp_path / "made", data=data)
    told = "started from the weights of `second`: 42 steps, 3.0 CPU-hours."
    assert told in " ".join((made / "README.md").read_text().split())
    for file in ("recipe.yaml", "README.md", "evaluation/summary.json"):
        text = (made / file).read_text()
        assert str(tmp_path) not in text
        assert str(data) not in text


def test_training_counts_what_is_behind_it(run, packed):
    spent = read_metadata(packed / "model.safetensors")["cpu_seconds"]
    whole = {"name": run.name, "step": 6, "cpu_seconds": spent}
    assert all_training(str(run), RunFolder(run)) == whole


def test_what_is_taken_or_too_large_is_refused(run, data, tmp_path, monkeypatch):
    (tmp_path / "taken").mkdir()
    with pytest.raises(TrainingError, match="already exists"):
        pack(run, tmp_path / "taken", data=data)
    monkeypatch.setattr(packing, "MAX_BYTES", 100)
    monkeypatch.setattr(packing, "evaluate_run", None)  # not asked, for it takes long
    with pytest.raises(TrainingError, match=r"have 0\.0 MB, and at most 0 MB ship"):
        pack(run, tmp_path / "model", data=data)
    assert not (tmp_path / "model").exists()


def test_a_name_is_taken_as_a_run_folder_is(named, data, tmp_path):
    bundle = load_run("drifting")
    state = load_run(named).world_model.state_dict()
    assert all(torch.equal(value, state[k]) for k, value in bundle.world_model.state_dict().items())
    done = invoke("rollout", "drifting", "--data", data)
    assert done.exit_code == 0, done.output
    assert done.output.strip() == "runs/trained/drifting/rollout.mp4"
    done = invoke("evaluate", "drifting", "--data", data)
    assert done.exit_code == 0, done.output
    assert "next: acwm report runs/trained/drifting" in done.output
    assert (tmp_path / "runs/trained/drifting/evaluation/episodes.parquet").exists()
    assert files(named) == KEPT  # nothing is written into a package
    assert "drifting" in invoke("list", "trained_model").output


def test_it_is_reported_and_compared_like_a_run(named, data, tmp_path):
    done = invoke("report", "drifting")
    assert done.exit_code == 0, done.output
    page = (tmp_path / "runs/trained/drifting/report.html").read_text()
    value = Summary.read(named).splits["ind_test"].scores.rows["model"]["psnr"].value
    assert f"{value:.1f}" in page
    assert files(tmp_path / "runs/trained/drifting") == {*KEPT, "report.html"}
    assert invoke("evaluate", "drifting", "--data", data, "--out", "again").exit_code == 0
    done = invoke("compare", "drifting", "again", "--metric", "psnr")
    assert done.exit_code == 0, done.output


def test_training_starts_from_a_name(named, data, tmp_path):
    sections = Recipe.from_yaml(named / "recipe.yaml").to_dict()
    sections["data"]["path"] = str(data)
    sections["training"] |= {"init_from": "drifting", "learning_rate": 1e-12, "ema_decay": 0.0}
    sections["trainer"]["max_steps"] = 1
    run = fit(Recipe.from_dict(sections), tmp_path / "tuned")
    assert Recipe.from_yaml(run / "recipe.yaml").training["init_from"] == "drifting"
    ours, theirs = (load_run(each).world_model.model.state_dict() for each in (run, named))
    for name, value in ours.items():
        torch.testing.assert_close(value, theirs[name], rtol=0, atol=1e-6)


def test_a_run_folder_of_that_name_is_nearer(named, run, tmp_path):
    shutil.copytree(run, tmp_path / "drifting")
    state = load_run(run).world_model.state_dict()
    found = load_run("drifting").world_model.state_dict()
    assert all(torch.equal(value, state[name]) for name, value in found.items())
    shutil.rmtree(tmp_path / "drifting")
    (tmp_path / "drifting").mkdir()  # any other folder is not
    assert load_run("drifting").recipe.data["path"].startswith("data/")


def test_results_of_another_version_are_not_mixed_with_its_own(named, run, data, tmp_path):
    copy = tmp_path / "runs/trained/drifting"
    copy.parent.mkdir(parents=True)
    shutil.copytree(run, copy)
    done = invoke("evaluate", "drifting", "--data", data)
    assert done.exit_code == 2
    assert "holds something other than this drifting: move it away" in done.output


@pytest.mark.parametrize("command", ["rollout", "evaluate"])
def test_unknown_names_are_one_sentence(named, command):
    done = invoke(command, "driftin")
    assert done.exit_code == 2
    assert done.output == "acwm: there is no run folder driftin; did you mean 'drifting'?\n"
    with pytest.raises(TrainingError, match="no trained model driftin; did you mean 'drifting'"):
        load_run("driftin")


def test_the_command_ships_a_run(run, data, tmp_path):
    done = invoke("ship", run, "evaluation.episodes=2", "--out", tmp_path / "m", "--data", data)
    assert done.exit_code == 0, done.output
    assert "0.0 MB; its card is" in done.output
    assert files(tmp_path / "m") == KEPT
    assert Summary.read(tmp_path / "m").splits["ind_test"].scores.clips == 2


def test_a_file_of_the_codec_ships_with_it(run, data, tmp_path):
    """So that the trained model has no path of one machine; `load_run` finds it in the folder."""
    torch.manual_seed(0)
    weights = tmp_path / "mine.bin"  # whatever its name
    save(Compact(weights="random"), weights, {})
    parts = {
        "codec": {"name": "compact", "weights": str(weights)},
        "model": {"name": "dit_xs", "width": 16, "layers": 1, "heads": 1},
        "conditioner": {"name": "adaln"},
    }
    other = tiny.make_run(tmp_path / "other", data, parts=parts, **QUICK, episodes=2)
    made = pack(other, tmp_path / "made", data=data)
    weights.unlink()
    moved = made.rename(tmp_path / "moved")
    assert files(moved) - KEPT == {"codec-weights.safetensors"}
    assert "weights: codec-weights.safetensors" in (moved / "recipe.yaml").read_text()
    recipe = Recipe.from_yaml(moved / "recipe.yaml")  # as `acwm fit` reads it
    assert recipe.codec.params["weights"] == str(moved / "codec-weights.safetensors")
    video = load_run(moved).world_model.rollout(torch.rand(1, 3, 32, 32), torch.zeros(1, 9, 2))
    assert video.isfinite().all()


@pytest.mark.ci
def test_a_codec_with_the_same_latents_takes_the_place_of_the_old_one(data, tmp_path):
    """A run on `compact` ships with the decoder that sees the given frame; no other codec does."""
    parts = {
        "codec": {"name": "compact"},
        "model": {"name": "dit_xs", "width": 16, "layers": 1, "heads": 1},
        "conditioner": {"name": "adaln"},
    }
    run = tiny.make_run(tmp_path / "run", data, parts=parts, **QUICK, episodes=2)
    words = ["codec=compact_reference", "evaluation.seed=5"]
    made = pack(run, tmp_path / "made", data=data, overrides=words)
    assert load_run(made).recipe.evaluation["seed"] == 5  # its scores can be made again
    before, now = load_run(run).world_model, load_run(made).world_model
    assert isinstance(now.codec, CompactReference)
    first, actions = torch.rand(1, 3, 32, 32), torch.zeros(1, 9, 2)
    for name, value in before.model.state_dict().items():
        torch.testing.assert_close(now.model.state_dict()[name], value.bfloat16().float())
    latents = [world.predict_latents(first, actions) for world in (before, now)]
    torch.testing.assert_close(*latents, rtol=0.05, atol=0.05)
    assert (before.rollout(first, actions) - now.rollout(first, actions)).abs().max() > 0.01
    with pytest.raises(TrainingError, match=r"codec=fine decodes other latents than those that"):
        pack(run, tmp_path / "other", data=data, overrides=["codec=fine"])


def test_a_file_of_the_codec_that_could_run_code_does_not_ship(run, tmp_path):
    recipe = Recipe.from_yaml(run / "recipe.yaml")
    recipe.codec.params["weights"] = str(tmp_path / "weights.pt")
    (tmp_path / "weights.pt").write_bytes(b"pickled")
    with pytest.raises(TrainingError, match=r"weights\.pt is not a safetensors file, so it cannot"):
        packing._portable_recipe(recipe, tmp_path)


def test_it_does_not_fix_the_number_of_threads(packed):
    assert "cpu_threads: null" in (packed / "recipe.yaml").read_text()


def test_another_folder_in_the_place_of_the_copy_is_left_alone(named, data, tmp_path):
    place = tmp_path / "runs/trained/drifting"
    place.mkdir(parents=True)
    (place / "notes.txt").write_text("mine")
    done = invoke("rollout", "drifting", "--data", data)
    assert done.exit_code == 2
    assert done.output == (
        "acwm: runs/trained/drifting holds something other than this drifting: move it away\n"
    )
    assert files(place) == {"notes.txt"}


def test_a_name_takes_no_address(named):
    done = invoke("rollout", "drifting://1")
    assert done.exit_code == 2
    assert "drifting://1 is not an address: the trained model is called drifting" in done.output
