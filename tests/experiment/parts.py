"""The components of the evaluation's tests, and a model that waits so that it can be killed."""

import os
import shutil
import signal
import time
from pathlib import Path

import numpy as np

from acwm_core.env.task import Goal, Task
from tests import tiny
from tests.plugins import plugin_of

HOLD = "hold"
"""A file in the working folder: while it is there, a training waits in its fourth step."""

HEARD = "heard"
"""One that the training makes there when it has received a signal in or after that step."""


def noted(handler):
    """The handler of a signal, which also says that it came."""

    def receive(number, frame):
        handler(number, frame)
        Path(HEARD).touch()

    return receive


class WaitingModel(tiny.PointwiseModel):
    """Like `PointwiseModel`; `fails` lets training end in an error."""

    def __init__(self, *, latent_channels: int, width: int = 4, fails: bool = False):
        super().__init__(latent_channels=latent_channels, width=width)
        self.fails, self.steps = fails, 0

    def forward(self, latents, sigma, conditioning):
        self.steps += self.training
        if self.training and self.steps == 4:
            for number in (signal.SIGTERM, signal.SIGUSR1):
                signal.signal(number, noted(signal.getsignal(number)))
        while self.steps >= 4 and Path(HOLD).exists():
            time.sleep(0.01)
        broken = self.training and self.fails and "FIXED" not in os.environ
        return super().forward(latents, sigma, conditioning) * (float("nan") if broken else 1.0)


class Corner(Task):
    """The square in the corner; nobody has a script for it."""

    name, summary, unit = "corner", "the square in the corner", "px"
    tolerance, max_steps = 3.0, 4

    def sample_goal(self, environment, rng):
        environment._position = np.array([2.0, 2.0])
        return Goal.now(environment)

    def distance(self, seen, goal):
        return np.linalg.norm(seen.states["position"] - goal.state["position"], axis=-1)


CORNER = Corner()

Plugin = plugin_of(
    environments={"square": "tests.data.square_world:Square"},  # whose workers need no torch
    codecs={"blocks": "tests.tiny:BlockCodec"},
    models={"waiting": f"{__name__}:WaitingModel"},
    conditioners={"linear": "tests.tiny:SumConditioner"},
    tasks={"square.corner": f"{__name__}:CORNER"},
)


RECIPE = """
env: square
codec: blocks
model: {name: waiting, width: 4}
conditioner: linear
objective: {steps: 2, prediction: clean, loss_on: clean, weighting: none}
data: {path: data/square, clip_frames: 9, batch_size: 2, validation_episodes: 1}
training:
  learning_rate: 1.0e-2
  cpu_threads: 1
  validate_every_n_steps: 10
  checkpoint_every_n_steps: 2
  sample_every_n_steps: 0
trainer: {max_steps: 12, accelerator: cpu}
evaluation:
  frames: 9
  device: cpu
  metrics: [mse, psnr]
  steps_sweep: []
  videos: 0
  counterfactual_episodes: 0
  perturbed_episodes: 0
"""

EXPERIMENT = """
title: Widths
caption: Two widths.
rows:
  narrow: tiny
  wide: tiny model.width=6
data: {square: {episodes: [4, 2, 2]}}
"""


def write_experiment(folder, text=EXPERIMENT, whole=None):
    """A recipe and an experiment beside it, with the data of `whole`, the fixture, if it is given.

    Commands are run in `folder`, too.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if whole:
        shutil.copytree(whole[0] / "data", folder / "data")
    (folder / "tiny.yaml").write_text(RECIPE)
    (folder / "widths.yaml").write_text(text)
    return folder / "widths.yaml"
