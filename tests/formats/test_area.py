"""Frames shrink by exact area averaging, to sizes a dataset can have."""

import numpy as np
import pytest
from PIL import Image

from acwm_core.errors import DataError, ShapeError
from acwm_formats.sizes import shrunk, target_size


def by_hand(frame, size):
    """Every pixel repeated until the new ones cover whole pixels, then averaged."""
    height, width = frame.shape[:2]
    large = frame.repeat(size[0], 0).repeat(size[1], 1).astype(np.float64)
    return large.reshape(size[0], height, size[1], width, 3).mean((1, 3))


@pytest.mark.parametrize("size", [(24, 16), (40, 48), (16, 48), (40, 32), (24, 32)])
def test_each_pixel_is_the_mean_of_what_it_covers(size):
    frame = np.random.default_rng(0).integers(0, 256, (40, 48, 3), np.uint8)
    small = shrunk(frame, size)
    assert small.dtype == np.uint8
    assert np.abs(small - by_hand(frame, size)).max() <= 0.501


def test_whole_factors_agree_with_pillow():
    frame = np.random.default_rng(1).integers(0, 256, (96, 64, 3), np.uint8)
    expected = np.asarray(Image.fromarray(frame).reduce(4))
    assert np.abs(shrunk(frame, (24, 16)).astype(int) - expected).max() <= 1


def test_sizes_are_multiples_of_eight_and_never_larger():
    assert target_size((480, 641)) == (480, 640)
    assert target_size((1024, 1024), 240) == (240, 240)
    assert target_size((240, 400), 120) == (120, 200)
    assert target_size((100, 100), (64, 96)) == (64, 96)
    with pytest.raises(DataError, match="cannot be enlarged"):
        target_size((64, 64), 128)
    with pytest.raises(DataError, match="too small"):
        target_size((15, 64))
    with pytest.raises(ShapeError, match="multiple of 8"):
        target_size((64, 64), 60)
