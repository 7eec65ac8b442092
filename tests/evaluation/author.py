"""Components as authors break them, each in its own way."""

from dataclasses import replace

import numpy as np

from acwm_core.env.environment import Environment
from acwm_core.evaluation.metric import Metric
from acwm_core.plugins import hookimpl
from tests.tiny import Drift, PointwiseModel


def name_of(target):
    words = "".join(f"_{each.lower()}" if each.isupper() else each for each in target)
    return words.removeprefix("_").removesuffix("_metric")


class World(Drift):
    def __init_subclass__(cls):
        cls.card = replace(Drift.card, name=name_of(cls.__name__))


class RaisingWorld(World):
    def _advance(self, action):
        self.push(action)

    def push(self, action):
        if self._frame_index == 3:
            raise ZeroDivisionError("no\nground")  # line of RaisingWorld
        super()._advance(action)


class UnfinishedWorld(World):
    _contacts = Environment._contacts


class HalfWorld(World):
    def _render(self):
        return super()._render()[0]


class PolicyWorld(World):
    action = staticmethod(lambda: [1.0, 2.0][5])  # line of PolicyWorld

    def policy(self, rng):
        return self.action


class ScalarPolicyWorld(PolicyWorld):
    action = staticmethod(lambda: 0.5)


class LongPolicyWorld(PolicyWorld):
    action = staticmethod(lambda: np.zeros(3))


class FixedSizeWorld(World):
    def __init__(self):
        super().__init__()


class RaisingMetric(Metric):
    name = "raising"

    def per_frame(self, prediction):
        return prediction.states["nothing"]  # line of RaisingMetric


class UnfinishedMetric(Metric):
    name = "unfinished"


class DriftMetric(Metric):
    """Can be measured in another package's environment alone."""

    name = "drift_only"

    def unavailable(self, card, estimator):
        return None if card.name == "drift" else "it is about drifting squares"

    def per_frame(self, prediction):
        return (prediction.video - prediction.target).abs().mean((1, 2, 3)).double().numpy()


class RaisingModel(PointwiseModel):
    def forward(self, latents, sigma, conditioning):
        return latents @ self.enter.weight.T  # line of RaisingModel


TARGETS = {
    "environment": (
        *("RaisingWorld", "UnfinishedWorld", "HalfWorld", "PolicyWorld"),
        *("ScalarPolicyWorld", "LongPolicyWorld", "FixedSizeWorld", "NamelessWorld"),
    ),
    "metric": ("RaisingMetric", "UnfinishedMetric", "DriftMetric"),
    "model": ("RaisingModel",),
}


class plugin:
    """Registers them under their names in small letters."""

    @staticmethod
    @hookimpl
    def register_environments(registry):
        for target in TARGETS["environment"]:
            registry.add(name_of(target), f"{__name__}:{target}")
        registry.add("deleted_world", f"{__name__}.deleted:DeletedWorld")

    @staticmethod
    @hookimpl
    def register_metrics(registry):
        for target in TARGETS["metric"]:
            name = "drift_only" if target == "DriftMetric" else name_of(target)
            registry.add(name, f"{__name__}:{target}")

    @staticmethod
    @hookimpl
    def register_models(registry):
        registry.add("raising_model", f"{__name__}:RaisingModel")
