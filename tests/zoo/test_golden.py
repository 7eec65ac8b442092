"""The models that ship predict what they predicted, to rounding."""

import pytest
import torch

from tests.zoo import golden


@pytest.fixture(scope="module")
def stored():
    return golden.read()


@pytest.mark.parametrize("name", golden.MODELS)
def test_a_shipped_model_predicts_what_it_did(name, stored):
    found = golden.predicted(name, stored[f"{name}.frame"])
    for kind, values in found.items():
        torch.testing.assert_close(
            values, stored[f"{name}.{kind}"], rtol=1e-4, atol=1e-5, equal_nan=True
        )
