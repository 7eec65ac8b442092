"""A recurrent model that draws one of several futures, and the score that teaches it to."""

import functools

import numpy as np
import pytest
import torch
from torch import nn

from acwm_core.checks import check_model
from acwm_core.errors import RecipeError
from acwm_core.model.conditioner import Conditioning
from acwm_core.model.objectives.objective import Batch
from acwm_core.model.objectives.regression import Regression
from acwm_recurrent.energy_score import EnergyScore, distance
from acwm_recurrent.recurrent import RecurrentModel

SMALL = {"channels": 16, "width": 64, "blocks": 1}
COIN = 0.7
"""How often the coin of `tossed` shows +1."""


def tossed(clips, seed):
    """Clips whose frames after the first are all +1 or all −1, which nothing foretells."""
    generator = torch.Generator().manual_seed(seed)
    coins = torch.where(torch.rand(clips, generator=generator) < COIN, 1.0, -1.0)
    latents = coins[:, None, None, None, None].repeat(1, 4, 1, 4, 4)
    latents[:, 0] = 0
    numbers = [torch.Generator().manual_seed(seed + clip) for clip in range(clips)]
    return Batch(latents, Conditioning(torch.zeros(clips, 4, SMALL["width"]), None, None), numbers)


def trained(model, objective, steps=250):
    objective.check_model(model)
    optimizer = torch.optim.Adam(model.parameters(), 1e-2)
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 1e-2 * (1 - step / steps)
        optimizer.zero_grad()
        objective.loss(model, tossed(64, 1000 * step), 1).backward()
        optimizer.step()
    return model.eval()


@torch.no_grad()
def drawn(model, objective, clips=400):
    """Frames of many draws of the same future, `[clips, 3]`, each the mean of its pixels."""
    batch = tossed(clips, 10**6)
    beginning = Batch(batch.latents[:, :1], batch.conditioning, batch.generators)
    return objective.predict(model, beginning, 4)[:, 1:].mean((2, 3, 4)).numpy()


def test_draws_fall_where_futures_do_as_often_and_stay_there():
    torch.manual_seed(0)
    model = RecurrentModel(latent_channels=1, noise=1, **SMALL)  # one coin, one number
    objective = EnergyScore()
    seen = drawn(trained(model, objective), objective)
    assert np.mean(np.abs(np.abs(seen) - 1) < 0.2) > 0.9
    assert np.mean(np.sign(seen) == np.sign(seen[:, :1])) > 0.99  # a draw does not change its mind
    assert np.mean(seen > 0) == pytest.approx(COIN, abs=0.1)
    torch.manual_seed(0)
    mean = trained(RecurrentModel(latent_channels=1, **SMALL), Regression())
    assert drawn(mean, Regression()).mean() == pytest.approx(2 * COIN - 1, abs=0.1)


def test_the_score_is_least_for_draws_of_the_true_distribution():
    """Over single cells it is known: E|x − y| − ½ E|x − x′|, each a mean of absolute values."""
    generator = torch.Generator().manual_seed(0)
    truth, *draws = torch.randn(3, 20_000, 1, 1, 4, 4, generator=generator)

    def score(spread, shift=0.0):
        first, second = (spread * each + shift for each in draws)
        near = distance(first, truth) + distance(second, truth)
        return ((near - distance(first, second)) / 2).item()

    assert score(1.0) < min(score(0.8), score(1.25), score(0.0), score(1.0, 0.3))
    apart = torch.full((5, 2, 3, 4, 4), 3.0)
    assert distance(apart, torch.zeros_like(apart)).item() == pytest.approx(3.0, rel=1e-5)


def test_a_model_that_draws_conforms():
    def drawing(*, latent_channels):
        model = {**SMALL, "noise": 4, "reading_blocks": 1}
        return RecurrentModel(latent_channels=latent_channels, **model)

    results = [*check_model(drawing)]
    assert [each.name for each in results if not each.passed] == []
    tried = {each.name for each in results if not each.reason}
    assert {
        "draws from the generators if it says so",
        "returns only the frames asked for",
        "streams what it predicts",
    } <= tried


def test_a_draw_is_taken_by_agent_and_stream_alike():
    torch.manual_seed(0)
    model = RecurrentModel(latent_channels=3, state_size=4, noise=5, **SMALL).eval()
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.2)
    given, modulation = torch.randn(2, 1, 3, 8, 8), torch.randn(2, 4, SMALL["width"])

    def numbers():
        return [torch.Generator().manual_seed(clip) for clip in range(2)]

    whole = model(given, Conditioning(modulation, None, None), 4, generators=numbers())
    stream = model.stream(given, context=2, generators=numbers())
    frames = [
        stream.advance(Conditioning(modulation[:, first:stop], None, None))
        for first, stop in ((0, 2), (1, 3), (2, 4))
    ]
    torch.testing.assert_close(torch.cat(frames, 1), whole)
    states = [
        functools.reduce(
            lambda state, frame: model.step(state, modulation[:, frame])[0],
            range(1, 4),
            model.start(given, modulation[:, 0], (torch.randn(2, 5),)),
        )
        for _ in range(2)
    ]
    torch.testing.assert_close(states[0].agent, states[1].agent)  # what it knows is no draw
    assert not torch.equal(states[0].grid, states[1].grid)


def test_only_models_that_draw_are_taught_to():
    with pytest.raises(RecipeError, match=r"set model\.noise=32"):
        EnergyScore().check_model(RecurrentModel(latent_channels=3, **SMALL))
    with pytest.raises(RecipeError, match=r"set objective=energy_score, or model\.noise=0"):
        Regression().check_model(RecurrentModel(latent_channels=3, noise=4, **SMALL))
