"""Networks that a file names layer by layer: linear ones, and convolutions of pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from torch import Tensor, nn

from acwm_core.errors import RecipeError

ACTIVATIONS: Mapping[str, type[nn.Module]] = {
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "hardtanh": nn.Hardtanh,
}
"""What may stand between layers with weights, by its name in the file."""

PICTURE, CONVOLUTION, FLATTEN = "picture", "convolution", "flatten"
"""Names of further layers: ``picture 9 32 32`` makes pictures of rows, ``convolution 2`` moves by 2
pixels, and ``flatten`` makes rows again."""


def network_of(layers: Sequence[int | str], weights: Mapping[str, Tensor]) -> nn.Sequential:
    """The network of these layers; `ValueError` for one that does not exist."""
    modules = [
        _named(layer, weights.get(f"{place}.weight"))
        if isinstance(layer, str)
        else _linear(weights[f"{place}.weight"])
        for place, layer in enumerate(layers)
    ]
    network = nn.Sequential(*modules)
    network.load_state_dict(dict(weights))
    return network


def layers_of(network: nn.Sequential) -> list[int | str]:
    """The layers of a network as a file names them.

    Raises:
        RecipeError: it has layers that such a file cannot hold.
    """
    names, layers = {kind: name for name, kind in ACTIVATIONS.items()}, list[int | str]()
    for module in network:
        if isinstance(module, nn.Linear):
            layers.append(module.out_features)
        elif isinstance(module, nn.Unflatten):
            layers.append(" ".join(map(str, (PICTURE, *module.unflattened_size))))
        elif isinstance(module, nn.Conv2d):
            layers.append(f"{CONVOLUTION} {module.stride[0]}")
        elif isinstance(module, nn.Flatten):
            layers.append(FLATTEN)
        elif type(module) in names:
            layers.append(names[type(module)])
        else:
            raise RecipeError(f"a policy with a layer {type(module).__name__} cannot be saved")
    return layers


def convolution(inputs: int, outputs: int, side: int = 3, stride: int = 2) -> nn.Conv2d:
    """A convolution that keeps the picture's size, divided by the stride and rounded up."""
    return nn.Conv2d(inputs, outputs, side, stride, padding=side // 2)


def _linear(matrix: Tensor) -> nn.Linear:
    return nn.Linear(matrix.shape[1], matrix.shape[0])


def _named(layer: str, weight: Tensor | None) -> nn.Module:
    """The layer of a name; `ValueError` if there is none."""
    name, *numbers = layer.split()
    if layer in ACTIVATIONS:
        return ACTIVATIONS[layer]()
    if layer == FLATTEN:
        return nn.Flatten()
    if name == PICTURE and len(numbers) == 3:
        return nn.Unflatten(1, (*map(int, numbers),))
    if name == CONVOLUTION and len(numbers) == 1 and weight is not None and weight.ndim == 4:
        return convolution(weight.shape[1], weight.shape[0], weight.shape[2], int(numbers[0]))
    raise ValueError(f"there is no layer {layer!r}")
