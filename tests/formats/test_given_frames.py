"""Imported recordings train and are evaluated with several given frames."""

from acwm_core.evaluation.results import Summary
from acwm_core.evaluation.storage import read_scores
from acwm_core.training.run import load_run
from tests.formats.test_command_line import QUICK, QUICK_EVALUATION, run

GIVEN = 5


def test_an_imported_dataset_is_learnt_and_scored_from_five_frames(tmp_path):
    """Rollouts of a Gymnasium environment, of at least 12 frames: it stays in sight so long."""
    data, folder = tmp_path / "dot", tmp_path / "run"
    words = ["--episodes", "3,2", "--frames", 14, "--size", 32, "--out", data]
    words += ["--policy", "tests.formats.toy_envs:right"]
    run("data", "import", "gymnasium", "tests.formats.toy_envs:Toy/Dot-v0", *words)
    given = f"data.context_frames={GIVEN}"
    run("fit", "small", f"data.path={data}", given, "--out", folder, *QUICK)
    run("evaluate", folder, *QUICK_EVALUATION)
    assert load_run(folder).world_model.context_frames == GIVEN
    assert Summary.read(folder).provenance["context_frames"] == GIVEN
    rows = [row for row in read_scores(folder) if row.kind == "model"]
    assert {row.split for row in rows} == {"ind_test"}
    assert {row.frames for row in rows} == {9 - GIVEN + 1}
