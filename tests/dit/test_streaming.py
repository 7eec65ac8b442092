"""A stream equals the computation that keeps nothing, whatever its length, and stays small."""

import pytest
import torch
from torch.nn import functional

from acwm_core.errors import RecipeError
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_dit import blocks
from acwm_dit.attention import temporal_rotation
from acwm_dit.dit import DiT

CONTEXT = 3
FIT = {"width": 32, "layers": 3, "heads": 2}


def small_world(conditioner="adaln", stride=4, seed=0, **params):
    """Weights are random everywhere, so that nothing is zero or the identity."""
    torch.manual_seed(seed)
    codec = catalog().create("codec", "identity", temporal_stride=stride)
    model = DiT(latent_channels=codec.channels, causal=True, **FIT)
    embedder = catalog().create(
        "conditioner", conditioner, action_size=2, temporal_stride=stride, **FIT, **params
    )
    for part in (model, embedder):
        for parameter in part.parameters():
            torch.nn.init.normal_(parameter, std=0.15)
    objective = DiffusionForcing(prediction="clean", steps=2)
    return WorldModel(codec, model, embedder, objective, [-1.0, 0.0], [1.0, 4.0]).eval()


def beginning(batch=2, given=1):
    return torch.rand(batch, given, 3, 32, 48, generator=torch.Generator().manual_seed(1))


def actions(latent_steps, stride=4, batch=2):
    return torch.rand(batch, latent_steps * stride, 2, generator=torch.Generator().manual_seed(2))


def streamed(world, rows, context=CONTEXT, given=1):
    between, later = rows[:, : given - 1], rows[:, given - 1 :]
    stream = world.stream(beginning(given=given), between, context=context, seeds=[5, 6])
    return torch.cat([stream.given, *stream.play(later)], 1)


@torch.no_grad()
def computed_anew(world, rows, context=CONTEXT, given=1):
    """Every evaluation over all frames since the start, by plain attention with a band mask."""
    band = BandAttention(context)
    stride = world.codec.temporal_stride
    generators = [torch.Generator().manual_seed(seed) for seed in (5, 6)]
    done = world.codec.encode(beginning(given=given))
    for latent_step in range((given - 1) // stride, rows.shape[1] // stride):
        known = functional.pad(rows[:, : (latent_step + 1) * stride], (0, 0, 0, 1))
        conditioning = world.conditioner(world.normalise(known))
        noise = torch.stack([torch.randn(done.shape[2:], generator=g) for g in generators])

        def denoise(noisy, sigma, past=done, conditioning=conditioning):
            everything = torch.cat([past, noisy], 1)
            levels = functional.pad(sigma, (past.shape[1], 0))
            with band:
                return world.model(everything, levels, conditioning)[:, -1:]

        new = world.objective.sample(denoise, noise[:, None], done[:, :0])
        done = torch.cat([done, new], 1)
    return world.codec.decode(done)


class BandAttention:
    """While open, temporal attention is a softmax over the last `context` frames."""

    def __init__(self, context):
        self.context = context

    def __enter__(self):
        self.usual = blocks.attend
        blocks.attend = self.attend

    def __exit__(self, *_):
        blocks.attend = self.usual

    def attend(self, query, key, value, *, causal=False):
        scores = query @ key.transpose(-1, -2) / query.shape[-1] ** 0.5
        if causal:
            places = torch.arange(scores.shape[-1])
            distance = places[:, None] - places
            outside = (distance < 0) | (distance >= self.context)
            scores = scores.masked_fill(outside, float("-inf"))
        return scores.softmax(-1) @ value


@pytest.mark.parametrize(
    ("conditioner", "params"),
    [
        ("adaln", {}),
        ("cross_attention", {}),
        ("adaln", {"embedding": "convolutional"}),
        ("cross_attention", {"embedding": "convolutional", "stride": 1}),
        ("adaln", {"stride": 2}),
    ],
)
def test_a_stream_far_longer_than_its_context_equals_the_uncached_computation(conditioner, params):
    world = small_world(conditioner, **params)
    rows = actions(4 * CONTEXT, params.get("stride", 4))
    video = streamed(world, rows)
    torch.testing.assert_close(video, computed_anew(world, rows), rtol=0, atol=1e-5)
    assert (video[:, 1:] - video[:, :-1]).abs().mean() > 0.01


@pytest.mark.parametrize("context", [CONTEXT, 2])
@pytest.mark.parametrize("conditioner", ["adaln", "cross_attention"])
def test_a_stream_goes_on_from_several_given_frames(conditioner, context):
    """Nine are given, three latent ones, be they within the context or not."""
    world, rows = small_world(conditioner), actions(4 * CONTEXT)
    video = streamed(world, rows, context, given=9)
    anew = computed_anew(world, rows, context, given=9)
    torch.testing.assert_close(video, anew, rtol=0, atol=1e-5)
    other = rows.clone()
    other[:, 4:8] = -other[:, 4:8]  # between the given frames
    changed = (video - streamed(world, other, context, given=9)).abs().amax((0, 2, 3, 4))
    assert not changed[:9].any()
    assert changed[9] > 1e-5


def test_the_comparison_can_fail():
    """Each thing that the cache must get right shows in the video."""
    world, rows = small_world(), actions(3 * CONTEXT)
    video = streamed(world, rows)
    assert (video - computed_anew(world, rows, CONTEXT + 1)).abs().max() > 1e-3
    other = rows.clone()
    other[:, 3] = torch.tensor([0.0, 4.0]) - other[:, 3]
    changed = (video - streamed(world, other)).abs().amax((0, 2, 3, 4))
    assert not changed[0]
    assert (changed[1 : 1 + 4 * CONTEXT] > 1e-4).all()


def test_within_the_context_it_is_the_model_as_it_was_trained():
    """No mask and no cache: the plain causal model over the clip, with a clean past."""
    world, rows = small_world(), actions(CONTEXT - 1)
    stream = world.stream(beginning(), context=CONTEXT, seeds=[5, 6])
    seen = []
    extend = world.model.extend

    def recorded(latents, sigma, conditioning, cache):
        predicted = extend(latents, sigma, conditioning, cache)
        seen.append((latents[:, -1:], sigma[:, -1:], predicted[:, -1:]))
        return predicted

    world.model.extend = recorded
    past = world.codec.encode(beginning())
    for latent_step in range(CONTEXT - 1):
        seen.clear()
        decoded = stream.step(rows[:, 4 * latent_step :][:, :4])
        known = functional.pad(rows[:, : 4 * (latent_step + 1)], (0, 0, 0, 1))
        conditioning = world.conditioner(world.normalise(known))
        for noisy, sigma, predicted in seen:
            levels = functional.pad(sigma, (past.shape[1], 0))
            with torch.no_grad():
                whole = world.model(torch.cat([past, noisy], 1), levels, conditioning)
            torch.testing.assert_close(predicted, whole[:, -1:], rtol=0, atol=1e-5)
        past = torch.cat([past, stream._latents.last], 1)
        torch.testing.assert_close(world.codec.decode(past)[:, -4:], decoded)


def test_memory_does_not_grow():
    world = small_world()
    stream = world.stream(beginning(), context=CONTEXT)
    sizes = []
    for _ in range(3 * CONTEXT):
        stream.step(actions(1))
        kept = {part.untyped_storage().data_ptr(): part for part in stream._latents.cache.tensors()}
        assert not any(part.requires_grad for part in kept.values())
        sizes.append(sum(part.untyped_storage().nbytes() for part in kept.values()))
    assert sizes[0] < sizes[CONTEXT - 2] == sizes[CONTEXT - 1] == sizes[-1]
    tokens, channels, layers, float32 = 2 * 3, FIT["width"], FIT["layers"], 4
    one_frame = 2 * tokens * channels * layers * float32  # keys and values
    assert sizes[-1] == 2 * one_frame * (CONTEXT - 1)  # of two batch elements
    assert len(stream._recent) == 2


def test_positions_stay_exact_for_days():
    """Ten million frames on; float32 angles would be off by half a radian."""
    query, key = torch.randn(2, 16)
    scores = []
    for first in (0, 10_000_001):
        turn = temporal_rotation(CONTEXT, 16, torch.device("cpu"), first)
        scores.append(turn(query.expand(CONTEXT, 16)) @ turn(key.expand(CONTEXT, 16)).T)
    torch.testing.assert_close(scores[1], scores[0], rtol=0, atol=1e-5)


def test_elements_of_a_batch_are_streams_of_their_own():
    world, rows = small_world(), actions(6)
    both = streamed(world, rows)
    alone = world.stream(beginning()[1:], context=CONTEXT, seeds=[6])
    torch.testing.assert_close(torch.cat(list(alone.play(rows[1:])), 1), both[1:, 1:])


def test_two_streams_of_one_model_do_not_disturb_each_other():
    world, rows = small_world(), actions(6)
    alone = streamed(world, rows)
    first, second = (world.stream(beginning(), context=CONTEXT, seeds=[5, 6]) for _ in range(2))
    for start in range(0, 24, 4):
        one = first.step(rows[:, start : start + 4])
        second.step(1 - rows[:, start : start + 4])
        torch.testing.assert_close(one, alone[:, 1 + start : 5 + start])


def test_bfloat16_stays_near_float32():
    world, rows = small_world(), actions(2 * CONTEXT)
    exact = streamed(world, rows)
    with torch.autocast("cpu", torch.bfloat16):
        rough = streamed(world, rows)
    assert (rough - exact).abs().mean() < 0.05 * exact.std()


def test_a_stream_under_inference_mode_leaves_the_model_trainable():
    """Rotary tables are kept from call to call, and training cannot use what that mode made."""
    world = small_world()
    frame = torch.rand(1, 3, 16, 80)  # a size of its own, as tables are kept by size
    with torch.inference_mode():
        world.stream(frame).step(actions(1, batch=1))
    latents = world.encode(frame[:, None].expand(-1, 5, -1, -1, -1))
    world.loss(latents, torch.zeros(1, 5, 2), [torch.Generator()]).backward()
    assert world.model.blocks[0].temporal.qkv.weight.grad.any()


def test_a_model_that_looks_ahead_is_refused():
    world = small_world()
    bidirectional = DiT(latent_channels=world.codec.channels, **FIT)
    with pytest.raises(RecipeError, match="causal=true"):
        bidirectional.new_cache(CONTEXT)
    with pytest.raises(RecipeError, match="at least 2"):
        world.stream(beginning(), context=1)
