"""The simulator that is asked, the row `perturbed`, and predictability horizons."""

import numpy as np
import pytest

from acwm_core.checks.disc import Disc
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_core.errors import DataError
from acwm_core.evaluation.clips import Clip
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.predict import Evaluator
from acwm_core.evaluation.score import build_metrics
from acwm_interventions.interventions import (
    intervene,
    perturbed,
    predictability,
    simulator_of,
    units_of_work,
)
from tests import tiny
from tests.evaluation.test_counterfactual import Episodes


class Chaos(Disc):
    """Moves by a map that doubles every difference, whatever the action."""

    def _advance(self, action):
        turns = 2 * (self.position + 0.4) / 0.8 + 1e-3
        self.position = (turns % 1) * 0.8 - 0.4


def rows_of(environment, frames=24, clips=3):
    specs = [EpisodeSpec("disc", "ind_test", index) for index in range(clips)]
    episodes = Episodes(simulate(environment, spec) for spec in specs)
    plans = [
        Clip("ind_test", i, 0, frames, donor=(i + 1) % clips, donor_start=0, seed=i)
        for i in range(clips)
    ]
    config = EvaluationConfig(device="cpu")
    told, metrics = [], build_metrics(["mse", "psnr"])
    evaluator = Evaluator(None, environment.card, metrics, config, advance=told.append)
    found = perturbed(evaluator, environment, plans, episodes)
    assert told == [1] * clips
    return found


def test_a_tame_world_is_predictable_to_the_end():
    rows, found = rows_of(Disc(size=(32, 48)))
    assert [row.kind for row in rows] == ["perturbed"] * 3
    assert all(0 < row.values["mse"] < 1e-4 for row in rows)
    assert found.clips == 3
    assert found.share[0] is None  # nothing has moved
    assert max(found.share[1:]) < 0.1
    assert found.horizon is None


def test_a_chaotic_world_is_predictable_for_as_long_as_differences_take_to_grow():
    _, found = rows_of(Chaos(size=(32, 48)))
    assert found.share[2] < 0.1
    # A millimetre grows to the disc's radius of a decimetre in log2(100) steps.
    assert 5 <= found.horizon <= 9
    assert found.share[found.horizon] >= found.limit


def test_cubes_at_rest_stay_predictable_and_pushed_cubes_drift_apart():
    environment = make_environment("push_cube", {"size": 64})
    spec = EpisodeSpec("push_cube", "ind_test", 0)
    policy = simulate(environment, spec, frames=50).actions
    environment.reset(options={"spec": spec})
    still = np.tile(environment.still_action(), (50, 1))
    grown = {}
    for name, actions in (("still", still), ("pushed", policy)):
        usual, moved = (
            simulate(environment, spec, actions, frames=50, perturbation=amount).states
            for amount in (0.0, 1.0)
        )
        apart = np.abs(usual["cube_position"] - moved["cube_position"]).max((1, 2))
        grown[name] = apart[-1] / apart[0]
    assert grown["still"] == pytest.approx(1, abs=0.05)
    assert grown["pushed"] > 1.5


@pytest.mark.parametrize(
    ("perturbed", "horizon"),
    [
        ([0, 1, 6, 3, 4, 4.9], None),
        ([0, 1, 2, 6, 6, 6], 3),
        ([0, 6, 2, 3, 4, 6], 5),  # a frame that is predictable again is no end
        ([0, 6, 6, 6, 6, 6], 1),
    ],
)
def test_the_horizon_is_where_the_share_stays_above_the_limit(perturbed, horizon):
    still = [0, 10, 10, 10, 10, 10]
    found = predictability([np.array([perturbed, still], float)])
    assert found.horizon == horizon
    assert found.share == [None, *(value / 10 for value in perturbed[1:])]


def test_errors_of_clips_are_pooled_before_they_are_compared():
    long, short = np.array([[0, 1.0, 3], [0, 2, 4]]), np.array([[0, 5.0], [0, 10]])
    assert predictability([long, short]).share == [None, 6 / 12, 3 / 4]


def test_recorded_data_has_no_simulator_to_ask(data):
    episodes = EpisodeDataset(data, "ind_test")
    object.__setattr__(episodes.card, "source", {"kind": "walk"})
    with pytest.raises(DataError, match="the data was recorded"):
        simulator_of(episodes)


def test_simulators_that_are_missing_or_changed_are_not_asked(data, monkeypatch):
    simulator_of(EpisodeDataset(data, "ind_test")).close()
    monkeypatch.setattr(tiny.Drift, "side", 20)
    with pytest.raises(DataError, match="does not reproduce the videos of the data"):
        simulator_of(EpisodeDataset(data, "ind_test"))
    episodes = EpisodeDataset(data, "ind_test")
    object.__setattr__(episodes.card.environment, "name", "drfit")
    with pytest.raises(DataError, match=r"is not available .*did you mean 'drift'"):
        simulator_of(episodes)


def test_nothing_is_simulated_unless_it_is_asked_for(data, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError

    monkeypatch.setattr("acwm_interventions.interventions.simulator_of", refuse)
    config = EvaluationConfig(counterfactual_episodes=0, perturbed_episodes=0, device="cpu")
    evaluator = Evaluator(None, tiny.Drift.card, {}, config)
    plans, episodes = {"ind_test": []}, {"ind_test": EpisodeDataset(data, "ind_test")}
    assert units_of_work(evaluator, plans) == 0
    found = intervene(evaluator, plans, episodes)
    assert not found.left_out
    assert not found.counterfactual
