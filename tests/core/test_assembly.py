"""One word swaps the objective: the model follows, or the recipe is refused."""

import pytest

from acwm_core.env.environment import ActionSpec, EnvironmentCard
from acwm_core.errors import RecipeError
from acwm_core.model.build import build_world_model
from acwm_core.plugins import catalog, hookimpl
from acwm_core.recipe import compose
from tests.tiny import PointwiseModel

CARD = EnvironmentCard(
    name="square",
    summary="a square",
    action=ActionSpec(("dx", "dy"), ("m", "m"), (-1.0, -1.0), (1.0, 1.0), "delta"),
    frame_size=(64, 64),
    fps=10,
    horizon=20,
    factors=(),
    ood_shifts=(),
    state=(),
    instances=("background",),
    engine="none",
)


class Bidirectional(PointwiseModel):
    """A model that has no say about time."""


class Plugin:
    @staticmethod
    @hookimpl
    def register_models(registry):
        registry.add("bidirectional", f"{__name__}:Bidirectional")


@pytest.fixture(scope="module", autouse=True)
def parts():
    catalog().add_plugin(Plugin, "tests_of_assembly")


def build(*words):
    return build_world_model(compose("push_cube_small", ["codec=identity", *words]), CARD)


WHOLE, FORCING = "objective=full_sequence", "objective=diffusion_forcing"


@pytest.mark.parametrize(
    ("words", "causal"),
    [
        ((), True),
        ((FORCING,), True),
        ((FORCING, "conditioner=cross_attention"), True),
        ((FORCING, "model.causal=true"), True),
        ((WHOLE, "model.causal=true"), True),
        ((WHOLE,), False),
    ],
)
def test_the_model_follows_the_objective(words, causal):
    model = build(*words).model
    assert model.causal is causal
    assert {block.temporal.causal for block in model.blocks} == {causal}


def test_a_saved_recipe_takes_the_word_too(tmp_path):
    saved = tmp_path / "recipe.yaml"
    saved.write_text(compose("push_cube_small", ["codec=identity", WHOLE]).to_yaml())
    assert build_world_model(compose(saved, [FORCING]), CARD).model.causal


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("+recurrent", "objective=next_frame"), r"a Denoiser\), which RecurrentModel is not"),
        (
            ("objective=regression",),
            r"a Predictor\), which DiT is not: .*diffusion_forcing",
        ),
        (
            ("objective=next_frame", "model=bidirectional"),
            "further inputs previous, previous_sigma",
        ),
        ((FORCING, "model.causal=false"), "is causal in time, but DiT.*full_sequence"),
        ((FORCING, "model=bidirectional"), "is causal in time, but Bidirectional"),
    ],
)
def test_a_model_that_the_objective_cannot_train_is_one_sentence(words, sentence):
    with pytest.raises(RecipeError, match=sentence):
        build(*words)
