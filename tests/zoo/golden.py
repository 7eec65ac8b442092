"""What the models that ship predicted on 2026-11-29, before scenes were declared.

`python -m tests.zoo.golden` made `tests/reference/golden_latents.safetensors` from the simulators:
the first frame of an episode, and of what each model makes of it and of random actions every 11th
number.
"""

from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

import acwm

FILE = Path(__file__).parents[1] / "reference" / "golden_latents.safetensors"
EVERY, FRAMES = 11, 13
MODELS = (
    *("push_cube", "push_cube_128", "push_cube_draws", "push_sand", "push_rope", "cloth_move"),
    *("robot_arm", "stack_cube", "reacher", "pour_water"),
)
PREDICT_STATES = ("push_cube", "push_cube_draws", "push_rope", "cloth_move")
"""Those that predicted states then."""


def random_actions(card) -> torch.Tensor:
    low, high = (torch.tensor(bound) for bound in (card.action.low, card.action.high))
    shares = torch.rand(FRAMES, card.action.size, generator=torch.Generator().manual_seed(3))
    return (low + shares * (high - low))[None]


@torch.no_grad()
def predicted(name: str, frame: torch.Tensor) -> dict[str, torch.Tensor]:
    """Numbers of the latents and, of some, of the states that a model predicts."""
    _, card, world_model = acwm.load(name)
    given, actions = frame[None].permute(0, 3, 1, 2) / 255, random_actions(card)
    found = {"latents": world_model.predict_latents(given, actions, seeds=[5])}
    if name in PREDICT_STATES:
        found["states"] = states(world_model, given, actions)
    return {kind: values.flatten()[::EVERY].clone() for kind, values in found.items()}


def states(world_model, given, actions) -> torch.Tensor:
    """The states that a model predicts, `[1, T, S]`."""
    length = world_model.codec.latent_frames(FRAMES)
    rows = world_model._prepare(actions, length)
    conditioning = world_model.conditioner.condition(rows, length, world_model.model.width)
    drawing = {"generators": [torch.Generator().manual_seed(5)]} if world_model.samples else {}
    latents = world_model.encode(given[:, None])
    return world_model.model.predict_states(latents, conditioning, length, **drawing)


def main() -> None:
    """Write the file anew."""
    from acwm_core.data.simulate import make_environment

    tensors = {}
    for name in MODELS:
        _, card, _ = acwm.load(name)
        environment = make_environment(card.name, {"size": card.frame_size})
        frame = torch.from_numpy(environment.reset(seed=1)[0].copy())
        environment.close()
        tensors |= {f"{name}.frame": frame}
        tensors |= {f"{name}.{kind}": value for kind, value in predicted(name, frame).items()}
    save_file(tensors, FILE)


def read() -> dict[str, torch.Tensor]:
    return load_file(FILE)


if __name__ == "__main__":
    main()
