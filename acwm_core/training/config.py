"""Parameters of training. Does not import torch, so that recipes are checked quickly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, cast

from annotated_types import Ge, Gt

from acwm_core.errors import RecipeError, unknown_name
from acwm_core.recipe.types import Fraction, FractionBelowOne, NonNegativeInt, PositiveInt

LOGGERS = {"csv": "", "tensorboard": "", "wandb": "WandbLogger", "mlflow": "MLFlowLogger"}
"""Names that `trainer.logger` accepts, with Lightning's class; the first two are built in."""

TRAINER_FLAGS = (
    *("accelerator", "strategy", "devices", "num_nodes", "precision", "logger", "callbacks"),
    *("fast_dev_run", "max_epochs", "min_epochs", "max_steps", "min_steps", "max_time"),
    *("limit_train_batches", "limit_val_batches", "limit_test_batches", "limit_predict_batches"),
    *("overfit_batches", "val_check_interval", "check_val_every_n_epoch", "num_sanity_val_steps"),
    *("log_every_n_steps", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"),
    *("accumulate_grad_batches", "gradient_clip_val", "gradient_clip_algorithm", "deterministic"),
    *("benchmark", "inference_mode", "use_distributed_sampler", "profiler", "detect_anomaly"),
    *("barebones", "plugins", "sync_batchnorm", "reload_dataloaders_every_n_epochs"),
    *("default_root_dir", "enable_autolog_hparams", "model_registry"),
)
"""The flags of Lightning's Trainer, known here without importing it."""


def chosen_loggers(flags: Mapping[str, Any]) -> list[Any]:
    """The loggers listed in the flag `logger` of the section `trainer`; names are checked.

    Raises:
        RecipeError: a name is not in `LOGGERS`.
    """
    given = flags.get("logger")
    listed = cast(list[Any], given if isinstance(given, list) else [given])
    for logger in listed:
        if isinstance(logger, str) and logger not in LOGGERS:
            raise unknown_name("logger", logger, LOGGERS)
    return [logger for logger in listed if not isinstance(logger, bool | None)]


def check_together(training: Mapping[str, Any], trainer: Mapping[str, Any]) -> None:
    """Check what the sections `training` and `trainer` say together.

    Raises:
        RecipeError: the optimiser does not work with the strategy.
    """
    if training.get("optimizer") == "muon" and trainer.get("strategy") in ("fsdp", "hsdp"):
        raise RecipeError(
            f"training.optimizer=muon needs whole matrices, which trainer.strategy="
            f"{trainer['strategy']} shards: set training.optimizer=adamw or trainer.strategy=ddp"
        )


@dataclass(frozen=True)
class TrainingConfig:
    """The recipe's section `training`: optimiser, schedule, validation, checkpoints and samples.

    Training length, devices, precision and gradient clipping (`gradient_clip_val`) are flags of
    Lightning's Trainer, in the recipe's section `trainer`.

    Attributes:
        optimizer: `adamw`, or `muon` for the matrices within layers and AdamW for all else.
        learning_rate: peak learning rate.
        weight_decay: decoupled weight decay of matrices and convolutions; biases, norms and
            embeddings have none.
        betas: AdamW's two momentum coefficients.
        warmup_steps: steps over which the learning rate rises linearly from 0.
        schedule: what the learning rate does after `decay_start`: stay constant, or fall to 0 at
            `trainer.max_steps`, linearly or as half a cosine.
        decay_start: fraction of `trainer.max_steps` at which it starts to fall.
        growing_horizon: fraction of `trainer.max_steps` over which training clips grow from a few
            latent frames to all. For models that unroll a state: they learn more in the same time
            if short clips come first. 0 trains on whole clips throughout.
        random_starts: fraction of the steps in which a random number of latent frames is cut off
            the start of clips, so that a model trained on whole episodes also starts from frames
            other than the first. A first frame is alone in its latent frame, a later one is not.
        ema_decay: decay of the moving average of the weights; validation, samples and the saved
            model use the average. 0 uses the weights themselves.
        init_from: a run folder, or a trained model's name, whose weights training starts from; by
            default weights are initialised randomly.
        ignore_mismatched_sizes: with `init_from`, take the weights that fit by name and shape, even
            if they were trained on latents of another codec, another rate or other actions, and
            initialise the others randomly.
        seed: seed of initial weights, clip order and noise.
        compile: compile the model with `torch.compile`; pays off after minutes.
        activation_checkpointing: keep only the inputs of each layer and recompute its activations
            for the gradient: a third more computation, for much less memory.
        cpu_threads: threads for CPU arithmetic per process. By default that of OMP_NUM_THREADS; if
            it is not set and one process trains on a CPU, one per core, or per idle core where
            waiting threads cannot be made to sleep. The run's recipe stores that number, and a
            resumed run keeps it.
        validate_every_n_steps: optimiser steps between validations.
        validation_rollouts: number of validation clips that are predicted at each validation, with
            at most 4 sampling steps, to log their similarity to the true ones; 0 for none.
        checkpoint_every_n_steps: optimiser steps between checkpoints, from which a run resumes.
        sample_every_n_steps: optimiser steps between sample videos in the log; 0 for none.
        sample_videos: number of validation clips in the samples.
    """

    optimizer: Literal["adamw", "muon"] = "adamw"
    learning_rate: Annotated[float, Gt(0)] = 1e-4
    weight_decay: Annotated[float, Ge(0)] = 0.01
    betas: tuple[FractionBelowOne, FractionBelowOne] = (0.9, 0.999)
    warmup_steps: NonNegativeInt = 0
    schedule: Literal["constant", "linear", "cosine"] = "constant"
    decay_start: FractionBelowOne = 0.0
    growing_horizon: Fraction = 0.0
    random_starts: Fraction = 0.0
    ema_decay: FractionBelowOne = 0.999
    init_from: str | None = None
    ignore_mismatched_sizes: bool = False
    seed: NonNegativeInt = 0
    compile: bool = False
    activation_checkpointing: bool = False
    cpu_threads: PositiveInt | None = None
    validate_every_n_steps: PositiveInt = 500
    validation_rollouts: NonNegativeInt = 4
    checkpoint_every_n_steps: PositiveInt = 500
    sample_every_n_steps: NonNegativeInt = 2000
    sample_videos: PositiveInt = 4

    def __post_init__(self) -> None:
        object.__setattr__(self, "betas", tuple(self.betas))  # YAML gives lists
        if self.ignore_mismatched_sizes and self.init_from is None:
            raise RecipeError(
                "training.ignore_mismatched_sizes=True needs training.init_from=RUN, "
                "whose weights it concerns"
            )
