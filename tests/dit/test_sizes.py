"""Registered sizes against the paper's parameter counts (arXiv 2605.08567)."""

import pytest
import torch

import acwm_dit.plugin
from acwm_core.plugins import Catalog


@pytest.fixture(scope="module")
def catalog():
    found = Catalog()
    found.add_plugin(acwm_dit.plugin, "acwm_dit")
    return found


def build(catalog, size, conditioner, **params):
    with torch.device("meta"):
        model = catalog.create("model", size, latent_channels=16)
        fit = {"width": model.width, "layers": model.layers, "heads": model.heads}
        fit |= {"action_size": 2, "temporal_stride": 4}
        return model, catalog.create("conditioner", conditioner, **fit, **params)


def millions(*modules):
    return round(sum(p.numel() for module in modules for p in module.parameters()) / 1e6)


@pytest.mark.parametrize(
    ("size", "published"), [("dit_s", 219), ("dit_m", 616), ("dit_l", 805), ("dit_xl", 1354)]
)
def test_published_parameter_counts(catalog, size, published):
    assert millions(*build(catalog, size, "adaln", embedding="convolutional")) == published


@pytest.mark.parametrize("size", ["dit_xs", "dit_s", "dit_m", "dit_l", "dit_xl"])
def test_summaries_state_the_models_own_count(catalog, size):
    model, _ = build(catalog, size, "adaln")
    count = sum(p.numel() for p in model.parameters()) / 1e6
    stated = catalog.component("model", size).summary.split(" M ")[0]
    assert stated == (f"{count:.1f}" if count < 10 else f"{count:.0f}")
