"""oneDNN's float32 products against PyTorch's own in float64."""

import pytest
import torch

from acwm_dit import linear
from acwm_dit.linear import Linear

needs_onednn = pytest.mark.skipif(
    not torch.backends.mkldnn.is_available(), reason="this PyTorch has no oneDNN"
)


@pytest.fixture
def onednn(monkeypatch):
    monkeypatch.setattr(linear, "mkl_is_slow", lambda: True)
    monkeypatch.setattr(linear, "SMALL", 0)


def gradients(layer, input, grad):
    out = layer(input.requires_grad_())
    wanted = [input, *layer.parameters()]
    return [out, *torch.autograd.grad(out, wanted, grad)]


@needs_onednn
@pytest.mark.parametrize(("size_in", "size_out"), [(24, 56), (56, 24)])
@pytest.mark.parametrize("bias", [True, False])
def test_values_and_gradients_are_those_of_pytorch(onednn, size_in, size_out, bias):
    torch.manual_seed(0)
    layer = Linear(size_in, size_out, bias=bias)
    input, grad = torch.randn(3, 5, size_in), torch.randn(3, 5, size_out)
    exact = torch.nn.Linear(size_in, size_out, bias=bias).double()
    exact.load_state_dict(layer.state_dict())
    for ours, theirs in zip(
        gradients(layer, input, grad),
        gradients(exact, input.detach().double(), grad.double()),
        strict=True,
    ):
        torch.testing.assert_close(ours, theirs.float(), rtol=1e-5, atol=1e-5)


@needs_onednn
def test_frozen_weights_and_inputs_get_no_gradient(onednn):
    layer = Linear(8, 4).requires_grad_(False)
    input = torch.randn(2, 8, requires_grad=True)
    layer(input).sum().backward()
    assert input.grad is not None
    assert layer.weight.grad is None
    layer.requires_grad_(True)
    layer(input.detach()).sum().backward()
    assert layer.weight.grad is not None


@needs_onednn
def test_autocast_and_float64_are_left_to_pytorch(onednn):
    layer, input = Linear(8, 4), torch.randn(2, 8)
    with torch.autocast("cpu", torch.bfloat16):
        assert layer(input).dtype == torch.bfloat16
    assert layer.double()(input.double()).dtype == torch.float64


@needs_onednn
def test_without_gradients_the_values_are_the_same(onednn):
    layer, input = Linear(8, 4), torch.randn(2, 8)
    with torch.no_grad():
        torch.testing.assert_close(layer(input), layer(input.requires_grad_()).detach())
    with torch.inference_mode():
        assert layer(input).is_inference()


def test_small_products_are_left_to_pytorch(monkeypatch):
    def refuse(*_):
        raise AssertionError("a product this small takes longer to start than to do")

    monkeypatch.setattr(linear, "mkl_is_slow", lambda: True)
    monkeypatch.setattr(linear, "_times_transposed", refuse)
    Linear(8, 4)(torch.randn(2, 8))


@needs_onednn
@pytest.mark.parametrize("autocast", [False, True])
def test_gelu_is_the_same_with_and_without_gradients(onednn, autocast):
    torch.manual_seed(0)
    layer, input = Linear(24, 56), torch.randn(3, 5, 24)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        trained = linear.linear_gelu(layer, input)
        with torch.no_grad():
            sampled = linear.linear_gelu(layer, input)
    assert trained.requires_grad
    assert sampled.dtype == trained.dtype == (torch.bfloat16 if autocast else torch.float32)
    exact = torch.nn.functional.gelu(layer.double()(input.double()), approximate="tanh")
    tolerance = 2e-2 if autocast else 1e-5
    for ours in (trained, sampled):
        torch.testing.assert_close(ours.double(), exact, rtol=tolerance, atol=tolerance)
