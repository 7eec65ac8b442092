"""`acwm fit resume=RUN`: the run says what to train, and what is named beside it must agree."""

import shutil

import pytest
import yaml
from click.testing import CliRunner

from acwm_core.cli import main
from acwm_core.training.run import read_metadata
from tests.tiny import tiny_recipe


@pytest.fixture
def started(data, tmp_path, monkeypatch):
    """A recipe that trains 16 steps, and its run with overrides, which has made 4."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(data, "here")
    recipe = tiny_recipe("elsewhere", training={"schedule": "constant"})
    (tmp_path / "mine.yaml").write_text(recipe.to_yaml())
    acwm("mine.yaml", "data.path=here", "trainer.max_steps=4", "model.width=6", "--out", "run")
    return tmp_path / "run"


def acwm(*words, code=0):
    done = CliRunner().invoke(main, ["fit", *words])
    assert done.exit_code == code, done.output
    return done.output


def steps(run):
    return read_metadata(run / "model.safetensors")["step"]


def test_everything_comes_from_the_run(started):
    before = yaml.safe_load((started / "recipe.yaml").read_text())
    assert "run is finished after 4 steps" in acwm("resume=run", code=2)
    acwm("resume=run", "trainer.max_steps=6")
    assert steps(started) == 6
    before["trainer"]["max_steps"] = 6
    now = yaml.safe_load((started / "recipe.yaml").read_text())
    assert now == before  # which names no precision: the checkpoint holds the one it began with


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["mine.yaml"], "data.path was here, is elsewhere; model.width was 6, is 8; "),
        (["mine.yaml", "data.path=here"], "model.width was 6, is 8; trainer.max_steps was 4, is"),
        (["model.width=7", "trainer.max_steps=9"], "another recipe: model.width was 6, is 7; "),
        (["codec.gain=3.0", "training.seed=1"], "codec.gain was 2.0, is 3.0; training.seed was 0"),
        (["trainer.max_steps=9", "--out", "other"], "omit --out other"),
        (["data.path=other"], "no dataset other"),
    ],
)
def test_what_is_named_and_differs_is_refused_in_a_short_sentence(started, words, said):
    before = (started / "recipe.yaml").read_bytes()
    message = (
        acwm("resume=run", *words, code=2)
        if "=" in words[0]
        else acwm(words[0], "resume=run", *words[1:], code=2)
    )
    assert said in message
    assert len(message) < 400
    assert (started / "recipe.yaml").read_bytes() == before


def test_a_recipe_that_agrees_may_be_named(started):
    same = ("data.path=here", "model.width=6", "trainer.max_steps=6")
    acwm("mine.yaml", "resume=run", *same)
    assert steps(started) == 6


def test_the_same_data_may_lie_elsewhere(started, data):
    shutil.move("here", "there")
    assert "there is no dataset here" in acwm("resume=run", code=2)
    acwm("resume=run", "data.path=there", "trainer.max_steps=6")
    assert yaml.safe_load((started / "recipe.yaml").read_text())["data"]["path"] == "there"
