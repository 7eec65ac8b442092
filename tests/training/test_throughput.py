"""Speeds that training tells loggers, and the operations that they are shares of."""

import pytest
from lightning.pytorch.loggers.logger import Logger

from acwm_core.training import throughput
from acwm_core.training.fit import fit
from acwm_core.training.run_folder import RunFolder
from acwm_core.training.throughput import operations
from tests.tiny import tiny_recipe, tiny_world_model
from tests.training.runs import numbers


class Kept(Logger):
    """Keeps the speeds that it is told."""

    told: list = []  # noqa: RUF012
    name = version = ""

    def log_hyperparams(self, *_, **__):
        pass

    def log_metrics(self, metrics, step=None):
        if any(name.startswith("speed/") for name in metrics):
            self.told.append((step, metrics))


def test_operations_are_those_of_the_products():
    """Of two layers on 4 latent pixels of 5 frames, and of the embedded actions, one per frame.

    A product costs as much again for the gradient of its weights, and for that of its input unless
    the input is data.
    """
    world = tiny_world_model()
    places = 5 * 2 * 2
    enter, leave = places * 4 * 8, places * 8 * 3
    embed = sum(p.numel() for n, p in world.conditioner.named_parameters() if "weight" in n) * 5
    assert operations(world, 9, (16, 16)) == 2 * (2 * enter + 3 * leave + 2 * embed)


def test_speeds_are_told_where_metrics_are_logged(data, tmp_path, monkeypatch):
    """With a device whose peak is known; they are not in metrics.csv."""
    monkeypatch.setattr(throughput, "get_available_flops", lambda *_: 10**9)
    Kept.told.clear()
    logger = {"class_path": "tests.training.test_throughput.Kept"}
    flags = {"log_every_n_steps": 4, "precision": "32-true", "logger": logger}
    run = RunFolder(fit(tiny_recipe(data, trainer=flags), tmp_path / "run"))
    assert [step for step, _ in Kept.told] == [3, 7, 11, 15]
    made = operations(tiny_world_model(), 9, (16, 16))
    for _, told in Kept.told:
        clips = told["speed/clips_per_second"]
        assert told["speed/frames_per_second"] == pytest.approx(9 * clips)
        assert told["speed/model_flops_utilisation"] == pytest.approx(made * clips / 1e9)
    assert not any(name.startswith("speed/") for _, name in numbers(run))
