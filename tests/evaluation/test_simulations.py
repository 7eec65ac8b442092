"""What an evaluation simulates again is kept for the next model, and never out of date."""

import shutil

import numpy as np
import pytest

from acwm_core.checks.disc import Disc
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.simulate import simulate
from acwm_core.env.episode import EpisodeSpec
from acwm_interventions import simulations
from acwm_interventions.evaluate import evaluate_run
from acwm_interventions.interventions import simulator_of
from acwm_interventions.simulations import Again, simulate_again
from tests import tiny


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """The folder in which simulations are kept: nothing yet."""
    monkeypatch.setenv("ACWM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache/references"


@pytest.fixture
def simulated(monkeypatch):
    """The specs of all episodes that are simulated."""
    seen = []
    simulate = simulations.simulate

    def watched(environment, spec, *arguments, **options):
        seen.append((spec.split, spec.index))
        return simulate(environment, spec, *arguments, **options)

    monkeypatch.setattr(simulations, "simulate", watched)
    return seen


@pytest.mark.ci
def test_another_model_is_evaluated_on_what_was_simulated_for_the_first(
    data, kept, simulated, tmp_path
):
    asks = {"perturbed_episodes": 2, "ensemble_episodes": 1, "ensemble_starts": 4}
    run = tiny.make_run(tmp_path / "run", data, videos=0, **asks)
    first = evaluate_run(run, progress=False)
    assert simulated
    simulated.clear()
    assert evaluate_run(run, progress=False).splits == first.splits
    assert simulated == []
    shutil.rmtree(kept)
    assert evaluate_run(run, progress=False).splits == first.splits


def asked(episode, **changes):
    frames = len(episode.video)
    return [
        Again(episode.spec, episode.actions, frames),
        Again(episode.spec, 0 * episode.actions, frames, **changes),
    ]


@pytest.mark.parametrize("harm", ["cut off", "another version", "a file in its place"])
def test_what_cannot_be_used_is_simulated_again(data, kept, simulated, harm, monkeypatch):
    episodes = EpisodeDataset(data, "ind_test")
    environment, episode = simulator_of(episodes), episodes[1]
    if harm == "a file in its place":
        kept.parent.mkdir()
        kept.write_text("")
    made = simulate_again(environment, asked(episode))
    if harm == "cut off":
        (file,) = kept.iterdir()
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    if harm == "another version":
        monkeypatch.setattr(simulations, "package_hash", lambda name: "other code")
    simulated.clear()
    again = simulate_again(environment, asked(episode))
    assert simulated == [("ind_test", 1)] * 2
    if harm != "a file in its place":
        simulated.clear()
        again = simulate_again(environment, asked(episode))
        assert not simulated
        assert len([*kept.iterdir()]) == 1  # the old one was replaced
    for one, other in zip(made, again, strict=True):
        assert one.spec == other.spec == episode.spec
        for name in ("video", "actions", "masks", "contacts"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
        assert one.states.keys() == other.states.keys()
        for name, values in one.states.items():
            np.testing.assert_array_equal(values, other.states[name])
            assert values.dtype == other.states[name].dtype
    np.testing.assert_array_equal(made[0].video, episode.video)


def test_whatever_is_asked_differently_is_simulated(kept, simulated):
    environment = Disc(size=(32, 48))
    episode, second = (simulate(environment, EpisodeSpec("disc", "train", k)) for k in range(2))
    changes = [{}, {"perturbation": 1.0}, {"perturbation": 2.0}, {"perturbation": 1.0, "start": 1}]
    for number, change in enumerate(changes, 1):
        simulate_again(environment, asked(episode, **change))
        assert len(simulated) == 2 * number
    simulate_again(environment, asked(second))
    shorter = [each._replace(frames=each.frames - 1) for each in asked(episode)]
    simulate_again(environment, [s._replace(actions=s.actions[:-1]) for s in shorter])
    assert len(simulated) == 2 * len(changes) + 4
