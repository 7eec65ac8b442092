"""Every installed environment conforms, and every check of environments can fail."""

import functools
import os
from multiprocessing.util import Finalize

import pytest

from acwm_core.checks import check_environment
from acwm_core.checks.disc import Disc
from acwm_core.checks.environment import EnvironmentChecks, digests_elsewhere
from acwm_core.checks.estimator import EstimatorChecks
from acwm_core.checks.result import checks_of, run_checks
from acwm_core.checks.task import TaskChecks
from acwm_core.data.shards import open_shard, write_shard
from acwm_core.env.card import check_episode
from acwm_core.env.environment import Environment
from acwm_core.errors import RecipeError
from acwm_core.plugins import catalog
from tests.checks.flawed import FLAWS
from tests.checks.results import failures, in_words, installed, only_run
from tests.episodes import assert_same

CHECKS = checks_of(EnvironmentChecks)


def worlds():
    """Parameters for a test: the installed environments, one for each module of a simulator."""
    modules = {part.name: part.target.partition(":")[0] for part in installed("environment")}
    first = {module: name for name, module in reversed(modules.items())}.values()
    for part in installed("environment"):
        marks = pytest.mark.ci if part.name in first else pytest.mark.slow
        yield pytest.param(part, id=part.name, marks=marks)


def with_two_threads(make):
    """Make an environment in a process in which Taichi has two threads to use."""
    import taichi

    taichi.init(arch=taichi.cpu, cpu_max_num_threads=2, log_level=taichi.ERROR)
    Finalize(None, taichi.reset, exitpriority=0)  # keeps what it compiled for the next time
    assert os.environ["OMP_NUM_THREADS"] == "2"
    return make()


@pytest.mark.parametrize("part", worlds())
def test_installed_environments_conform(part, monkeypatch, tmp_path):
    """With two threads in its fresh process, and with its estimator; a shard keeps its episode."""
    for library in ("OMP", "OPENBLAS"):
        monkeypatch.setenv(f"{library}_NUM_THREADS", "2")
    monkeypatch.setattr(
        "acwm_core.checks.environment.digests_elsewhere",
        lambda make, *which: digests_elsewhere(functools.partial(with_two_threads, make), *which),
    )
    suite = EnvironmentChecks(part.name)
    assert failures(run_checks(suite)) == {}

    if part.name in catalog().registry("estimator"):
        reading = EstimatorChecks(part.name)
        reading._environment = suite
        assert failures(run_checks(reading)) == {}

    check_episode(suite.episode, suite.card)
    write_shard(tmp_path / "shard-00000.tar", [suite.episode], suite.card.fps, {})
    read = open_shard(tmp_path / "shard-00000.tar").episode(0)
    assert_same(read, suite.episode)


@pytest.mark.ci
def test_a_sound_environment_passes_every_check():
    results = list(check_environment(Disc))
    assert [result.name for result in results] == [in_words(check) for check in CHECKS]
    assert failures(results) == {}


@pytest.mark.parametrize("flawed", FLAWS, ids=lambda flawed: flawed.__name__)
def test_flaws_are_found(flawed, monkeypatch):
    check, reason = FLAWS[flawed]
    only_run(check, monkeypatch)
    found = failures(check_environment(flawed))
    assert list(found) == [check]
    assert reason in found[check]


def test_every_check_has_a_flaw_that_it_finds():
    of_tasks = {in_words(check) for check in checks_of(TaskChecks)}  # tests/tasks has theirs
    assert FLAWS.checks() == {in_words(check) for check in CHECKS} - of_tasks


def test_what_cannot_be_tried_is_told():
    class Bare(Disc):
        _perturb = Environment._perturb
        _snapshot = Environment._snapshot

    found = {result.name: str(result) for result in check_environment(Bare)}
    untried = {name: line for name, line in found.items() if "not tried" in line}
    assert untried["perturbed start is close"].startswith(
        "--    perturbed start is close: not tried:"
    )
    assert "it takes no snapshots" in untried["snapshot returns to its moment"]
    assert untried.keys() - {in_words(check) for check in checks_of(TaskChecks)} == {
        "perturbed start is close",
        "snapshot returns to its moment",
    }


def test_unknown_environments_are_named_at_once():
    with pytest.raises(RecipeError, match="unknown environment 'push_cubes'"):
        check_environment("push_cubes")
