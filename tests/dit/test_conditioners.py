"""Which actions reach which latent frame, and how."""

import pytest
import torch

from acwm_core.errors import RecipeError, ShapeError
from acwm_dit.adaln import AdaLN
from acwm_dit.cross_attention import CrossAttention, GatedAttention

FIT = {"width": 16, "layers": 2, "heads": 2}
KINDS = [AdaLN, CrossAttention]


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def build(kind=AdaLN, action_size=2, temporal_stride=4, **params):
    return kind(action_size=action_size, temporal_stride=temporal_stride, **FIT, **params)


def embedded(conditioner, actions):
    conditioning = conditioner(actions)
    if conditioning.modulation is not None:
        return conditioning.modulation
    return conditioning.context.squeeze(2)


def seen(conditioner, frames, latent_frames):
    """For each latent frame, the action rows that its embedding depends on."""
    actions = torch.randn(1, frames, 2, requires_grad=True)
    out = embedded(conditioner, actions)
    assert out.shape == (1, latent_frames, FIT["width"])
    rows = []
    for frame in range(latent_frames):
        (gradient,) = torch.autograd.grad(out[0, frame].sum(), actions, retain_graph=True)
        rows.append(gradient[0].abs().sum(-1).nonzero().flatten().tolist())
    return rows


@pytest.mark.parametrize("kind", KINDS)
def test_stacked_sees_exactly_the_actions_of_its_step(kind):
    rows = seen(build(kind), 13, 4)
    assert rows == [[], [0, 1, 2, 3], [4, 5, 6, 7], [8, 9, 10, 11]]


def test_stacked_at_other_strides():
    assert seen(build(temporal_stride=1), 4, 4) == [[], [0], [1], [2]]
    assert seen(build(temporal_stride=3), 7, 3) == [[], [0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize("kind", KINDS)
def test_convolutional_sees_what_its_docstring_says(kind):
    rows = seen(build(kind, embedding="convolutional"), 13, 4)
    assert rows == [[0, 1, 2, 3], list(range(1, 8)), list(range(5, 12)), [9, 10, 11, 12]]


@pytest.mark.parametrize("stride", [1, 2, 8])
def test_convolutional_at_any_power_of_two(stride):
    conditioner = build(temporal_stride=stride, embedding="convolutional")
    assert embedded(conditioner, torch.randn(3, 1 + 2 * stride, 2)).shape == (3, 3, 16)


@pytest.mark.parametrize("embedding", ["stacked", "convolutional"])
def test_a_single_frame_has_an_embedding(embedding):
    assert embedded(build(embedding=embedding), torch.zeros(2, 1, 2)).shape == (2, 1, 16)


def test_order_of_actions_within_a_step_matters():
    conditioner = build()
    actions = torch.randn(1, 5, 2)
    swapped = actions[:, [1, 0, 2, 3, 4]]
    assert not torch.allclose(embedded(conditioner, actions), embedded(conditioner, swapped))


def test_convolutional_refuses_other_strides():
    with pytest.raises(RecipeError, match="power of two"):
        build(temporal_stride=3, embedding="convolutional")


def test_unknown_embedding_is_refused():
    with pytest.raises(RecipeError, match="stacked, convolutional"):
        build(embedding="convolution")


@pytest.mark.parametrize("shape", [(1, 5, 3), (1, 6, 2), (5, 2), (1, 0, 2)])
def test_wrong_actions_are_refused(shape):
    with pytest.raises(ShapeError, match="actions must"):
        build()(torch.zeros(shape))


def test_adaln_leaves_tokens_alone():
    conditioning = build()(torch.randn(1, 5, 2))
    tokens = torch.randn(1, 2, 3, 16)
    assert conditioning.context is None
    assert conditioning.inject(0, tokens) is tokens


def test_fresh_cross_attention_changes_nothing():
    conditioning = build(CrossAttention)(torch.randn(1, 5, 2))
    tokens = torch.randn(1, 2, 3, 16)
    assert conditioning.modulation is None
    assert torch.equal(conditioning.inject(0, tokens), tokens)


def test_cross_attention_reaches_only_its_own_frame():
    conditioner = build(CrossAttention)
    torch.nn.init.ones_(conditioner.attentions[1].gate)
    tokens, actions = torch.randn(1, 3, 4, 16), torch.randn(1, 9, 2)
    before = conditioner(actions).inject(1, tokens)
    actions[:, 5] += 1  # an action of latent frame 2
    change = (conditioner(actions).inject(1, tokens) - before).abs().amax((0, 2, 3))
    assert (change > 1e-5).tolist() == [False, False, True]


def test_gated_attention_is_attention_over_the_context():
    """Against torch's own multi-head attention with the same weights and several tokens."""
    ours = GatedAttention(16, 2, 16)
    torch.nn.init.constant_(ours.gate, 0.7)
    theirs = torch.nn.MultiheadAttention(16, 2, batch_first=True)
    with torch.no_grad():
        theirs.in_proj_weight.copy_(torch.cat([ours.query.weight, ours.key_value.weight]))
        theirs.in_proj_bias.zero_()
        theirs.out_proj.load_state_dict(ours.out.state_dict())
    tokens, context = torch.randn(2, 3, 5, 16), torch.randn(2, 3, 4, 16)
    query, key = ours.norm_tokens(tokens).flatten(0, 1), ours.norm_context(context).flatten(0, 1)
    expected = tokens + torch.tensor(0.7).tanh() * theirs(query, key, key)[0].view_as(tokens)
    torch.testing.assert_close(ours(tokens, context), expected)


@pytest.mark.parametrize("embedding", ["stacked", "convolutional"])
def test_every_parameter_of_cross_attention_is_in_the_graph(embedding):
    """Distributed training stops at a parameter that gets no gradient at all."""
    conditioner = build(CrossAttention, embedding=embedding)
    tokens = torch.randn(1, 2, 3, 16)
    conditioning = conditioner(torch.randn(1, 5, 2))
    for layer in range(2):
        tokens = conditioning.inject(layer, tokens)
    tokens.sum().backward()
    assert all(parameter.grad is not None for parameter in conditioner.parameters())
