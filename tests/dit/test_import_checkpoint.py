"""From a `latest.pt` as the published code writes it to a run that predicts what it predicted."""

import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from click.testing import CliRunner
from safetensors import safe_open
from safetensors.torch import save_file

from acwm_core.catalog import catalog
from acwm_core.checks import check_importer
from acwm_core.cli import main
from acwm_core.data.generate import generate
from acwm_core.errors import CheckpointError, DataError, RecipeError, TrainingError
from acwm_core.import_checkpoint import import_checkpoint
from acwm_core.training.launch import fit
from acwm_core.training.run import load_run, read_metadata
from tests.checks.results import failures
from tests.codecs.tiny_autoencoders import tiny_wan

pytestmark = pytest.mark.usefixtures("one_thread")

REFERENCE = Path(__file__).parent.parent / "reference"
CASES = {
    "acwm_dit_adaln_bidirectional": ("adaln", "push_cube", "flow.objective=full_sequence"),
    "acwm_dit_crossattn_causal": ("cross_attention", "robot_arm", "model.causal=null"),
}
WORDS = ("model.heads=4", "env=push_cube")
QUICK = (
    "evaluation.frames=5",
    "evaluation.steps=1",
    "evaluation.steps_sweep=[1, 2]",
    "evaluation.videos=0",
)
SHORT = (
    "trainer.max_steps=1",
    "trainer.precision=32-true",
    "trainer.enable_progress_bar=false",
    "training.learning_rate=1e-9",
    "training.sample_every_n_steps=0",
    "data.batch_size=1",
    "data.clip_frames=5",
    "data.window_stride=32",
    "data.validation_episodes=0",
)


def reference(name):
    with safe_open(REFERENCE / f"{name}.safetensors", "pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    weights = {k.removeprefix("weights."): v for k, v in tensors.items() if "weights." in k}
    return weights, tensors


def content(name="acwm_dit_adaln_bidirectional", prefix="model.", **changes):
    """What the published trainer saves; `changes` replace weights, None takes one away."""
    weights = reference(name)[0] | {key.replace("__", "."): v for key, v in changes.items()}
    state = {f"{prefix}{key}": value for key, value in weights.items() if value is not None}
    aside = {"vae.model.encoder.conv1.bias": torch.zeros(3), "scheduler.sigmas": torch.zeros(5)}
    return {"model_state_dict": {**state, **aside}, "step": 100_000, "epoch": 7}


@pytest.fixture
def latest(tmp_path):
    """Write a checkpoint and return its path."""

    def write(values, **options):
        torch.save(values, tmp_path / "latest.pt", **options)
        return tmp_path / "latest.pt"

    return write


@pytest.fixture(scope="module")
def wan(tmp_path_factory):
    """The words that name a tiny Wan."""
    folder = tmp_path_factory.mktemp("codec") / "wan"
    tiny_wan().save_pretrained(folder)
    return f"codec.weights={folder}"


@pytest.mark.parametrize("prefix", ["model.", "module.model."])
@pytest.mark.parametrize("name", CASES)
def test_an_imported_run_computes_what_the_published_network_does(
    name, prefix, latest, wan, tmp_path
):
    conditioner, environment, objective = CASES[name]
    words = (f"env={environment}", "model.heads=4", objective, wan)
    made = import_checkpoint(latest(content(name, prefix)), tmp_path / "run", words)
    assert (made.step, made.recipe.conditioner.name) == (100_000, conditioner)
    world_model = load_run(made.run).world_model
    tensors = reference(name)[1]
    with torch.no_grad():
        conditioning = world_model.conditioner(tensors["action"])
        latents = tensors["x"].permute(0, 1, 4, 2, 3)
        out = world_model.model(latents, tensors["t"] / 1000, conditioning)
    torch.testing.assert_close(out.permute(0, 1, 3, 4, 2), tensors["out"], rtol=0, atol=1e-5)


def test_the_recipe_is_the_published_protocol(latest, tmp_path):
    made = import_checkpoint(latest(content()), tmp_path / "run", WORDS)
    recipe = made.recipe
    assert recipe.flow == {
        "objective": "diffusion_forcing",
        "shift": 5.0,
        "prediction": "velocity",
        "loss_on": "velocity",
        "weighting": "gaussian",
        "steps": 49,
    }
    assert recipe.codec.name == "wan"
    assert recipe.training["learning_rate"] == 1e-4
    assert recipe.data["clip_frames"] == 37
    assert recipe.env is not None
    facts = read_metadata(made.run / "model.safetensors")
    assert (facts["step"], facts["codec"]) == (100_000, None)
    card = yaml.safe_load((made.run / "card.yaml").read_text())
    assert card["source"]["name"] == "latest.pt"
    assert made.notes == ("Left aside: vae.* (1), scheduler.* (1).",)


@pytest.mark.parametrize(
    ("kind", "conditioner"), [("adaLN", "adaln"), ("cross_attn", "cross_attention")]
)
def test_the_published_size_is_known_by_its_shapes(kind, conditioner):
    shapes = json.loads((REFERENCE / "published_dit_s_state_dict.json").read_text())[kind]
    with torch.device("meta"):
        state = {f"model.{name}": torch.empty(shape) for name, shape in shapes.items()}
    found = catalog().create("importer", "published_dit").read({"model_state_dict": state})
    assert found.sections["model"] == {"name": "dit_s", "patch_size": 2}
    assert found.sections["conditioner"]["name"] == conditioner
    assert (found.latent_channels, found.action_size, found.untold) == (16, 2, {})


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "push_cube"
    episodes = {"train": 2, "ind_test": 2}
    generate("push_cube", folder, episodes=episodes, size=32, workers=0, progress=False)
    return folder


def test_it_is_evaluated_rolled_out_and_trained_on(latest, wan, data, tmp_path, monkeypatch):
    """On the command line; training starts from the weights, and a run of it goes on as any."""
    monkeypatch.chdir(tmp_path)

    def acwm(*words):
        done = CliRunner().invoke(main, [str(word) for word in words])
        assert done.exit_code == 0, done.output
        return done.output

    imported = (latest(content()), wan, "model.heads=4", f"data.path={data}")
    said = acwm("import-checkpoint", *imported, "--out", "run")
    assert "dit_xs with adaln" in said
    assert "100,000 steps" in said
    acwm("evaluate", "run", *QUICK)
    assert json.loads(Path("run/evaluation/summary.json").read_text())["splits"]["ind_test"]
    acwm("rollout", "run", "--steps", 1, "--out", "film.png")
    acwm("rollout", "run", "--steps", 1, "--mode", "stream", "--out", "stream.mp4")
    acwm("report", "run")
    again = f"acwm import-checkpoint {tmp_path}/latest.pt {wan} model.heads=4 data.path={data}"
    assert f"{again} --out run-again" in Path("run/report.html").read_text()
    acwm("fit", "run/recipe.yaml", *SHORT, "training.init_from=run", "--out", "tuned")
    before, after = (load_run(run).world_model.state_dict() for run in ("run", "tuned"))
    for name, tensor in before.items():
        torch.testing.assert_close(after[name], tensor, rtol=0, atol=1e-6)


def test_training_from_a_run_that_is_none_is_refused(latest, wan, data, tmp_path):
    words = (wan, "model.heads=4", f"data.path={data}")
    made = import_checkpoint(latest(content()), tmp_path / "run", words)
    recipe = str(made.run / "recipe.yaml")
    fit = ["fit", recipe, "--out", str(tmp_path / "tuned")]
    done = CliRunner().invoke(main, [*fit, f"training.init_from={tmp_path / 'nowhere'}"])
    assert done.exit_code == 2
    assert "nowhere: there is no run with trained weights" in done.output
    assert not (tmp_path / "tuned").exists()


@pytest.mark.parametrize("resume", [None, "auto", "run"])
def test_training_does_not_write_over_imported_weights(resume, latest, wan, data, tmp_path):
    words = (wan, "model.heads=4", f"data.path={data}")
    made = import_checkpoint(latest(content()), tmp_path / "run", words)
    before = (made.run / "model.safetensors").read_bytes()
    goes_on = made.run if resume == "run" else resume
    with pytest.raises(TrainingError, match=r"imported weights.*training\.init_from="):
        fit(made.recipe, made.run, resume=goes_on)
    assert (made.run / "model.safetensors").read_bytes() == before


class Attack:
    def __init__(self, mark):
        self.mark = mark

    def __reduce__(self):
        return os.system, (f"touch {self.mark}",)


@pytest.mark.parametrize("zipped", [True, False])
def test_pickled_code_is_not_run(zipped, latest, tmp_path):
    mark = tmp_path / "mark"
    path = latest({**content(), "config": Attack(mark)}, _use_new_zipfile_serialization=zipped)
    with pytest.raises(CheckpointError, match=r"system\).*nothing in it was run"):
        import_checkpoint(path, tmp_path / "run", WORDS)
    assert not mark.exists()
    assert not (tmp_path / "run").exists()
    torch.load(path, weights_only=False)  # the attack is real
    assert mark.exists()


def test_numbers_of_numpy_and_old_files_are_read(latest, tmp_path):
    values = {**content(), "best_loss": np.float64(0.1), "history": np.zeros(3)}
    path = latest(values, _use_new_zipfile_serialization=False)
    made = import_checkpoint(path, tmp_path / "run", WORDS)
    assert "best_loss, history" in made.notes[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_proj__weight": None}, "lacks x_proj.weight"),
        ({"x_proj__weight": torch.zeros(64, 16)}, "x_proj.weight has shape"),
        ({"blocks__1__t_block__ffwd__0__bias": None}, r"lacks blocks\.1\.t_block\.ffwd\.0\.bias"),
        ({"blocks__1__t_block__ffwd__0__bias": torch.zeros(3)}, r"ffwd\.0\.bias has shape \(3,\)"),
        ({"blocks__9__s_block__ffwd__0__bias": torch.zeros(3)}, r"lacks blocks\.2"),
        ({"final_layer__linear__bias": torch.full((64,), float("nan"))}, "bias are not finite"),
        ({"head__weight": torch.zeros(3)}, "holds head.weight"),
        ({"final_layer__linear__bias": 3}, "final_layer.linear.bias'"),
    ],
)
def test_a_wrong_tensor_is_named(changes, message, latest, tmp_path):
    with pytest.raises(CheckpointError, match=message):
        import_checkpoint(latest(content(**changes)), tmp_path / "run", WORDS)
    assert not (tmp_path / "run").exists()


def test_an_entry_beside_the_network_is_named(latest, tmp_path):
    values = content()
    values["model_state_dict"]["discriminator.weight"] = torch.zeros(2)
    with pytest.raises(CheckpointError, match=r"'discriminator\.weight'"):
        import_checkpoint(latest(values), tmp_path / "run", WORDS)


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        (("env=push_cube",), CheckpointError, "heads: add the word model.heads="),
        (("model.heads=4",), CheckpointError, "data.path=FOLDER or one of .*env=push_cube"),
        (("model.heads=4", "env=stack_cube"), DataError, "size 2, and those of stack_cube have 7"),
        (("model.heads=5", "env=push_cube"), RecipeError, "5 heads"),
        ((*WORDS, "conditioner=cross_attention"), CheckpointError, "convolutional"),
        ((*WORDS, "model.layers=3"), CheckpointError, r"lacks blocks\.2"),
        ((*WORDS, "model.depth=3"), RecipeError, "no parameter 'depth'"),
        (("model.heads=4", "data.path=nowhere"), DataError, "no dataset in nowhere"),
    ],
)
def test_wrong_words_are_refused(words, error, message, latest, tmp_path):
    with pytest.raises(error, match=message):
        import_checkpoint(latest(content()), tmp_path / "run", words)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"state_dict": {}, "epoch": 3}, "no checkpoint that published_dit knows; it holds state"),
        ([1, 2], "holds a list"),
        ({}, "holds nothing"),
    ],
)
def test_other_files_are_refused(values, message, latest, tmp_path):
    with pytest.raises(CheckpointError, match=message):
        import_checkpoint(latest(values), tmp_path / "run", WORDS)


def test_damaged_and_missing_files_are_refused(latest, tmp_path):
    path = latest(content())
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(CheckpointError, match="damaged"):
        import_checkpoint(path, tmp_path / "run", WORDS)
    with pytest.raises(CheckpointError, match="is missing"):
        import_checkpoint(tmp_path / "nothing.pt", tmp_path / "run", WORDS)
    save_file({"weight": torch.zeros(2)}, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="it holds weight"):
        import_checkpoint(tmp_path / "other.safetensors", tmp_path / "run", WORDS)


def test_a_run_is_not_overwritten(latest, tmp_path):
    path = latest(content())
    import_checkpoint(path, tmp_path / "run", WORDS)
    with pytest.raises(TrainingError, match="holds a run already"):
        import_checkpoint(path, tmp_path / "run", WORDS)


def test_the_importer_conforms():
    assert failures(check_importer("published_dit")) == {}


PAGE = Path(__file__).parents[2] / "docs" / "published-checkpoints.md"


def test_every_command_of_the_page_works(latest, wan, data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    latest(content())
    Path("data").mkdir()
    Path("data/push_cube").symlink_to(data)
    more = {
        "import-checkpoint": (wan, "model.heads=4"),
        "evaluate": QUICK,
        "fit": SHORT,
        "rollout": ("--steps", "1"),
    }
    lines = re.findall(r"^ {4}acwm (.*)$", PAGE.read_text(), re.M)
    assert len(lines) == 5
    for line in lines:
        words = shlex.split(line)
        done = CliRunner().invoke(main, [*words, *more[words[0]]])
        assert done.exit_code == 0, f"{line}: {done.output}"
    assert Path("runs/tuned/model.safetensors").is_file()
