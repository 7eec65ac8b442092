"""A point that actions move, and a model that knows it: it is best to go straight to the goal."""

import numpy as np
import torch
from torch import nn

from acwm_core.model.dynamics import CarriedStates
from acwm_core.plugins import catalog
from acwm_planning.policies.saved import PolicyCard, PolicyInputs, SavedPolicy
from tests import tiny
from tests.plugins import plugin_of

ROOM = 32 - tiny.SIDE


class Known(tiny.Exact):
    """Also predicts where the square is, and carries it."""

    def carry_states(self, given, generators=()):
        shown = nn.functional.pixel_shuffle(given[:, -1], 8).unflatten(1, (tiny.STRIDE, 3))[:, -1]
        return Corners(tiny.corners_of(shown).float())

    def predict_states(self, given, conditioning, frames, generators=()):
        states = self.carry_states(given)
        return torch.cat(
            [states.advance(conditioning.frames(k - 1, k + 1)) for k in range(1, frames)], 1
        )


class Corners(CarriedStates):
    def __init__(self, corners):
        self._corners = corners

    @property
    def current(self):
        return self._corners

    def advance(self, conditioning):
        passed = []
        for action in conditioning.modulation[:, -1].unflatten(1, (tiny.STRIDE, 2)).unbind(1):
            self._corners = (self._corners + 2 * action).clamp(0, ROOM)
            passed.append(self._corners)
        return torch.stack(passed, 1)

    def picked(self, rows):
        return Corners(self._corners[rows].clone())

    def put(self, rows, others):
        self._corners = self._corners.clone()
        self._corners[rows] = others._corners


Plugin = plugin_of(models={"known": f"{__name__}:Known"})


def register():
    tiny.register()
    if "known_world" not in catalog().plugins:
        catalog().add_plugin(Plugin, "known_world")


def make_run(folder):
    """A run whose model predicts where the square is, as the simulator has it."""
    register()
    return tiny.make_exact_run(folder, "known", states=["position"])


def straight(folder):
    """The best policy, by hand: the scaled action is the way to the goal, as far as a step goes."""
    inputs = PolicyInputs({"position": [2]}, {"position": [2]}, [0.0] * 4, [8.0] * 4, [1.0] * 2)
    network = nn.Sequential(nn.Linear(6, 2), nn.Hardtanh())
    matrix = np.zeros((2, 6), np.float32)  # of where it is, where the goal is, and the change
    matrix[:, :2], matrix[:, 2:4] = -np.eye(2), np.eye(2)
    network[0].weight.data, network[0].bias.data = torch.from_numpy(matrix), torch.zeros(2)
    card = PolicyCard(
        *("slide", "place", tiny.STRIDE, [-2.0, -2.0], [2.0, 2.0], inputs),
        layers=[2, "hardtanh"],
        training={},
    )
    folder.mkdir()
    SavedPolicy(card, network.requires_grad_(False)).save(folder)
    return folder
