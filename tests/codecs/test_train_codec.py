"""Training codecs: what it sees, what it counts, and that it learns."""

import math
import re

import numpy as np
import pytest
import torch
from click.testing import CliRunner

from acwm_codecs import train_codec
from acwm_codecs.compact import Compact, Fine
from acwm_codecs.compact_reference import CompactReference
from acwm_codecs.frame_groups import Source, load_videos, sample_groups
from acwm_codecs.train_codec import RunningErrors, Training, detail_weights, learning_rate
from acwm_core.cli import main
from acwm_core.data.generate import generate
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import DataError
from acwm_core.files import training_record
from acwm_formats.arrays import write_dataset
from tests.recordings import Noise


def moving_bars(shade, frames=12, size=(72, 80)):
    """A video `[T, H, W, 3]` of a bar in one colour that moves over a grey ground."""
    video = np.full((frames, *size, 3), 60, np.uint8)
    for t in range(frames):
        video[t, :, 4 * t : 4 * t + 16] = shade
    return video


SOURCES = [Source([moving_bars(shade)]) for shade in ((250, 40, 40), (240, 240, 240))]


def test_groups_are_four_frames_in_order_and_of_the_source_that_they_name():
    groups = sample_groups(SOURCES, 200, np.random.default_rng(0))
    assert groups.frames.shape == (200, 12, 64, 64)
    assert set(groups.sources.tolist()) == {0, 1}
    frames = groups.frames.unflatten(1, (4, 3))
    grey = (frames.amax(2) - frames.amin(2)).amax((1, 2, 3)) < 1e-6
    assert torch.equal(grey, groups.sources == 1)  # whatever the order of the colours
    still = (frames[:, 0] == frames[:, 3]).flatten(1).all(1)
    assert 0.05 < still.float().mean() < 0.5


def test_what_a_model_predicts_comes_with_its_frames_and_the_frame_that_it_was_given():
    """In a video whose frames and cells are as bright as they are late, low and far right."""
    video = np.zeros((13, 64, 80, 3), np.uint8)
    latents = np.zeros((4, 16, 8, 10), np.float16)
    rows, columns = np.arange(64)[:, None] // 8, np.arange(80) // 8
    for frame in range(13):
        video[frame] = (10 * frame + rows + 4 * columns)[..., None]
    for frame in range(4):
        last = 10 * 4 * frame
        latents[frame] = last + np.arange(8)[:, None] + 4 * np.arange(10)
    groups = sample_groups([Source([video], [latents])], 100, np.random.default_rng(0))
    assert 50 < groups.predicted.sum() < 90
    assert len(groups.latents) == groups.predicted.sum()
    last = (groups.frames[groups.predicted][:, -1] * 255).round()
    assert torch.equal(last[:, ::8, ::8], groups.latents[:, 0])
    given = (groups.references[groups.predicted][:, 0] * 255).round()
    assert (last - given).flatten(1).unique().tolist() == [40, 80, 120]
    assert len({tuple(each[0, 0].tolist()) for each in groups.latents}) > 3  # various crops


def test_the_learning_rate_warms_up_stays_and_falls_to_zero():
    rates = [learning_rate(step, 1000, 1.0, 0.25) for step in (4, 200, 700, 875, 1000)]
    assert rates == pytest.approx([0.02, 1, 1, 0.5, 0])
    assert learning_rate(1000, 1000, 1.0, 0.0) == 1


def test_hard_sources_count_for_less_than_their_error_and_for_more_than_their_decibels():
    running = RunningErrors(2)
    weights = running.update(torch.tensor([0.04, 0.01]), torch.tensor([0, 1]))
    assert weights.tolist() == pytest.approx([1 / 3, 2 / 3])
    assert running.decibels() == pytest.approx([-10 * math.log10(0.04), 20])


@pytest.mark.slow
def test_training_from_nothing_learns_and_keeps_the_latents_normalised():
    torch.manual_seed(0)
    codec = Fine(weights="random").train()
    training = Training(codec, SOURCES, batch=4, seed=0)
    seen = [training.running.values.mean().item() for _ in training.steps(60, 1e-3, 1)]
    assert seen[-1] < 0.35 * seen[0]
    frames = sample_groups(SOURCES, 16, np.random.default_rng(9)).frames
    with torch.inference_mode():
        latents = codec.eval().normalise(codec.encoder(frames * 2 - 1))
    assert 0.4 < latents.std().item() < 2.5


def test_motion_and_edges_count_for_more():
    groups = sample_groups(SOURCES[:1], 8, np.random.default_rng(0)).frames
    weights = detail_weights(groups)
    assert weights.mean((1, 2, 3)).tolist() == pytest.approx([1] * 8)
    changing = groups.unflatten(1, (4, 3)).std(1, keepdim=True).expand(-1, 4, -1, -1, -1) > 0.1
    at_motion, elsewhere = weights[changing.flatten(1, 2)], weights[~changing.flatten(1, 2)]
    assert at_motion.mean() > 1.5 * elsewhere.mean()


def test_a_training_that_was_stored_goes_on_as_if_nothing_had_happened(tmp_path, monkeypatch):
    monkeypatch.setattr(train_codec, "MEASURED_BATCHES", 2)

    def training():
        torch.manual_seed(0)
        return Training(Fine(weights="random").train(), SOURCES, batch=2, seed=3)

    whole, first, second = training(), training(), training()
    assert list(whole.steps(4, 1e-3, 1)) == [1, 2, 3, 4]
    for step in first.steps(4, 1e-3, 1):
        if step == 2:
            break
    first.store(tmp_path / "x.training", {"a": 1})
    with pytest.raises(DataError, match="other settings"):
        second.restore(tmp_path / "x.training", {"a": 2})
    second.restore(tmp_path / "x.training", {"a": 1})
    assert list(second.steps(4, 1e-3, 1)) == [3, 4]
    for name, value in whole.codec.state_dict().items():
        assert torch.equal(second.codec.state_dict()[name], value), name


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Runs the command on an episode of push_cube."""
    pytest.importorskip("mujoco")
    monkeypatch.setattr(train_codec, "MEASURED_BATCHES", 2)
    monkeypatch.chdir(tmp_path)
    generate(
        "push_cube",
        tmp_path / "d",
        episodes={"train": 1, "ind_test": 1},
        seed=3,
        size=64,
        workers=0,
    )

    def run(out, *words, refused=False):
        command = [str(tmp_path / "d"), "--out", str(tmp_path / out), "--steps", "2", *words]
        command = ["train-codec", *command, "--batch", "2"]
        done = CliRunner().invoke(main, command, catch_exceptions=False)
        assert done.exit_code == (2 if refused else 0), done.output
        return done.output

    return run


@pytest.mark.ci
def test_a_decoder_learns_from_what_a_model_predicts(run, tmp_path):
    from_models = ["--codec", "compact_reference", "--start", "compact", "--predicted-by"]
    run("own.safetensors", *from_models, "push_cube")
    record = training_record(tmp_path / "own.safetensors")
    assert record["decoder_only"]
    assert [each["model"] for each in record["predicted_by"]] == ["push_cube"]
    trained = CompactReference(weights=str(tmp_path / "own.safetensors"))
    video = torch.rand(1, 5, 3, 64, 64)
    assert torch.equal(trained.encode(video), Compact().encode(video))
    untold = [value for name, value in trained.reference.named_parameters() if "tell" in name]
    assert any(value.abs().max() > 0 for value in untold)  # they began as zeros
    from_own = ["--codec", "compact_reference", "--start", str(tmp_path / "own.safetensors")]
    run("finer.safetensors", "--codec", "compact_reference", "--freeze-coarse")
    finer = CompactReference(weights=str(tmp_path / "finer.safetensors"))
    assert torch.equal(finer.decoder[4].weight, CompactReference().decoder[4].weight)
    assert not torch.equal(
        finer.decoder[6].first.weight, CompactReference().decoder[6].first.weight
    )
    for words, says in (
        (["--freeze-coarse"], "needs --codec compact_reference"),
        (["--freeze-coarse", *from_own], "only the coarse layers that ship"),
        (["--codec", "fine", "--predicted-by", "push_cube"], "the latents of another codec"),
        ([*from_models, "push_sand"], "push_sand at 64×112, of which no data was given"),
        (["--predicted-by", "push_cube", "--start", "random"], "not --start random"),
        (["--codec", "compact", "--start", "fine"], "do not fit into compact"),
    ):
        assert says in run("other.safetensors", *words, refused=True)


@pytest.mark.ci
def test_the_command_goes_on_from_weights_and_records_the_way(run, tmp_path):

    run("one.safetensors", "--start", "random")
    run("two.safetensors", "--start", str(tmp_path / "one.safetensors"), "--seed", "5")
    record = training_record(tmp_path / "two.safetensors")
    assert (record["seed"], record["steps"], record["start"]["seed"]) == (5, 2, 0)
    assert record["start"]["start"] == "random"
    assert record["data"] == [
        {"environment": "push_cube", "frame_size": [64, 64], "seed": 3, "episodes": 1}
    ]
    Compact(weights=str(tmp_path / "two.safetensors"))
    told = run("three.safetensors", "--decoder-only")  # from the weights that ship
    before, now = re.findall(r"(\d+\.\d+) dB (?:before|now)", told)
    assert float(before) > 20
    assert float(now) == pytest.approx(float(before), abs=3)
    ours, shipped = Compact(weights=str(tmp_path / "three.safetensors")), Compact()
    assert training_record(tmp_path / "three.safetensors")["decoder_only"]
    video = torch.rand(1, 5, 3, 64, 64)
    torch.testing.assert_close(ours.encode(video), shipped.encode(video), rtol=1e-2, atol=1e-2)
    assert not torch.equal(ours(video), shipped(video))

    for words, says in (
        (["--seed", "-1"], "--seed"),
        (["--threads", "-1"], "--threads"),
        (["--decay", "-1"], "--decay"),
        (["--peak", "nan"], "not finite"),
        (["--decoder-only", "--start", "random"], "not --start random"),
    ):
        assert says in run("three.safetensors", *words, refused=True)
    assert "must end in .safetensors" in run("four.bin", refused=True)
    kept = Compact(weights=str(tmp_path / "three.safetensors"))
    assert torch.equal(kept(video), ours(video))


@pytest.mark.parametrize(
    ("frames", "size", "says"),
    [(8, 32, "are 32×32, and training needs 64×64"), (3, 64, "less than the 4 frames")],
)
def test_unsuitable_data_is_refused(tmp_path, frames, size, says):
    action = ActionSpec(("x", "y"), ("m", "m"), (-1, -1), (1, 1), "delta")
    recordings = {"train": Noise([frames], size)}
    write_dataset(tmp_path / "d", recordings, name="d", action=action, fps=5, progress=False)
    with pytest.raises(DataError, match=says):
        load_videos(tmp_path / "d", 9)
