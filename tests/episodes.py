"""What tests say of episodes."""

import numpy as np


def assert_same(one, other):
    """All that two episodes hold is equal, in values and types."""
    assert one.states.keys() == other.states.keys()
    pairs = {name: (one.states[name], other.states[name]) for name in one.states}
    for name in ("video", "actions", "masks", "contacts"):
        pairs[name] = getattr(one, name), getattr(other, name)
    for name, (first, second) in pairs.items():
        assert first.dtype == second.dtype, name
        np.testing.assert_array_equal(first, second, name)
    assert one.factors == other.factors
    assert one.ood_label == other.ood_label
