"""Actions read from videos, against a world whose actions are known."""

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from acwm_core.cli.main import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.clips import DataConfig
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.data.video import write_mp4
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import DataError
from acwm_core.training.data import ClipData
from acwm_formats.arrays import write_dataset
from acwm_formats.check import check_dataset
from acwm_formats.inverse import label as labelling
from acwm_formats.inverse.label import CONFIDENCE, label
from acwm_formats.inverse.network import InverseDynamics, loss_of, window
from acwm_formats.inverse.reader import ActionReader
from acwm_formats.timeline import Recording
from tests import tiny

STEPS, SIDE = 200, 16
ACTION = ActionSpec(("right", "down"), ("px", "px"), (-2.0, -2.0), (2.0, 2.0), "delta")


def episode(rng, hidden, length=20):
    """A smooth spot that an action moves by so many pixels, or nothing to see."""
    moves = rng.uniform(-2, 2, (length - 1, 2)).astype(np.float32)
    places = [rng.uniform(6, 10, 2)]
    for k, move in enumerate(moves):
        moves[k] = np.clip(places[-1] + move, 4, 12) - places[-1]
        places.append(places[-1] + moves[k])
    across = np.arange(SIDE)
    spots = [
        np.exp(-((across - x) ** 2) / 8) * np.exp(-((across[:, None] - y) ** 2) / 8)
        for x, y in places
    ]
    light = 0 if hidden else 255
    video = np.repeat((light * np.stack(spots)).astype(np.uint8)[..., None], 3, -1)
    return Recording(video, moves)


def write(folder, seed, **splits):
    rng = np.random.default_rng(seed)
    episodes = {
        split: [episode(rng, number % 4 == 3) for number in range(count)]
        for split, count in splits.items()
    }
    write_dataset(folder, episodes, name="spot", action=ACTION, fps=10, progress=False)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Forty recorded episodes, and eight others of the same world; in a quarter it is dark."""
    torch.set_num_threads(1)
    place = tmp_path_factory.mktemp("label")
    write(place / "recorded", 0, train=40, ind_test=2)
    write(place / "others", 1, train=8)
    return place


@pytest.fixture(scope="module")
def trained(folders):
    return ActionReader(EpisodeDataset(folders / "recorded", "train"), steps=STEPS, progress=False)


@pytest.fixture(scope="module")
def done(folders, trained):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(labelling, "ActionReader", lambda *_, **options: trained)
        label(folders / "others", folders / "recorded", folders / "out", progress=False)
    return folders / "out"


@pytest.mark.ci
def test_actions_are_those_that_moved_the_world(folders, done):
    """The true ones of the other episodes, which labelling did not see."""
    found, true = EpisodeDataset(done, "train"), EpisodeDataset(folders / "others", "train")
    assert len(found) == 48
    own = np.concatenate([found.actions(40 + k)[:-1] for k in range(8)])
    wanted = np.concatenate([true.actions(k)[:-1] for k in range(8)])
    explained = 1 - ((own - wanted) ** 2).mean(0) / wanted.var(0)
    assert explained.min() > 0.5
    held_out = DatasetCard.read(done).source["held_out"]["explained"]
    assert np.abs(explained - held_out).max() < 0.25  # what is told is what is so


@pytest.mark.ci
def test_recorded_and_labelled_actions_are_kept_apart(folders, done):
    found, recorded = EpisodeDataset(done, "train"), EpisodeDataset(folders / "recorded", "train")
    for index in range(len(recorded)):
        assert np.array_equal(found.actions(index), recorded.actions(index))
        assert np.all(found.states(index, [CONFIDENCE]) == 1)
    for index in range(40, 48):
        confidence = found.states(index, [CONFIDENCE])
        assert np.all((confidence >= 0) & (confidence < 1))
        video = EpisodeDataset(folders / "others", "train").video(index - 40)
        assert np.array_equal(found.video(index), video)
    card = DatasetCard.read(done)
    assert card.source["labelled"]["train"] == [40, 48]
    assert card.splits == {"train": 48, "ind_test": 2}
    assert "were not recorded but read from their videos" in card.source["notes"][0]
    assert all(finding.problem is None for finding in check_dataset(done, replays=0))


@pytest.mark.ci
def test_what_cannot_be_read_has_less_confidence_and_more_error(folders, trained):
    """In the dark nothing can be read."""
    data = EpisodeDataset(folders / "others", "train")
    sure = [float(trained.read(data.video(k)).confidence.mean()) for k in range(8)]
    assert max(sure[3::4]) < 0.1
    assert min(sure[k] for k in range(8) if k % 4 < 3) > 0.5
    assert trained.quality.surer > trained.quality.less_sure


def test_unsure_episodes_are_left_out_and_all_of_them_refused(folders, tmp_path):
    options = {"steps": 5, "least": 0.99, "progress": False}
    with pytest.raises(DataError, match=r"no episode of .* mean confidence of 0\.99 or more"):
        label(folders / "others", folders / "recorded", tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_datasets_that_do_not_fit_are_refused(folders, tmp_path):
    tiny.register()
    write(tmp_path / "one", 2, train=1)
    with pytest.raises(DataError, match="one labelled episode"):
        label(folders / "others", tmp_path / "one", tmp_path / "out", steps=5, progress=False)
    generate("drift", tmp_path / "large", episodes={"train": 1}, workers=0, progress=False)
    with pytest.raises(DataError, match=r"frames of 32×32, and .* of 16×16"):
        label(tmp_path / "large", folders / "recorded", tmp_path / "out", steps=5, progress=False)


def test_videos_without_actions_become_data_to_train_on(folders, tmp_path):
    """By the commands; before they are labelled, nothing is trained on them."""
    tiny.register()
    data = EpisodeDataset(folders / "others", "train")
    (tmp_path / "films").mkdir()
    for index in range(4):
        frames = data.video(index).transpose(0, 2, 3, 1)
        write_mp4(tmp_path / "films" / f"{index}.mp4", frames, data.card.environment.fps)
    films, out = tmp_path / "imported", tmp_path / "out"
    words = ["data", "import", "videos", str(tmp_path / "films"), "--out", str(films)]
    told = CliRunner().invoke(main, [*words, "--workers", "0"])
    assert "if none were recorded, give --unlabelled" in told.output
    told = CliRunner().invoke(
        main, [*words, "--unlabelled", "--test-episodes", "1", "--workers", "0"]
    )
    assert told.exit_code == 0, told.output
    with pytest.raises(DataError, match="cannot be trained on: no actions were recorded"):
        ClipData(DataConfig(str(films)), EpisodeDataset(films, "train"), tiny.MeanCodec(), 0)
    words = ["data", "label", str(films), "--from", str(folders / "recorded"), "--out", str(out)]
    told = CliRunner().invoke(main, [*words, "--steps", "20"])
    assert told.exit_code == 0, told.output
    assert "actions of 4 held-out recorded episodes" in told.output
    assert "labelled 3 episodes" in told.output
    ClipData(DataConfig(str(out)), EpisodeDataset(out, "train"), tiny.MeanCodec(), 0)


def test_a_window_has_the_frames_around_a_moment():
    frames = torch.arange(5)[:, None, None, None].expand(5, 3, 1, 1)
    assert window(frames, 2)[:, 0, 0, 0].tolist() == [1, 2, 3, 4]
    assert window(frames, 0)[:, 0, 0, 0].tolist() == [0, 0, 1, 2]
    assert window(frames, 3)[:, 0, 0, 0].tolist() == [2, 3, 4, 4]


def test_the_loss_is_least_for_the_true_mean_and_variance():
    """By its gradient, against the moments of what was drawn."""
    rng = torch.Generator().manual_seed(0)
    drawn = 0.5 + 2 * torch.randn(4000, 1, generator=rng)
    mean = torch.zeros(1, requires_grad=True)
    log_variance = torch.zeros(1, requires_grad=True)
    optimiser = torch.optim.Adam([mean, log_variance], 0.05)
    for _ in range(400):
        optimiser.zero_grad()
        loss_of(mean.expand(4000, 1), log_variance.expand(4000, 1), drawn).backward()
        optimiser.step()
    assert mean.item() == pytest.approx(drawn.mean().item(), abs=0.02)
    assert log_variance.exp().item() == pytest.approx(drawn.var().item(), rel=0.02)


@pytest.mark.parametrize("size", [(32, 32), (64, 48), (128, 160)])
def test_the_network_takes_every_size(size):
    mean, log_variance = InverseDynamics(3)(torch.zeros(2, 4, 3, *size, dtype=torch.uint8))
    assert mean.shape == log_variance.shape == (2, 3)
