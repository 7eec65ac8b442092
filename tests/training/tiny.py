"""The smallest real parts: a codec, a model and a conditioner that train in milliseconds."""

import hashlib
import json
import os
import signal
from pathlib import Path

import numpy as np
import torch
from lightning.pytorch.callbacks import Callback
from torch import nn

from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import Denoiser
from acwm_core.model.objectives.full_sequence import FullSequence
from acwm_core.model.world_model import WorldModel
from acwm_core.recipe import Recipe
from acwm_core.training.optimizers import local
from tests.plugins import plugin_of


class TinyWorld(Environment):
    """A white square on grey that moves by its action."""

    card = EnvironmentCard(
        name="tiny_world",
        summary="a square that moves by its action",
        action=ActionSpec(("dx", "dy"), ("px", "px"), (-4.0, -4.0), (4.0, 4.0), "delta"),
        frame_size=(16, 16),
        fps=10,
        horizon=12,
        factors=(),
        ood_shifts=(),
        state=(StateField("position", (2,), "px", "of the square's corner"),),
        instances=("background", "square"),
        engine="numpy",
    )

    def _start(self, factors, rng):
        self._position = rng.uniform(0, 12, 2)

    def _advance(self, action):
        self._position = np.clip(self._position + action, 0, 12)

    def _render(self):
        frame, mask = np.full((16, 16, 3), 60, np.uint8), np.zeros((16, 16), np.uint8)
        row, column = self._position.astype(int)
        frame[row : row + 4, column : column + 4] = 255
        mask[row : row + 4, column : column + 4] = 1
        return frame, mask

    def _state(self):
        return {"position": self._position.copy()}

    def _contacts(self):
        return []

    def policy(self, rng):
        return lambda: rng.uniform(-4, 4, 2)


class TinyCodec(Codec):
    """Folds 8×8 pixels into channels and mixes the colours' means by a fixed, frozen matrix."""

    channels = 3
    spatial_stride = 8
    temporal_stride = 2

    def __init__(self, *, gain: float = 2.0) -> None:
        super().__init__()
        self.gain = gain
        self.mix = nn.Parameter(torch.tensor([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]))

    def _encode(self, video):
        small = nn.functional.avg_pool3d(video, (1, 8, 8))[:, ::2]
        return torch.einsum("blchw,dc->bldhw", (small - 0.5) * self.gain, self.mix)

    def _decode(self, latents):
        small = torch.einsum("bldhw,dc->blchw", latents, self.mix) / self.gain + 0.5
        video = small.repeat_interleave(8, -1).repeat_interleave(8, -2)
        return video.repeat_interleave(2, 1)[:, 1:]

    def fingerprint(self):
        values = [self.gain, *self.mix.flatten().tolist()]
        return hashlib.sha256(repr(values).encode()).hexdigest()[:16]


class TinyConditioner(Conditioner):
    """The actions of a latent step, concatenated, through one linear layer."""

    def __init__(self, *, action_size, temporal_stride, width, layers, heads) -> None:
        super().__init__()
        self.stride = temporal_stride
        self.embed = nn.Linear(action_size * temporal_stride, width)

    def forward(self, actions):
        batch, frames, size = actions.shape
        padded = nn.functional.pad(actions[:, : frames - 1], (0, 0, self.stride, 0))
        grouped = padded.reshape(batch, -1, self.stride * size)
        return Conditioning(self.embed(grouped), None, self)


class TinyModel(Denoiser):
    """Two 1×1 convolutions with dropout, a norm and a table of embeddings; layers if asked for."""

    layers = 1
    heads = 1

    def __init__(
        self, *, latent_channels: int, width: int = 8, dropout: float = 0.1, depth: int = 0
    ) -> None:
        super().__init__()
        self.width = width
        self.enter = nn.Linear(latent_channels + 1, width)
        self.norm = nn.LayerNorm(width)
        self.position = nn.Embedding(64, width)
        self.dropout = nn.Dropout(dropout)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width))
            for _ in range(depth)
        )
        self.leave = nn.Linear(width, latent_channels)

    def forward(self, latents, sigma, conditioning):
        level = sigma[:, :, None, None, None].expand_as(latents[:, :, :1])
        tokens = self.enter(torch.cat([latents, level], 2).permute(0, 1, 3, 4, 2))
        frames = torch.arange(latents.shape[1], device=latents.device)
        tokens = tokens + (conditioning.modulation + self.position(frames))[:, :, None, None]
        tokens = self.dropout(nn.functional.silu(self.norm(tokens)))
        for block in self.blocks:
            tokens = tokens + block(tokens)
        return self.leave(tokens).permute(0, 1, 4, 2, 3)


class Killed(Exception):
    """What `Kill` raises, unlike any error of ours."""


class Kill(Callback):
    """Ends training before a batch, or in a validation from that batch on, when a test says so."""

    batch: int | None = None
    in_validation = False
    error: type[BaseException] = Killed

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if not self.in_validation and trainer.fit_loop.total_batch_idx == self.batch:
            raise self.error

    def on_validation_batch_start(self, trainer, *_):
        reached = self.batch is not None and trainer.fit_loop.total_batch_idx >= self.batch
        if self.in_validation and reached:
            raise self.error


class Die(Callback):
    """Ends this process by SIGKILL before a batch."""

    def __init__(self, batch: int) -> None:
        self._batch = batch

    def on_train_batch_start(self, trainer, *_):
        if trainer.fit_loop.total_batch_idx == self._batch and not os.environ.get("SPARED"):
            os.kill(os.getpid(), signal.SIGKILL)


class Signal(Callback):
    """Sends this process a signal before a batch, or within a validation from that batch on."""

    def __init__(
        self, batch: int, rank: int = 0, number: int = signal.SIGTERM, validation: bool = False
    ) -> None:
        self._batch, self._rank, self._number, self._validation = batch, rank, number, validation

    def on_train_batch_start(self, trainer, *_):
        if not self._validation and trainer.fit_loop.total_batch_idx == self._batch:
            self._send(trainer)

    def on_validation_batch_start(self, trainer, *_):
        if self._validation and trainer.fit_loop.total_batch_idx == self._batch:
            self._send(trainer)

    def _send(self, trainer):
        if trainer.global_rank == self._rank and not os.environ.get("SPARED"):
            os.kill(os.getpid(), self._number)


class Stop(Callback):
    """Asks for the end of training after a batch, as Lightning's Timer does."""

    def __init__(self, batch: int) -> None:
        self._batch = batch

    def on_train_batch_end(self, trainer, *_):
        if trainer.fit_loop.total_batch_idx == self._batch and not os.environ.get("SPARED"):
            trainer.should_stop = True


class Poison(Callback):
    """Makes the loss of a batch infinite through its actions, on one rank."""

    def __init__(self, batch: int, rank: int = 0) -> None:
        self._batch, self._rank = batch, rank

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        if batch_idx == self._batch and trainer.global_rank == self._rank:
            batch["actions"].mul_(float("inf"))


class Witness(Callback):
    """Writes down the first action of every clip that a rank trains on, one line per batch."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        with (self._folder / f"rank-{trainer.global_rank}.jsonl").open("a") as file:
            file.write(json.dumps(batch["actions"][:, 0].tolist()) + "\n")


class Weigh(Callback):
    """Writes down the bytes that this rank holds of weights, gradients, moments and averages."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)

    def on_before_optimizer_step(self, trainer, pl_module, optimizer):
        states = [value for state in optimizer.state.values() for value in state.values()]
        parameters = [p for group in optimizer.param_groups for p in group["params"]]
        held = {
            "weights": parameters,
            "gradients": [parameter.grad for parameter in parameters],
            "optimizer": [value for value in states if value.ndim],  # not the numbers of steps
            "average": [
                *pl_module.averaged.model.parameters(),
                *pl_module.averaged.conditioner.parameters(),
            ],
        }
        if trainer.global_step:
            sizes = {name: sum(local(t).nbytes for t in tensors) for name, tensors in held.items()}
            (self._folder / f"rank-{trainer.global_rank}.json").write_text(json.dumps(sizes))


TinyPlugin = plugin_of(
    environments={"tiny_world": f"{__name__}:TinyWorld"},
    codecs={"tiny_codec": f"{__name__}:TinyCodec"},
    models={"tiny_model": f"{__name__}:TinyModel"},
    conditioners={"tiny_conditioner": f"{__name__}:TinyConditioner"},
)


def tiny_recipe(data, /, **sections) -> Recipe:
    """A recipe of the tiny parts; `sections` go over its defaults, key by key."""
    defaults = {
        "training": {
            "learning_rate": 1e-2,
            "schedule": "linear",
            "warmup_steps": 3,
            "ema_decay": 0.9,
            "validate_every_n_steps": 4,
            "checkpoint_every_n_steps": 3,
            "sample_every_n_steps": 0,
            "cpu_threads": 1,
        },
        "data": {
            "path": str(data),
            "batch_size": 4,
            "clip_frames": 9,
            "window_stride": 2,
            "validation_episodes": 2,
        },
        "objective": {"prediction": "clean", "loss_on": "clean", "weighting": "none", "steps": 2},
        "trainer": {"max_steps": 16, "accelerator": "cpu", "log_every_n_steps": 1},
    }
    parts = {"env": "world", "codec": "codec", "model": "model", "conditioner": "conditioner"}
    chosen = {section: {"name": f"tiny_{name}"} for section, name in parts.items()}
    chosen |= {name: {**defaults[name], **sections.get(name, {})} for name in defaults}
    for name in parts:
        chosen[name] |= sections.get(name, {})
    return Recipe.from_dict(chosen)


def tiny_world_model(seed: int = 0, **params) -> WorldModel:
    torch.manual_seed(seed)
    codec = TinyCodec()
    model = TinyModel(latent_channels=codec.channels, **params)
    conditioner = TinyConditioner(
        action_size=2, temporal_stride=2, width=model.width, layers=1, heads=1
    )
    objective = FullSequence(prediction="clean", loss_on="clean", weighting="none", steps=2)
    return WorldModel(codec, model, conditioner, objective, (-1.0, -1.0), (1.0, 1.0))
