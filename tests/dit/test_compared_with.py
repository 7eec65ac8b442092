"""The network that benchmarks/training.py compares ours with is the published one."""

from pathlib import Path

import pytest
import torch
from safetensors import safe_open

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "tests" / "reference" / "acwm_dit_adaln_bidirectional.safetensors"


@pytest.fixture
def compared(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    import published_dit

    return published_dit


def test_published_weights_load_by_name_and_give_the_published_output(compared):
    with safe_open(REFERENCE, "pt") as file:
        about = file.metadata()
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    weights = {k.removeprefix("weights."): v for k, v in tensors.items() if "weights." in k}
    network = compared.PublishedDiT(
        in_channels=int(about["in_channels"]),
        action_size=int(about["action_dim"]),
        width=int(about["dim"]),
        layers=int(about["layers"]),
        heads=int(about["heads"]),
        causal=about["temporal_causal"] == "True",
    )
    network.load_state_dict(weights)
    with torch.no_grad():
        out = network(tensors["x"], tensors["t"], tensors["action"])
    torch.testing.assert_close(out, tensors["out"], rtol=0, atol=1e-5)
