"""Whole recipes: what is checked, what is written out, and that nothing heavy is imported."""

from pathlib import Path

import pytest

from acwm_core.errors import AcwmError
from acwm_core.plugins import Registry, catalog, hookimpl
from acwm_core.recipe import ComponentConfig, Recipe, compose


class Codec:
    """A third party's codec, registered late."""

    def __init__(self, *, depth: int, sizes: tuple[int, ...] = (1, 2), mode: object = print):
        self.depth, self.sizes, self.mode = depth, sizes, mode


class Plugin:
    @hookimpl
    def register_codecs(self, registry: Registry) -> None:
        registry.add("third_party", f"{__name__}:Codec", requires=("no_such_engine",))
        registry.add("preset", f"{__name__}:Codec", depth=3)
        registry.add("plain", f"{__name__}:Codec")
        registry.add("nowhere", f"{__name__}:Missing")


@pytest.fixture(autouse=True)
def third_party(fresh_catalog: None) -> None:
    """The installed catalog and a plugin as a notebook registers it."""
    catalog().add_plugin(Plugin(), "third_party")


@pytest.fixture
def recipe(tmp_path: Path) -> Path:
    path = tmp_path / "mine.yaml"
    path.write_text("extends: [push_cube_small.yaml]\n")
    return path


def test_every_default_is_written_out(recipe: Path) -> None:
    composed = compose(recipe, ["model=dit_s", "model.patch_size=4", "training.betas=[0.9, 0.95]"])
    assert composed.model == ComponentConfig(
        "dit_s",
        {
            "width": 768,
            "layers": 10,
            "heads": 12,
            "patch_size": 4,
            "causal": None,
            "inputs": None,
        },
    )
    assert composed.training["betas"] == (0.9, 0.95)
    assert composed.training["learning_rate"] == 4e-3
    assert composed.trainer == {  # Lightning's not
        "gradient_clip_val": 1.0,
        "max_steps": 1700,
        "accelerator": "auto",
        "devices": 1,
        "strategy": "auto",
    }


def test_a_saved_recipe_reads_back_the_same(recipe: Path, tmp_path: Path) -> None:
    composed = compose(
        recipe,
        [
            "codec=preset",
            "codec.sizes=[3]",
            "training.learning_rate=1e-5",
            "trainer.max_time='1e4'",
            "trainer.callbacks=[{class_path: a.B, init_args: {c: 1}}]",
        ],
    )
    assert composed.codec == ComponentConfig("preset", {"depth": 3, "sizes": (3,)})
    saved = tmp_path / "saved.yaml"
    saved.write_text(composed.to_yaml())
    assert Recipe.from_yaml(saved) == composed
    assert Recipe.from_dict(composed.to_dict()) == composed
    # Standing on its own: a component renamed in it takes its own defaults, not the saved ones.
    assert compose(saved, ["model=dit_s"], trusted=True).model.params["width"] == 768


WRONG = {
    "env=push_cub": "unknown environment 'push_cub'; did you mean 'push_cube'?",
    "conditioner=cross_atention": "did you mean 'cross_attention'?",
    "modle=dit_s": "unknown section 'modle'; did you mean 'model'?",
    "model.layer=4": "model.layer=4: DiT has no parameter 'layer'; did you mean 'layers'?",
    "model.latent_channels=4": "model.latent_channels follows from the other components; omit it",
    "conditioner.width=4": "conditioner.width follows from the other components; omit it",
    "codec.dept=1": "no parameter 'dept'",
    "codec=plain": "Codec needs the parameter 'depth'; add codec.depth=…",
    "codec=nowhere": "but tests.recipe.test_recipe has no 'Missing'",
    "codec=": "names no codec; add codec=NAME",
    "training=5": "training=5: give parameters, as in training.parameter=value",
    "training.learning_rate=-1": "training.learning_rate=-1 must be above 0",
    "training.max_steps=10": "has no parameter 'max_steps'; did you mean trainer.max_steps?",
    "model.learning_rate=1": "'learning_rate'; did you mean training.learning_rate?",
    "data.batch_size=0": "data.batch_size=0 must be at least 1",
    "evaluation.metrics=psnr": "evaluation.metrics=psnr: expected [str or dict[str, Any], …]",
    "evaluation.metrics=[psn]": "unknown metric 'psn'; did you mean 'psnr'?",
    'evaluation.metrics=[{"as":"other"}]': "names no metric; write {name: METRIC",
    'evaluation.metrics=[lpips,{"name":"lpips","network":"vgg"}]': "lists 'lpips' twice",
    'evaluation.metrics=[{"name":"lpips","as":"the.net"}]': "'the.net' is not a valid name",
    'evaluation.metrics=[{"name":"lpips","as":"vgg","netwrok":"vgg"}]': (
        "evaluation.metrics.vgg.netwrok=vgg: LPIPS has no parameter 'netwrok'; "
        "did you mean 'network'?"
    ),
    "evaluation.metrics=[torchmetrics.image.VisualInformation]": (
        "there is no torchmetrics.image.VisualInformation; did you mean 'VisualInformationFidelity'"
    ),
    "evaluation.metrics=[psnr.image.PSNR]": "'psnr' is a metric itself, so there is no psnr.image",
    'evaluation.metrics=[{"name":"torchmetrics.image.VisualInformationFidelity","sigma":1}]': (
        "VisualInformationFidelity has no parameter 'sigma'; did you mean 'sigma_n_sq'?"
    ),
    "trainer.max_step=5": "Trainer has no parameter 'max_step'; did you mean 'max_steps'?",
}


@pytest.mark.parametrize("words", WRONG)
def test_what_is_wrong_is_said_in_one_sentence(recipe: Path, words: str) -> None:
    with pytest.raises(AcwmError) as error:
        compose(recipe, words.split())
    assert WRONG[words] in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "word",
    [
        "trainer.strategy={class_path: a.B, init_args: {c: 1}}",
        "trainer.logger=false",
        "trainer.devices=2",
        "trainer.devices=[0, 1]",
        "trainer.max_time={hours: 1}",
        "codec={name: third_party, depth: 1}",  # its engine is missing, but nothing uses it yet
    ],
)
def test_what_is_right_passes(recipe: Path, word: str) -> None:
    compose(recipe, [word])


def test_a_recipe_without_a_required_part_is_refused(tmp_path: Path) -> None:
    (tmp_path / "short.yaml").write_text("env: push_cube\ncodec: compact\nmodel: dit_xs\n")
    with pytest.raises(AcwmError, match="names no conditioner"):
        compose(tmp_path / "short.yaml")
    with pytest.raises(AcwmError, match=r"DataConfig needs the parameter 'path'; add data\.path="):
        compose(tmp_path / "short.yaml", ["conditioner=adaln"])


def test_a_recipe_may_leave_the_environment_open(recipe: Path, tmp_path: Path) -> None:
    open_ended = compose("small")
    assert open_ended.env is None
    assert "env" not in open_ended.to_dict()
    saved = tmp_path / "saved.yaml"
    saved.write_text(open_ended.to_yaml())
    assert compose(saved) == open_ended
    assert compose(recipe, ["env=null"]).env is None
    named = compose("small", ["env=push_cube"])
    assert named.env == compose(recipe).env
    with pytest.raises(AcwmError, match="names no env; add env=NAME"):
        compose("small", ["env.size=64"])
