"""Videos of clips: what their panels show."""

import av
import numpy as np
import torch

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.videos import case_study, moving_instances


def test_a_video_shows_truth_prediction_difference_and_the_truth_over_the_prediction(
    evaluated, data
):
    record = next(v for v in Summary.read(evaluated).videos if v.kind == "model")
    assert record.panels == [["truth", "prediction"], ["difference", "truth over prediction"]]
    with av.open(str(evaluated / "evaluation/videos" / record.file)) as file:
        frame = next(file.decode(video=0)).to_ndarray(format="rgb24")[2::4, 2::4]
    episode = EpisodeDataset(data, record.split)[record.episode]
    truth, square = episode.video[0], episode.masks[0] == 1
    assert np.abs(frame[:32, :32].astype(int) - truth).mean() < 8
    off = np.abs(frame[:32, 34:].astype(int) - truth).max(-1) > 40
    heat = frame[34:, :32].astype(int).sum(-1)
    assert heat[off].mean() > heat[~off].mean() + 50
    tint = frame[34:, 34:].astype(int)
    green = tint[..., 1] - tint[..., 0]
    assert green[square].mean() > 25
    assert abs(green[~square].mean()) < 8


def test_only_what_moves_is_tinted():
    masks = np.zeros((6, 8, 12), np.uint8)
    masks[:, 2:6, 4:8] = 1  # stands still, and is covered for a while
    for frame in range(6):
        masks[frame, 3:5, 2 * frame : 2 * frame + 2] = 2
    assert np.array_equal(moving_instances(masks), masks == 2)
    assert not moving_instances(masks * 0).any()
    clip = torch.rand(6, 3, 8, 12)
    names, frames = case_study(clip, clip, masks * 0)
    assert names == [["truth", "prediction", "difference"]]
    assert frames.shape == (6, 8, 3 * 12 + 2 * 2, 3)
