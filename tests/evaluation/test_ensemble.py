"""The simulator's own ensemble: its starts, and the energy distance of a model's futures to it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from acwm_core.checks.disc import Disc, DiscEstimator
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import RecipeError
from acwm_core.evaluation.clips import Clip
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.score import build_metrics
from acwm_core.recipe.check import check_section
from acwm_interventions.ensemble import (
    RESOLVED,
    compare_ensembles,
    energy_distances,
    start_doubt,
)
from acwm_interventions.interventions import intervene
from acwm_report.run import EvaluatedRun
from acwm_report.tables import ensemble_tables
from acwm_report.terminal import print_summary
from tests import tiny
from tests.evaluation.test_counterfactual import Episodes
from tests.evaluation.test_simulator import Chaos

STARTS, FRAMES = 8, 12


def greys(values):
    """A future `[T, 1, 1, 3]` whose frames differ as numbers in 0 … 255 do."""
    pixels = np.asarray(values).round().clip(0, 255).astype(np.uint8)
    return np.repeat(pixels[:, None, None, None], 3, -1)


@pytest.mark.parametrize("apart", [0.0, 1.5])
def test_the_energy_distance_of_two_gaussians_is_the_closed_form(apart):
    """Of N(0, 1) and N(d, 1): 2 E|N(d, 2)| − 2 E|N(0, 2)|, and 0 for halves of one of them."""
    rng, sigma, frames = np.random.default_rng(0), 20, 3000
    one = [greys(128 + sigma * rng.normal(size=frames)) for _ in range(6)]
    other = [greys(128 + sigma * (apart + rng.normal(size=frames))) for _ in range(2)]
    distances, spread = energy_distances({"simulator": one, "model": other})
    between = stats.foldnorm(apart / 2**0.5, scale=2**0.5).mean()
    within = 2 / np.pi**0.5
    expected = (2 * between - 2 * within) * sigma / 255
    for name, value in (("model", expected), ("simulator", 0)):
        error = distances[name].std() / frames**0.5
        assert distances[name].mean() == pytest.approx(value, abs=4 * error)
    assert spread["simulator"] == pytest.approx(within * sigma / 255, rel=0.02)


def test_a_single_future_is_as_far_as_its_distance_less_what_it_may_be():
    true, alone = [greys([100]), greys([120])], [greys([110])]
    distances, spread = energy_distances({"simulator": true, "model": alone})
    assert distances["model"] == pytest.approx([(2 * 10 - 20) / 255])
    assert "model" not in spread


def test_starts_differ_by_what_a_pixel_resolves():
    disc = Disc(size=(32, 48))
    spec = EpisodeSpec("disc", "ind_test", 3)
    amount = start_doubt(simulate(disc, spec, frames=4), DiscEstimator(disc.card))
    assert amount == pytest.approx(RESOLVED / 32 / 1e-3)  # a frame is 1 m high
    still = np.zeros((2, 2), np.float32)

    def place(**start):
        return simulate(disc, spec, still, frames=2, **start).states["position"][0]

    places = np.array([place(perturbation=amount, start=k) for k in range(1, 400)])
    own = place()
    assert np.std(places * 32, 0) == pytest.approx(RESOLVED, rel=0.15)
    assert places.mean(0) == pytest.approx(own, abs=1e-3)
    assert np.array_equal(place(perturbation=1), place(perturbation=1, start=0))


class Oracle:
    """A `VideoModel` that simulates, from starts that seeds decide, as far off as it is told."""

    samples, steps, context_frames, clip_frames = True, None, 1, FRAMES
    device = torch.device("cpu")

    def __init__(self, environment, amount, specs):
        self.environment, self.amount, self.specs = environment, amount, specs
        self.asked = 0

    def children(self):
        return []

    def codec(self, video):
        return video

    def rollout_chunks(self, given, actions, *, mode, steps, seeds):
        made = []
        for rows, seed in zip(actions.numpy(), seeds, strict=True):
            self.asked += 1
            episode = simulate(
                self.environment,
                self.specs[0],
                rows,
                frames=len(rows),
                perturbation=self.amount,
                start=seed % 10**9 + 10**6,
            )
            made.append(torch.as_tensor(episode.video).permute(0, 3, 1, 2).float() / 255)
        yield torch.stack(made)


def compared(amount, samples=STARTS, world=Chaos):
    environment = world(size=(32, 48))
    spec = EpisodeSpec("disc", "ind_test", 0)
    episodes = Episodes([simulate(environment, spec, frames=FRAMES)])
    clips = [Clip("ind_test", 0, 0, FRAMES, seed=5)]
    config = EvaluationConfig(samples=samples, ensemble_starts=STARTS, ensemble_episodes=1)
    model = Oracle(environment, amount, [spec])
    estimator = DiscEstimator(environment.card)
    evaluator = Evaluator(model, environment.card, build_metrics(["mse"]), config, estimator)
    return compare_ensembles(evaluator, environment, clips, episodes), model


def test_a_model_that_doubts_as_the_world_does_is_as_near_as_the_world_itself():
    doubting, model = compared(RESOLVED / 32 / 1e-3)
    sure, _ = compared(1e-6)
    far = doubting.distance["copy"].value
    assert model.asked == doubting.draws == STARTS
    assert doubting.moved == pytest.approx(RESOLVED / 32)
    assert abs(doubting.distance["model"].value) < 0.1 * far
    assert abs(doubting.distance["simulator"].value) < 0.1 * far
    assert doubting.distance["codec"] == doubting.distance["simulator"]  # it loses nothing
    assert sure.distance["model"].value > 2 * doubting.distance["model"].value
    assert doubting.spread["model"].value == pytest.approx(
        doubting.spread["simulator"].value, rel=0.3
    )
    assert sure.spread["model"].value < 0.1 * sure.spread["simulator"].value
    assert len(doubting.curves["model"]) == FRAMES


def test_the_test_is_off_and_is_left_out_where_starts_cannot_be_moved(data):
    assert EvaluationConfig().ensemble_episodes == 0
    with pytest.raises(RecipeError, match="ensemble_starts"):
        check_section("evaluation", {"ensemble_starts": 3})
    config = EvaluationConfig(ensemble_episodes=1, perturbed_episodes=0, device="cpu")
    evaluator = Evaluator(None, tiny.Drift.card, {}, config)
    plans = {"ind_test": [Clip("ind_test", 0, 0, 13)]}
    found = intervene(evaluator, plans, {"ind_test": EpisodeDataset(data, "ind_test")})
    assert [*found.left_out] == ["ensemble"]
    assert not found.ensembles


def test_what_is_found_is_printed_and_on_the_page(evaluated, capsys):
    made, _ = compared(1.0)
    summary = replace(Summary.read(evaluated), ensembles={"ind_test": made})
    print_summary(summary)
    shown = capsys.readouterr().out
    assert f"from {STARTS} starts" in shown
    assert "half against half" in shown
    run = replace(EvaluatedRun.read(evaluated, "run1"), summary=summary)
    (table,) = ensemble_tables(run)
    assert [row.title for row in table.rows] == [
        "Simulator",
        "Codec reconstruction",
        "Model",
        "First frame, repeated",
    ]
    assert table.rows[2].cells[0].value == made.distance["model"].value
