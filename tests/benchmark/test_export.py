"""Tasks hold what a participant needs, and nothing of the truth."""

import hashlib
import json

import numpy as np
import pytest
from PIL import Image

from acwm_benchmark.export import evaluation_config, export_tasks
from acwm_benchmark.score import score_predictions
from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.protocol import protocol_named
from tests.benchmark.participant import WRITERS
from tests.formats import release

SEED = 123456789


def index(tasks):
    return [json.loads(line) for line in (tasks / "index.jsonl").read_text().splitlines()]


def still(tasks, out):
    """Predictions in which nothing moves."""
    for task in index(tasks):
        (out / task["id"]).parent.mkdir(parents=True, exist_ok=True)
        frame = np.asarray(Image.open(tasks / task["images"][0])) / np.float32(255)
        WRITERS["npz"](out / task["id"], np.stack([frame] * task["frames"]))
    return out


def test_tasks_are_first_frames_and_actions_of_the_test_clips(tasks, truth):
    clips = [task for task in index(tasks) if not task["branch"]]
    assert len(clips) == 6 + 5
    for task in clips:
        split, number = task["id"].removeprefix("slide/").rsplit("-", 1)
        episode = EpisodeDataset(truth / "slide", split)[int(number)]
        actions = np.load(tasks / task["actions"])["actions"]
        assert task["frames"] == len(actions) == 9
        np.testing.assert_array_equal(actions[:-1], episode.actions[:8])
        (image,) = task["images"]
        np.testing.assert_array_equal(np.asarray(Image.open(tasks / image)), episode.video[0])


def test_nothing_of_the_truth_is_in_them(tasks, truth):
    firsts = {
        episode.video[0].tobytes()
        for split in ("ind_test", "ood_test")
        for episode in EpisodeDataset(truth / "slide", split)
    }
    for path in tasks.rglob("*"):
        if path.suffix == ".png":
            assert np.asarray(Image.open(path)).tobytes() in firsts
        elif path.suffix == ".npz":
            assert list(np.load(path)) == ["actions"]
        elif path.is_file():
            text = path.read_text()
            assert "position" not in text.replace("position_error", "")
            assert "ground" not in text  # a factor


def test_files_are_those_of_the_checksums(tasks):
    lines = (tasks / "SHA256SUMS").read_text().splitlines()
    named = {line.partition("  ")[2] for line in lines}
    files = {str(path.relative_to(tasks)) for path in tasks.rglob("*") if path.is_file()}
    assert named == files - {"SHA256SUMS"}
    for line in lines:
        digest, _, name = line.partition("  ")
        assert hashlib.sha256((tasks / name).read_bytes()).hexdigest() == digest


def test_several_given_frames_are_several_pictures(truth, tmp_path):
    words = ["evaluation.context_frames=3", "evaluation.frames=9"]
    made = export_tasks(["slide"], tmp_path / "tasks", data=truth, overrides=words)
    for task in made.all:
        assert task.given == len(task.images) == 3
    episode = EpisodeDataset(truth / "slide", "ind_test")[0]
    shown = [np.asarray(Image.open(made.folder / name)) for name in made.all[0].images]
    np.testing.assert_array_equal(np.stack(shown), episode.video[:3])


@pytest.mark.ci
def test_the_public_set_can_be_simulated_by_anyone_and_a_secret_one_cannot(parts, tmp_path):
    options = {"episodes": 2, "workers": 0, "progress": False, "size": 32}
    made = {
        name: export_tasks(["slide"], tmp_path / name, seed=seed, **options).folder
        for name, seed in (("public", 0), ("secret", SEED))
    }
    for name, tasks in made.items():
        still(tasks, tmp_path / f"{name}-made")
        (tmp_path / f"{name}-truth").rename(tmp_path / f"{name}-kept")

    def score(name, data=None):
        out = tmp_path / f"{name}-scores"
        options = {"data": data, "out": out, "progress": False, "workers": 0}
        score_predictions(tmp_path / f"{name}-made", made[name], **options)

    score("public")
    with pytest.raises(DataError, match="the seed of its tasks is secret"):
        score("secret")
    with pytest.raises(DataError, match="other episodes of ind_test than the tasks"):
        score("secret", tmp_path / "public-kept")
    score("secret", tmp_path / "secret-kept")
    written = [
        *made["secret"].rglob("*.json*"),
        tmp_path / "secret-scores/slide/evaluation/summary.json",
    ]
    assert not [path for path in written if str(SEED) in path.read_text()]


@pytest.mark.ci
def test_clips_of_the_published_release_are_scored_by_its_protocol(parts, tmp_path):
    home = tmp_path / "push_block"
    splits = {"ind_train": 1, "ind_test": 3, "ood_test": 2}
    release.environment(home, size=(32, 32), length=40, splits=splits)
    with pytest.raises(SystemExit) as ended:
        main(["data", "import", "acwm-phys", str(home), "--out", str(tmp_path / "data")])
    assert not ended.value.code
    words = ["evaluation.protocol=acwm-phys", "evaluation.metrics=[mse,psnr]"]
    tasks = export_tasks([], tmp_path / "tasks", data=tmp_path / "data", overrides=words)
    config = EvaluationConfig(protocol="acwm-phys", metrics=("mse",))
    windows = protocol_named("acwm-phys").windows(40, config.frames, config.cuts)
    assert len(tasks.all) == 5 * len(windows)
    assert {task.frames for task in tasks.all} == {37}
    predictions = still(tasks.folder, tmp_path / "still")
    told = {"out": tmp_path / "scores", "progress": False}
    found = score_predictions(predictions, tasks.folder, data=tmp_path / "data", **told)
    summary = found["push_cube"]
    assert summary.protocol == "acwm-phys"
    rows = summary.splits["ind_test"].scores.rows
    assert rows["model"]["psnr"].value == pytest.approx(rows["copy"]["psnr"].value)
    assert "recorded" in summary.left_out.get("perturbed", "recorded")
    with pytest.raises(DataError, match="cannot be simulated: import it"):
        score_predictions(predictions, tasks.folder, **told)


def test_what_cannot_be_exported_is_told(tasks, truth, tmp_path):
    with pytest.raises(DataError, match="is not empty"):
        export_tasks(["slide"], tasks, data=truth)
    with pytest.raises(DataError, match="holds no dataset of drift"):
        export_tasks(["drift"], tmp_path / "t", data=truth)
    with pytest.raises(RecipeError, match="not a setting of the evaluation"):
        evaluation_config(["model.width=3"])
    with pytest.raises(RecipeError, match="did you mean 'context_frames'"):
        export_tasks(
            ["slide"], tmp_path / "t", data=truth, overrides=["evaluation.context_frame=3"]
        )
    with pytest.raises(DataError, match="holds no tasks"):
        score_predictions(tmp_path, tmp_path)
