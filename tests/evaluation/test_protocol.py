import numpy as np
import pytest
import torch

from acwm_core.data.episodes import EpisodeDataset
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.protocol import (
    Batch,
    batches,
    derangement,
    load_sample,
    noise_seed,
    plan_clips,
    predictors,
)
from tests.core.tiny import tiny_world_model


@pytest.mark.parametrize("count", [2, 3, 4, 17, 100])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_derangement_is_a_permutation_that_moves_everything(count, seed):
    order = derangement(count, seed)
    assert sorted(order) == list(range(count))
    assert all(place != other for place, other in enumerate(order))


def test_a_derangement_is_fixed_by_its_seed_and_reaches_every_cycle():
    assert derangement(50, 3) == derangement(50, 3)
    assert derangement(50, 3) != derangement(50, 4)
    cycles = {tuple(derangement(4, seed)) for seed in range(200)}
    assert len(cycles) == 6  # (4 − 1)! cycles through all four


def test_noise_seeds_differ_by_clip_and_not_by_what_else_is_evaluated():
    seeds = {noise_seed(0, s, e) for s in ("ind_test", "ood_test") for e in range(100)}
    assert len(seeds) == 200
    some = plan_clips("ood_test", 100, EvaluationConfig(episodes=3))
    every = plan_clips("ood_test", 100, EvaluationConfig())
    assert [plan.seed for plan in some] == [plan.seed for plan in every[:3]]
    assert noise_seed(1, "ind_test", 0) != noise_seed(0, "ind_test", 0)


def test_donors_are_among_the_episodes_taken():
    plans = plan_clips("ind_test", 100, EvaluationConfig(episodes=5))
    assert {plan.donor for plan in plans} == {0, 1, 2, 3, 4}


def test_one_episode_has_no_other():
    with pytest.raises(DataError, match="needs two"):
        plan_clips("ind_test", 1, EvaluationConfig())


def test_a_sample_is_cut_from_its_episode(data):
    episodes = EpisodeDataset(data, "ind_test")
    plan = plan_clips("ind_test", len(episodes), EvaluationConfig())[2]
    sample, episode, donor = load_sample(plan, episodes, 9), episodes[2], episodes[plan.donor]
    np.testing.assert_array_equal(
        (sample.video.numpy() * 255).round(), episode.video[:9].transpose(0, 3, 1, 2)
    )
    np.testing.assert_array_equal(sample.actions[:8], episode.actions[:8])
    np.testing.assert_array_equal(sample.donor_actions[:8], donor.actions[:8])
    assert not sample.actions[8].any()
    assert not sample.donor_actions[8].any()
    assert len(load_sample(plan, episodes, None).video) == len(episode.video)
    assert len(load_sample(plan, episodes, 1000).video) == len(episode.video)


def test_batches_hold_clips_of_one_length(data):
    episodes = EpisodeDataset(data, "ind_test")
    plans = plan_clips("ind_test", len(episodes), EvaluationConfig())
    lengths = [9, 9, 9, 5, 9]
    samples = (load_sample(p, episodes, n) for p, n in zip(plans, lengths, strict=True))
    grouped = [[len(sample.video) for sample in group] for group in batches(samples, 2)]
    assert grouped == [[9, 9], [9], [5], [9]]


def test_rows_predict_what_they_are_named_after():
    world_model = tiny_world_model().eval()
    generator = torch.Generator().manual_seed(0)
    video = torch.rand(2, 9, 3, 16, 16, generator=generator)
    own, other = torch.rand(2, 2, 9, 2, generator=generator)
    rows = predictors(world_model, steps=2, window=5)
    batch = Batch(video, own, other, seeds=[3, 4])

    def rollout(actions):
        return world_model.rollout(video[:, 0], actions, steps=2, window=5, seeds=[3, 4])

    assert torch.equal(rows["model"](batch), rollout(own))
    assert torch.equal(rows["shuffled"](batch), rollout(other))
    assert not torch.equal(rollout(own), rollout(other))
    assert all(torch.equal(frame, video[:, 0]) for frame in rows["copy"](batch).unbind(1))
    assert torch.equal(rows["codec"](batch), world_model.codec(video))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"metrics": []}, "metrics"),
        ({"splits": ["ind_tes"]}, "did you mean 'ind_test'"),
        ({"frames": 1}, "frames"),
        ({"steps": 0}, "steps"),
        ({"batch_size": 0}, "batch_size"),
        ({"episodes": 1}, "episodes"),
        ({"seed": -1}, "seed"),
        ({"videos": -1}, "videos"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(RecipeError, match=message):
        EvaluationConfig(**settings)


def test_the_headline_is_psnr_or_else_the_first_metric():
    assert EvaluationConfig().headline == "psnr"
    assert EvaluationConfig(metrics=("ssim", "mse")).headline == "ssim"
