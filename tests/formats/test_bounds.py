"""Bounds of recorded actions: of what moves, of what does not, and without outliers."""

import numpy as np

from acwm_formats.bounds import action_bounds, outliers


def test_the_range_and_a_place_for_what_never_moves():
    rows = np.array([[-2, 5], [1, 5], [3, 5]], np.float32)
    low, high = action_bounds(rows, quantile=False)
    assert low.tolist() == [-2, 4]
    assert high.tolist() == [3, 6]


def test_quantiles_leave_out_a_hundredth_at_either_end():
    rows = np.append(np.linspace(-1, 1, 200), 1000).astype(np.float32)[:, None]
    (told,) = outliers(rows, ("push",))
    assert "push" in told
    low, high = action_bounds(rows, quantile=True)
    assert -1 <= low[0] <= -0.97
    assert 0.97 <= high[0] <= 1
