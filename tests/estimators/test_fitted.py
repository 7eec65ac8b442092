"""Estimators of one's own world: the fitted camera and layout, and the whole way to one."""

import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from safetensors.numpy import save_file

from acwm_core.cli import main
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import generate
from acwm_core.env.camera import Camera
from acwm_core.env.card import StateField
from acwm_core.errors import DataError
from acwm_core.evaluation.clips import as_clip
from acwm_estimators.estimator import FittedEstimator
from acwm_estimators.fitted import _camera, fitted_layout, layout_from_dict
from acwm_estimators.targets import seen_points
from tests import tiny
from tests.tiny import Drift


@pytest.fixture(scope="module")
def drift(tmp_path_factory):
    tiny.register()
    folder = tmp_path_factory.mktemp("data") / "drift"
    counts = {"train": 24, "ind_test": 4}
    generate("drift", folder, episodes=counts, workers=0, progress=False)
    return folder


def projected(points, eye, focal):
    """By a pinhole at `eye` that looks down and a little forward, written out."""
    tilt = 0.5
    away = points - np.array(eye)
    right, forward, up = away.T
    depth = -up * np.cos(tilt) + forward * np.sin(tilt)
    down = -(up * np.sin(tilt) + forward * np.cos(tilt))
    return np.stack([focal * right / depth, focal * down / depth], -1)


def test_a_pinhole_camera_is_found_from_points_and_where_they_appear():
    rng = np.random.default_rng(0)
    points, other = (rng.uniform([-1, -1, 0], [1, 1, 0.5], (n, 3)) for n in (200, 50))
    camera = _camera([(points, projected(points, (0, -1, 3), 1.2))])
    seen = camera.to_frame(other)
    np.testing.assert_allclose(seen[:, :2], projected(other, (0, -1, 3), 1.2), atol=1e-6)
    np.testing.assert_allclose(camera.from_frame(seen), other, atol=1e-6)
    on_table = np.column_stack([other[:, :2], np.full(50, 0.2)])
    found = camera.on_plane(camera.to_frame(on_table)[:, :2], 0.2)
    np.testing.assert_allclose(found, on_table, atol=1e-6)


def test_a_coordinate_that_never_changes_is_kept():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (200, 2)), np.full(200, 0.3)])
    camera = _camera([(points, projected(points, (0, -1, 3), 1.2))])
    np.testing.assert_allclose(camera.from_frame(camera.to_frame(points)), points, atol=1e-6)


def test_each_position_finds_the_mask_that_shows_it(drift):
    layout = fitted_layout(EpisodeDataset(drift, "train"))
    ((points,), names) = layout.points, layout.instances
    assert (points.field, points.instances, names) == ("position", ("square",), ("square",))
    corner = np.array([[5.0, 20.0, 0.0]])  # row and column of the square's corner, in pixels
    middle = layout.camera.to_frame(corner)[0, :2] * 32 + 16
    np.testing.assert_allclose(middle, (20 + 4, 5 + 4), atol=0.6)  # positions are rounded
    assert layout_from_dict(json.loads(json.dumps(asdict(layout)))) == layout


def test_data_without_masks_or_positions_is_refused(drift, tmp_path):
    generate("tiny_world", tmp_path / "few", episodes={"train": 1}, workers=0, progress=False)
    with pytest.raises(DataError, match=r"no position in the states .* follows a mask"):
        fitted_layout(EpisodeDataset(tmp_path / "few", "train"), most=1)
    with pytest.raises(DataError, match="there is no state 'yaw', but position"):
        fitted_layout(EpisodeDataset(drift, "train"), {"yaw": 4})


CAMERA = Camera((0.0, -2.0, 1.5), (0.0, 0.0, 0.2), fov=50)


class Masts(list):
    """Episodes of a mast that stands at a place on a table; its mask is what rises above it."""

    path = "data/masts"

    def __init__(self, camera, **declared):
        field = StateField("foot", (2,), "m", "on the table", height=0.1, **declared)
        environment = replace(
            Drift.card, camera=camera, state=(field,), instances=("ground", "mast")
        )
        self.card = SimpleNamespace(environment=environment)
        rng = np.random.default_rng(0)
        feet = rng.uniform(-0.5, 0.5, (3, 20, 2))
        super().__init__(
            SimpleNamespace(masks=np.stack([*map(drawn, f)]), states={"foot": f}) for f in feet
        )


def drawn(foot):
    """The mask of a mast of 0.3 m."""
    mask = np.zeros((32, 32), np.uint8)
    for height in np.linspace(0.1, 0.4, 30):
        x, y, _ = CAMERA.project(np.array([*foot, height]), 32, 32)
        mask[int(y) - 1 : int(y) + 1, int(x) - 1 : int(x) + 1] = 1
    return mask


@pytest.mark.parametrize("declared", [{}, {"kind": "position", "instances": ("mast",)}])
def test_positions_lie_where_the_declared_camera_says(declared):
    layout = fitted_layout(Masts(CAMERA, **declared))
    (points,) = layout.points
    assert (points.instances, points.plane) == (("mast",), 0.1)
    foot = np.array([[[0.3, -0.2]]])
    seen = seen_points({"foot": foot[0]}, points, layout.camera)
    pixel = CAMERA.project(np.array([0.3, -0.2, 0.1]), 32, 32)
    np.testing.assert_allclose(seen[0, 0, :2] * 32 + 16, pixel[:2], atol=1e-6)
    np.testing.assert_allclose(layout.camera.on_plane(seen[..., :2], 0.1)[..., :2], foot, atol=1e-6)
    assert layout_from_dict(json.loads(json.dumps(asdict(layout)))) == layout
    fitted = seen_points({"foot": foot[0]}, points, fitted_layout(Masts(None, **declared)).camera)
    assert np.linalg.norm(fitted[0, 0, :2] * 32 + 16 - pixel[:2]) > 1  # it knows the masks alone


def test_a_long_body_is_no_other_camera():
    """Its place may be far from the middle of its mask."""
    masts = Masts(CAMERA, kind="position", instances=("mast",))
    for episode in masts:
        for mask, foot in zip(episode.masks, episode.states["foot"], strict=True):
            x, y, _ = CAMERA.project(np.array([*foot, 0.1]), 32, 32)
            mask[: int(y), int(x)] = 1  # up to the ceiling
    assert fitted_layout(masts).camera == CAMERA


def test_a_camera_that_did_not_see_the_data_is_refused():
    other = replace(CAMERA, target=(1.2, 0.0, 0.2))
    with pytest.raises(DataError, match=r"the camera .* shows foot .* away from the mask of mast"):
        fitted_layout(Masts(other, kind="position", instances=("mast",)))


def test_weights_that_train_estimator_did_not_write_are_refused(tmp_path):
    (tmp_path / "text").write_text("root:x:0:0")
    save_file({"x": np.zeros(3)}, tmp_path / "other")
    for name in ("text", "other"):
        words = ["new", "estimator", "mine", "--weights", str(tmp_path / name)]
        refused = CliRunner().invoke(main, [*words, "--out", str(tmp_path / "mine")])
        assert refused.exit_code == 2
        assert refused.stderr.count("\n") == 1
        assert not (tmp_path / "mine").exists()


@pytest.mark.ci
def test_one_command_trains_what_reads_the_world(drift, tmp_path):
    out = tmp_path / "drift.safetensors"
    done = CliRunner().invoke(
        main, ["train-estimator", str(drift), "--out", str(out), "--steps", "150"]
    )
    assert done.exit_code == 0, done.output
    assert "position: square" in done.output
    assert "masks of square: IoU" in done.output
    dataset = EpisodeDataset(drift, "ind_test")
    estimator = FittedEstimator(dataset.card.environment, weights=out)
    true = np.concatenate([dataset[index].states["position"] for index in range(4)])
    videos = [dataset[index].video for index in range(4)]
    seen = np.concatenate([estimator.read(as_clip(each)).states["position"] for each in videos])
    assert np.nanmedian(np.linalg.norm(seen - true, axis=1)) < 1.5  # pixels, of 24
    made = CliRunner().invoke(
        main, ["new", "estimator", "drift", "--weights", str(out), "--out", str(tmp_path / "mine")]
    )
    assert made.exit_code == 0, made.output
    weights = tmp_path / "mine" / "acwm_drift_estimator" / "drift.safetensors"
    assert weights.read_bytes() == out.read_bytes()
