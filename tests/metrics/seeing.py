"""An estimator that sees exactly what a test says, and clips to go with it."""

import numpy as np
import torch

from acwm_core.env.environment import ActionSpec, EnvironmentCard
from acwm_core.env.physics import Observation, Physics, StateEstimator
from acwm_core.evaluation.metric import Prediction

SIDE = 32


class Oracle(StateEstimator):
    """Sees one observation, whatever the video."""

    def __init__(self, card, physics, observation):
        super().__init__(card)
        self._physics, self.observation = physics, observation
        self.fields = tuple(observation.states)

    @property
    def physics(self):
        return self._physics

    def estimate(self, video):
        return self.observation

    def pixels(self, field, values):
        return np.asarray(values, np.float64)[..., :2] * 100


def card_of(instances, fps=10):
    return EnvironmentCard(
        name="test",
        summary="",
        action=ActionSpec(("x",), ("",), (-1.0,), (1.0,), "absolute"),
        frame_size=(SIDE, SIDE),
        fps=fps,
        horizon=100,
        factors=(),
        ood_shifts=(),
        state=(),
        instances=("ground", *instances),
        engine="",
    )


def clip(physics=None, *, seen=None, true=None, states=None, read=None, contacts=(), names=()):
    """A prediction in which `seen` masks and `read` states are observed; the truth unless given."""
    true = seen if true is None else true
    frames = len(true) if true is not None else len(next(iter((states or read).values())))
    true = np.zeros((frames, SIDE, SIDE), np.uint8) if true is None else true
    seen, states = true if seen is None else seen, states or {}
    card = card_of(names)
    observation = Observation(seen, states | (read or {}))
    video = torch.arange(frames)[:, None, None, None] / frames * torch.ones(3, SIDE, SIDE)
    return Prediction(
        video=video,
        target=video,
        actions=np.zeros((frames, 1), np.float32),
        states=states,
        masks=true,
        contacts=np.array(contacts, np.int32).reshape(-1, 3),
        card=card,
        estimator=Oracle(card, physics or Physics(), observation),
    )


def boxes(frames, *places, size=6):
    """Masks `[T, H, W]` with a square of ids 1, 2, … at each (row, column), None for none."""
    masks = np.zeros((frames, SIDE, SIDE), np.uint8)
    for instance, place in enumerate(places, 1):
        if place is not None:
            row, column = place
            masks[:, row : row + size, column : column + size] = instance
    return masks
