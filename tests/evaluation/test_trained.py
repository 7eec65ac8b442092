"""A small model trained by `fit`: its scores, and played frame by frame it follows its actions."""

import pytest
import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.recipe import Recipe
from acwm_core.training.fit import fit
from acwm_core.training.run import load_run
from acwm_dream.rollout import rollout_run
from acwm_interventions.evaluate import evaluate_run
from tests import tiny

RECIPE = {
    "env": {"name": "drift"},
    "codec": {"name": "identity", "spatial_stride": 4, "temporal_stride": 2},
    "model": {"name": "dit_xs", "width": 64, "layers": 2},
    "conditioner": {"name": "adaln"},
    "objective": {
        "name": "diffusion_forcing",
        "shift": 20.0,
        "prediction": "clean",
        "loss_on": "clean",
        "weighting": "none",
        "steps": 4,
    },
    "training": {"learning_rate": 2e-3, "warmup_steps": 20, "ema_decay": 0.98},
    "trainer": {"max_steps": 1500, "accelerator": "cpu", "enable_progress_bar": False},
}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run and its data."""
    folder = tmp_path_factory.mktemp("trained")
    data = tiny.make_dataset(folder / "data", train=256, ind_test=12)
    recipe = Recipe.from_dict(
        {**RECIPE, "data": {"path": str(data), "clip_frames": 13, "batch_size": 16}}
    )
    return fit(recipe, folder / "run"), data


@pytest.mark.slow
def test_a_trained_stream_follows_its_actions(trained):
    run, data = trained
    world = load_run(run).world_model
    episodes = EpisodeDataset(data, "ind_test")
    video = torch.stack([torch.tensor(episodes.video(i)) for i in range(12)]).float() / 255
    actions = torch.stack([torch.tensor(episodes.actions(i)) for i in range(12)])

    def error(rows):
        stream = world.stream(video[:, 0], context=7)
        played = torch.cat(list(stream.play(rows[:, :-1])), 1)
        return (played - video[:, 1:]).square().mean().item()

    true = error(actions)
    whole = (world.rollout(video[:, 0], actions)[:, 1:] - video[:, 1:]).square().mean().item()
    still = (video[:, :1] - video[:, 1:]).square().mean().item()
    print(f"mean squared errors: {true=} {whole=} {still=} swapped={error(-actions)}")
    assert true < 0.5 * still
    assert true < 0.5 * error(-actions)
    assert true < 1.3 * whole


@pytest.mark.slow
def test_the_command_streams_it(trained, tmp_path):
    run, _ = trained
    out = rollout_run(run, tmp_path / "film.mp4", mode="stream", device="cpu")
    assert out.stat().st_size > 1000


@pytest.mark.slow
def test_its_scores_lie_where_theory_puts_them(trained):
    """Above copying the first frame and above wrong actions, below the codec; and it answers.

    On colours that it never saw it is worse, but still heeds its actions.
    """
    run, _ = trained
    overrides = ["metrics=[mse,psnr]", "counterfactual_metrics=[response]", "videos=0"]
    overrides = [f"evaluation.{each}" for each in [*overrides, "steps_sweep=[]"]]
    splits = evaluate_run(run, overrides=overrides, progress=False).splits
    inside, outside = (
        {kind: row["psnr"].value for kind, row in splits[name].scores.rows.items()}
        for name in ("ind_test", "ood_test")
    )
    found = splits["ind_test"].counterfactual.rows
    answers = {kind: row["response"].value for kind, row in found.items()}
    print(f"PSNR {inside=} {outside=} {answers=}")
    assert max(inside["copy"], inside["shuffled"]) + 3 < inside["model"] < inside["codec"]
    assert outside["shuffled"] < outside["model"] < inside["model"]
    assert answers["codec"] == pytest.approx(1)  # the codec loses nothing here
    assert 0.3 < answers["model"] < 1
