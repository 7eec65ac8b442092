"""Evaluation with several given frames, and of a model that carries its state through."""

import numpy as np
import pytest
import torch

from acwm_core.checks.disc import Disc
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import DataError
from acwm_core.evaluation.clips import Clip, as_clip, plan_clips
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.score import build_metrics
from acwm_core.evaluation.storage import read_scores
from acwm_core.training.run import load_run
from acwm_interventions.counterfactual import counterfactual, simulate_branches
from acwm_interventions.evaluate import evaluate_run
from acwm_interventions.interventions import perturbed
from acwm_metrics.response import Response
from tests import tiny
from tests.evaluation.by_hand import predictions, squared_error
from tests.evaluation.test_counterfactual import Episodes, Known, response, simulator

GIVEN = 5
QUICK = {"metrics": ["mse"], "counterfactual_metrics": [], "perturbed_episodes": 0, "videos": 0}


def clips(path, given):
    return {"data": {"path": str(path), "clip_frames": 9, "context_frames": given}}


@pytest.fixture(scope="module")
def run(tmp_path_factory, data):
    return tiny.make_run(
        tmp_path_factory.mktemp("runs") / "given", data, parts=clips(data, GIVEN), **QUICK
    )


def test_scores_begin_with_the_last_given_frame(run, data):
    summary = evaluate_run(run, progress=False)
    world_model, episodes = load_run(run).world_model, list(EpisodeDataset(data, "ind_test"))
    found = {(r.episode, r.kind): r for r in read_scores(run) if r.split == "ind_test"}
    assert {result.frames for result in found.values()} == {9 - GIVEN + 1}
    for index in range(len(episodes)):
        truth, made = predictions(world_model, episodes, index, given=GIVEN)
        for kind, video in made.items():
            mse = squared_error(video, truth, GIVEN - 1)
            assert found[index, kind].values["mse"] == pytest.approx(mse, rel=1e-4)
    assert summary.provenance["context_frames"] == GIVEN
    assert summary.provenance["mode"] == "windows"


def test_so_many_are_given_as_the_evaluation_says(run, data, tmp_path):
    """The linear model does not mind, so with one frame it is one that was trained with one."""
    one = tiny.make_run(tmp_path / "one", data, parts=clips(data, 1), **QUICK)
    usual = evaluate_run(one, progress=False)
    told = evaluate_run(
        run, overrides=["evaluation.context_frames=1"], overwrite=True, progress=False
    )
    assert told.provenance["context_frames"] == 1
    assert told.splits["ind_test"].scores.rows == usual.splits["ind_test"].scores.rows


def test_a_clip_of_given_frames_alone_is_refused():
    config = EvaluationConfig()
    assert [plan.given for plan in plan_clips("ind_test", [6, 7], config, 5)] == [5, 5]
    with pytest.raises(DataError, match="episode 1 of ind_test has 5 frames, of which 5 are given"):
        plan_clips("ind_test", [6, 5], config, 5)


@pytest.fixture(scope="module")
def world():
    environment = Disc(size=(32, 48))
    specs = [EpisodeSpec("disc", "ind_test", index) for index in range(2)]
    episodes = Episodes(simulate(environment, spec) for spec in specs)
    plans = [Clip("ind_test", i, 0, 24, 1 - i, 0, seed=i, given=GIVEN) for i in range(2)]
    return environment, specs, episodes, plans


def test_branches_begin_with_what_was_given(world):
    environment, specs, episodes, plans = world
    for branches, factual in simulate_branches(environment, plans, episodes, 10):
        assert torch.equal(factual.video, as_clip(episodes[factual.clip.episode].video[:10]))
        for branch, made in zip(branches, factual.branches, strict=True):
            assert np.array_equal(branch.actions, made.actions)
            assert np.array_equal(branch.actions[: GIVEN - 1], factual.actions[: GIVEN - 1])
            assert not np.array_equal(branch.actions, factual.actions)
            assert torch.equal(made.video[:GIVEN], factual.video[:GIVEN])
        assert any(not torch.equal(made.video, factual.video) for made in factual.branches)
    evaluator = Evaluator(
        Known(environment, specs, simulator),
        environment.card,
        {},
        EvaluationConfig(batch_size=3, device="cpu"),
    )
    fans = simulate_branches(environment, plans, episodes, 10)
    found, _ = counterfactual(evaluator, {"response": Response()}, fans)
    assert response(found) == pytest.approx(1, abs=1e-9)
    assert found.frames == 10 - GIVEN + 1


def test_a_perturbed_start_is_scored_on_the_same_frames(world):
    environment, _, episodes, plans = world
    config = EvaluationConfig(device="cpu")
    evaluator = Evaluator(None, environment.card, build_metrics(["mse"]), config)
    rows, found = perturbed(evaluator, environment, plans, episodes)
    assert [row.frames for row in rows] == [24 - GIVEN + 1] * 2
    assert len(found.share) == 24 - GIVEN + 1


@pytest.fixture(scope="module")
def recurrent(tmp_path_factory, data):
    parts = {
        "codec": {"name": "identity", "temporal_stride": 2},
        "model": {"name": "recurrent", "channels": 8, "width": 16, "blocks": 1},
        "objective": {"name": "regression"},
        "conditioner": {"name": "adaln"},
    }
    path = tmp_path_factory.mktemp("runs") / "recurrent"
    return tiny.make_run(path, data, parts=parts, **QUICK, frames=None, steps_sweep=[1, 2])


def test_a_model_trained_for_it_carries_its_state_through_whole_episodes(recurrent, data):
    """13 frames are more than a window of 9, which would begin anew after it."""
    summary = evaluate_run(recurrent, progress=False)
    assert summary.provenance["mode"] == "stream"
    assert summary.splits["ind_test"].steps is None  # it has no choice of sampling steps
    model = load_run(recurrent).world_model
    episode = EpisodeDataset(data, "ind_test")[0]
    video = torch.tensor(episode.video.transpose(0, 3, 1, 2))[None].float() / 255
    actions = torch.tensor(episode.actions)[None]

    def found():
        rows = read_scores(recurrent)
        return next(r for r in rows if (r.split, r.episode, r.kind) == ("ind_test", 0, "model"))

    def mse(**how):
        return (model.rollout(video[:, 0], actions, **how) - video).square().mean().item()

    whole = mse(mode="whole")
    assert mse(mode="windows") != pytest.approx(whole, rel=1e-3)
    assert found().values["mse"] == pytest.approx(whole, rel=1e-4)
    told = evaluate_run(
        recurrent, overrides=["evaluation.mode=windows"], overwrite=True, progress=False
    )
    assert told.provenance["mode"] == "windows"
    assert found().values["mse"] == pytest.approx(mse(mode="windows"), rel=1e-4)


def test_the_published_protocol_predicts_windows_from_one_frame():
    config = EvaluationConfig(protocol="acwm-phys")
    assert (config.mode, config.context_frames) == ("windows", 1)
    assert EvaluationConfig().mode is None


def test_more_frames_may_be_given_than_a_response_usually_has(run, monkeypatch):
    monkeypatch.setattr("acwm_interventions.interventions.CLIP_FRAMES", 4)
    asked = ["evaluation.counterfactual_metrics=[response]", "evaluation.counterfactual_episodes=2"]
    summary = evaluate_run(run, overrides=asked, overwrite=True, progress=False)
    found = summary.splits["ind_test"].counterfactual
    assert found is not None
    assert found.rows["model"]["response"].value is not None
