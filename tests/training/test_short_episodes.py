"""Training on episodes of several lengths, some of them shorter than a clip."""

import pytest
import torch

from acwm_core.data.clips import DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import AcwmWarning
from acwm_core.training.data import ClipData
from acwm_core.training.fit import fit
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder
from acwm_formats.arrays import write_dataset
from tests.recordings import Noise
from tests.tiny import TinyCodec, TinyModel, tiny_recipe
from tests.training.runs import numbers

FRAMES = (9, 5, 12, 7, 6, 9, 8, 5, 9, 6)


@pytest.fixture(scope="module")
def short(tmp_path_factory, tiny_parts):
    folder = tmp_path_factory.mktemp("data") / "short"
    action = ActionSpec(("x", "y"), ("m", "m"), (-1, -1), (1, 1), "delta")
    write_dataset(
        folder, {"train": Noise(FRAMES)}, name="tiny_world", action=action, fps=5, progress=False
    )
    return folder


@pytest.fixture
def seen(monkeypatch):
    """Latent frames of the batches that the model got."""
    lengths = []
    forward = TinyModel.forward

    def watched(self, latents, *rest):
        if torch.is_grad_enabled():
            lengths.append(latents.shape[1])
        return forward(self, latents, *rest)

    monkeypatch.setattr(TinyModel, "forward", watched)
    return lengths


@pytest.mark.parametrize("cached", [True, False])
def test_no_batch_is_filled_up(short, seen, tmp_path, cached):
    recipe = tiny_recipe(short, data={"cache_latents": cached})
    run = RunFolder(fit(recipe, tmp_path / "run"))
    assert len(seen) == 16
    assert set(seen) == {5, 4, 3}  # clips of 9, 7 and 5 frames, 2 frames per latent
    assert {name for _, name in numbers(run)} >= {"val/loss"}
    load_run(run.path)


def test_rollouts_and_samples_use_several_held_out_episodes(short, tiny_parts):
    config = DataConfig(path=str(short), clip_frames=9, validation_episodes=6)
    data = ClipData(config, EpisodeDataset(short, "train"), TinyCodec(), seed=0)
    video, actions = data.sample(3)  # of episodes of 6, 9, 8, 5, 9 and 6 frames
    assert video.shape[:2] == actions.shape[:2] == (3, 7)
    assert data.sample(0)[0].shape[0] == 0


def test_too_few_episodes_to_learn_from_are_reported(short, tiny_parts, monkeypatch, recwarn):
    config = DataConfig(path=str(short), validation_episodes=6, cache_latents=False)
    data = ClipData(config, EpisodeDataset(short, "train"), TinyCodec(), seed=0)
    with pytest.warns(AcwmWarning, match=r"has 4 episodes to train on"):
        data.setup("fit")
    recwarn.clear()
    monkeypatch.setattr("acwm_core.training.data.FEWEST_EPISODES", 4)
    data.setup("fit")
    assert not recwarn.list
