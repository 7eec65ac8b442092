"""Checkpoints as the published trainer writes them, of the reference's weights."""

from pathlib import Path

import torch
from safetensors import safe_open

REFERENCE = Path(__file__).parent.parent / "reference"

WORDS = ("model.heads=4", "env=push_cube")
"""What an import of them needs."""


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


def writer(folder):
    """What writes a checkpoint into `folder` and returns its path."""

    def write(values, **options):
        torch.save(values, folder / "latest.pt", **options)
        return folder / "latest.pt"

    return write
