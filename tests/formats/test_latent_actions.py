"""Latent actions learnt from videos alone, against a world whose actions are known."""

import json

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from acwm_core.cli.main import main
from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import DataError
from acwm_formats.arrays import write_dataset
from acwm_formats.check import check_dataset
from acwm_formats.inverse.action_decoder import ActionDecoder
from acwm_formats.inverse.latent_label import label_latent
from acwm_formats.inverse.latent_network import HIGHEST, LatentDynamics, change
from acwm_formats.timeline import Recording
from acwm_play.layout import controls

SIDE, STEPS = 16, 120
ACTION = ActionSpec(("right", "down"), ("px", "px"), (-2.0, -2.0), (2.0, 2.0), "delta")
WAYS = np.array([[2, 0], [-2, 0], [0, 2], [0, -2]])


def episode(rng, length=20, still=False):
    """A square of four pixels that jumps two of them in one of four ways."""
    place, frames, moves = rng.integers(3, 13, 2), [], []
    for _ in range(length):
        frame = np.zeros((SIDE, SIDE, 3), np.uint8)
        column, row = place
        frame[row - 2 : row + 2, column - 2 : column + 2] = 255
        frames.append(frame)
        inside = [way for way in WAYS if np.all((place + way >= 2) & (place + way <= SIDE - 2))]
        moves.append(inside[rng.integers(len(inside))] * (not still))
        place = place + moves[-1]
    return Recording(np.stack(frames), np.array(moves[:-1], np.float32))


def write(folder, seed, episodes=None, **splits):
    rng = np.random.default_rng(seed)
    drawn = {split: [episode(rng) for _ in range(count)] for split, count in splits.items()}
    drawn = drawn if episodes is None else {"train": episodes}
    write_dataset(folder, drawn, name="square", action=ACTION, fps=10, progress=False)
    return folder


@pytest.fixture(scope="module")
def videos(tmp_path_factory):
    return write(tmp_path_factory.mktemp("latent") / "videos", 0, train=60, ind_test=4)


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """Five labelled episodes of the same world."""
    return write(tmp_path_factory.mktemp("latent") / "few", 1, train=5)


@pytest.fixture(scope="module")
def done(videos, few):
    torch.set_num_threads(1)
    out = videos.parent / "out"
    return out, label_latent(videos, out, 2, few, steps=STEPS, progress=False)


def codes_and_ways(out, videos, split):
    found, true = EpisodeDataset(out, split), EpisodeDataset(videos, split)
    moves = np.concatenate([true.actions(k)[:-1] for k in range(len(true))])
    codes = np.concatenate([found.actions(k)[:-1] for k in range(len(found))])
    return codes.astype(int), (moves[:, None] == WAYS).all(2).argmax(1)


@pytest.mark.ci
def test_codes_say_which_way_the_square_goes(done, videos):
    """In episodes that nobody learnt from. Codes that are drawn at random could not."""
    codes, ways = codes_and_ways(done[0], videos, "ind_test")

    def accuracy(numbers):
        """Share that is right if each code stands for the way that is commonest with it."""
        each = [np.bincount(ways[numbers == code], minlength=4) for code in np.unique(numbers)]
        return sum(counts.max() for counts in each) / len(ways)

    numbers = codes @ (2 * HIGHEST + 1) ** np.arange(2)
    assert accuracy(numbers) > 0.95
    assert accuracy(np.random.default_rng(0).permutation(numbers)) < 0.7


@pytest.mark.ci
def test_the_tie_gives_the_recorded_actions_of_other_episodes(done, videos):
    """What the card holds is enough to compute them, without any of acwm's code."""
    codes, ways = codes_and_ways(done[0], videos, "ind_test")
    decoder = DatasetCard.read(done[0]).source["action_decoder"]
    levels = np.concatenate([np.eye(5)[codes[:, k] + HIGHEST] for k in range(2)], 1)
    actions = levels @ np.array(decoder["weights"]).T + decoder["offset"]
    wanted = WAYS[ways]
    explained = 1 - ((actions - wanted) ** 2).mean(0) / wanted.var(0)
    assert explained.min() > 0.8
    assert min(done[1].decoder.explained) > 0.7
    assert (decoder["actions"], decoder["from"]) == (["right", "down"], "few")


@pytest.mark.ci
def test_the_card_and_the_output_keep_latent_actions_apart(done, videos):
    out, told = done
    card = DatasetCard.read(out)
    assert card.environment.name == "square_latent"
    assert card.environment.action.names == ("latent_0", "latent_1")
    assert card.environment.action.low == (-2.0, -2.0)
    assert card.source["kind"] == "latent actions"
    assert "learnt from the videos alone and not recorded" in card.source["notes"][0]
    assert told.quality.explained > 0.5 > told.quality.shuffled
    assert not told.quality.collapsed
    assert card.splits == {"train": 60, "ind_test": 4}
    assert all(finding.problem is None for finding in check_dataset(out, replays=0))
    found, true = EpisodeDataset(out, "train")[7], EpisodeDataset(videos, "train")[7]
    assert np.array_equal(found.video, true.video)
    assert set(np.unique(found.actions)) <= {-2, -1, 0, 1, 2}
    keys = [each["keys"] for each in controls(card.environment, None)]
    assert keys == [("ArrowLeft", "ArrowRight"), ("ArrowDown", "ArrowUp")]


def test_the_command_names_what_is_missing_and_what_it_wrote(few, tmp_path):
    def run(*words):
        return CliRunner().invoke(main, ["data", "label", str(few), *words])

    out = tmp_path / "out"
    told = run("--out", str(out))
    assert told.exit_code == 2
    assert "give --from LABELLED, or --latent N if no actions were recorded" in told.output
    told = run("--out", str(out), "--latent", "1", "--least", "0.5")
    assert "--least needs labels with a confidence" in told.output
    told = run("--out", str(out), "--latent", "1", "--from", str(few), "--steps", "2")
    assert told.exit_code == 0, told.output
    assert "of 5 codes," in told.output
    assert "recorded actions of 1 held-out episodes" in told.output
    assert "  right: R² " in told.output
    assert "less than half is explained: what torques" in told.output
    info = CliRunner().invoke(main, ["data", "info", str(out), "--json"])
    assert json.loads(info.output)["source"]["action_decoder"]["from"] == "few"
    told = run("--out", str(out), "--latent", "1")
    assert (told.exit_code, "already exists" in told.output) == (2, True)


def test_a_collapse_is_said(few, tmp_path, monkeypatch):
    one = lambda self, frames: torch.ones(len(frames), 2, requires_grad=True)  # noqa: E731
    monkeypatch.setattr(LatentDynamics, "latents", one)
    words = ["data", "label", str(few), "--latent", "2", "--steps", "2"]
    told = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "out")])
    assert "of 25 codes, 1.0 are in effective use" in told.output
    assert "the latent actions have collapsed" in told.output


def test_what_nothing_can_be_learnt_from_is_refused(tmp_path):
    rng = np.random.default_rng(2)
    one = write(tmp_path / "one", 0, train=1)
    still = write(tmp_path / "still", 0, [episode(rng, still=True) for _ in range(3)])
    with pytest.raises(DataError, match="has 1 episode: two are needed"):
        label_latent(one, tmp_path / "out", 2, steps=2, progress=False)
    with pytest.raises(DataError, match="nothing ever changes in the videos"):
        label_latent(still, tmp_path / "out", 2, steps=2, progress=False)
    assert not (tmp_path / "out").exists()


def test_an_episode_of_one_frame_is_refused(videos, tmp_path, monkeypatch):
    real = EpisodeDataset.__init__

    def cut(self, *given, **options):
        real(self, *given, **options)
        self.lengths[3] = 1

    monkeypatch.setattr(EpisodeDataset, "__init__", cut)
    with pytest.raises(DataError, match=r"episode 3 of train of .* has a single frame"):
        label_latent(videos, tmp_path / "out", 2, steps=2, progress=False)


def test_a_linear_relation_of_levels_and_actions_is_recovered():
    """Of each level for itself, beside noise that no level explains."""
    rng = np.random.default_rng(0)
    latents = rng.integers(-2, 3, (4000, 2)).astype(np.float32)
    curve = np.array([3.0, -1, 0, 5, 2])
    true = np.stack([curve[latents[:, 0].astype(int) + 2], 2 * latents[:, 1] + 7], 1)
    decoder = ActionDecoder.fit(latents, (true + rng.normal(0, 0.1, true.shape)).astype(np.float32))
    assert np.abs(decoder(latents) - true).max() < 0.05


def test_a_latent_is_a_whole_number_with_a_gradient():
    torch.manual_seed(0)
    network = LatentDynamics(3)
    frames = torch.randint(0, 255, (8, 4, 3, 24, 40), dtype=torch.uint8)
    latents = network.latents(frames)
    assert torch.equal(latents.round(), latents)
    assert latents.abs().max() <= HIGHEST
    assert len(latents.unique(dim=0)) > 4
    (network(frames, latents) - change(frames)).square().mean().backward()
    first = next(network.inverse.see.parameters())
    assert first.grad.abs().max() > 0


def test_the_change_is_that_to_the_next_frame():
    frames = torch.arange(4, dtype=torch.uint8)[None, :, None, None, None].expand(1, 4, 3, 8, 8)
    assert change(10 * frames).unique().tolist() == pytest.approx([4 * 10 / 127.5])
