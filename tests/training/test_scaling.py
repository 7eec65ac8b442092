"""docs/scaling.md and reference/memory.md: tables are counted, commands are valid recipes."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file

from acwm_core.plugins import catalog
from acwm_core.recipe import compose
from acwm_core.training.fit import fit
from acwm_core.training.layers import state_memory
from acwm_core.training.run import load_run
from acwm_core.training.run_folder import RunFolder
from tests.tiny import tiny_recipe

DOCS = Path(__file__).parents[2] / "docs"
TEXT = "".join((DOCS / n).read_text() for n in ("scaling.md", "reference/memory.md"))
COMMANDS = re.findall(r"(?:acwm|acwm_core\.cli) fit ([^;`\n]+)", TEXT.replace("\\\n", " "))


def gigabytes(size):
    """The row of a size: parameters, then memory by number of devices, then the checkpoint."""
    with torch.device("meta"):
        model = catalog().create("model", size, latent_channels=16)
        fit = {"width": model.width, "layers": model.layers, "heads": model.heads}
        fit |= {"action_size": 2, "temporal_stride": 4, "embedding": "convolutional"}
        conditioner = catalog().create("conditioner", "adaln", **fit)
    world_model = SimpleNamespace(model=model, conditioner=conditioner)
    state = [state_memory(world_model, devices) for devices in (1, 2, 8, 32)]
    saved = sum(state[0].values()) - state[0]["gradients"]
    return [
        f"{state[0]['weights'] / 4e6:,.0f} M",
        *(f"{sum(memory.values()) / 1e9:.1f}" for memory in state),
        f"{saved / 1e9:.1f}",
    ]


@pytest.mark.parametrize("size", ["dit_s", "dit_m", "dit_l", "dit_xl"])
def test_the_table_is_what_is_counted(size):
    assert f"| `{size}` | {' | '.join(gigabytes(size))} |" in TEXT


def test_the_table_of_checkpoints_is_the_sum():
    rows = re.findall(r"\| ([\d.]+) GB \| ([\d.]+) GB \| ([\d.]+) GB \| ([\d.]+) GB \|", TEXT)
    assert len(rows) == 4
    for row, size in zip(rows, ("dit_s", "dit_m", "dit_l", "dit_xl"), strict=True):
        parameters, *_, last = gigabytes(size)
        last, weights, written, kept = map(float, (last, *row[1:]))
        assert row[0] == f"{last}"
        assert weights == pytest.approx(float(parameters[:-2].replace(",", "")) * 4e-3, abs=0.06)
        assert (written, kept) == pytest.approx((last + weights, 2 * last + weights), abs=0.16)


def test_the_table_of_eight_gpus_is_the_sum():
    rows = re.findall(r"^\|.*`(?:ddp|fsdp)` \| ([\d. |]+) \|$", TEXT, re.MULTILINE)
    assert len(rows) == 5
    for row in rows:
        state, activations, whole, *_ = map(float, row.split(" | "))
        assert whole == pytest.approx(state + activations)


def test_the_average_of_checkpoints_is_a_run(data, tmp_path, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    run, other = RunFolder(tmp_path / "runs" / "push_cube"), RunFolder(tmp_path / "other")
    for number, each in enumerate((run, other)):
        training = {"seed": number, "validation_rollouts": 0, "sample_every_n_steps": 0}
        fit(tiny_recipe(data, trainer={"max_steps": 2}, training=training), each.path)
    kept = run.path / "kept"
    kept.mkdir()
    for number, each in enumerate((run, other)):
        shutil.copy(each.last_checkpoint, kept / f"{number}.ckpt")
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    one, two = (load_file(each.weights) for each in (run, other))
    made = load_run(tmp_path / "runs" / "push_cube_averaged").world_model.state_dict()
    assert any(not torch.equal(one[name], two[name]) for name in one)
    for name in one:
        torch.testing.assert_close(made[name], (one[name] + two[name]) / 2)


def test_the_commands_compose():
    assert len(COMMANDS) >= 7
    for command in COMMANDS:
        recipe, *words = shlex.split(command)
        if "--out" in words:
            del words[words.index("--out") : words.index("--out") + 2]
        recipe = "push_cube" if recipe == "resume=runs/push_cube" else recipe
        composed = compose(recipe, [word for word in words if not word.startswith("resume=")])
        flags = composed.trainer
        clips = composed.data["batch_size"] * flags["devices"] * flags.get("num_nodes", 1)
        assert clips * flags.get("accumulate_grad_batches", 1) == 32, command


def test_the_batch_script_is_one():
    (script,) = re.findall(r"```bash\n(.*?)```", TEXT, re.DOTALL)
    subprocess.run(["bash", "-n"], input=script, text=True, check=True)
    assert "--ntasks-per-node=8" in script
    assert "trainer.devices=8" in script
    assert "--nodes=4" in script
    assert "trainer.num_nodes=4" in script
