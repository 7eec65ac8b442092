"""Training, rollouts, streams and plans on an accelerator that does not exist (`pretended`).

Whatever uses tensors of two devices fails here as on a GPU, and a training step must not wait for
the device.
"""

import copy
import re

import numpy as np
import pytest
import torch

from acwm_core.checks.trial import shaken
from acwm_core.errors import RecipeError, TrainingError
from acwm_core.model.build import build_world_model
from acwm_core.model.objectives.flow import FlowMatching
from acwm_core.plugins import catalog
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from acwm_planning.futures import GoalCost, History, ModelRollouts
from acwm_planning.gradient import Gradient
from tests import tiny
from tests.checks.results import installed
from tests.codecs.tiny_autoencoders import save_tiny_codecs
from tests.training.parts import combinations, recipe
from tests.training.pretended import NAME, Pretended, Waits, WrongDeviceError
from tests.training.runs import numbers, weights

DEVICE = f"{NAME}:0"


def callback(name, **init_args):
    return {"class_path": f"tests.training.{name}", "init_args": init_args}


STEPS = callback("pretended.Steps")
FLAGS = {"strategy": callback("pretended.PretendedStrategy"), "callbacks": [STEPS]}


def trained(made, folder):
    """Train on the pretended device: the run, and what its steps waited for, by their number."""
    with Waits() as waits:
        run = RunFolder(fit(made, folder))
    return run, waits.noted


@pytest.mark.parametrize("parts", combinations())
def test_steps_do_not_wait_for_the_device(parts, data, tmp_path):
    """But where metrics are logged, in the third; validation and samples work there, too."""
    run, noted = trained(recipe(data, *parts, trainer=FLAGS), tmp_path / "run")
    assert [noted.get(step) for step in (1, 3, 4)] == [None] * 3
    assert noted[2]
    assert (run.samples / "step-0000006.gif").exists()
    assert float(numbers(run)["5", "val/loss"]) > 0


def test_it_trains_as_the_cpu_does(data, tmp_path):
    """With the same noise; attention alone is computed in another way."""
    parts = combinations()[0].values[0]
    run, _ = trained(recipe(data, *parts, trainer=FLAGS), tmp_path / "run")
    flags = {"accelerator": "cpu"}
    other = RunFolder(fit(recipe(data, *parts, trainer=flags), tmp_path / "other"))
    ours, theirs = weights(run), weights(other)
    assert not any(isinstance(each, Pretended) for each in ours.values())
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-5)


def test_muon_does_not_wait_either(data, tmp_path):
    made = recipe(data, *combinations()[0].values[0], {"optimizer": "muon"}, FLAGS)
    noted = trained(made, tmp_path / "run")[1]
    assert not {1, 3, 4} & {*noted}


FAULTS = {
    "mean.*a number is read": lambda x: x.mean().item(),
    "branch.*a number is read": lambda x: bool(x.mean() > 0),
    "copy.*a copy to the CPU": lambda x: x.cpu(),
    "table.*not page-locked": lambda x: torch.zeros(3).to(x.device, non_blocking=True),
    "float.*not page-locked": lambda x: torch.tensor(0.5, device=x.device),
    "mask.*what a mask selects": lambda x: x[x > 0],
}
"""Ways to wait, each with a pattern of what is noted."""


def spoil(monkeypatch, fault):
    """Let `fault` look at the latents of every step."""
    right = FlowMatching.error

    def error(self, evaluate, clean, *others):
        fault(clean)
        return right(self, evaluate, clean, *others)

    monkeypatch.setattr(FlowMatching, "error", error)


@pytest.mark.parametrize("pattern", FAULTS)
def test_whatever_waits_is_noted(pattern):
    latents = torch.rand(2, 3)
    with Waits() as waits:
        there = latents.to(DEVICE)
        waits.place = pattern.partition(".")[0]
        FAULTS[pattern](there)
    ((place, (what, *_)),) = waits.noted.items()
    assert re.match(pattern, f"{place}: {what}")


def test_a_step_that_waits_is_found(data, tmp_path, monkeypatch):
    """By its number, with the line."""
    spoil(monkeypatch, lambda clean: clean.mean().item())
    noted = trained(recipe(data, *combinations()[0].values[0], trainer=FLAGS), tmp_path / "run")[1]
    for step in (1, 3, 4):
        (what,) = noted[step]
        assert re.search(r"a number is read, at .*acwm_.*\.py:\d+", what)


def test_tensors_of_two_devices_do_not_meet(data, tmp_path, monkeypatch):
    spoil(monkeypatch, lambda clean: clean * torch.ones(clean.shape[-1]))
    made = recipe(data, *combinations()[0].values[0], trainer=FLAGS)
    with pytest.raises(WrongDeviceError, match=r"aten\.mul"):
        trained(made, tmp_path / "run")


def test_a_nan_stops_training_when_it_is_looked_at(data, tmp_path):
    """Where it is saved or logged, in step 4; until then nothing was saved of what came after."""
    flags = {**FLAGS, "callbacks": [callback("callbacks.Poison", batch=3)]}
    often = {"checkpoint_every_n_steps": 2}
    made = recipe(data, *combinations()[0].values[0], often, flags)
    with pytest.raises(TrainingError, match=r"not finite in step 3 "):
        trained(made, tmp_path / "run")
    assert all(each.isfinite().all() for each in weights(RunFolder(tmp_path / "run")).values())


def world_of(parts, codec=None):
    """A world model with weights at random, and a copy on the pretended device."""
    made = recipe("", *parts)
    world = shaken(build_world_model(made, tiny.TinyWorld.card)).eval()
    return world


def moved(world):
    return copy.deepcopy(world).to(DEVICE)


def same(ours, theirs):
    assert isinstance(ours, Pretended)
    torch.testing.assert_close(ours.held, theirs, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("parts", combinations())
def test_rollouts_and_streams_stay_on_the_device(parts):
    world = world_of(parts)
    first, actions = torch.rand(2, 3, 16, 16), torch.rand(2, 9, 2) * 8 - 4
    with Waits(), torch.no_grad():
        there = moved(world)
        for mode in ("whole", "windows", "stream"):
            options = {"mode": mode, "window": 5, "steps": 2}
            try:
                expected = world.rollout(first, actions, **options)
            except RecipeError:
                assert mode == "stream"
                continue
            same(there.rollout(first.to(DEVICE), actions.to(DEVICE), **options), expected)


@pytest.mark.parametrize("parts", combinations())
def test_plans_are_made_there(parts):
    """Costs and gradients by the model; planners themselves are on the CPU."""
    world = world_of(parts)
    environment = tiny.TinyWorld()
    frame, _ = environment.reset(options={"spec": tiny.spec(0)})
    history = History(tiny.spec(0), [frame])
    still = np.zeros(2, np.float32)

    def judge(futures, task, goal):
        """How far the last frame is from the first, in latents and in pixels."""
        away = futures.latents([1]) - futures.still(frame)
        seen = futures.video([1]) - futures.video([0])
        return away.square().flatten(1).mean(1) + 0.1 * seen.square().flatten(1).mean(1)

    def planned(model):
        rollouts = ModelRollouts(model, environment.card, None, steps=2)
        cost = rollouts.cost(history, still, GoalCost(judge, None, None), 0)
        planner = Gradient(candidates=2, iterations=2, horizon=2, action_block=2)
        low, high = (torch.tensor(each) for each in ((-4.0, -4.0), (4.0, 4.0)))
        return planner.plan(cost, low, high, torch.Generator().manual_seed(0))

    expected = planned(world)
    with Waits():
        made = planned(moved(world))
    torch.testing.assert_close(made.actions, expected.actions, rtol=1e-2, atol=1e-2)
    assert made.cost == pytest.approx(expected.cost, rel=1e-2)


@pytest.fixture(scope="module")
def codec_weights(tmp_path_factory):
    return save_tiny_codecs(tmp_path_factory.mktemp("codecs"))


CODECS = [each for each in installed("codec") if not each.name.startswith("autoencoder_")]


@pytest.mark.parametrize("part", CODECS, ids=lambda part: part.name)
def test_codecs_encode_and_decode_there(part, request):
    needs = {"weights": request.getfixturevalue("codec_weights")[part.name]} if part.extra else {}
    codec = catalog().create("codec", part.name, **needs).eval()
    video = torch.rand(2, 9, 3, 16, 16)
    with torch.no_grad():
        latents = codec.encode(video)
        decoded = codec.decode(latents)
        with Waits():
            there = moved(codec)
            same(there.encode(video.to(DEVICE)), latents)
            same(there.decode(latents.to(DEVICE)), decoded)
            decode = there.frame_decoder()
            parts = [decode(each) for each in latents.to(DEVICE).split(1, 1)]
            same(torch.cat(parts, 1), decoded)
