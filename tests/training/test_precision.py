"""Which precision a run computes in: on every kind of hardware, asked for, and resumed."""

import shutil
import warnings

import pytest
import torch

from acwm_core.errors import AcwmWarning, TrainingError
from acwm_core.model import precision as arithmetic
from acwm_core.recipe import Recipe, compose
from acwm_core.training import precision
from acwm_core.training.checkpoints import read_details
from acwm_core.training.config import TrainingConfig
from acwm_core.training.fit import fit
from acwm_core.training.precision import automatic_precision
from acwm_core.training.run_folder import RunFolder
from acwm_core.training.trainer import build_trainer
from tests.training.callbacks import Kill, Killed
from tests.training.runs import killable


@pytest.fixture
def processor(monkeypatch):
    """A function that pretends a processor."""

    def pretend(onednn, native, machine="x86_64", limit=None, slowdown=1.0):
        monkeypatch.setattr(arithmetic, "onednn_multiplies_bfloat16", lambda: onednn)
        monkeypatch.setattr(arithmetic, "cpu_has_bfloat16", lambda: native)
        monkeypatch.setattr(arithmetic.platform, "machine", lambda: machine)
        monkeypatch.setattr(arithmetic, "bfloat16_slowdown", lambda device: slowdown)
        for name in arithmetic.ISA_LIMITS:
            monkeypatch.delenv(name, raising=False)
        if limit:
            monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", limit)
        arithmetic.bfloat16_is_fast.cache_clear()

    yield pretend
    arithmetic.bfloat16_is_fast.cache_clear()


@pytest.fixture
def slow_bfloat16(monkeypatch):
    """A machine without a GPU whose processor emulates bfloat16."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(precision, "bfloat16_is_fast", lambda: False)
    monkeypatch.setattr(precision, "bfloat16_slowdown", lambda device: 6.94)


@pytest.mark.parametrize(
    ("described", "expected"),
    [
        ({"onednn": True, "native": True}, True),
        ({"onednn": False, "native": True}, False),  # ONEDNN_MAX_CPU_ISA=AVX2, or no oneDNN
        ({"onednn": True, "native": False}, False),  # AVX-512 without bfloat16: emulated
        ({"onednn": False, "native": False}, False),  # AVX2
        ({"onednn": True, "native": True, "limit": "AVX512_CORE", "slowdown": 1.9}, False),
        ({"onednn": True, "native": True, "limit": "ALL", "slowdown": 0.5}, True),
        ({"onednn": True, "native": False, "machine": "aarch64", "slowdown": 0.6}, True),
        ({"onednn": True, "native": False, "machine": "aarch64", "slowdown": 1.3}, False),
        ({"onednn": False, "native": False, "machine": "arm64"}, False),  # Apple
    ],
)
def test_a_processor_takes_what_it_multiplies_fast(described, expected, processor, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    processor(**described)
    assert arithmetic.bfloat16_is_fast() is expected
    assert automatic_precision("auto") == ("bf16-mixed" if expected else "32-true")


@pytest.mark.parametrize("accelerator", ["auto", "gpu", "cuda"])
@pytest.mark.parametrize("native", [True, False])
def test_a_gpu_takes_bfloat16_only_from_its_hardware(native, accelerator, monkeypatch):
    """PyTorch says that older GPUs support what they emulate, unless it is asked."""

    def supported(including_emulation=True):
        return including_emulation or native

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", supported)
    assert automatic_precision(accelerator) == ("bf16-mixed" if native else "32-true")


def test_beside_a_gpu_a_run_on_the_processor_asks_the_processor(processor, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    processor(onednn=False, native=False)
    assert automatic_precision("cpu") == "32-true"
    processor(onednn=True, native=True)
    assert automatic_precision("cpu") == "bf16-mixed"
    assert automatic_precision("mps") == "32-true"


def test_what_a_person_asks_for_is_done_with_a_warning(slow_bfloat16):
    flags = {"max_steps": 1, "accelerator": "cpu", "precision": "bf16-mixed"}
    with pytest.warns(AcwmWarning, match=r"bf16-mixed is emulated .* 6\.9 times") as warned:
        trainer = build_trainer(flags, TrainingConfig(), [], [])
    assert trainer.precision == "bf16-mixed"
    assert len([each for each in warned if each.category is AcwmWarning]) == 1


@pytest.mark.parametrize("asked", [None, "32-true", 32])
def test_nothing_is_said_of_what_is_not_emulated(asked, slow_bfloat16):
    flags = {"max_steps": 1, "accelerator": "cpu"} | ({"precision": asked} if asked else {})
    with warnings.catch_warnings():
        warnings.simplefilter("error", AcwmWarning)
        assert build_trainer(flags, TrainingConfig(), [], []).precision == "32-true"


def test_the_measured_ratio_is_of_real_products():
    before = torch.get_rng_state()
    ratio = arithmetic.bfloat16_slowdown(torch.device("cpu"))
    assert 0.05 < ratio < 100
    assert torch.equal(before, torch.get_rng_state())  # a run's seed is not used up


def begun(data, path, monkeypatch, **flags):
    """A run that was killed after its first checkpoint."""
    monkeypatch.setattr(Kill, "batch", 5)
    recipe = killable(data)
    with pytest.raises(Killed):
        fit(_with(recipe, **flags), path)
    monkeypatch.setattr(Kill, "batch", None)
    return RunFolder(path)


def _with(recipe, **flags):
    sections = recipe.to_dict()
    return Recipe.from_dict({**sections, "trainer": {**sections["trainer"], **flags}})


@pytest.mark.parametrize("fast", [True, False])
def test_a_run_keeps_its_precision_on_another_machine(fast, data, tmp_path, monkeypatch):
    chosen, other = ("bf16-mixed", "32-true") if fast else ("32-true", "bf16-mixed")
    monkeypatch.setattr(precision, "bfloat16_slowdown", lambda device: 6.94)
    monkeypatch.setattr(precision, "bfloat16_is_fast", lambda: fast)
    run = begun(data, tmp_path / "run", monkeypatch)
    assert read_details(run.last_checkpoint)["precision"] == chosen
    monkeypatch.setattr(precision, "bfloat16_is_fast", lambda: not fast)
    with pytest.raises(TrainingError, match=rf"trainer\.precision was {chosen}, is {other}"):
        fit(_with(killable(data), precision=other), run.path, resume=run.path)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        fit(killable(data), run.path, resume=run.path)
    assert read_details(run.last_checkpoint)["precision"] == chosen
    emulated = [each for each in seen if "is emulated" in str(each.message)]
    assert len(emulated) == int(fast)


def test_an_old_run_whose_recipe_names_a_precision_resumes_in_it(
    data, tmp_path, monkeypatch, slow_bfloat16
):
    """Checkpoints did not record it; recipes said bf16-mixed, and say nothing today."""
    run = begun(data, tmp_path / "run", monkeypatch, precision="bf16-mixed")
    checkpoint = torch.load(run.last_checkpoint, weights_only=True)
    del checkpoint["precision"]
    torch.save(checkpoint, run.last_checkpoint)
    old = tmp_path / "copy"
    shutil.copytree(run.path, old)
    with pytest.warns(AcwmWarning, match="is emulated"):
        fit(killable(data), old, resume=old)
    assert read_details(RunFolder(old).last_checkpoint)["precision"] == "bf16-mixed"
    assert Recipe.from_yaml(RunFolder(old).recipe).trainer["precision"] == "bf16-mixed"


@pytest.mark.parametrize("recipe", ["small", "demo", "push_cube_small"])
def test_recipes_for_a_cpu_leave_the_precision_to_it(recipe):
    assert "precision" not in compose(recipe).trainer
