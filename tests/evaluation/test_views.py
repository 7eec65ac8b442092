"""Frames that show two cameras side by side: scores of each, and what they are called."""

import json
from dataclasses import replace

import av
import numpy as np
import pytest
from PIL import Image

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_core.evaluation.metric import Metric
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.storage import read_scores
from acwm_core.evaluation.videos import DIVIDER
from acwm_core.evaluation.views import metrics_of_views
from acwm_core.training.run import load_run
from acwm_dream.captions import HEIGHT
from acwm_dream.rollout import rollout_run
from acwm_interventions.evaluate import evaluate_run
from acwm_metrics.fvd import FVD
from acwm_metrics.pixel import SSIM
from acwm_report.boards import boards_of
from acwm_report.comparison import compare_runs
from acwm_report.run import EvaluatedRun
from acwm_report.tables import score_tables
from tests import tiny
from tests.evaluation.by_hand import predictions, squared_error

VIEWS = ("cameras.wrist", "cameras.top.left")
NAMES = ("wrist", "top.left")
QUICK = {"metrics": ["psnr", "mse", "m_mse"], "counterfactual_metrics": [], "perturbed_episodes": 0}


def with_views(data, views):
    card = DatasetCard.read(data)
    replace(card, environment=replace(card.environment, views=views)).write(data)
    return data


@pytest.fixture(scope="module")
def data(parts, tmp_path_factory):
    made = tiny.make_dataset(tmp_path_factory.mktemp("data") / "drift", ood_test=0)
    return with_views(made, VIEWS)


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    made = tiny.make_run(tmp_path_factory.mktemp("runs") / "wide", data, **QUICK)
    evaluate_run(made, progress=False)
    return made


def test_every_metric_of_pixels_is_measured_in_each_view(run, data):
    found = {(r.episode, r.kind): r for r in read_scores(run)}
    episodes, world_model = list(EpisodeDataset(data, "ind_test")), load_run(run).world_model
    for index in range(len(episodes)):
        truth, made = predictions(world_model, episodes, index)
        for kind, video in made.items():
            values = found[index, kind].values
            halves = video[..., :16], video[..., 16:]
            errors = [
                squared_error(*pair) for pair in zip(halves, truth.split(16, -1), strict=True)
            ]
            assert [values["mse@wrist"], values["mse@top.left"]] == pytest.approx(errors, rel=1e-4)
            decibels = [-10 * np.log10(each + 1e-8) for each in errors]
            measured = [values["psnr@wrist"], values["psnr@top.left"]]
            assert measured == pytest.approx(decibels, rel=1e-4)
            assert values["mse"] == pytest.approx(np.mean(errors), rel=1e-4)
    summary = Summary.read(run)
    assert summary.headline == "psnr"  # the whole frame's
    assert summary.environment["views"] == [*NAMES]
    assert [*summary.metrics] == [
        *QUICK["metrics"],
        *(f"{name}@{view}" for view in NAMES for name in QUICK["metrics"]),
    ]


def test_what_a_view_is_too_small_for_is_told(data):
    card = DatasetCard.read(data).environment

    class Wide(Metric):
        name, reads = "wide", "pixels"

        def unavailable(self, card, estimator):
            return None if card.frame_size[1] >= 32 else "too narrow"

        def per_frame(self, prediction):
            raise NotImplementedError

    metrics = {"wide": Wide(), "ssim": SSIM(), "fvd": FVD.__new__(FVD)}
    found, left_out = metrics_of_views(metrics, card)
    assert [*found] == ["ssim@wrist", "ssim@top.left"]  # sets of clips are the whole frame's
    assert left_out == {"wide@wrist": "too narrow", "wide@top.left": "too narrow"}
    assert metrics_of_views(metrics, replace(card, views=())) == ({}, {})


def test_other_views_than_those_of_the_training_are_refused(run, data, tmp_path):
    swapped = tiny.make_dataset(tmp_path / "swapped", train=0, ood_test=0, ind_test=1)
    with_views(swapped, VIEWS[::-1])
    with pytest.raises(DataError, match=r"cameras\.top\.left, cameras\.wrist, but"):
        evaluate_run(run, data=swapped, out=tmp_path / "out", progress=False)


def test_a_report_has_the_rows_of_each_view_and_a_leaderboard_its_columns(run, tmp_path):
    (table,) = score_tables(EvaluatedRun.read(run, "run1"))
    assert [column.title for column in table.columns] == ["PSNR", "MSE", "M-MSE"]
    assert [(group, len(rows)) for group, rows in table.row_groups] == [
        ("", 4),
        ("wrist", 4),
        ("top.left", 4),
    ]
    summary = Summary.read(run)
    wrist = next(row for row in table.row_groups[1][1] if row.strong)
    assert (
        wrist.cells[0].value == summary.splits["ind_test"].scores.rows["model"]["psnr@wrist"].value
    )
    (board,) = boards_of({"wide": summary})
    assert board.table.groups[:3] == [
        ("In distribution", 3),
        ("In distribution · wrist", 1),
        ("In distribution · top.left", 1),
    ]
    assert [column.title for column in board.table.columns[3:5]] == ["PSNR", "PSNR"]


def test_runs_are_compared_in_each_view(run, data, tmp_path):
    other = tiny.make_run(tmp_path / "other", data, seed=1, **QUICK)
    evaluate_run(other, progress=False)
    found = compare_runs([run, other], metrics=["mse@wrist"])
    (difference,) = found.differences
    assert found.units == {"mse@wrist": ""}
    assert difference.episodes == 5


def test_a_rollout_has_the_names_of_views_above_its_frames(run, data, tmp_path):
    sheet = np.asarray(Image.open(rollout_run(run, tmp_path / "sheet.png", device="cpu")))
    names, frames = sheet[:HEIGHT, :256], sheet[HEIGHT:][::8, ::8]
    truth = EpisodeDataset(data, "ind_test")[0].video
    np.testing.assert_array_equal(frames[:32, :32], truth[0])
    assert all(half.max() > 200 for half in (names[:, :128], names[:, 128:]))
    film = rollout_run(run, tmp_path / "film.mp4", device="cpu")
    with av.open(str(film)) as file:
        shown = next(file.decode(video=0))
    assert (shown.height, shown.width) == (HEIGHT + 8 * (3 * 32 + 2 * DIVIDER), 8 * 32)


def test_panels_of_several_views_stand_one_below_the_other(run):
    panels = {json.dumps(video.panels) for video in Summary.read(run).videos}
    assert panels == {
        '[["truth"], ["prediction"], ["difference"], ["truth over prediction"]]',
    }
