"""From a `latest.pt` as the published code writes it to a run that predicts what it predicted."""

import json
import re
import shlex
from pathlib import Path

import pytest
import torch
import yaml
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.data.generate import generate
from acwm_core.errors import TrainingError
from acwm_core.plugins import catalog
from acwm_core.training.fit import fit
from acwm_core.training.run import load_run, read_metadata
from acwm_zoo.importing import import_checkpoint
from tests.codecs.tiny_autoencoders import original_state, tiny_wan
from tests.dit.latest import REFERENCE, WORDS, content, reference, writer

CASES = {
    "acwm_dit_adaln_bidirectional": ("adaln", "push_cube", "objective=full_sequence"),
    "acwm_dit_crossattn_causal": ("cross_attention", "robot_arm", "model.causal=null"),
}
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


@pytest.fixture
def latest(tmp_path):
    """Write a checkpoint and return its path."""
    return writer(tmp_path)


@pytest.fixture(scope="module")
def wan(tmp_path_factory):
    """The words that name a tiny Wan."""
    folder = tmp_path_factory.mktemp("codec") / "wan"
    tiny_wan().save_pretrained(folder)
    return f"codec.weights={folder}"


@pytest.mark.parametrize(("name", "prefix"), zip(CASES, ("model.", "module.model."), strict=True))
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
    assert recipe.objective.name == "diffusion_forcing"
    assert recipe.objective.params == {
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


@pytest.mark.ci
def test_it_is_evaluated_rolled_out_and_trained_on(latest, wan, data, tmp_path, monkeypatch):
    """On the command line; training starts from the weights, and a run of it goes on as any."""
    monkeypatch.chdir(tmp_path)

    def acwm(*words):
        done = CliRunner().invoke(main, [str(word) for word in words])
        assert done.exit_code == 0, done.output
        return done.output

    imported = (latest(content()), wan, "model.heads=4", f"data.path={data}")
    reader = ("--importer", "published_dit")
    said = acwm("import-checkpoint", *imported, *reader, "--out", "run")
    assert "dit_xs with adaln" in said
    assert "100,000 steps" in said
    acwm("evaluate", "run", *QUICK)
    assert json.loads(Path("run/evaluation/summary.json").read_text())["splits"]["ind_test"]
    acwm("rollout", "run", "--steps", 1, "--out", "film.png")
    acwm("rollout", "run", "--steps", 1, "--mode", "stream", "--out", "stream.mp4")
    acwm("report", "run")
    again = f"acwm import-checkpoint {tmp_path}/latest.pt {' '.join(reader)} {wan} model.heads=4"
    assert f"{again} data.path={data} --out run-again" in Path("run/report.html").read_text()
    acwm("fit", "run/recipe.yaml", *SHORT, "training.init_from=run", "--out", "tuned")
    before, after = (load_run(run).world_model.state_dict() for run in ("run", "tuned"))
    for name, tensor in before.items():
        torch.testing.assert_close(after[name], tensor, rtol=0, atol=1e-6)


def test_the_codec_comes_along_if_its_weights_do(latest, tmp_path, monkeypatch):
    """The trainer's state holds the frozen Wan: then nothing is downloaded."""
    monkeypatch.chdir(tmp_path)
    autoencoder = original_state(tiny_wan(num_res_blocks=2))
    values = content()
    values["model_state_dict"] |= {f"vae.model.{k}": v for k, v in autoencoder.items()}
    values["model_state_dict"] |= {"vae.mean": torch.zeros(16)}
    made = import_checkpoint(latest(values), Path("run"), WORDS)
    assert made.recipe.codec.params["weights"] == "run/codec.safetensors"
    assert made.notes[0] == "Left aside: scheduler.* (1)."
    codec = load_run("run").world_model.codec
    torch.save(autoencoder, "wan.pth")
    assert codec.fingerprint() == catalog().create("codec", "wan", weights="wan.pth").fingerprint()
    import_checkpoint("latest.pt", Path("other"), (*WORDS, "codec.weights=wan.pth"))
    assert not Path("other/codec.safetensors").exists()
    load_run("other")


def test_training_does_not_write_over_imported_weights(latest, wan, data, tmp_path):
    words = (wan, "model.heads=4", f"data.path={data}")
    made = import_checkpoint(latest(content()), tmp_path / "run", words)
    before = (made.run / "model.safetensors").read_bytes()
    for resume in (None, "auto", made.run):
        with pytest.raises(
            TrainingError, match=r"holds weights but no checkpoint.*training\.init_from="
        ):
            fit(made.recipe, made.run, resume=resume)
    assert (made.run / "model.safetensors").read_bytes() == before


def test_a_run_is_not_overwritten(latest, tmp_path):
    path = latest(content())
    import_checkpoint(path, tmp_path / "run", WORDS)
    with pytest.raises(TrainingError, match="holds a run already"):
        import_checkpoint(path, tmp_path / "run", WORDS)


PAGE = Path(__file__).parents[2] / "docs" / "reference" / "paper.md"


@pytest.mark.ci
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
    section = PAGE.read_text().partition("## Published checkpoints")[2]
    lines = re.findall(r"^ {4}acwm (.*)$", section, re.M)
    assert len(lines) == 5
    for line in lines:
        words = shlex.split(line)
        done = CliRunner().invoke(main, [*words, *more[words[0]]])
        assert done.exit_code == 0, f"{line}: {done.output}"
    assert Path("runs/tuned/model.safetensors").is_file()
