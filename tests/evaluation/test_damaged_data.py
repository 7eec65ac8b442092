"""An episode that cannot be read is left out and told, and the others are judged."""

import shutil

import pytest

from acwm_core.errors import AcwmWarning, DataError
from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.storage import read_scores
from acwm_interventions.evaluate import evaluate_run
from tests import tiny
from tests.evaluation.test_given_frames import QUICK
from tests.folders import damage_episode


def test_damaged_episodes_do_not_end_an_evaluation(data, tmp_path):
    mine = shutil.copytree(data, tmp_path / "data", ignore=shutil.ignore_patterns("references"))
    damage_episode(mine, "ind_test", 0)
    damage_episode(mine, "ind_test", 3, "actions.npy")
    run = tiny.make_run(tmp_path / "run", mine, **QUICK)
    with pytest.warns(AcwmWarning, match=r"2 of 5 episodes of ind_test .*episode 0: .*checksum"):
        evaluate_run(run, progress=False)
    assert {r.episode for r in read_scores(run) if r.split == "ind_test"} == {1, 2, 4}
    summary = Summary.read(run)
    assert summary.splits["ind_test"].scores.episodes == 3
    assert {*summary.left_out} == {"episode 0 of ind_test", "episode 3 of ind_test"}
    for index in (1, 2):
        damage_episode(mine, "ind_test", index)
    with pytest.raises(DataError, match="4 of 5 episodes of ind_test cannot be read"):
        evaluate_run(run, progress=False)
