"""A loop of one's own: what it saves, its noise, and the page that shows it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import acwm
from acwm_core.data.card import DatasetCard
from tests import tiny
from tests.tiny import pointwise_world_model

PAGE = Path(__file__).parents[2] / "docs" / "python.md"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    tiny.register()
    folder = tmp_path_factory.mktemp("loop")
    data = tiny.make_dataset(folder / "data")
    return tiny.make_run(folder / "run", data), data


def test_a_saved_model_loads_as_it_was(run, tmp_path):
    recipe = acwm.load(run[0]).recipe
    card = acwm.EpisodeDataset(run[1], "train").card
    torch.manual_seed(3)
    trained = acwm.build_world_model(recipe, card)
    saved = acwm.save(tmp_path / "mine", recipe, card, trained, step=5)
    again = acwm.load(saved)
    assert again.recipe == recipe
    assert again.card == card.environment
    for name, value in trained.state_dict().items():
        assert torch.equal(again.world_model.state_dict()[name], value), name
    with pytest.raises(acwm.AcwmError, match="holds a run already: choose another folder"):
        acwm.save(saved, recipe, card, trained)


def test_a_world_model_is_built_from_either_card(run):
    recipe, card = acwm.load(run[0]).recipe, DatasetCard.read(run[1])
    built = [acwm.build_world_model(recipe, each) for each in (card, card.environment)]
    assert torch.equal(built[0].action_low, built[1].action_low)
    assert built[0].action_low.tolist() == [-2.0, -2.0]


def test_the_noise_of_a_loss_follows_torchs_seed():
    world_model = pointwise_world_model()
    latents, actions = torch.randn(3, 4, 3, 2, 2), torch.zeros(3, 13, 2)

    def loss(seed):
        torch.manual_seed(seed)
        return world_model.loss(latents, actions).item()

    assert loss(0) == loss(0) != loss(1)
    torch.manual_seed(0)
    seeds = torch.randint(2**62, (3,)).tolist()
    generators = [torch.Generator().manual_seed(seed) for seed in seeds]
    assert world_model.loss(latents, actions, generators).item() == loss(0)


def test_planners_tasks_and_environments_by_name():
    planner = acwm.make_planner("cem", horizon=2, action_block=1, candidates=64, elites=8)
    planner.reset()
    wanted = torch.tensor([0.5, -0.25])
    low, high = torch.tensor([-1.0, -1.0]), torch.tensor([1.0, 1.0])
    plan = planner.plan(
        lambda actions: (actions - wanted).square().sum((1, 2)),
        low,
        high,
        torch.Generator().manual_seed(0),
    )
    assert (plan.actions - wanted).abs().max() < 0.1
    assert acwm.make_task("reacher", "reach").unit == "m"
    for make in (acwm.make_planner, acwm.make_env, lambda name: acwm.make_task("reacher", name)):
        with pytest.raises(acwm.AcwmError, match="unknown"):
            make("nonsuch")


@pytest.mark.ci
def test_the_page_runs_as_it_is_written(tmp_path):
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    assert len(blocks[0].splitlines()) < 30
    proof = (
        "import sys\n"
        "assert 'lightning' not in sys.modules\n"
        "assert video.shape == (1, 13, 3, 64, 64) and 0 <= video.min() and video.max() <= 1\n"
        "assert loss.isfinite() and summary.splits and plan.evaluations > 0\n"
        # Alone it is computed in another order than beside other candidates.
        "again = cost(plan.actions[None]).item()\n"
        "assert abs(plan.cost - again) < 1e-5 * again, (plan.cost, again)\n"
    )
    code = "\n".join([*blocks, proof])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
