"""The kinds of templates of `acwm new`, the components they register, and how to use them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Kind:
    """A kind of template; its files are in the folder with its name."""

    registers: str  # kind of the component that the package registers
    summary: str  # summary of the component, for `acwm list`
    use: str  # a command that uses the component, with NAME as its name


KINDS = {
    "environment": Kind(
        "environment",
        "a body that glides over a plane and is pushed",
        "acwm generate NAME --size 64 --episodes 100",
    ),
    "scene": Kind(
        "environment",
        "a box that slides over a floor and is pushed",
        "acwm generate NAME --size 64 --episodes 100",
    ),
    "codec": Kind(
        "codec",
        "every frame by itself: strides 8×8",
        "acwm fit push_cube_small codec=NAME --out runs/NAME",
    ),
    "model": Kind(
        "model",
        "a convolutional denoiser that looks back in time",
        "acwm fit push_cube_small model=NAME --out runs/NAME",
    ),
    "conditioner": Kind(
        "conditioner",
        "a linear layer of the actions of each latent frame",
        "acwm fit push_cube_small conditioner=NAME --out runs/NAME",
    ),
    "objective": Kind(
        "objective",
        "diffusion forcing whose past is never noisier than its future",
        "acwm fit push_cube_small objective=NAME --out runs/NAME",
    ),
    "metric": Kind(
        "metric",
        "mean absolute error of pixels",
        "acwm evaluate RUN 'evaluation.metrics=[NAME]'",
    ),
    "estimator": Kind(
        "estimator",
        "masks and a position, by the colour of a body",
        "acwm evaluate RUN --overwrite",
    ),
    "task": Kind("task", "bring the world to where it once was", "acwm plan RUN NAME"),
    "planner": Kind("planner", "the best of random candidates", "acwm plan RUN TASK planner=NAME"),
}
