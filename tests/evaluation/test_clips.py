import numpy as np
import pytest
import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError, RecipeError
from acwm_core.evaluation.clips import (
    Clip,
    derangement,
    donor_actions,
    noise_seed,
    plan_clips,
    read_clips,
)
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.predict import Evaluator
from acwm_core.recipe.check import check_section
from tests.tiny import pointwise_world_model


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
    some = plan_clips("ood_test", [9] * 100, EvaluationConfig(episodes=3))
    every = plan_clips("ood_test", [9] * 100, EvaluationConfig())
    assert [plan.seed for plan in some] == [plan.seed for plan in every[:3]]
    other = plan_clips("ood_test", [9] * 100, EvaluationConfig(seed=1))
    assert not {plan.seed for plan in other} & {plan.seed for plan in every}


def test_donors_are_among_the_episodes_taken():
    plans = plan_clips("ind_test", [9] * 100, EvaluationConfig(episodes=5))
    assert {plan.donor for plan in plans} == {0, 1, 2, 3, 4}


def test_one_episode_has_no_other():
    with pytest.raises(DataError, match="needs two"):
        plan_clips("ind_test", [9], EvaluationConfig())


def test_a_clip_is_read_from_the_first_frame(data):
    episodes = EpisodeDataset(data, "ind_test")
    clip = plan_clips("ind_test", episodes.lengths, EvaluationConfig(frames=9))[2]
    ((_, part),), whole, donor = read_clips([clip], episodes), episodes[2], episodes[clip.donor]
    donated = donor_actions(clip, part.actions, episodes)
    np.testing.assert_array_equal(part.video, whole.video[:9])
    np.testing.assert_array_equal(part.actions[:8], whole.actions[:8])
    np.testing.assert_array_equal(donated[:8], donor.actions[:8])
    assert not part.actions[8].any()
    assert not donated[8].any()


@pytest.mark.parametrize("frames", [None, 1000])
def test_the_full_protocol_takes_whole_episodes(frames):
    plans = plan_clips("ind_test", [13, 9, 20], EvaluationConfig(frames=frames))
    assert [(plan.episode, plan.start, plan.frames) for plan in plans] == [
        (0, 0, 13),
        (1, 0, 9),
        (2, 0, 20),
    ]


def test_batches_hold_clips_of_one_length(data):
    episodes = EpisodeDataset(data, "ind_test")
    lengths = [9, 9, 9, 5, 9]
    clips = [Clip("ind_test", e, 0, n) for e, n in enumerate(lengths)]
    evaluator = Evaluator(pointwise_world_model(), None, {}, EvaluationConfig(batch_size=2))
    made = evaluator.predictions(clips, episodes, ["copy"])
    grouped = [[len(each.video) for each in batch] for batch in made]
    assert grouped == [[9, 9], [9], [5], [9]]


def test_rows_predict_what_they_are_named_after():
    world_model = pointwise_world_model().eval()
    generator = torch.Generator().manual_seed(0)
    video = torch.rand(2, 9, 3, 16, 16, generator=generator)
    own, other = torch.rand(2, 2, 9, 2, generator=generator)
    world_model.clip_frames = 5
    evaluator = Evaluator(world_model, None, {}, EvaluationConfig(steps=2))
    truths = [
        Prediction(clip, clip, actions.numpy(), {}, None, None, None, clip=Clip(seed=seed))
        for clip, actions, seed in zip(video, own, (3, 4), strict=True)
    ]
    kinds = ["model", "shuffled", "copy", "codec"]
    made = evaluator.predict(truths, kinds, other.numpy())
    assert [each.kind for each in made] == 2 * kinds
    rows = {kind: torch.stack([p.video for p in made if p.kind == kind]) for kind in kinds}

    def rollout(actions):
        return world_model.rollout(video[:, 0], actions, steps=2, window=5, seeds=[3, 4])

    assert torch.equal(rows["model"], rollout(own))
    assert torch.equal(rows["shuffled"], rollout(other))
    assert not torch.equal(rollout(own), rollout(other))
    assert all(torch.equal(frame, video[:, 0]) for frame in rows["copy"].unbind(1))
    assert torch.equal(rows["codec"], world_model.codec(video))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"splits": ["ind_tes"]}, "did you mean 'ind_test'"),
        ({"frames": 1}, "frames"),
        ({"steps": 0}, "steps"),
        ({"steps_sweep": (0, 4)}, "steps_sweep"),
        ({"sweep_episodes": 1}, "sweep_episodes"),
        ({"batch_size": 0}, "batch_size"),
        ({"episodes": 1}, "episodes"),
        ({"seed": -1}, "seed"),
        ({"videos": -1}, "videos"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(RecipeError, match=message):
        check_section("evaluation", settings)
