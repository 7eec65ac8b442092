"""Layers of different widths, and conditioners that act at the input, fit what there is."""

import pytest
import torch

from acwm_core.checks import check_conditioner, check_model
from acwm_core.errors import RecipeError
from acwm_core.model.build import build_conditioner, build_world_model
from acwm_core.plugins import catalog
from acwm_core.recipe import ComponentConfig, compose
from acwm_dit.cross_attention import CrossAttention
from tests.checks.results import failures
from tests.checks.toys import AtTheInput, SmallUNet, ToysPlugin
from tests.core.test_assembly import CARD


@pytest.fixture(scope="module", autouse=True)
def toys():
    if "toy_unet" not in catalog().registry("model"):
        catalog().add_plugin(ToysPlugin, "toys")


def fitted(name, model, **params):
    """A conditioner as a recipe names it, with no weight at zero."""
    torch.manual_seed(0)
    made = build_conditioner(ComponentConfig(name, params), model, 2, 4)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(torch.randn_like(parameter), alpha=0.1)
    return made


def test_a_model_of_two_widths_conforms():
    assert failures(check_model(SmallUNet)) == {}


def test_a_conditioner_that_acts_at_the_input_alone_conforms():
    assert failures(check_conditioner(AtTheInput)) == {}


def test_cross_attention_is_as_wide_as_each_layer():
    model = SmallUNet(latent_channels=4, width=8, middle=20)
    layers = fitted("cross_attention", model).attentions
    assert [layer.query.weight.shape for layer in layers] == [(8, 8), (20, 20), (8, 8)]
    assert [layer.key_value.weight.shape for layer in layers] == [(16, 8), (40, 8), (16, 8)]


def test_equal_widths_give_the_weights_that_no_widths_give():
    """Names and values, so that earlier checkpoints and seeds keep their meaning."""
    sizes = {"action_size": 2, "temporal_stride": 4, "width": 8, "layers": 2, "heads": 2}
    torch.manual_seed(0)
    without = CrossAttention(**sizes).state_dict()
    torch.manual_seed(0)
    given = CrossAttention(**sizes, widths=(8, 8)).state_dict()
    assert [*without] == [*given]
    assert all(torch.equal(without[name], given[name]) for name in given)


def test_a_recipe_joins_them():
    recipe = compose("push_cube_small", ["model=toy_unet", "conditioner=cross_attention"])
    assert "widths" not in recipe.conditioner.params
    world = build_world_model(recipe, CARD)
    rows = 1 + 2 * world.codec.temporal_stride
    latents = torch.randn(1, 3, world.codec.channels, 8, 8)
    assert world.loss(latents, torch.zeros(1, rows, CARD.action.size)).isfinite()


def test_what_does_not_fit_is_one_sentence():
    model = SmallUNet(latent_channels=4)
    with pytest.raises(TypeError, match="argument 'widths'"):
        fitted("toy_one_width", model)
    fitted("toy_one_width", SmallUNet(latent_channels=4, middle=8))
    with pytest.raises(RecipeError, match="cannot divide the 15 channels of a layer among 2 heads"):
        fitted("cross_attention", SmallUNet(latent_channels=4, middle=15))
    with pytest.raises(RecipeError, match="widths follows from the other components"):
        compose("push_cube_small", ["conditioner=cross_attention", "conditioner.widths=[8]"])
