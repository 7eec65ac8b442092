"""The variants of learning.py: overrides of the small recipe."""

BASE = "base"
DENOISING = ("objective=full_sequence", "objective.steps=5")
COMMON = (
    "training.optimizer=adamw",
    "training.learning_rate=2e-3",
    "data.batch_size=16",
)
"""Overrides of all variants, before their own ones, and of those that bring no overlay with another
objective: the small recipe before the study."""

NEXT, OWN = "objective=next_frame", "objective.own_past=0.5"
MUON = ("training.optimizer=muon", "training.learning_rate=4e-3")
WHOLE = ("data.clip_frames=301", "data.clip_starts=episode")
RECURRENT = ("+recurrent", "training.optimizer=muon", "training.learning_rate=4e-3")
SLOWER = ("+recurrent", "training.optimizer=muon", "training.learning_rate=2e-3")

FINE = (*SLOWER, "model.channels=96", "codec=fine", "model.patch_size=2")
READING = ("model.blocks=0", "model.reading_blocks=5")
"""The grid stays that of the given frame, and all frames are read from it at once."""
JOINTS = "data.states=[joint_position]"

VARIANTS: dict[str, tuple[str, ...]] = {
    BASE: (),
    "predict velocity, loss on velocity": (
        "objective.prediction=velocity",
        "objective.loss_on=velocity",
    ),
    "predict velocity, loss on clean": ("objective.prediction=velocity", "objective.loss_on=clean"),
    "predict clean, loss on velocity": ("objective.prediction=clean", "objective.loss_on=velocity"),
    "shift 1": ("objective.shift=1",),
    "shift 5": ("objective.shift=5",),
    "shift 100": ("objective.shift=100",),
    "Gaussian weights": ("objective.weighting=gaussian",),
    "published flow": (
        "objective.shift=5",
        "objective.prediction=velocity",
        "objective.loss_on=velocity",
        "objective.weighting=gaussian",
    ),
    "AdamW, half the rate": ("training.learning_rate=1e-3",),
    "AdamW, twice the rate": ("training.learning_rate=4e-3",),
    "Muon": ("training.optimizer=muon",),
    "Muon, half the rate": ("training.optimizer=muon", "training.learning_rate=1e-3"),
    "Muon, twice the rate": ("training.optimizer=muon", "training.learning_rate=4e-3"),
    "Muon, four times the rate": ("training.optimizer=muon", "training.learning_rate=8e-3"),
    "Muon, eight times the rate": ("training.optimizer=muon", "training.learning_rate=16e-3"),
    "cross-attention": ("conditioner=cross_attention",),
    "convolutional actions": ("conditioner.embedding=convolutional",),
    "diffusion forcing": ("objective=diffusion_forcing",),
    "batches of 4": ("data.batch_size=4",),
    "batches of 8": ("data.batch_size=8",),
    "batches of 32": ("data.batch_size=32",),
    "diffusion forcing, Muon": ("objective=diffusion_forcing", "training.optimizer=muon"),
    "diffusion forcing, Muon, twice the rate": (
        "objective=diffusion_forcing",
        "training.optimizer=muon",
        "training.learning_rate=4e-3",
    ),
    "diffusion forcing, Muon, four times the rate": (
        "objective=diffusion_forcing",
        "training.optimizer=muon",
        "training.learning_rate=8e-3",
    ),
    "next frame": (NEXT, *MUON),
    "next frame, own past": (NEXT, OWN, *MUON),
    "whole episodes, diffusion forcing": ("objective=diffusion_forcing", *MUON, *WHOLE),
    "whole episodes, next frame": (NEXT, *MUON, *WHOLE),
    "whole episodes, next frame, own past": (NEXT, OWN, *MUON, *WHOLE),
    "shortcut": ("+shortcut", *MUON),
    "whole episodes, shortcut": ("+shortcut", *MUON, *WHOLE),
    "recurrent": (*RECURRENT, "training.growing_horizon=0", "training.random_starts=0"),
    "recurrent, growing horizon": (*RECURRENT, "training.random_starts=0"),
    "recurrent, growing horizon, random starts": RECURRENT,
    "recurrent, growing horizon, random starts, 96 channels": (*RECURRENT, "model.channels=96"),
    "recurrent, half the rate": SLOWER,
    "fine codec": FINE,
    "fine codec, read at once": (*FINE, *READING),
    "fine codec, read at once, joints": (*FINE, *READING, JOINTS),
    "fine codec, read at once, joints, four frames": (
        *FINE,
        *READING,
        JOINTS,
        "objective.frames=4",
    ),
    "fine codec, one block and three, joints": (
        *FINE,
        "model.blocks=1",
        "model.reading_blocks=3",
        JOINTS,
    ),
}


def overrides(variant: str) -> tuple[str, ...]:
    """All overrides of a variant."""
    own = VARIANTS[variant]
    denoising = () if {"+recurrent", "+shortcut"} & {*own} else DENOISING
    return *COMMON, *denoising, *own
