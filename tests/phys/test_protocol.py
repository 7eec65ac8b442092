"""The published protocol: windows of drawn episodes, and what becomes of their scores."""

import json
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.errors import RecipeError
from acwm_core.evaluation.clips import Clip, cut_episode, noise_seed, plan_clips
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.metric import Prediction
from acwm_core.evaluation.protocol import Protocol
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.score import build_metrics, score
from acwm_core.evaluation.storage import read_scores
from acwm_core.evaluation.summarise import summarise
from acwm_core.recipe.check import check_section
from acwm_core.training.run import load_run
from acwm_interventions.evaluate import evaluate_run
from acwm_phys.protocol import PublishedWindows
from tests import tiny
from tests.evaluation.by_hand import rollout, squared_error, true_clip

REFERENCE = Path(__file__).parent.parent / "reference"
PROTOCOL = PublishedWindows()

CUTS = (PROTOCOL.defaults["frames"], PROTOCOL.defaults["cuts"])

SMALL = {"protocol": "acwm-phys", "frames": 5, "cuts": 3, "episodes": 3, "steps": 2}
"""The protocol on episodes of 13 frames."""


def published(**settings):
    return EvaluationConfig(protocol="acwm-phys", **settings)


def test_what_is_not_said_is_as_published():
    config = published()
    assert (config.frames, config.cuts, config.episodes, config.steps) == (37, 10, 50, 49)
    assert published(steps=5, frames=None).steps == 5
    full = EvaluationConfig()
    assert (full.protocol, full.frames, full.cuts, full.episodes) == ("full", None, None, None)


@pytest.mark.parametrize("length", [37, 38, 46, 47, 50, 57, 64, 66, 300])
def test_starts_are_those_of_linspace(length):
    found = PROTOCOL.windows(length, *CUTS)
    expected = np.linspace(0, length - 37, 10).astype(int)
    assert [start for start, _ in found] == list(dict.fromkeys(expected.tolist()))
    assert all(frames == 37 and start + frames <= length for start, frames in found)
    assert (found[0][0], found[-1][0]) == (0, length - 37)


def test_starts_by_hand():
    starts = [start for start, _ in PROTOCOL.windows(66, *CUTS)]
    assert starts == [0, 3, 6, 9, 12, 16, 19, 22, 25, 29]  # 29 / 9 = 3.22…
    assert [start for start, _ in PROTOCOL.windows(40, *CUTS)] == [0, 1, 2, 3]


def test_an_episode_shorter_than_a_window_is_one_shorter_clip():
    assert PROTOCOL.windows(20, *CUTS) == [(0, 20)]
    plans = plan_clips("ind_test", [20, 66], published(cuts=2))
    assert [(p.episode, p.start, p.frames) for p in plans] == [(0, 0, 20), (1, 0, 37), (1, 29, 37)]
    assert plans[2].donor_start == 0  # the donor has no 29 frames to skip


def test_at_most_fifty_episodes_are_drawn():
    drawn = PROTOCOL.episodes(200, 50)
    assert drawn == sorted(random.Random(0).sample(range(200), 50))
    assert PROTOCOL.episodes(24, 50) == list(range(24))
    assert Protocol().episodes(24, 3) == [0, 1, 2]


def test_every_window_has_its_own_noise_and_a_donor_of_the_same_time():
    plans = plan_clips("ood_test", [66] * 8 + [44], published())
    assert len({plan.seed for plan in plans}) == len(plans)
    seeds = {(p.episode, p.start): p.seed for p in plans}
    others = plan_clips("ood_test", [66] * 20, published(cuts=4))
    shared = [p for p in others if (p.episode, p.start) in seeds]
    assert shared
    assert all(p.seed == seeds[p.episode, p.start] for p in shared)
    for plan in plans:
        assert plan.donor != plan.episode
        longest = (44 if plan.donor == 8 else 66) - plan.frames
        assert plan.donor_start == min(plan.start, longest)
    assert noise_seed(0, "ind_test", 4) == noise_seed(0, "ind_test", 4, start=0)


def numbered(frames, contacts):
    """An episode in which everything tells its frame."""
    number = np.arange(frames)
    actions = np.stack([number, -number], 1).astype(np.float32)
    actions[-1] = 0
    return Episode(
        spec=EpisodeSpec("drift"),
        video=np.broadcast_to(number[:, None, None, None], (frames, 8, 8, 3)).astype(np.uint8),
        actions=actions,
        states={"number": number},
        masks=np.broadcast_to(number[:, None, None], (frames, 8, 8)).astype(np.uint8),
        contacts=np.array(contacts, np.int32).reshape(-1, 3),
        factors={},
        ood_label=None,
    )


def test_a_window_is_cut_from_all_that_is_known():
    episode = numbered(12, [(2, 0, 1), (3, 0, 1), (7, 1, 2), (8, 0, 2)])
    clip = cut_episode(episode, 3, 5)
    assert clip.states["number"].tolist() == [3, 4, 5, 6, 7]
    assert clip.masks[:, 0, 0].tolist() == clip.video[:, 0, 0, 0].tolist() == [3, 4, 5, 6, 7]
    assert clip.actions.tolist() == [[3, -3], [4, -4], [5, -5], [6, -6], [0, 0]]
    assert clip.contacts.tolist() == [[0, 0, 1], [4, 1, 2]]
    whole = cut_episode(episode, 0, 12)
    assert whole.contacts.tolist() == episode.contacts.tolist()
    np.testing.assert_array_equal(whole.actions, episode.actions)


@pytest.fixture(scope="module")
def windowed(data, tmp_path_factory):
    run = tiny.make_run(tmp_path_factory.mktemp("runs") / "windows", data, **SMALL)
    evaluate_run(run, progress=False)
    return run


def test_every_window_is_predicted_from_its_own_first_frame(windowed, data):
    world_model = load_run(windowed).world_model
    results = {(r.split, r.episode, r.start): r for r in read_scores(windowed) if r.kind == "model"}
    for split, episodes in (("ind_test", 5), ("ood_test", 4)):
        for episode in random.Random(0).sample(range(episodes), 3):
            whole = EpisodeDataset(data, split)[episode]
            for start in (0, 4, 8):
                truth, _ = true_clip(whole, start, 5)
                made = rollout(world_model, whole, start=start, frames=5, steps=2)
                error = squared_error(made, truth)
                found = results.pop((split, episode, start))
                assert found.values["mse"] == pytest.approx(error, rel=1e-4)
                assert found.frames == 5
    assert not results


def test_windows_are_pooled_and_episodes_resampled(windowed):
    summary = Summary.read(windowed)
    assert summary.protocol == "acwm-phys"
    assert summary.provenance["evaluation"]["cuts"] == 3
    assert summary.provenance["sampling_steps"] == 2
    for split, result in summary.splits.items():
        rows = [r for r in read_scores(windowed) if (r.split, r.kind) == (split, "model")]
        errors = np.array([r.values["mse"] for r in rows])
        scores = result.scores
        assert (scores.clips, scores.episodes) == (9, 3)
        assert scores.rows["model"]["mse"].value == pytest.approx(errors.mean())
        decibels = -10 * np.log10(errors + 1e-8)
        pooled = scores.rows["model"]["psnr"].value
        assert pooled == pytest.approx(-10 * np.log10(errors.mean() + 1e-8))
        assert scores.rows["model"]["psnr_mean"].value == pytest.approx(decibels.mean())
        assert scores.rows["model"]["mse"].low is None  # three episodes are too few


def test_videos_of_windows_have_names_of_their_own(windowed):
    records = Summary.read(windowed).videos
    files = [record.file for record in records]
    assert len(set(files)) == len(files)
    assert {path.name for path in (windowed / "evaluation/videos").iterdir()} == set(files)
    assert any(record.start for record in records)


def test_the_sweep_over_steps_takes_one_window_of_each_episode(data, tmp_path):
    settings = {**SMALL, "steps_sweep": [1, 2], "sweep_episodes": 2, "videos": 0}
    settings |= {"metrics": ["mse"], "counterfactual_metrics": []}
    run = tiny.make_run(tmp_path / "sweep", data, **settings)
    summary = evaluate_run(run, progress=False, overrides=["evaluation.splits=[ind_test]"])
    curve = summary.splits["ind_test"].steps
    rows = [r for r in read_scores(run) if r.kind == "model" and r.start == 0][:2]
    assert curve.clips == 2
    expected = np.mean([r.values["mse"] for r in rows])
    assert curve.points[1].scores["mse"].value == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"protocol": "acwm_phys"}, "did you mean 'acwm-phys'"),
        ({"cuts": 3}, "cuts=3 needs a protocol that cuts windows of episodes; full takes one"),
        ({"protocol": "acwm-phys", "cuts": 0}, "cuts=0 must be at least 1"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(RecipeError, match=message):
        check_section("evaluation", settings)


def test_published_values_come_out_of_the_summary(card):
    clips = load_file(REFERENCE / "metrics.safetensors")
    expected = json.loads((REFERENCE / "metrics.json").read_text())
    metrics = build_metrics(["mse", "m_mse", "ssim", "psnr", "psnr_mean"])
    results = []
    for number, (made, true) in enumerate(zip(clips["pred"], clips["gt"], strict=True)):
        frames = len(true)
        plan = Clip("ind_test", number, 0, frames, 1 - number, 0, 0)
        videos = made.movedim(-1, 1), true.movedim(-1, 1)
        prediction = Prediction.of(numbered(frames, []), *videos, card)
        results.append(score(replace(prediction, clip=plan), metrics))
    for result, values in zip(results, expected["per_video"], strict=True):
        for name, value in values.items():
            assert result.values[name] == pytest.approx(value, abs=1e-6, rel=0)
    row = summarise(results, metrics, seed=0).rows["model"]
    for name, value in expected["batch"].items():
        assert row[name].value == pytest.approx(value, abs=1e-6, rel=0)
    decibels = np.mean([values["psnr"] for values in expected["per_video"]])
    assert row["psnr_mean"].value == pytest.approx(decibels, abs=1e-6, rel=0)


@pytest.fixture
def card():
    return tiny.Drift.card
