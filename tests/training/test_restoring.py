"""What a resumed training knows of its best checkpoint."""

import shutil

import torch

from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.training.callbacks import Kill
from tests.training.runs import killable, killed_run

OFTEN = {"validate_every_n_steps": 1, "checkpoint_every_n_steps": 1}


def state_of_the_best(checkpoint):
    (state,) = (s for n, s in checkpoint["callbacks"].items() if n.startswith("ModelCheckpoint"))
    return state


def test_the_best_checkpoint_is_still_known_after_a_resume_elsewhere(data, tmp_path, monkeypatch):
    """The run was moved, and its state names a file of somebody else, which Lightning would remove
    once there is a better checkpoint."""
    monkeypatch.setattr(Kill, "batch", 6)
    stopped = killed_run(data, tmp_path / "stopped", monkeypatch, training=OFTEN)
    work = tmp_path / "work.txt"
    work.write_text("a year of work")
    for loss in (1e9, 0.0):  # one that is beaten at once, and one that never is
        run = RunFolder(shutil.copytree(stopped.path, tmp_path / f"run-{loss}"))
        checkpoint = torch.load(run.last_checkpoint, weights_only=True)
        score, path = torch.tensor(loss), str(work)
        state_of_the_best(checkpoint).update(
            best_k_models={path: score},
            kth_value=score,
            best_model_score=score,
            best_model_path=path,
            kth_best_model_path=path,
            dirpath=str(run.checkpoints),
        )
        torch.save(checkpoint, run.last_checkpoint)
        best = run.checkpoints / "best.ckpt"
        before = best.read_bytes()
        fit(killable(data, trainer={"max_steps": 9}, training=OFTEN), "", resume=run.path)
        assert work.read_text() == "a year of work"
        assert (best.read_bytes() == before) == (loss == 0)
        after = state_of_the_best(torch.load(run.last_checkpoint, weights_only=True))
        assert after["best_model_path"] == str(best)
        assert (after["best_model_score"] == 0) == (loss == 0)
