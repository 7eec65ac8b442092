import dataclasses
import json
import shutil

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from skimage.metrics import structural_similarity

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import AcwmError, AcwmWarning, DataError, RecipeError, TrainingError
from acwm_core.evaluation.clips import plan_clips
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.evaluate import choose_device
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.score import build_metrics
from acwm_core.evaluation.storage import read_scores
from acwm_core.training.run import load_run
from acwm_interventions.evaluate import evaluate_run
from tests import tiny
from tests.evaluation.by_hand import predictions, squared_error

FEW = {"counterfactual_metrics": [], "perturbed_episodes": 0, "metrics": ["mse"], "videos": 0}
"""Settings of evaluations of which little is asked."""


def by_hand(run, data, split):
    """MSE and SSIM of every row, predicted one clip at a time."""
    world_model, episodes = load_run(run).world_model, list(EpisodeDataset(data, split))
    found = {}
    for index in range(len(episodes)):
        truth, made = predictions(world_model, episodes, index)
        for kind, video in made.items():
            ssim = [
                structural_similarity(a, b, data_range=1, channel_axis=0)
                for a, b in zip(truth.numpy(), video.numpy(), strict=True)
            ]
            found[index, kind] = squared_error(video, truth), np.mean(ssim)
    return found


@pytest.mark.parametrize("split", ["ind_test", "ood_test"])
def test_numbers_are_those_of_an_independent_computation(evaluated, data, split):
    results = [r for r in read_scores(evaluated) if r.split == split]
    expected = by_hand(evaluated, data, split)
    assert {(r.episode, r.kind) for r in results} == set(expected)
    for result in results:
        mse, ssim = expected[result.episode, result.kind]
        assert result.values["mse"] == pytest.approx(mse, rel=1e-4)
        assert result.values["ssim"] == pytest.approx(ssim, abs=1e-4)
        assert result.values["psnr"] == pytest.approx(-10 * np.log10(mse + 1e-8), abs=1e-3)
    scores = Summary.read(evaluated).splits[split].scores
    for kind in ("model", "shuffled", "copy", "codec"):
        errors = [mse for (_, k), (mse, _) in expected.items() if k == kind]
        assert scores.rows[kind]["mse"].value == pytest.approx(np.mean(errors), rel=1e-4)
        pooled = -10 * np.log10(np.mean(errors) + 1e-8)
        assert scores.rows[kind]["psnr"].value == pytest.approx(pooled, abs=1e-3)


def test_the_copy_row_is_the_error_of_standing_still(evaluated, data):
    for result in read_scores(evaluated):
        if result.kind == "copy":
            video = EpisodeDataset(data, result.split)[result.episode].video[:9] / 255.0
            curve = ((video - video[0]) ** 2).mean((1, 2, 3))
            np.testing.assert_allclose(result.curves["mse"], curve, rtol=1e-5, atol=1e-9)
            assert result.curves["mse"][0] == 0


def test_the_codec_is_a_ceiling_and_the_copy_starts_perfect(evaluated):
    split = Summary.read(evaluated).splits["ind_test"]
    rows = {kind: row["psnr"].value for kind, row in split.scores.rows.items()}
    assert rows["codec"] == max(rows.values())
    curve = split.horizon["copy"]["psnr"]
    assert len(curve) == 9
    assert curve[0] == pytest.approx(80)


def test_labels_split_the_out_of_distribution_episodes(evaluated, data):
    summary = Summary.read(evaluated)
    labels = [e.ood_label for e in EpisodeDataset(data, "ood_test")]
    groups = summary.splits["ood_test"].labels
    assert {name: scores.clips for name, scores in groups.items()} == {
        "colour=90": 2,
        "ground=60": 2,
    }
    assert sorted(labels) == ["colour=90", "colour=90", "ground=60", "ground=60"]
    assert summary.splits["ind_test"].labels == {}
    mean = np.mean([scores.rows["model"]["mse"].value for scores in groups.values()])
    assert summary.splits["ood_test"].scores.rows["model"]["mse"].value == pytest.approx(mean)


def test_the_batch_size_changes_nothing(evaluated, data, tmp_path):
    first = read_scores(evaluated)
    for size in (1, 3):
        run = tiny.make_run(tmp_path / str(size), data, batch_size=size, **FEW)
        evaluate_run(run, progress=False)
        for a, b in zip(first, read_scores(run), strict=True):
            assert (a.split, a.episode, a.kind) == (b.split, b.episode, b.kind)
            np.testing.assert_allclose(a.curves["mse"], b.curves["mse"], rtol=1e-5, atol=1e-10)


@pytest.mark.ci
def test_a_second_evaluation_repeats_the_first(evaluated, data, tmp_path):
    run = tiny.make_run(tmp_path / "again", data, **tiny.SWEEP)
    evaluate_run(run, progress=False)
    assert read_scores(run) == read_scores(evaluated)
    before, after = Summary.read(evaluated), Summary.read(run)
    assert after.splits == before.splits
    assert after.gap == before.gap
    files = [sorted((r / "evaluation/videos").iterdir()) for r in (run, evaluated)]
    assert [f.read_bytes() for f in files[0]] == [f.read_bytes() for f in files[1]]


class Oracle(torch.nn.Module):
    """A world model that knows every video; its codec loses nothing."""

    def __init__(self, episodes):
        super().__init__()
        self.device = torch.device("cpu")
        videos = [torch.tensor(e.video.transpose(0, 3, 1, 2)).float() / 255 for e in episodes]
        self.videos = videos

    def codec(self, video):
        return video

    def rollout_chunks(self, given, actions, *, mode, steps, seeds):
        frames = actions.shape[1]
        known = [v[:frames] for f in given for v in self.videos if torch.equal(v[:1], f)]
        yield torch.stack(known)


def test_a_perfect_model_stays_finite_or_null_in_json(data, tmp_path):
    from acwm_core.evaluation.evaluate import Entrant, _summarise, _write

    run = tiny.make_run(tmp_path / "oracle", data)
    bundle = load_run(run)
    config = EvaluationConfig(metrics=("mse", "ssim", "psnr"), frames=9, device="cpu")
    episodes = EpisodeDataset(data, "ind_test")
    evaluator = Evaluator(Oracle(episodes), bundle.card, build_metrics(config.metrics), config)
    plans = plan_clips("ind_test", episodes.lengths, config)
    results = {"ind_test": evaluator.scores(plans, episodes)}
    videos = evaluator.videos(plans, episodes, results["ind_test"])
    summary = _summarise(
        run / "evaluation",
        Entrant({"env": "drift", "codec": "blocks"}, {}),
        evaluator,
        results,
        {"ind_test": {}},
        [],
    )
    summary.provenance["dataset"] = {"frame_size": [32, 32]}
    _write(run / "evaluation", summary, results, videos)
    text = (run / "evaluation/summary.json").read_text()
    json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in JSON"))
    summary.provenance.clear()  # it was made up
    summary.write(run / "evaluation")
    scores = Summary.read(run).splits["ind_test"].scores
    assert scores.rows["model"]["mse"].value == 0
    assert scores.rows["model"]["psnr"].value == pytest.approx(80)
    assert scores.paired["copy"]["psnr"].better == 5
    assert scores.paired["shuffled"]["psnr"].difference.value == 0


def test_rows_of_parquet_are_readable_by_others(evaluated):
    table = pq.read_table(evaluated / "evaluation/episodes.parquet")
    assert table.num_rows == 4 * (5 + 4)
    assert {"split", "episode", "ood_label", "kind", "psnr", "psnr_per_frame"} <= set(
        table.schema.names
    )
    assert len(table["psnr_per_frame"][0]) == 9


def test_the_summary_says_where_it_comes_from(evaluated, data):
    facts = Summary.read(evaluated).provenance
    assert facts["training_steps"] == 7
    assert facts["sampling_steps"] == 2
    assert facts["dataset"]["episodes"] == {"train": 2, "ind_test": 5, "ood_test": 4}
    assert facts["dataset"]["checksums"]["ind_test"] == EpisodeDataset(data, "ind_test").checksum
    assert facts["evaluation"]["frames"] == 9
    assert facts["parameters"] == sum(
        p.numel() for n, p in load_run(evaluated).world_model.named_parameters()
    )


def test_picks_are_ranked_by_the_headline(evaluated):
    results = [r for r in read_scores(evaluated) if r.kind == "model" and r.split == "ind_test"]
    ranked = [r.episode for r in sorted(results, key=lambda r: -r.values["psnr"])]
    picked = {
        v.pick: v.episode
        for v in Summary.read(evaluated).videos
        if v.kind == "model" and v.split == "ind_test"
    }
    assert picked == {"best": ranked[0], "median": ranked[2], "worst": ranked[4]}


def test_a_new_evaluation_replaces_the_videos_of_the_old(data, tmp_path):
    run = tiny.make_run(tmp_path / "replaced", data, **FEW | {"videos": 1})
    evaluate_run(run, progress=False)
    words = ["evaluation.splits=[ind_test]"]
    evaluate_run(run, overrides=words, overwrite=True, progress=False)
    files = {f.name for f in (run / "evaluation/videos").iterdir()}
    assert files == {v.file for v in Summary.read(run).videos}
    assert all(name.startswith("ind_test") for name in files)


def test_it_is_told_when_the_training_is_not_at_its_end(data, tmp_path):
    parts = {"trainer": {"max_steps": 16}}
    run = tiny.make_run(tmp_path / "half", data, parts=parts, **FEW | {"videos": 0})
    with pytest.warns(AcwmWarning, match="7 of 16 steps"):
        evaluate_run(run, progress=False)


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        (["evaluation.step=3"], RecipeError, "did you mean 'steps'"),
        (["evaluation.metrics=[pnsr]"], RecipeError, "did you mean 'psnr'"),
        (["evaluation.metrics=[]"], RecipeError, "must name at least one: let the recipe extend b"),
        (["model.width=8"], RecipeError, "is not a setting of the evaluation"),
        (["evaluation.device=tpu9"], RecipeError, "no such device"),
    ],
)
def test_wrong_words_are_refused_before_anything_is_written(data, tmp_path, words, error, message):
    run = tiny.make_run(tmp_path / "words", data)
    with pytest.raises(error, match=message):
        evaluate_run(run, overrides=words, progress=False)
    assert not (run / "evaluation").exists()


def test_missing_things_are_named(data, tmp_path):
    with pytest.raises(TrainingError, match="no run folder"):
        evaluate_run(tmp_path / "nothing", progress=False)
    run = tiny.make_run(tmp_path / "run", data)
    with pytest.raises(DataError, match="no dataset in"):
        evaluate_run(run, data=tmp_path / "nowhere", progress=False)
    small = tiny.make_dataset(tmp_path / "small", ind_test=1, ood_test=0)
    with pytest.raises(DataError, match="no split 'ood_test'"):
        evaluate_run(run, data=small, overrides=["evaluation.splits=[ood_test]"], progress=False)
    with pytest.raises(DataError, match="needs two"):
        evaluate_run(run, data=small, progress=False)
    untested = tiny.make_dataset(tmp_path / "untested", train=2, ind_test=0, ood_test=0)
    with pytest.raises(DataError, match="no test split: add one"):
        evaluate_run(run, data=untested, progress=False)


def test_data_of_another_environment_is_refused(data, tmp_path, monkeypatch):
    run = tiny.make_run(tmp_path / "run", data)
    action = dataclasses.replace(tiny.Drift.card.action, high=(3.0, 3.0))
    monkeypatch.setattr(tiny.Drift, "card", dataclasses.replace(tiny.Drift.card, action=action))
    other = tiny.make_dataset(tmp_path / "other")
    with pytest.raises(DataError, match="trained on drift"):
        evaluate_run(run, data=other, progress=False)


def test_the_device_is_found_or_refused():
    assert choose_device("cpu").type == "cpu"
    with pytest.raises(AcwmError, match="no such device"):
        choose_device("cuda:99")


def test_a_missing_dataset_is_named_with_the_command_that_makes_it(evaluated, data, tmp_path):
    run = shutil.copytree(evaluated, tmp_path / "run")
    recipe = run / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace(str(data), "data/gone"))
    with pytest.raises(
        DataError, match="there is no dataset in data/gone: make its test"
    ) as caught:
        evaluate_run(run, progress=False)
    assert "`acwm generate drift --episodes 0,5,4 --size 32x32 --seed 0 --out data/gone`" in str(
        caught.value
    )
