"""Clips that begin with several given frames, and clips that are whole episodes."""

import json

import pytest
import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import RecipeError
from acwm_core.model.world_model import WorldModel
from acwm_core.training.fit import fit
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder
from tests.tiny import TinyModel, tiny_recipe
from tests.training.runs import numbers
from tests.training.test_short_episodes import short  # noqa: F401 - a fixture

STEPS = {"max_steps": 4}


@pytest.fixture
def seen(monkeypatch):
    """Latent frames, and how many of them were clean, of each batch that was trained on."""
    batches = []
    forward = TinyModel.forward

    def watched(self, latents, sigma, conditioning):
        if torch.is_grad_enabled():
            batches.append((latents.shape[1], int((sigma == 0).all(0).sum())))
        return forward(self, latents, sigma, conditioning)

    monkeypatch.setattr(TinyModel, "forward", watched)
    return batches


def test_a_run_learns_and_predicts_with_as_many_given_frames_as_its_recipe_says(
    data, seen, tmp_path
):
    """Five frames are three latent ones at a stride of 2; nine frames are five."""
    recipe = tiny_recipe(data, data={"context_frames": 5}, trainer=STEPS)
    run = RunFolder(fit(recipe, tmp_path / "run"))
    assert set(seen) == {(5, 3)}
    assert {"val/loss", "val/psnr"} <= {name for _, name in numbers(run)}
    bundle = load_run(run.path)
    assert bundle.recipe.data["context_frames"] == bundle.world_model.context_frames == 5
    assert bundle.world_model.clip_frames == 9
    video = torch.tensor(EpisodeDataset(data, "train").video(0))[None] / 255
    rolled = bundle.world_model.rollout(video[:, :5], torch.zeros(1, 12, 2))
    assert rolled.shape == (1, 12, 3, 16, 16)
    torch.testing.assert_close(rolled[:, :5], bundle.world_model.codec(video[:, :5]))


def test_validation_scores_only_what_was_predicted(data, tmp_path, monkeypatch):
    """Repeating the last given frame is 0 dB above doing so, whatever stood before it."""

    def still(self, given, actions, **how):
        assert given.shape[1] == 5
        return given[:, -1:].expand(-1, actions.shape[1], -1, -1, -1)

    monkeypatch.setattr(WorldModel, "rollout", still)
    recipe = tiny_recipe(data, data={"context_frames": 5}, trainer=STEPS)
    found = numbers(RunFolder(fit(recipe, tmp_path / "run")))
    scores = [float(v) for (_, name), v in found.items() if name == "val/psnr_over_first_frame"]
    assert len(scores) == 1
    assert scores == pytest.approx([0], abs=1e-4)


def test_given_frames_that_do_not_fit_are_refused_before_training(data, tmp_path):
    for wrong in (2, 9):
        with pytest.raises(RecipeError, match=rf"context_frames={wrong} must be 1 plus a multiple"):
            fit(tiny_recipe(data, data={"context_frames": wrong}), tmp_path / "run")
    with pytest.raises(RecipeError, match="context_frames=0 must be at least 1"):
        tiny_recipe(data, data={"context_frames": 0})


@pytest.mark.parametrize("cached", [True, False])
def test_short_clips_keep_a_frame_to_predict(short, seen, tmp_path, cached):  # noqa: F811
    """Episodes of 5 and 6 frames are filled up to the four latent frames that are needed."""
    recipe = tiny_recipe(short, data={"context_frames": 5, "cache_latents": cached})
    fit(recipe, tmp_path / "run")
    assert {length for length, _ in seen} == {5, 4}
    assert {clean for _, clean in seen} == {3}


@pytest.mark.parametrize(
    ("frames", "starts", "reading"),
    [
        (5, (0, 4), {}),
        (9, (0,), {"cache_latents": False}),
        (12, (0,), {}),
        (5, (0, 4), {"reader": "webdataset", "shuffle_buffer": 1}),
    ],
)
def test_clips_may_begin_with_their_episodes_and_follow_each_other(
    data, tmp_path, frames, starts, reading
):
    """Each batch of four has four first actions; those of these clips, no others."""
    (tmp_path / "seen").mkdir()
    witness = {
        "class_path": "tests.training.callbacks.Witness",
        "init_args": {"folder": str(tmp_path / "seen")},
    }
    recipe = tiny_recipe(
        data,
        data={"clip_starts": "episode", "clip_frames": frames, **reading},
        trainer={"max_steps": 12, "callbacks": [witness]},
    )
    run = fit(recipe, tmp_path / "run")
    lines = (tmp_path / "seen" / "rank-0.jsonl").read_text().splitlines()
    first = {tuple(action) for line in lines for action in json.loads(line)}
    episodes = EpisodeDataset(data, "train")
    actions = [episodes.actions(index) for index in range(6)]
    assert first == {tuple(each[start].tolist()) for each in actions for start in starts}
    assert load_run(run).world_model.clip_frames == frames
