"""The world model and the codec's public side, on real tiny parts."""

import numpy as np
import pytest
import torch

from acwm_core.errors import RecipeError, ShapeError
from acwm_core.model.objectives.diffusion_forcing import DiffusionForcing
from acwm_core.model.world_model import WorldModel
from tests.tiny import MeanCodec, pointwise_world_model


def first_frame(batch=2):
    return torch.rand(batch, 3, 16, 16, generator=torch.Generator().manual_seed(1))


def actions(batch=2, frames=37, size=2):
    values = torch.rand(batch, frames, size, generator=torch.Generator().manual_seed(2)) * 4 - 2
    values[:, -1] = 0
    return values


@pytest.mark.parametrize("frames", [1, 2, 4, 5, 37, 40, 66, 80])
def test_rollout_gives_a_frame_per_action_row_and_starts_with_the_given_one(frames):
    world = pointwise_world_model()
    video = world.rollout(first_frame(), actions(frames=frames))
    assert video.shape == (2, frames, 3, 16, 16)
    expected = world.codec(first_frame()[:, None])[:, 0]
    torch.testing.assert_close(video[:, 0], expected)
    assert video.min() >= 0
    assert video.max() <= 1


def test_a_clip_does_not_depend_on_its_neighbours_in_the_batch():
    world = pointwise_world_model()
    together = world.rollout(first_frame(), actions(), seeds=[7, 8])
    alone = world.rollout(first_frame()[1:], actions()[1:], seeds=[8])
    torch.testing.assert_close(together[1:], alone)
    other = world.rollout(first_frame()[1:], actions()[1:], seeds=[9])
    assert not torch.allclose(alone, other)


def test_windows_after_several_given_frames_begin_with_the_last_ones_predicted():
    """Five frames are given, two latent ones; a window of 13 predicts 8, the next begins with 5."""
    world = pointwise_world_model()
    given, rows = torch.rand(1, 5, 3, 16, 16), actions(1, 20)
    long = world.rollout(given, rows, window=13, seeds=[3])
    assert long.shape[1] == 20
    torch.testing.assert_close(long[:, :5], world.codec(given))
    generator = torch.Generator().manual_seed(3)
    head = world.codec.decode(world._predict(given, rows[:, :13], None, [generator]))
    latents = world._predict(head[:, -5:], rows[:, 8:], None, [generator])
    tail = world.codec.decode(latents, frames=12)
    torch.testing.assert_close(long, torch.cat([head, tail[:, 5:]], dim=1))


def test_a_model_learns_what_follows_the_frames_that_it_is_given():
    world = pointwise_world_model()
    components = world.codec, world.model, world.conditioner, world.objective
    parts = *components, [-2.0, -2.0], [2.0, 2.0]
    world = WorldModel(*parts, clip_frames=13, context_frames=5)
    latents = world.encode(torch.rand(2, 13, 3, 16, 16))
    changed = latents.clone()
    changed[:, 1] += 1  # the pointwise model predicts each frame by itself

    def loss(values):
        return world.loss(
            values, actions(2, 13), [torch.Generator().manual_seed(s) for s in (1, 2)]
        )

    assert loss(latents) == loss(changed)
    changed[:, 2] += 1
    assert loss(latents) != loss(changed)


@pytest.mark.parametrize(("clip_frames", "context_frames"), [(13, 2), (13, 4), (13, 13), (13, 0)])
def test_given_frames_must_make_whole_latent_frames_and_leave_some(clip_frames, context_frames):
    world = pointwise_world_model()
    components = world.codec, world.model, world.conditioner, world.objective
    parts = *components, [-2.0, -2.0], [2.0, 2.0]
    with pytest.raises(RecipeError, match=rf"data\.context_frames={context_frames} must be 1 plus"):
        WorldModel(*parts, clip_frames=clip_frames, context_frames=context_frames)


def test_actions_are_normalised_by_the_bounds_and_the_last_goes_on_to_a_row_of_raw_zeros():
    world = pointwise_world_model()
    world.action_low.copy_(torch.tensor([0.0, -2.0]))
    raw = torch.tensor([[[0.0, -2.0], [2.0, 2.0], [1.0, 1.0]]])
    prepared = world._prepare(raw, latent_frames=2)
    assert prepared.shape == (1, 5, 2)
    expected = [[-1, -1], [1, 1], [1, 1], [1, 1], [-1, 0]]
    torch.testing.assert_close(prepared[0], torch.tensor(expected, dtype=torch.float32))


def test_a_video_that_ends_within_a_latent_frame_is_that_of_actions_that_go_on():
    """5 frames are two latent frames, of which 4 are predicted from the actions that lead there."""
    world = pointwise_world_model()
    rows = actions(1, 5)
    rows[:, 3] = rows[:, 2]
    whole = world.rollout(first_frame(1), rows, seeds=[3])
    cut = world.rollout(first_frame(1), rows[:, :4], seeds=[3])
    torch.testing.assert_close(cut, whole[:, :4])


def test_loss_reaches_model_and_conditioner_but_not_the_codec():
    world = pointwise_world_model().train()
    assert not world.codec.training
    video = torch.rand(2, 9, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    world.loss(world.encode(video), actions(frames=9), [torch.Generator()] * 2).backward()
    for part in (world.model, world.conditioner):
        assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in part.parameters())
    assert all(not p.requires_grad for p in world.codec.parameters())


def test_a_short_training_learns_what_actions_do():
    """Blocks brighten with the summed action; after training, true actions beat swapped ones."""
    settings = {"prediction": "clean", "loss_on": "clean", "weighting": "none", "shift": 20}
    world = pointwise_world_model(objective=DiffusionForcing, **settings)
    optimizer = torch.optim.Adam(world.parameters(), 1e-2)
    generator = torch.Generator().manual_seed(0)

    def batch(count):
        push = torch.randn(count, 1, 2, generator=generator).clamp(-2, 2).expand(-1, 9, -1) / 8
        time = torch.arange(9)[None, :, None, None, None]
        level = 0.5 + push[:, :1, :1, None, None] * time * 0.5
        return level.expand(count, 9, 3, 16, 16).clamp(0, 1), push

    for _ in range(300):
        video, push = batch(64)
        loss = world.loss(world.encode(video), push, [generator] * len(push))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    video, push = batch(64)
    right = (world.rollout(video[:, 0], push) - video).square().mean()
    swapped = (world.rollout(video[:, 0], push.flip(0)) - video).square().mean()
    assert right < 0.3 * swapped


@pytest.mark.parametrize("seeds", [np.array([7, 8]), torch.tensor([7, 8]), (7, np.uint8(8))])
def test_seeds_may_be_those_of_numpy_and_pytorch(seeds):
    world = pointwise_world_model()
    same = world.rollout(first_frame(), actions(), seeds=[7, 8])
    assert torch.equal(world.rollout(first_frame(), actions(), seeds=seeds), same)


@pytest.mark.parametrize("seeds", [5, "78", 7.5, np.array([7.0, 8.0]), [7, None], [7, 2**64]])
def test_seeds_that_are_none_are_refused(seeds):
    with pytest.raises(ShapeError, match=r"whole number per batch element|more than 64 bits"):
        pointwise_world_model().rollout(first_frame(), actions(), seeds=seeds)


def test_wrong_shapes_are_refused_with_a_sentence():
    world = pointwise_world_model()
    with pytest.raises(ShapeError, match="2 action dimensions, not 3"):
        world.rollout(first_frame(), actions(size=3))
    with pytest.raises(ShapeError, match="1 first frames for 2"):
        world.rollout(first_frame(1), actions())
    with pytest.raises(ShapeError, match="windows of 1"):
        world.rollout(first_frame(), actions(), window=1)
    with pytest.raises(ShapeError, match=r"K = 1 \+ n·4, not \[2, 3, 3, 16, 16\]"):
        world.rollout(torch.rand(2, 3, 3, 16, 16), actions())
    with pytest.raises(ShapeError, match="there are no frames"):
        world.rollout(torch.rand(2, 0, 3, 16, 16), actions())
    with pytest.raises(RecipeError, match="mode='steam' must be one of stream, windows, whole"):
        world.rollout(first_frame(), actions(), mode="steam")
    with pytest.raises(ShapeError, match="4 frames in windows of 37 after 5 given frames"):
        world.rollout(torch.rand(2, 5, 3, 16, 16), actions(2, 4))


WRONG_ACTIONS = [
    (lambda rows: rows * float("nan"), ShapeError, "not finite"),
    (lambda rows: rows.index_fill(1, torch.tensor([1]), float("inf")), ShapeError, "not finite"),
    (lambda rows: rows + torch.tensor([0.0, 4.1]), ShapeError, r"dimension 1 .* \[-2, 2\]: clip"),
    (lambda rows: rows - torch.tensor([4.1, 0.0]), ShapeError, r"dimension 0 .* \[-2, 2\]: clip"),
    (lambda rows: rows[..., :1], ShapeError, "2 action dimensions, not 1"),
]


@pytest.mark.parametrize(("spoil", "error", "sentence"), WRONG_ACTIONS)
def test_actions_that_no_model_was_built_for_are_refused(spoil, error, sentence):
    with pytest.raises(error, match=sentence):
        pointwise_world_model().rollout(first_frame(), spoil(actions()))


def test_actions_at_their_bounds_and_the_last_row_are_taken_as_they_are():
    world, rows = pointwise_world_model(), actions()
    rows[:, 0], rows[:, 1] = 2 + 1e-6, -2
    usual = torch.cat([*world.rollout_chunks(first_frame(), rows)], 1)
    assert torch.equal(world.rollout(first_frame(), rows), usual)
    rows[:, -1] = float("nan")  # it leads to no frame
    assert torch.equal(world.rollout(first_frame(), rows), usual)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda frame: (frame * 255).byte(), r"not torch.uint8: take frames / 255"),
        (lambda frame: frame * 255, r"\[0, 1\], not in \[.*: divide 8-bit values by 255"),
        (lambda frame: frame * 2 - 1, r"\[0, 1\], not in \[-"),
        (lambda frame: frame * float("nan"), r"\[0, 1\], not in \["),
        (lambda frame: frame.permute(0, 2, 3, 1), r"\[B, 3, H, W\]"),
        (lambda frame: frame[0], r"\[B, 3, H, W\]"),
    ],
)
@pytest.mark.parametrize("way", ["rollout", "stream"])
def test_frames_that_are_no_pictures_are_refused(way, spoil, sentence):
    given = {"rollout": (actions(),), "stream": ()}[way]
    with pytest.raises(ShapeError, match=sentence):
        getattr(pointwise_world_model(), way)(spoil(first_frame()), *given)


def test_a_codec_refuses_more_frames_than_its_latents_hold():
    with pytest.raises(ShapeError, match="5 frames, not 6"):
        MeanCodec().decode(torch.zeros(1, 2, 3, 2, 2), frames=6)
    with pytest.raises(ShapeError, match="decodes"):
        MeanCodec().decode(torch.zeros(1, 2, 4, 2, 2))
