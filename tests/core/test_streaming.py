"""Streams of the smallest parts: what goes in, what comes out, what is refused."""

import pytest
import torch
from torch import nn

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import Cache
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.objectives.full_sequence import FullSequence
from acwm_core.model.world_model import WorldModel
from tests.tiny import MeanCodec, PointwiseModel, SumConditioner


class FrameCodec(MeanCodec):
    """Latent frames that are decoded by themselves."""

    memoryless = True


class Counter(Cache):
    """Of a model that looks at no other frame: only their number is kept."""

    def keep(self, frames):
        self.frames += frames


class CausalModel(PointwiseModel):
    """Writes down the noise levels that it is asked for."""

    causal = True

    def __init__(self, **params):
        super().__init__(**params)
        self.asked = []

    def new_cache(self, context):
        return Counter(context)

    def extend(self, latents, sigma, conditioning, cache):
        self.asked.append([cache.frames, *sigma[0].tolist()])
        return self(latents, sigma, conditioning)


class RecentConditioner(Conditioner):
    """Adds a linear map of the mean action of the last three latent steps."""

    history = 3

    def __init__(self, *, action_size, width):
        super().__init__()
        self.embed = nn.Linear(action_size, width)

    def forward(self, actions):
        steps = actions[:, :-1].unflatten(1, (-1, 4)).mean(2)
        recent = nn.functional.pad(steps, (0, 0, 3, 0)).unfold(1, 3, 1).mean(-1)
        return Conditioning(self.embed(recent), None, self)


def small_world(objective=DiffusionForcing, **parts):
    torch.manual_seed(0)
    codec = parts.get("codec", FrameCodec())
    model = parts.get("model", CausalModel(latent_channels=codec.channels))
    conditioner = parts.get("conditioner", RecentConditioner(action_size=2, width=model.width))
    how = objective(prediction="clean", steps=3)
    return WorldModel(codec, model, conditioner, how, [-2.0, -2.0], [2.0, 2.0])


def first_frame(batch=2):
    return torch.rand(batch, 3, 16, 16, generator=torch.Generator().manual_seed(1))


def actions(rows, batch=2):
    return torch.rand(batch, rows, 2, generator=torch.Generator().manual_seed(2)) * 4 - 2


def test_a_step_gives_the_frames_of_its_actions():
    world = small_world()
    stream = world.stream(first_frame())
    torch.testing.assert_close(stream.first, world.codec(first_frame()[:, None])[:, 0])
    for _ in range(3):
        video = stream.step(actions(4))
        assert video.shape == (2, 4, 3, 16, 16)
        assert 0 <= video.min() <= video.max() <= 1


def test_done_frames_are_evaluated_clean_together_with_the_next():
    """With three steps a latent frame takes three evaluations, the first of two frames."""
    world = small_world()
    stream = world.stream(first_frame())
    stream.step(actions(4))
    stream.step(actions(4))
    low, middle = (world.model.asked[k][1] for k in (2, 1))
    assert 0 < low < middle < 1
    expected = [[0, 0, 1], [1, middle], [1, low], [1, 0, 1], [2, middle], [2, low]]
    assert world.model.asked == expected


@pytest.mark.parametrize("rows", [1, 3, 4, 9, 20])
def test_play_gives_a_frame_per_action_whatever_their_number(rows):
    world = small_world()
    chunks = list(world.stream(first_frame()).play(actions(rows)))
    assert sum(chunk.shape[1] for chunk in chunks) == rows
    assert max(chunk.shape[1] for chunk in chunks) <= 4
    full = torch.cat([actions(rows), *[actions(rows)[:, -1:]] * (-rows % 4)], 1)
    stepped = world.stream(first_frame())
    whole = torch.cat([stepped.step(part) for part in full.split(4, 1)], 1)
    torch.testing.assert_close(torch.cat(chunks, 1), whole[:, :rows])


def test_a_conditioner_gets_as_much_of_the_past_as_it_says():
    """Each latent frame alone decides its prediction here, so the whole clip gives the same."""
    world = small_world()
    rows = actions(4 * 8)
    video = torch.cat(list(world.stream(first_frame(), seeds=[3, 4]).play(rows)), 1)
    known = nn.functional.pad(rows, (0, 0, 0, 1))
    conditioning = world.conditioner(world.normalise(known))
    generators = [torch.Generator().manual_seed(seed) for seed in (3, 4)]
    for latent_frame in range(1, 9):
        noise = torch.stack([torch.randn((3, 2, 2), generator=g) for g in generators])[:, None]
        own = conditioning.frames(latent_frame, latent_frame + 1)
        latents = world.objective.sample(
            lambda noisy, sigma, own=own: world.model(noisy, sigma, own), noise, noise[:, :0]
        )
        expected = world.codec.decode(latents.repeat(1, 2, 1, 1, 1))[:, 1:]
        start = 4 * (latent_frame - 1)
        torch.testing.assert_close(video[:, start : start + 4], expected)


def test_steps_and_seeds_are_heeded():
    world = small_world()
    usual = world.stream(first_frame(), seeds=[1, 2]).step(actions(4))
    again = world.stream(first_frame(), seeds=[1, 2], steps=3).step(actions(4))
    torch.testing.assert_close(usual, again)
    for other in ({"seeds": [1, 3]}, {"seeds": [1, 2], "steps": 1}):
        changed = world.stream(first_frame(), **other).step(actions(4))
        assert not torch.allclose(usual[1], changed[1])


def test_wrong_actions_are_refused_and_disturb_nothing():
    world = small_world()
    stream, undisturbed = world.stream(first_frame()), world.stream(first_frame())
    for wrong in (actions(3), actions(4, batch=1), actions(4)[0]):
        with pytest.raises(ShapeError, match=r"a step takes actions \[2, 4, 'A'\]"):
            stream.step(wrong)
    for wrong, sentence in (
        (torch.zeros(2, 4, 3), "2 action dimensions, not 3"),
        (actions(4) * float("nan"), "not finite"),
        (actions(4) + 5, r"out of its bounds \[-2, 2\]: clip it"),
    ):
        with pytest.raises(ShapeError, match=sentence):
            stream.step(wrong)
    with pytest.raises(ShapeError, match=r"actions are \[B, T, A\]"):
        next(stream.play(actions(4)[0]))
    torch.testing.assert_close(stream.step(actions(4)), undisturbed.step(actions(4)))


def test_wrong_actions_between_given_frames_are_refused():
    world, given = small_world(), torch.rand(2, 5, 3, 16, 16)
    world.stream(given, actions(4))
    with pytest.raises(ShapeError, match="not finite"):
        world.stream(given, actions(4) * float("nan"))
    for wrong in (actions(3), actions(4, batch=1)):
        with pytest.raises(ShapeError, match=r"between 5 frames there are actions \[2, 4, 'A'\]"):
            world.stream(given, wrong)


def test_parts_that_cannot_be_streamed_are_refused_with_what_to_do():
    class RemembersAll(Codec):
        channels, spatial_stride, temporal_stride = 3, 8, 4
        _encode, _decode = MeanCodec._encode, MeanCodec._decode
        fingerprint = MeanCodec.fingerprint

    class NoCache(PointwiseModel):
        causal = True

    sums = SumConditioner(action_size=2, temporal_stride=4, width=8, layers=1, heads=1)
    for parts, reason in (
        ({"model": PointwiseModel(latent_channels=3)}, "PointwiseModel has no cache"),
        ({"objective": FullSequence}, "cannot be streamed.*diffusion_forcing"),
        ({"conditioner": sums}, "SumConditioner embeds all actions"),
        ({"model": NoCache(latent_channels=3)}, "NoCache has no cache of earlier frames"),
        ({"codec": RemembersAll()}, "RemembersAll"),
    ):
        with pytest.raises(RecipeError, match=reason):
            small_world(**parts).stream(first_frame())
    with pytest.raises(RecipeError, match="at least 2"):
        small_world().stream(first_frame(), context=1)
    with pytest.raises(ShapeError, match=r"2 first frames .* 1 seeds"):
        small_world().stream(first_frame(), seeds=[1])
