"""Predictions with one known fault each, made from a true video `[T, 3, H, W]` in [0, 1].

All begin with the true first frame, as it is given to every model.
"""

import numpy as np
import torch
from torch.nn.functional import pad


def late(true, frames=3):
    """Right, but some frames late."""
    return true[(torch.arange(len(true)) - frames).clamp(0)]


def one_frame_late(true):
    return late(true, 1)


def frozen(true):
    """The first frame, repeated."""
    return true[:1].expand_as(true)


def black(true):
    return _given(true, torch.zeros_like(true))


def dark(true):
    """All of it at a fifth of its brightness."""
    return _given(true, 0.2 * true)


def flickering(true):
    """Every second frame black."""
    return torch.where(torch.arange(len(true))[:, None, None, None] % 2 == 1, 0, true)


def median(true):
    """What each pixel shows most of the time: what moves is gone."""
    return _given(true, true.median(0, keepdim=True).values.expand_as(true))


def vanishing(true, share=0.25):
    """Right for a quarter of the time; then there is nothing."""
    return torch.where(_after(true, share), 0, true)


def stopped(true, share=0.25):
    """Right for a quarter of the time; then it stands still."""
    return true[torch.arange(len(true)).clamp(max=int(np.ceil(share * len(true))) - 1)]


def emptied(true, share=0.5):
    """Right for half of the time; then what moves is gone."""
    return torch.where(_after(true, share), median(true)[1:2], true)


def hazy(true):
    """Fading more and more into the mean of all frames."""
    share = torch.linspace(0, 0.8, len(true))[:, None, None, None]
    return (1 - share) * true + share * true.mean(0, keepdim=True)


def noisy(true):
    noise = torch.from_numpy(np.random.default_rng(0).normal(0, 0.1, true.shape))
    return _given(true, (true + noise.float()).clamp(0, 1))


def shifted(true, share=0.1):
    """Moved aside by a tenth of the frame."""
    by = round(share * true.shape[-1])
    return _given(true, pad(true, (by, 0, 0, 0), mode="replicate")[..., : true.shape[-1]])


def swapped(true):
    """Red, green and blue swapped."""
    return _given(true, true[:, [1, 2, 0]])


def mirrored(true):
    return _given(true, true.flip(-1))


CRAFTED = {
    make.__name__: make
    for make in (
        one_frame_late,
        late,
        frozen,
        black,
        dark,
        flickering,
        median,
        vanishing,
        stopped,
        emptied,
        hazy,
        noisy,
        shifted,
        swapped,
        mirrored,
    )
}
"""How to make each of them."""


def _given(true, made):
    return torch.cat([true[:1], made[1:]])


def _after(true, share):
    return (torch.arange(len(true)) >= share * len(true))[:, None, None, None]
