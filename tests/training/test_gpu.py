"""Training on a real GPU, as `test_pretended.py` has it on none. benchmarks/gpu.sh runs it."""

import pytest
import torch
from lightning.pytorch.callbacks import Callback

from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from tests.training.parts import combinations, recipe
from tests.training.runs import weights

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device"),
]


class Strict(Callback):
    """Whatever waits for the GPU is an error, but in the first step and in those that log."""

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        waits = not batch_idx or (batch_idx + 1) % trainer.log_every_n_steps == 0
        torch.cuda.set_sync_debug_mode("default" if waits else "error")

    def on_train_end(self, trainer, pl_module):
        torch.cuda.set_sync_debug_mode("default")

    def on_exception(self, trainer, pl_module, exception):
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("parts", combinations())
def test_a_gpu_trains_as_the_cpu_without_waiting(parts, data, tmp_path):
    strict = {"class_path": "tests.training.test_gpu.Strict"}
    made = [
        RunFolder(fit(recipe(data, *parts, trainer=flags), tmp_path / name))
        for name, flags in (
            ("gpu", {"accelerator": "gpu", "devices": 1, "callbacks": [strict]}),
            ("cpu", {"accelerator": "cpu"}),
        )
    ]
    ours, theirs = ({name: each.cpu() for name, each in weights(run).items()} for run in made)
    torch.testing.assert_close(ours, theirs, rtol=1e-2, atol=1e-4)


@pytest.mark.parametrize("training", [{"compile": True}, {"optimizer": "muon"}])
def test_default_precision_and_compiled_models_train(training, data, tmp_path):
    flags = {"accelerator": "gpu", "devices": 1, "precision": "bf16-mixed"}
    made = recipe(data, *combinations()[0].values[0], training=training, trainer=flags)
    run = RunFolder(fit(made, tmp_path / "run"))
    assert all(each.isfinite().all() for each in weights(run).values())
