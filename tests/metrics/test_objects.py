"""Sharpness, colours and numbers of objects, by changes whose effect is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from acwm_core.env.physics import Gap, Physics
from acwm_metrics.objects import ColourError, ObjectCountError, PermanenceAfterContact
from acwm_metrics.sharpness import Sharpness
from tests.metrics.seeing import boxes, clip

FRAMES = 6
TRUE = boxes(FRAMES, (3, 3), (20, 20))
NAMES = ("a", "b", "c")
SOLID = Physics(objects=NAMES)


def pictured(seen=TRUE, paint=lambda video: None):
    """A clip whose objects are noise in two colours, and a prediction painted differently."""
    noise = torch.from_numpy(np.random.default_rng(0).uniform(-0.1, 0.1, (FRAMES, 3, 32, 32)))
    target = torch.full((FRAMES, 3, 32, 32), 0.1)
    for instance, colour in ((1, (0.9, 0.2, 0.2)), (2, (0.2, 0.2, 0.8))):
        own = torch.from_numpy(instance == TRUE)[:, None]
        target = torch.where(own, torch.tensor(colour)[:, None, None] + noise.float(), target)
    video = target.clone()
    paint(video)
    return replace(clip(SOLID, seen=seen, true=TRUE, names=NAMES), video=video, target=target)


def test_half_the_gradient_is_a_quarter_of_the_energy_and_so_is_twice():
    for factor in (0.5, 2.0):
        seen = pictured(paint=lambda video, factor=factor: video.mul_(factor))
        assert Sharpness().per_frame(seen) == pytest.approx(np.full(FRAMES, 0.25))
    assert Sharpness().value(pictured()) == 1


def test_what_vanished_is_not_sharp_and_has_no_colour():
    def empty(video):
        video[3:, :, 19:27, 19:27] = 0.1

    seen = np.where((TRUE == 2) & (np.arange(FRAMES) >= 3)[:, None, None], 0, TRUE)
    assert Sharpness().per_frame(pictured(seen, empty)) == pytest.approx([1] * 3 + [0.5] * 3)
    errors = ColourError().per_frame(pictured(seen, empty))
    assert errors == pytest.approx([0] * 3 + [0.5] * 3)
    assert ColourError().coverage(pictured(seen, empty), errors) == 0.75
    assert ObjectCountError().per_frame(pictured(seen, empty)).tolist() == [0] * 3 + [1] * 3


def test_colours_are_compared_wherever_things_are():
    moved = boxes(FRAMES, (3, 3), (20, 8))

    def move(video):
        own = video[:, :, 20:26, 20:26] + torch.tensor([0.3, 0, 0])[:, None, None]
        video[:, :, 20:26, 20:26] = 0.1
        video[:, :, 20:26, 8:14] = own

    assert ColourError().value(pictured(moved, move)) == pytest.approx(0.3 / 3**0.5 / 2)


def test_one_gone_and_one_made_up_are_two_errors():
    assert ObjectCountError().value(pictured(boxes(FRAMES, (3, 3), None, (20, 20)))) == 2
    doubled = np.where(boxes(FRAMES, (3, 20)) == 1, 1, TRUE)
    assert ObjectCountError().value(pictured(doubled)) == 1


def test_permanence_counts_from_the_first_contact_on():
    physics = replace(SOLID, gaps=(Gap("pair", ("a", "b"), lambda s, _: s.states["gap"], touch=0),))
    seen = np.where((TRUE == 2) & (np.arange(FRAMES) == 4)[:, None, None], 0, TRUE)
    states = {"gap": np.ones(FRAMES)}
    for contacts, value in (([(2, 1, 2)], 0.75), ([(0, 1, 2)], np.nan), ([], np.nan)):
        hit = clip(physics, seen=seen, true=TRUE, states=states, contacts=contacts, names=NAMES)
        assert PermanenceAfterContact().value(hit) == pytest.approx(value, nan_ok=True)
