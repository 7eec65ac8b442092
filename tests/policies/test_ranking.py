"""Rankings whose answer is known: by the simulator itself, an exact model, and a blind one."""

import numpy as np
import pytest

from acwm_core.data.shards import file_sha256
from acwm_core.env.task import Goal
from acwm_core.errors import AcwmWarning, DataError, RecipeError
from acwm_core.files import read_json
from acwm_core.training.run import load_run
from acwm_planning.controllers import PolicyController
from acwm_planning.policies.episode import true_outcome
from acwm_planning.policies.judges import EpisodeSimulator, ModelJudge
from acwm_planning.policies.ranking import RANKING_FILE, Ranking
from acwm_planning.policies.run import Ranker, rank_policies
from acwm_planning.policies.scripted import ScriptedPolicy, built_in_policies
from acwm_planning.policies.table import summarise
from acwm_planning.resumable import ResumableResults
from acwm_report.terminal import print_ranking
from tests import tiny

pytestmark = pytest.mark.ci

SEEDS = range(6)


class Simulator(EpisodeSimulator):
    """Stands in for a model: it judges as a `ModelJudge` does."""

    batch = 1

    def replay(self, start, actions):
        played = (self.play(start, PolicyController.replaying(a), len(a)) for a in actions)
        return [true_outcome(result, start) for result in played]


def simulator(given=1):
    reader = tiny.SquareEstimator(tiny.Slide.card)
    return Simulator(tiny.task_environment(), given, tiny.STRIDE, reader)


def ranked(tmp_path, model, policies=None, seeds=SEEDS):
    reader = tiny.SquareEstimator(tiny.Slide.card)
    policies = built_in_policies(True) if policies is None else policies
    ranker = Ranker(simulator(), model, reader, policies, ScriptedPolicy("solution"))
    about = {"environment": "slide", "task": "place", "unit": "px", "weights": None}
    results = ResumableResults(tmp_path, about, ("policy", "seed"))
    for seed in seeds:
        results.add(*ranker.lines(seed, ranker.rows))
    return summarise(results)


def test_the_simulator_in_the_place_of_the_model_is_right(tmp_path):
    found = ranked(tmp_path, simulator())
    assert len(found.policies) >= 20
    assert found.episodes == len(SEEDS)
    for each in found.agreement["model"].values():
        for value in (each.pearson, each.spearman, each.kendall):
            assert (value.value, value.low) == pytest.approx((1, 1))
        for value in (each.mmrv, each.optimism):
            assert (value.value, value.low, value.high) == (0, 0, 0)
    choice = found.decisions["model"]
    assert (choice.starts, choice.regret.value, choice.regret.high) == (6, 0, 0)
    assert choice.chance.value > 0.5
    assert choice.gain.low > 0
    best, worst = found.policies[0], found.policies[-1]
    assert best.success["truth"] == 1 > worst.success["truth"]
    assert best.success["model"] == best.success["truth"]


def test_an_exact_model_ranks_as_well_as_its_estimator_reads(tmp_path, exact):
    bundle = load_run(exact)
    reader = tiny.SquareEstimator(bundle.card)
    found = ranked(tmp_path, ModelJudge(bundle.world_model, reader, tiny.PLACE, batch=7))
    for judge in ("model", "estimator"):
        returns, choice = found.agreement[judge]["returns"], found.decisions[judge]
        assert returns.spearman.value > 0.97
        assert returns.pearson.value > 0.97
        assert abs(returns.optimism.value) < 12  # a pixel in each of 12 frames
        assert choice.regret.value < 0.1 * choice.chance.value


def test_a_model_that_ignores_actions_chooses_no_better_than_chance(tmp_path, blind):
    bundle = load_run(blind)
    reader = tiny.SquareEstimator(bundle.card)
    model = ModelJudge(bundle.world_model, reader, tiny.PLACE, batch=7)
    found = ranked(tmp_path, model)
    choice = found.decisions["model"]
    assert choice.regret.value == pytest.approx(choice.chance.value)
    assert (choice.gain.low, choice.gain.high) == pytest.approx((0, 0))
    for each in found.agreement["model"].values():
        assert each.spearman.value is None  # all policies come to the same
        assert each.mmrv.value > 0


def test_a_model_sees_the_actions_that_were_taken(exact):
    """Against the simulator, episode by episode: to the pixel that the estimator reads."""
    bundle = load_run(exact)
    reader, stage = tiny.SquareEstimator(bundle.card), simulator()
    model = ModelJudge(bundle.world_model, reader, tiny.PLACE)
    for seed in range(4):
        start = stage.start(tiny.spec(seed))
        rows = [np.random.default_rng(seed).uniform(-2, 2, (12, 2)).astype(np.float32)]
        (true,), (seen,) = stage.replay(start, rows), model.replay(start, rows)
        assert seen.returns == pytest.approx(true.returns, abs=12 * 1.5)
        assert (true.steps, true.success) == (12, False) or true.success


def test_frames_that_are_given_stand_still_and_are_not_judged(tmp_path, parts):
    """A model that is given five frames: the same outcome as one that is given one."""
    run = tiny.make_exact_run(tmp_path / "run", context_frames=5)
    bundle = load_run(run)
    reader = tiny.SquareEstimator(bundle.card)
    start = simulator(given=5).start(tiny.spec(1))
    assert start.frames.shape == (5, 32, 32, 3)
    assert (start.frames == start.frames[0]).all()
    assert np.shape(start.history.actions) == (4, 2)
    rows = [np.full((12, 2), 1.5, np.float32), np.full((12, 2), -1.0, np.float32)]
    made = ModelJudge(bundle.world_model, reader, tiny.PLACE).replay(start, rows)
    single = ModelJudge(
        load_run(tiny.make_exact_run(tmp_path / "one")).world_model, reader, tiny.PLACE
    )
    assert made == single.replay(simulator().start(tiny.spec(1)), rows)


def test_seeds_that_are_solved_at_their_start_are_left_out(tmp_path, exact, monkeypatch):
    draw = tiny.PLACE.sample_goal

    def sample_goal(environment, rng):
        solved = environment.episode_spec.index == 0
        return Goal.now(environment) if solved else draw(environment, rng)

    monkeypatch.setattr(tiny.PLACE, "sample_goal", sample_goal, raising=False)
    with pytest.warns(AcwmWarning, match="solved at the start of episode 0"):
        found = rank_policies(
            exact, "place", ["behaviour", "solution"], seeds=(0, 1, 2), out=tmp_path / "ranking"
        )
    assert found.episodes == 2


def test_results_are_kept_and_gone_on_with(tmp_path, exact, monkeypatch):
    calls = []
    lines = Ranker.lines

    def counted(self, seed, names):
        calls.append((seed, len(names)))
        return lines(self, seed, names)

    monkeypatch.setattr(Ranker, "lines", counted)
    words = ["solution", "behaviour", "solution,skill=0.5"]
    out = exact.parent / "ranking" / "place"
    whole = rank_policies(exact, "place", words, seeds=(0, 1), out=tmp_path / "whole")
    rank_policies(exact, "place", words[:2], seeds=(0,), out=out)
    calls.clear()
    found = rank_policies(exact, "place", words, seeds=(0, 1), out=out)
    assert calls == [(0, 1), (1, 4)]  # what was there is not done again
    assert sorted(map(str, found.policies)) == sorted(map(str, whole.policies))
    assert found.decisions == whole.decisions
    assert read_json(out / RANKING_FILE, Ranking, "a ranking") == found
    assert found.weights == file_sha256(exact / "model.safetensors")


def test_settings_that_fail_at_once_do_not_keep_the_folder(tmp_path, exact, monkeypatch):
    def failing(self, seed, names):
        raise DataError("no such thing")

    with monkeypatch.context() as patched:
        patched.setattr(Ranker, "lines", failing)
        with pytest.raises(DataError, match="no such thing"):
            rank_policies(exact, "place", ["solution"], seeds=(0,), out=tmp_path, steps=3)
    assert rank_policies(exact, "place", ["solution"], seeds=(0,), out=tmp_path).episodes == 1


def test_policies_need_a_common_episode(tmp_path, exact):
    out = tmp_path / "out"
    rank_policies(exact, "place", ["solution"], seeds=(0,), out=out)
    with pytest.raises(RecipeError.__base__, match="have no episode in common"):
        rank_policies(exact, "place", ["behaviour"], seeds=(1,), out=out)


def test_a_task_without_a_solution_is_ranked_by_the_behaviour(tmp_path, exact):
    found = rank_policies(exact, "shy", ["scripted"], seeds=(0,), out=tmp_path / "out")
    assert len(found.policies) >= 20
    assert all(each.policy.startswith("behaviour") for each in found.policies)
    assert all(each.success["truth"] == 0 or each.returns["truth"] <= 0 for each in found.policies)
    with pytest.raises(RecipeError, match="'shy' has no"):
        rank_policies(exact, "shy", ["solution"], seeds=(0,), out=tmp_path / "other")


class Blind(tiny.SquareEstimator):
    """Reads nothing in any picture."""

    def estimate(self, video):
        seen = super().estimate(video)
        seen.states["position"][:] = np.nan
        return seen


def test_an_estimator_that_reads_nothing_is_an_error_and_no_ranking(tmp_path, exact):
    bundle = load_run(exact)
    reader = Blind(bundle.card)
    policies = [ScriptedPolicy("solution"), ScriptedPolicy("behaviour")]
    model = ModelJudge(bundle.world_model, reader, tiny.PLACE)
    ranker = Ranker(simulator(), model, reader, policies, policies[0])
    about = {"environment": "slide", "task": "place", "unit": "px", "weights": None}
    results = ResumableResults(tmp_path, about, ("policy", "seed"))
    results.add(*ranker.lines(0, ranker.rows))
    with pytest.raises(
        DataError, match=r"cannot read the distance .* 2 of 2 policies \(solution, beha"
    ):
        summarise(results)
    assert len(results.finished()) == 3


def test_episodes_of_which_nothing_is_read_are_counted(tmp_path, exact, capsys):
    """Of a model whose pictures show nothing: the estimator reads the true ones."""
    bundle = load_run(exact)
    model = ModelJudge(bundle.world_model, Blind(bundle.card), tiny.PLACE)
    policies = [ScriptedPolicy("solution"), ScriptedPolicy("behaviour")]
    found = ranked(tmp_path, model, policies, seeds=range(2))
    assert [each.unread for each in found.policies] == [{"model": 2}] * 2
    print_ranking(found)
    said = "in 2 of 2 episodes the estimator could not read the distance in the predicted frames"
    assert capsys.readouterr().out.count(said) == 2
