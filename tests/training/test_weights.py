"""Training that weighs frames: against sums by hand, and which weights are refused."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import acwm
from acwm_core.checks.trial import WIDTH, TinyDenoiser, TinyPredictor, batch_of
from acwm_core.data.clips import DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import AcwmError, DataError, RecipeError
from acwm_core.model.batch import Batch
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.next_frame import NextFrame
from acwm_core.model.objectives.regression import Regression
from acwm_core.training.data import ClipData
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from acwm_formats.arrays import Recording, write_dataset
from acwm_scene import motion_training
from acwm_shortcut.shortcut import ShortcutForcing
from tests.tiny import TinyCodec, tiny_recipe
from tests.training.runs import assert_same, numbers

ACTION = ActionSpec(("right", "down"), ("px", "px"), (-1.0, -1.0), (1.0, 1.0), "delta")


@pytest.fixture(scope="module")
def sure(tmp_path_factory):
    """Twelve episodes with weights: all one, drawn, all nought, of both signs."""
    rng, recordings = np.random.default_rng(0), []
    for _ in range(12):
        weights = {
            "ones": np.ones((21, 1)),
            "drawn": rng.uniform(0, 1, (21, 1)),
            "nothing": np.zeros((21, 1)),
            "signed": rng.normal(size=(21, 1)),
            "pair": np.ones((21, 2)),
        }
        video = rng.integers(0, 255, (21, 32, 32, 3), np.uint8)
        actions = rng.uniform(-1, 1, (20, 2)).astype(np.float32)
        states = {name: rows.astype(np.float32) for name, rows in weights.items()}
        recordings.append(Recording(video, actions, states))
    folder = tmp_path_factory.mktemp("sure") / "data"
    state = dict.fromkeys(recordings[0].states, "")
    write_dataset(
        folder,
        {"train": recordings},
        name="sure",
        action=ACTION,
        fps=10,
        state=state,
        progress=False,
    )
    return folder


def asked(folder, weights, steps=6, states=(), **sections):
    chosen = {"weights": weights, "states": [*states]}
    recipe = tiny_recipe(folder, data=chosen, trainer={"max_steps": steps}, **sections)
    return replace(recipe, env=None)


def clips_of(data, **asked):
    config = DataConfig(str(data), clip_frames=9, window_stride=2, cache_latents=False, **asked)
    return ClipData(config, EpisodeDataset(data, "train"), TinyCodec(), 0)


def noise(*shape, seed):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


class Fixed(torch.nn.Module):
    """Predicts the same latents whatever it is given, and counts as a model that does not draw."""

    samples, training = False, False

    def __init__(self, latents):
        super().__init__()
        self.latents = latents

    def forward(self, given, *_, **__):
        return self.latents[:, -self.latents.shape[1] + given.shape[1] :]


def test_the_weighed_squared_error_is_that_of_a_sum_by_hand():
    true, weights = noise(2, 4, 3, 2, 2, seed=0), torch.rand(2, 4)
    predicted = noise(2, 4, 3, 2, 2, seed=1)
    batch = Batch(true, None, (), None, weights)
    loss = Regression().loss(Fixed(predicted), batch, 1).item()
    total = 0.0
    for clip in range(2):
        for frame in (1, 2, 3):
            squares = (true[clip, frame] - predicted[clip, frame]).numpy() ** 2
            total += weights[clip, frame].item() * squares.sum() / 12
    assert loss == pytest.approx(total / 6, rel=1e-5)


@pytest.mark.parametrize("of", [DiffusionForcing, NextFrame, ShortcutForcing, Regression])
def test_the_loss_is_the_sum_over_frames_of_their_weighed_errors(of):
    """By weights that leave a single frame, and by others."""
    objective = of()
    flow = of is not Regression
    model = TinyDenoiser(2, objective.inputs) if flow else TinyPredictor(2)
    latents, modulation = noise(2, 4, 2, 4, 4, seed=2), noise(2, 4, WIDTH, seed=3)

    def loss(weights):
        clips = batch_of(latents, modulation)
        chosen = Batch(clips.latents, clips.conditioning, clips.generators, None, weights)
        return objective.loss(model, chosen, 1).item()

    single = torch.zeros(3, 2, 4)
    for frame in range(3):
        single[frame, :, frame + 1] = 1
    parts = [loss(weights) for weights in single]
    assert min(parts) > 0
    assert loss(None) == pytest.approx(sum(parts), rel=1e-4)
    wanted = 0.5 * parts[0] + 2 * parts[2]
    assert loss(0.5 * single[0] + 2 * single[2]) == pytest.approx(wanted, rel=1e-4)


def test_a_latent_frame_has_the_mean_weight_of_the_actions_that_lead_to_it(sure, tmp_path):
    run = fit(asked(sure, None, 1), tmp_path / "run")
    world, seen = acwm.load(run).world_model, []
    world.objective.loss = lambda model, batch, known: seen.append(batch.weights)
    weights = torch.arange(18.0).reshape(2, 9)
    latents = world.encode(torch.rand(2, 9, 3, 32, 32))
    world.loss(latents, torch.zeros(2, 9, 2), (), None, weights)
    assert seen[0].tolist() == [[1, 0.5, 2.5, 4.5, 6.5], [1, 9.5, 11.5, 13.5, 15.5]]


def test_clips_hold_the_weights_of_their_actions(sure):
    episodes = EpisodeDataset(sure, "train")
    data = clips_of(sure, weights="drawn")
    clips = data._training_clips()
    for index, (episode, start) in enumerate(clips.windows.tolist()[:9]):
        true = episodes.states(episode, ["drawn"])[start : start + 9, 0]
        np.testing.assert_array_equal(clips[index]["weights"].numpy(), true)
    assert "weights" not in clips_of(sure)._training_clips()[0]


def test_weights_of_one_change_nothing_and_others_do(sure, tmp_path):
    names = (None, "ones", "drawn")
    runs = [RunFolder(fit(asked(sure, name), tmp_path / str(name))) for name in names]
    assert_same(runs[0], runs[1])
    losses = [numbers(run)["0", "train/loss"] for run in runs]
    assert float(losses[2]) < float(losses[0])


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("certain", r"has no such field .* those with one are ones, drawn, nothing, signed"),
        ("pair", "has no such field of the state with one number"),
        ("signed", r"has weights in episode 0 that are not 0 or more"),
        ("nothing", "no weight above 0, so nothing would be learnt"),
    ],
)
def test_what_is_no_weight_is_refused(sure, name, message):
    with pytest.raises(DataError, match=message):
        clips_of(sure, weights=name)


def test_weights_that_nothing_heeds_are_refused(sure, tmp_path):
    scene = {"name": "scene", "channels": 4, "width": 8, "blocks": 1}
    recipe = asked(sure, "drawn", model=scene, objective={"name": "scene"}, states=["drawn"])
    with pytest.raises(AcwmError, match="objective=scene weighs no frames: leave out"):
        fit(recipe, tmp_path / "run")
    with pytest.raises(RecipeError, match=r"data\.weights needs data\.reader=random_access"):
        DataConfig("data", weights="drawn", reader="webdataset")


def test_the_motion_of_a_scene_is_learnt_from_clips_as_often_as_they_weigh(monkeypatch):
    rows, weights = [], torch.tensor([[0.0, 0, 9], [1, 1, 9], [3, 3, 9]])

    class Clips:
        seed, shows_progress = 0, False
        conditioner_parameters = list

        def conditioning(self, chosen):
            rows.append(chosen)

    class Moving(torch.nn.Linear):
        def motion_parameters(self):
            return [*self.parameters()]

        def motion_loss(self, *_, **__):
            return self.weight.sum()

    monkeypatch.setattr(motion_training, "CLIPS", 3)
    clips = Clips()
    clips.weights = weights
    motion_training.learn_motion(Moving(1, 1), clips, torch.zeros(3, 3, 1), 150)
    counts = torch.bincount(torch.cat(rows), minlength=3) / 450
    assert counts[0] == 0
    assert counts[2] == pytest.approx(0.75, abs=0.07)


def test_a_scene_prepares_by_the_weights_of_its_data(sure, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(
        "acwm_scene.objective.learn_motion", lambda model, clips, *_: seen.append(clips.weights)
    )
    scene = {"name": "scene", "channels": 4, "width": 8, "blocks": 1}
    objective = {"name": "scene", "motion_steps": 1}
    recipe = asked(sure, "drawn", 1, model=scene, objective=objective, states=["ones"])
    fit(recipe, tmp_path / "run")
    (weights,) = seen
    clips = clips_of(sure, weights="drawn", validation_episodes=2)._training_clips()
    assert torch.equal(weights, clips.inputs(range(len(clips)))["weights"])
