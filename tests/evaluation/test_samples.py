"""`evaluation.samples`: several draws of each clip, against predictions made one at a time."""

import dataclasses

import numpy as np
import pytest
import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.evaluation.clips import draw_seeds, noise_seed
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.storage import read_scores
from acwm_core.model.world_model import WorldModel
from acwm_core.training.run import load_run
from acwm_interventions.evaluate import evaluate_run
from acwm_report.draws import draws_phrase
from acwm_report.terminal import print_summary
from tests import tiny
from tests.evaluation.by_hand import squared_error, true_clip

DRAWS = 3
METRICS = {"metrics": ["mse", "psnr", "energy_score", "spread_skill"]}


ALONE = {**METRICS, "videos": 0, "counterfactual_episodes": 0}
"""Without anything that is predicted beside the clips."""


@pytest.fixture(scope="module")
def drawn(data, tmp_path_factory):
    """A run of which several draws are evaluated; tests must not change it."""
    run = tiny.make_run(
        tmp_path_factory.mktemp("drawn") / "run", data, samples=DRAWS, batch_size=4, **METRICS
    )
    evaluate_run(run, progress=False)
    return run


def draws_by_hand(run, data, index):
    """The true clip of an episode and all draws of it, with the clip's own seeds."""
    world, episode = load_run(run).world_model, EpisodeDataset(data, "ind_test")[index]
    video, actions = true_clip(episode)
    seeds = draw_seeds(noise_seed(0, "ind_test", index), DRAWS)
    made = [world.rollout(video[None, :1], actions[None], seeds=[seed])[0] for seed in seeds]
    return video, torch.stack(made)


def test_rows_are_those_of_an_independent_computation(drawn, data):
    rows = Summary.read(drawn).splits["ind_test"].scores.rows
    clips = [draws_by_hand(drawn, data, index) for index in range(5)]
    errors = np.array([[squared_error(made, video) for made in draws] for video, draws in clips])
    mean = [squared_error(draws.mean(0), video) for video, draws in clips]
    assert rows["model"]["mse"].value == pytest.approx(errors.mean(), rel=1e-4)
    assert rows["mean_of_draws"]["mse"].value == pytest.approx(np.mean(mean), rel=1e-4)
    assert rows["best_of_draws"]["mse"].value == pytest.approx(errors.min(1).mean(), rel=1e-4)
    assert list(rows)[:3] == ["model", "mean_of_draws", "best_of_draws"]
    away = np.mean([(draws - video).square().mean((2, 3, 4)).sqrt() for video, draws in clips])
    pairs = [(0, 1), (0, 2), (1, 2)]
    apart = [
        (draws[a] - draws[b]).square().mean((1, 2, 3)).sqrt().mean()
        for _, draws in clips
        for a, b in pairs
    ]
    assert rows["model"]["energy_score"].value == pytest.approx(away - np.mean(apart) / 2, rel=1e-4)


@pytest.mark.ci
def test_the_first_draw_is_the_only_one_of_a_single_sample(drawn, data, tmp_path):
    """Metrics of draws that are listed do not change a result without draws by a bit."""
    runs = {
        "plain": {"metrics": METRICS["metrics"][:2]},
        "listed": METRICS,
    }
    made = {}
    for name, settings in runs.items():
        run = tiny.make_run(tmp_path / name, data, **settings)
        made[name] = dataclasses.asdict(evaluate_run(run, progress=False))["splits"]
    assert made["plain"] == made["listed"]
    alone = made["plain"]["ind_test"]["scores"]["rows"]
    assert {"mean_of_draws", "best_of_draws"}.isdisjoint(alone)
    errors = []
    for index in range(5):
        video, draws = draws_by_hand(drawn, data, index)
        errors.append(squared_error(draws[0], video))
    assert alone["model"]["mse"]["value"] == pytest.approx(np.mean(errors), rel=1e-5)
    references = Summary.read(drawn).splits["ind_test"].scores.rows
    assert references["codec"]["mse"].value == alone["codec"]["mse"]["value"]


def test_a_model_that_draws_nothing_is_predicted_once(data, tmp_path, monkeypatch):
    """It is scored by the same rules: its draw is its own mean and best, and it has no spread."""
    monkeypatch.setattr(tiny.PointwiseModel, "samples", False)
    predicted, rollout = [], WorldModel.rollout_chunks

    def counted(self, given, *rest, **more):
        predicted.extend(given)
        return rollout(self, given, *rest, **more)

    monkeypatch.setattr(WorldModel, "rollout_chunks", counted)
    run = tiny.make_run(tmp_path / "run", data, samples=8, **ALONE)
    summary = evaluate_run(run, progress=False)
    rows = summary.splits["ind_test"].scores.rows
    for kind in ("mean_of_draws", "best_of_draws"):
        assert rows[kind]["mse"] == rows["model"]["mse"]
    assert rows["model"]["spread_skill"].value == 0
    assert len(predicted) == 2 * 9  # own and other actions of five and four clips
    assert "the model is deterministic" in draws_phrase(summary, "ind_test")


def test_a_line_and_the_table_show_them(drawn, capsys):
    summary = Summary.read(drawn)
    print_summary(summary)
    shown = capsys.readouterr().out
    phrase = draws_phrase(summary, "ind_test")
    assert phrase.startswith(f"{DRAWS} draws: PSNR")
    assert f"ind_test: {phrase}" in shown
    assert "frames" in shown
    assert {score.kind for score in read_scores(drawn)} >= {"mean_of_draws", "best_of_draws"}
