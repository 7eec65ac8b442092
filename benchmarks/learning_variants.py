"""The variants of learning.py: overrides of the small recipe."""

BASE = "base"
COMMON = (
    "flow.objective=full_sequence",
    "flow.steps=5",
    "training.optimizer=adamw",
    "training.learning_rate=2e-3",
    "data.batch_size=16",
)
"""Overrides of all variants, before their own ones: the small recipe before the study."""

NEXT, OWN = "flow.objective=next_frame", "flow.own_past=0.5"
MUON = ("training.optimizer=muon", "training.learning_rate=4e-3")
WHOLE = ("data.clip_frames=301", "data.clip_starts=episode")
RECURRENT = ("+recurrent", "training.optimizer=muon", "training.learning_rate=4e-3")
SLOWER = ("+recurrent", "training.optimizer=muon", "training.learning_rate=2e-3")

VARIANTS: dict[str, tuple[str, ...]] = {
    BASE: (),
    "predict velocity, loss on velocity": ("flow.prediction=velocity", "flow.loss_on=velocity"),
    "predict velocity, loss on clean": ("flow.prediction=velocity", "flow.loss_on=clean"),
    "predict clean, loss on velocity": ("flow.prediction=clean", "flow.loss_on=velocity"),
    "shift 1": ("flow.shift=1",),
    "shift 5": ("flow.shift=5",),
    "shift 100": ("flow.shift=100",),
    "Gaussian weights": ("flow.weighting=gaussian",),
    "published flow": (
        "flow.shift=5",
        "flow.prediction=velocity",
        "flow.loss_on=velocity",
        "flow.weighting=gaussian",
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
    "diffusion forcing": ("flow.objective=diffusion_forcing",),
    "batches of 4": ("data.batch_size=4",),
    "batches of 8": ("data.batch_size=8",),
    "batches of 32": ("data.batch_size=32",),
    "diffusion forcing, Muon": ("flow.objective=diffusion_forcing", "training.optimizer=muon"),
    "diffusion forcing, Muon, twice the rate": (
        "flow.objective=diffusion_forcing",
        "training.optimizer=muon",
        "training.learning_rate=4e-3",
    ),
    "diffusion forcing, Muon, four times the rate": (
        "flow.objective=diffusion_forcing",
        "training.optimizer=muon",
        "training.learning_rate=8e-3",
    ),
    "next frame": (NEXT, *MUON),
    "next frame, own past": (NEXT, OWN, *MUON),
    "whole episodes, diffusion forcing": ("flow.objective=diffusion_forcing", *MUON, *WHOLE),
    "whole episodes, next frame": (NEXT, *MUON, *WHOLE),
    "whole episodes, next frame, own past": (NEXT, OWN, *MUON, *WHOLE),
    "recurrent": (*RECURRENT, "training.growing_horizon=0", "training.random_starts=0"),
    "recurrent, growing horizon": (*RECURRENT, "training.random_starts=0"),
    "recurrent, growing horizon, random starts": RECURRENT,
    "recurrent, growing horizon, random starts, 96 channels": (*RECURRENT, "model.channels=96"),
    "recurrent, half the rate": SLOWER,
}
