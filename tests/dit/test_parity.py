"""The published network's outputs, through the converter of published checkpoints."""

import json
from pathlib import Path

import pytest
import torch
from safetensors import safe_open

from acwm_dit.adaln import AdaLN
from acwm_dit.cross_attention import CrossAttention
from acwm_dit.dit import DiT
from acwm_dit.published import DataError, convert

REFERENCE = Path(__file__).parent.parent / "reference"
CASES = {
    "acwm_dit_adaln_bidirectional": AdaLN,
    "acwm_dit_crossattn_causal": CrossAttention,
}


def load(name):
    with safe_open(REFERENCE / f"{name}.safetensors", "pt") as file:
        about = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    weights = {k.removeprefix("weights."): v for k, v in tensors.items() if "weights." in k}
    width, layers, heads = (int(about[key]) for key in ("dim", "layers", "heads"))
    model = DiT(
        latent_channels=int(about["in_channels"]),
        width=width,
        layers=layers,
        heads=heads,
        causal=about["temporal_causal"] == "True",
    )
    conditioner = CASES[name](
        action_size=int(about["action_dim"]),
        temporal_stride=4,
        width=width,
        layers=layers,
        heads=heads,
        embedding="convolutional",
    )
    return tensors, weights, model, conditioner


@pytest.mark.parametrize("name", CASES)
def test_reproduces_the_published_network(name):
    tensors, weights, model, conditioner = load(name)
    model_state, conditioner_state = convert(weights, model, conditioner)
    model.load_state_dict(model_state)
    conditioner.load_state_dict(conditioner_state)
    with torch.no_grad():
        latents = tensors["x"].permute(0, 1, 4, 2, 3)
        out = model(latents, tensors["t"] / 1000, conditioner(tensors["action"]))
    torch.testing.assert_close(out.permute(0, 1, 3, 4, 2), tensors["out"], rtol=0, atol=1e-5)


def test_the_network_that_benchmarks_compare_with_is_the_published_one(monkeypatch):
    monkeypatch.syspath_prepend(str(REFERENCE.parents[1] / "benchmarks"))
    from published_dit import PublishedDiT

    tensors, weights, model, _ = load("acwm_dit_adaln_bidirectional")
    sizes = {"width": model.width, "layers": model.layers, "heads": model.heads}
    channels, actions = tensors["x"].shape[-1], tensors["action"].shape[-1]
    network = PublishedDiT(in_channels=channels, action_size=actions, causal=False, **sizes)
    network.load_state_dict(weights)
    with torch.no_grad():
        out = network(tensors["x"], tensors["t"], tensors["action"])
    torch.testing.assert_close(out, tensors["out"], rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "conditioner"), [("adaLN", AdaLN), ("cross_attn", CrossAttention)]
)
def test_published_dit_s_has_exactly_our_parameters(kind, conditioner):
    shapes = json.loads((REFERENCE / "published_dit_s_state_dict.json").read_text())[kind]
    with torch.device("meta"):
        published = {name: torch.empty(shape) for name, shape in shapes.items()}
        model = DiT(latent_channels=16, width=768, layers=10, heads=12)
        conditions = conditioner(
            action_size=2,
            temporal_stride=4,
            width=768,
            layers=10,
            heads=12,
            embedding="convolutional",
        )
        states = convert(published, model, conditions)
    for module, state in zip((model, conditions), states, strict=True):
        ours = {name: tensor.shape for name, tensor in module.state_dict().items()}
        assert {name: tensor.shape for name, tensor in state.items()} == ours


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        ({"x_proj.weight": None}, "lacks x_proj.weight"),
        ({"blocks.7.s_block.ffwd.0.bias": torch.zeros(3)}, "blocks.7.s_block.ffwd.0.bias"),
        ({"action_embedder.mlp_in.0.weight": torch.zeros(64, 3)}, r"mlp_in.0.weight .*\(64, 3\)"),
    ],
)
def test_a_wrong_checkpoint_names_the_tensor(damage, message):
    _, weights, model, conditioner = load("acwm_dit_adaln_bidirectional")
    weights |= damage
    weights = {name: tensor for name, tensor in weights.items() if tensor is not None}
    with pytest.raises(DataError, match=message):
        convert(weights, model, conditioner)


def test_the_other_conditioner_is_refused():
    _, weights, model, _ = load("acwm_dit_adaln_bidirectional")
    _, _, _, conditioner = load("acwm_dit_crossattn_causal")
    with pytest.raises(DataError, match=r"lacks blocks\.0\.action_cross_attn"):
        convert(weights, model, conditioner)


def test_stacked_actions_are_refused():
    _, weights, model, _ = load("acwm_dit_adaln_bidirectional")
    conditioner = AdaLN(action_size=2, temporal_stride=4, width=64, layers=2, heads=4)
    with pytest.raises(DataError, match="embedding=convolutional"):
        convert(weights, model, conditioner)
