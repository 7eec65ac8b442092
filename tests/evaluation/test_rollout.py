import shutil
from dataclasses import replace

import av
import numpy as np
import pytest
import torch
from PIL import Image

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.pictures import to_pixels
from acwm_core.env.environment import ActionSpec
from acwm_core.errors import AcwmWarning, DataError, RecipeError, ShapeError
from acwm_core.evaluation.evaluate import check_environment
from acwm_core.training.run import load_run
from acwm_dream.rollout import _read_actions, frame_strip, rollout_run
from acwm_formats.arrays import write_dataset
from tests import tiny
from tests.recordings import Noise

DIVIDER, SCALE, SIDE = 2, 8, 32


def frames_of(path):
    with av.open(str(path)) as file:
        return [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]


def test_a_recorded_episode_is_shown_beside_its_truth(evaluated, data, tmp_path):
    out = rollout_run(evaluated, tmp_path / "deep/video.mp4", episode=1, device="cpu")
    frames = frames_of(out)
    assert len(frames) == 13
    assert frames[0].shape == (SIDE * SCALE, (3 * SIDE + 2 * DIVIDER) * SCALE, 3)
    truth = EpisodeDataset(data, "ind_test")[1].video
    for frame, true in zip(frames, truth, strict=True):
        shown = frame[4::SCALE, 4::SCALE][:, :SIDE].astype(int)
        assert np.abs(shown - true).mean() < 6


def test_draws_stand_side_by_side_after_the_truth(evaluated, data, tmp_path):
    out = rollout_run(evaluated, tmp_path / "draws.png", samples=3, seed=5, device="cpu")
    sheet = np.asarray(Image.open(out))[::SCALE, ::SCALE]
    rows = [sheet[first : first + SIDE] for first in range(0, len(sheet), SIDE + DIVIDER)]
    assert len(rows) == 4
    np.testing.assert_array_equal(rows[0][:, -SIDE:], EpisodeDataset(data, "ind_test")[0].video[-1])
    for seed, row in zip((5, 6, 7), rows[1:], strict=True):
        alone = rollout_run(evaluated, tmp_path / "one.png", seed=seed, device="cpu")
        shown = np.asarray(Image.open(alone))[::SCALE, ::SCALE][SIDE + DIVIDER :][:SIDE]
        assert np.abs(row.astype(int) - shown).max() <= 1
    assert not np.array_equal(rows[1], rows[2])


def test_a_model_that_draws_nothing_shows_one(evaluated, tmp_path, monkeypatch):
    monkeypatch.setattr(tiny.PointwiseModel, "samples", False)
    with pytest.raises(RecipeError, match="--samples"):
        rollout_run(evaluated, tmp_path / "draws.mp4", samples=2, device="cpu")


def test_own_actions_give_the_prediction_alone(evaluated, tmp_path):
    np.save(tmp_path / "actions.npy", np.zeros((20, 2)))
    out = rollout_run(
        evaluated, tmp_path / "video.mp4", actions=tmp_path / "actions.npy", device="cpu"
    )
    frames = frames_of(out)
    assert len(frames) == 21
    assert frames[0].shape == (SIDE * SCALE, SIDE * SCALE, 3)


def test_own_actions_change_the_prediction(evaluated, tmp_path):
    pictures = []
    for value in (-2, 2):
        np.save(tmp_path / "actions.npy", np.full((8, 2), value))
        out = rollout_run(
            evaluated, tmp_path / "sheet.png", actions=tmp_path / "actions.npy", device="cpu"
        )
        pictures.append(np.asarray(Image.open(out)))
    assert np.abs(pictures[0].astype(int) - pictures[1]).max() > 3


def test_a_sheet_has_a_row_per_panel_and_exact_pixels(evaluated, data, tmp_path):
    out = rollout_run(evaluated, tmp_path / "sheet.png", split="ood_test", device="cpu")
    sheet = np.asarray(Image.open(out))[::SCALE, ::SCALE]
    assert sheet.shape == (3 * SIDE + 2 * DIVIDER, 8 * SIDE + 7 * DIVIDER, 3)
    truth = EpisodeDataset(data, "ood_test")[0].video
    np.testing.assert_array_equal(sheet[:SIDE, :SIDE], truth[0])
    np.testing.assert_array_equal(sheet[:SIDE, -SIDE:], truth[-1])


def test_without_the_dataset_the_same_episode_is_simulated(evaluated, data, tmp_path):
    run = shutil.copytree(evaluated, tmp_path / "run")
    recipe = run / "recipe.yaml"
    recipe.write_text(recipe.read_text().replace(str(data), str(tmp_path / "gone")))
    made = rollout_run(run, tmp_path / "made.png", split="ood_test", episode=1, device="cpu")
    kept = rollout_run(evaluated, tmp_path / "kept.png", split="ood_test", episode=1, device="cpu")
    assert made.read_bytes() == kept.read_bytes()
    with pytest.raises(DataError, match="there is no dataset"):
        rollout_run(run, tmp_path / "made.png", data=tmp_path / "gone")
    with pytest.raises(DataError, match="give 0 or more"):
        rollout_run(run, tmp_path / "made.png", episode=-1)
    card = run / "card.yaml"
    card.write_text(card.read_text().replace("name: drift", "name: elsewhere"))
    with pytest.raises(DataError, match="no simulator of elsewhere is installed"):
        rollout_run(run, tmp_path / "made.png")


def test_a_picture_can_be_the_first_frame(evaluated, tmp_path):
    Image.new("RGB", (50, 40), (250, 20, 20)).save(tmp_path / "first.png")
    with pytest.warns(AcwmWarning, match=r"first.png is squeezed from 40×50 to 32×32 pixels: crop"):
        out = rollout_run(
            evaluated, tmp_path / "sheet.png", image=tmp_path / "first.png", device="cpu"
        )
    first = np.asarray(Image.open(out))[:SIDE, :SIDE]
    assert first[..., 0].mean() > 200
    assert first[..., 1].mean() < 60


@pytest.fixture(scope="module")
def causal_run(data, tmp_path_factory):
    """A run whose model can be streamed."""
    parts = {
        "codec": {"name": "identity", "temporal_stride": 2},
        "model": {"name": "dit_xs", "width": 16, "layers": 2},
        "conditioner": {"name": "adaln"},
        "objective": {"name": "diffusion_forcing", "prediction": "clean", "steps": 2},
    }
    return tiny.make_run(tmp_path_factory.mktemp("runs") / "causal", data, parts=parts)


def test_a_streamed_file_holds_what_the_stream_of_the_model_gives(causal_run, data, tmp_path):
    rows = np.random.default_rng(0).uniform(-2, 2, (30, 2)).astype(np.float32)
    np.save(tmp_path / "actions.npy", rows)
    request = {"actions": tmp_path / "actions.npy", "mode": "stream", "seed": 5, "device": "cpu"}
    out = rollout_run(causal_run, tmp_path / "sheet.png", **request)
    first = torch.tensor(EpisodeDataset(data, "ind_test")[0].video[0]).permute(2, 0, 1) / 255
    stream = load_run(causal_run).world_model.stream(first[None], context=5, seeds=[5])
    chunks = [stream.step(torch.tensor(part)[None]) for part in np.split(rows, 15)]
    video = to_pixels(torch.cat([stream.first[:, None], *chunks], 1)[0])
    assert np.abs(np.diff(video[1:].astype(int), axis=0)).max() > 3
    np.testing.assert_array_equal(
        np.asarray(Image.open(out))[::SCALE, ::SCALE], frame_strip([video])
    )
    film = rollout_run(causal_run, tmp_path / "video.mp4", **request)
    assert len(frames_of(film)) == 31


def test_modes_differ_in_how_many_frames_are_predicted_at_once(causal_run):
    model = load_run(causal_run).world_model
    first, actions = torch.rand(1, 3, 32, 32), torch.rand(1, 24, 2)

    def sizes(mode):
        chunks = model.rollout_chunks(first, actions, mode=mode, steps=1)
        return [chunk.shape[1] for chunk in chunks]

    assert model.clip_frames == 9
    assert sizes("whole") == [24]
    assert sizes("windows") == sizes(None) == [9, 8, 7]
    assert sizes("stream") == [1, 2 * 8, 7]


def test_a_recorded_episode_is_streamed_beside_its_truth(causal_run, data, tmp_path):
    out = rollout_run(causal_run, tmp_path / "sheet.png", mode="stream", device="cpu")
    sheet = np.asarray(Image.open(out))[::SCALE, ::SCALE]
    truth = EpisodeDataset(data, "ind_test")[0].video
    np.testing.assert_array_equal(sheet[:SIDE, :SIDE], truth[0])
    np.testing.assert_array_equal(sheet[:SIDE, -SIDE:], truth[-1])


def test_wrong_requests_are_refused(evaluated, tmp_path):
    video, rows = tmp_path / "video.mp4", tmp_path / "actions.npy"
    with pytest.raises(RecipeError, match=r"\.mp4 for a video"):
        rollout_run(evaluated, tmp_path / "video.avi")
    with pytest.raises(RecipeError, match="did you mean 'ind_test'"):
        rollout_run(evaluated, video, split="ind_tst")
    with pytest.raises(RecipeError, match="did you mean 'stream'"):
        rollout_run(evaluated, video, mode="strem")
    with pytest.raises(RecipeError, match="cannot be streamed"):
        rollout_run(evaluated, video, mode="stream", device="cpu")
    with pytest.raises(DataError, match="no episode 5"):
        rollout_run(evaluated, video, episode=5)
    with pytest.raises(DataError, match="cannot be read"):
        rollout_run(evaluated, video, actions=rows)
    with pytest.raises(
        DataError, match="holds other with 5 frames/s, the actions x, y, but the run was trained"
    ):
        rollout_run(evaluated, video, data=of_another_environment(tmp_path / "other"))
    for wrong, error in (
        (np.zeros((4, 3)), "shape"),
        (np.zeros(4), "shape"),
        (np.full((4, 2), 2.5), "bounds"),
        (np.full((4, 2), np.nan), "bounds"),
    ):
        np.save(rows, wrong)
        with pytest.raises(ShapeError, match=error):
            rollout_run(evaluated, video, actions=rows)
    (tmp_path / "first.png").write_text("no picture")
    with pytest.raises(DataError, match="picture"):
        rollout_run(evaluated, video, image=tmp_path / "first.png")
    assert not video.exists()


def of_another_environment(folder):
    action = ActionSpec(("x", "y"), ("m", "m"), (-1, -1), (1, 1), "delta")
    recordings = {"train": Noise([9]), "ind_test": Noise([9])}
    write_dataset(folder, recordings, name="other", action=action, fps=5, progress=False)
    return folder


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_actions_at_their_bounds_are_accepted(kind, tmp_path):
    """In 32 bits, -3.7 is less and 4.2 is less than in 64 bits."""
    spec = ActionSpec(("x", "y"), ("m", "m"), (-3.7, 0.04), (4.2, 0.05), "delta")
    rows = np.array([spec.low, spec.high], kind)
    np.save(tmp_path / "actions.npy", rows)
    read = _read_actions(tmp_path / "actions.npy", spec)
    np.testing.assert_array_equal(read[:2], rows.astype(np.float32))
    np.save(tmp_path / "actions.npy", rows * 1.001)
    with pytest.raises(ShapeError, match="outside their bounds"):
        _read_actions(tmp_path / "actions.npy", spec)


SPEC = ActionSpec(("x", "y"), ("m", "m"), (-1, -1), (1, 1), "delta")


@pytest.mark.parametrize(
    ("spec", "fps", "said"),
    [
        ({}, 30, "30 frames/s, but .* 10 frames/s: resample it"),
        ({"kind": "absolute"}, 10, "kind absolute, but .* the kind delta"),
        ({"names": ("y", "x")}, 10, "the actions y, x in this order, but .* x, y"),
        ({"units": ("m", "cm")}, 10, "y in cm, but .* y in m"),
        ({"low": (-3, -1), "high": (1, 4)}, 10.05, None),
    ],
)
def test_data_must_mean_the_same_and_may_have_another_range(spec, fps, said, tmp_path):
    """New recordings of one robot have bounds of their own; beyond, the model extrapolates."""
    changed = replace(SPEC, **spec)
    recordings = {"train": Noise([9]), "ind_test": Noise([9])}
    for name, action, rate in (("before", SPEC, 10), ("now", changed, fps)):
        card = {"name": "mine", "action": action, "fps": rate}
        write_dataset(tmp_path / name, recordings, **card, progress=False)
    before = DatasetCard.read(tmp_path / "before").environment
    dataset = EpisodeDataset(tmp_path / "now", "ind_test")
    if said:
        with pytest.raises(DataError, match=said):
            check_environment(dataset, before)
        return
    statistics = {"ind_test": {"min": [-2.5, -1], "max": [1, 1]}}
    dataset.card = replace(dataset.card, actions=statistics)
    with pytest.warns(AcwmWarning, match=r"action x from -2.5 to 1, .*trained on -1 to 1") as told:
        check_environment(dataset, before)
    assert len(told) == 1
