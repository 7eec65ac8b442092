"""The smallest real parts, and the smallest real data and runs of them.

Worlds that need no simulator, codecs, models and conditioners that run in microseconds, a task, and
folders as `generate` and `fit` leave them. `register` makes them known by name.
"""

import hashlib
from dataclasses import replace

import numpy as np
import torch
from torch import nn

from acwm_core.checks.trial import shaken
from acwm_core.data.card import DatasetCard
from acwm_core.data.generate import generate
from acwm_core.env.environment import ActionSpec, Environment, EnvironmentCard, StateField
from acwm_core.env.episode import EpisodeSpec, Factor
from acwm_core.env.physics import Observation, Physics, StateEstimator
from acwm_core.env.task import Goal, Task, TaskEnvironment
from acwm_core.model.build import build_world_model
from acwm_core.model.codec import Codec
from acwm_core.model.conditioner import Conditioner, Conditioning
from acwm_core.model.dynamics import Denoiser, Keypoints, LatentStream, Predictor
from acwm_core.model.objectives.full_sequence import FullSequence
from acwm_core.model.world_model import WorldModel
from acwm_core.plugins import catalog
from acwm_core.recipe import Recipe
from acwm_core.recipe.compose import read_recipe, recipe_folder
from acwm_core.training.run import save_weights
from tests.plugins import plugin_of

METRICS = read_recipe(recipe_folder() / "base.yaml")["evaluation"]
"""Those of every shipped recipe."""

SWEEP = {"steps_sweep": [1, 2, 6], "sweep_episodes": 3}
"""A short curve of scores against sampling steps."""

SIDE = 8
"""Pixels of the square of `Drift`."""

STRIDE = 4
"""Frames of a step of `Exact`."""


class Drift(Environment):
    """A red square that drifts by its action on a plain background."""

    side = SIDE
    card = EnvironmentCard(
        name="drift",
        summary="a square that drifts by its action",
        action=ActionSpec(("dx", "dy"), ("px", "px"), (-2.0, -2.0), (2.0, 2.0), "delta"),
        frame_size=(32, 32),
        fps=10,
        horizon=13,
        factors=(
            Factor.discrete("colour", "grey value", train=(200, 220), ood=(90,), nominal=200),
            Factor.discrete("ground", "grey value", train=(30,), ood=(60,), nominal=30),
        ),
        ood_shifts=("colour", "ground"),
        state=(StateField("position", (2,), "px", "of the square's corner"),),
        instances=("background", "square"),
        engine="numpy",
        episodes={"train": 8, "ind_test": 4, "ood_test": 4},
    )

    @property
    def room(self):
        return self.card.frame_size[0] - self.side

    def _start(self, factors, rng):
        self._factor_values = {"colour": 255, "ground": 60, **factors}
        self._position = rng.uniform(0, self.room, 2)

    def _advance(self, action):
        self._position = (self._position + action).clip(0, self.room)

    def _render(self):
        row, column = self._position.round().astype(int)
        frame = np.full((*self.frame_size, 3), self._factor_values["ground"], np.uint8)
        mask = np.zeros(self.frame_size, np.uint8)
        square = slice(row, row + self.side), slice(column, column + self.side)
        frame[(*square, 0)] = self._factor_values["colour"]
        mask[square] = 1
        return frame, mask

    def _state(self):
        return {"position": self._position.copy()}

    def _contacts(self):
        return [(0, 1)]

    def policy(self, rng):
        heading = rng.uniform(-2, 2, 2)
        return lambda: heading


class TinyWorld(Drift):
    """A smaller square, without factors, that moves at random."""

    side = 4
    card = replace(
        Drift.card,
        name="tiny_world",
        action=ActionSpec(("dx", "dy"), ("px", "px"), (-4.0, -4.0), (4.0, 4.0), "delta"),
        frame_size=(16, 16),
        horizon=12,
        factors=(),
        ood_shifts=(),
        episodes={},
    )

    def policy(self, rng):
        return lambda: rng.uniform(-4, 4, 2)


class Slide(Drift):
    """The world with tasks and an estimator."""

    card = replace(Drift.card, name="slide", summary="a square that slides")


class Unread(Drift):
    """The world with a task and without an estimator."""

    card = replace(Slide.card, name="unread")


class ToPlace(Task):
    """The square at a place."""

    name, summary, unit = "place", "the square within 1.5 px of its place", "px"
    tolerance, max_steps = 1.5, 12

    def sample_goal(self, environment, rng):
        corners = np.array([[0.0, 0.0], [0.0, 24.0], [24.0, 0.0], [24.0, 24.0]])
        environment._position = corners[rng.integers(4)] * 0.7
        return Goal.now(environment)

    def distance(self, seen, goal):
        return np.linalg.norm(seen.states["position"] - goal.state["position"], axis=-1)

    def solution(self, environment, goal, rng):
        return lambda: np.clip(goal.state["position"] - environment._position, -2, 2)


class Shy(ToPlace):
    """The same, but the left half of the world is forbidden, and nobody solves it."""

    name = "shy"

    def failed(self, seen, goal):
        return seen.states["position"][:, 1] < 12

    def solution(self, environment, goal, rng):
        return None


PLACE, SHY = ToPlace(), Shy()


def task_environment(task=PLACE):
    return TaskEnvironment(Slide(), task)


def spec(seed):
    return EpisodeSpec("slide", "ind_test", seed)


def corners_of(frames):
    """Where the reddest squares of frames `[N, 3, 32, 32]` begin: rows and columns `[N, 2]`."""
    sums = nn.functional.avg_pool2d(frames[:, :1], SIDE, 1)[:, 0]
    best = sums.flatten(1).argmax(1)
    return torch.stack([best // sums.shape[2], best % sums.shape[2]], 1)


def squares(corners):
    """Frames `[N, 3, 32, 32]` of nominal squares whose corners are at these places `[N, 2]`."""
    frames = torch.full((len(corners), 3, 32, 32), 30 / 255)
    for frame, (row, column) in zip(frames, corners.round().int().tolist(), strict=True):
        frame[0, row : row + SIDE, column : column + SIDE] = 200 / 255
    return frames


class SquareEstimator(StateEstimator):
    """Where the brightest block of pixels begins."""

    fields = ("position",)
    instances = ("square",)

    @property
    def physics(self):
        return Physics()

    def estimate(self, video):
        masks = np.zeros((len(video), *video.shape[2:]), np.uint8)
        return Observation(masks, {"position": corners_of(video).numpy().astype(float)})

    def pixels(self, field, values):
        return values


class MeanCodec(Codec):
    """Latents are colours of blocks in the last frame of each group, scaled to ±1."""

    channels = 3
    spatial_stride = 8
    temporal_stride = 4

    def _encode(self, video):
        side = self.spatial_stride
        return nn.functional.avg_pool3d(video[:, :: self.temporal_stride], (1, side, side)) * 2 - 1

    def _decode(self, latents):
        video = ((latents + 1) / 2).repeat_interleave(self.temporal_stride, 1)
        for axis in (3, 4):
            video = video.repeat_interleave(self.spatial_stride, axis)
        return video[:, self.temporal_stride - 1 :]

    def fingerprint(self):
        return f"means-{self.temporal_stride}x{self.spatial_stride}"


class BlockCodec(MeanCodec):
    """Latents are colours of 4×4 blocks, of one frame in two."""

    spatial_stride = 4
    temporal_stride = 2


class TinyCodec(MeanCodec):
    """Mixes the colours by a fixed, frozen matrix."""

    temporal_stride = 2

    def __init__(self, *, gain: float = 2.0) -> None:
        super().__init__()
        self.gain = gain
        self.mix = nn.Parameter(torch.tensor([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]]))

    def _encode(self, video):
        return torch.einsum("blchw,dc->bldhw", super()._encode(video) * self.gain / 2, self.mix)

    def _decode(self, latents):
        return super()._decode(torch.einsum("bldhw,dc->blchw", latents, self.mix) / self.gain * 2)

    def fingerprint(self):
        values = [self.gain, *self.mix.flatten().tolist()]
        return hashlib.sha256(repr(values).encode()).hexdigest()[:16]


class PointwiseModel(Denoiser):
    """One linear layer per latent pixel, with conditioning added in between."""

    layers = heads = 1

    def __init__(self, *, latent_channels: int, width: int = 8) -> None:
        super().__init__()
        self.width = width
        self.enter = nn.Linear(latent_channels + 1, width)
        self.leave = nn.Linear(width, latent_channels)

    def forward(self, latents, sigma, conditioning):
        level = sigma[:, :, None, None, None].expand_as(latents[:, :, :1])
        tokens = torch.cat([latents, level], 2).flatten(3).transpose(2, 3)
        tokens = torch.tanh(self.enter(tokens))
        if conditioning.modulation is not None:
            tokens = tokens + conditioning.modulation[:, :, None]
        tokens = conditioning.inject(0, conditioning.inject_input(tokens))
        return self.leave(tokens).transpose(2, 3).reshape(latents.shape)


class TinyModel(Denoiser):
    """Two 1×1 convolutions with dropout, a norm and a table of embeddings; layers if asked for."""

    layers = heads = 1

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


class Exact(Predictor):
    """Slides the square as the simulator does, from where it is seen, to half a pixel.

    Needs the codec `identity` and the conditioner `raw`.
    """

    width, layers, heads = 2 * STRIDE, 0, 1
    causal = True
    blind = False

    def __init__(self, *, latent_channels: int):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, given, conditioning, frames, generators=()):
        stream = self.stream(given, context=None)
        more = [stream.advance(conditioning.frames(k - 1, k + 1)) for k in range(1, frames)]
        return torch.cat(more, 1)

    def stream(self, given, *, context, generators=()):
        return _ExactStream(given, self.blind)


class Blind(Exact):
    """Lets the square drift to a corner whatever is done."""

    blind = True


class Sighted(Exact):
    """Says where it sees the square, and beside it a keypoint for which no picture cares."""

    keypoint_names = ("square", "nothing")

    def read_keypoints(self, latents):
        places = (corners_seen(latents.flatten(0, 1)) + SIDE / 2).flip(1) / 16 - 1
        values = torch.stack([places, torch.zeros_like(places)], 1).unflatten(0, latents.shape[:2])
        return Keypoints(values, torch.tensor([[1.0, 1.0], [0.0, 0.0]]), torch.tensor([1.0, 0.0]))

    def predict_keypoints(self, given, conditioning, frames, generators=()):
        given = given.expand(len(conditioning.modulation), -1, -1, -1, -1)
        return self.read_keypoints(self(given, conditioning, frames))


def corners_seen(latents):
    """The corners `[N, 2]` that latent frames `[N, C, 4, 4]` show in their last video frame."""
    shown = nn.functional.pixel_shuffle(latents, 8).unflatten(1, (STRIDE, 3))[:, -1]
    return corners_of(shown).float()


class _ExactStream(LatentStream):
    def __init__(self, given, blind):
        self._corners, self._blind = corners_seen(given[:, -1]), blind

    def advance(self, conditioning):
        frames = []
        for action in conditioning.modulation[:, -1].unflatten(1, (STRIDE, 2)).unbind(1):
            moved = torch.ones_like(action) if self._blind else 2.0 * action  # pixels
            self._corners = (self._corners + moved).clamp(0, 32 - SIDE)
            frames.append((squares(self._corners) - 0.5) / 0.25)
        return nn.functional.pixel_unshuffle(torch.cat(frames, 1), 8)[:, None]


class SumConditioner(Conditioner):
    """Adds a linear map of the sum of the actions so far."""

    def __init__(self, *, action_size, temporal_stride, width, layers, heads):
        super().__init__()
        self.stride = temporal_stride
        self.embed = nn.Linear(action_size, width)

    def forward(self, actions):
        so_far = actions.cumsum(1) - actions
        return Conditioning(self.embed(so_far[:, :: self.stride]), None, self)


class RawConditioner(Conditioner):
    """The normalised actions of a latent frame in a row."""

    history = 1

    def __init__(self, *, action_size, temporal_stride, width, layers, heads):
        super().__init__()
        self.stride = temporal_stride

    def rows(self, actions):
        padded = nn.functional.pad(actions[:, :-1], (0, 0, self.stride, 0))
        return padded.unflatten(1, (-1, self.stride)).flatten(2)

    def forward(self, actions):
        return Conditioning(self.rows(actions), None, self)


class TinyConditioner(RawConditioner):
    """The actions of a latent frame through one linear layer."""

    def __init__(self, **sizes) -> None:
        super().__init__(**sizes)
        self.embed = nn.Linear(sizes["action_size"] * self.stride, sizes["width"])

    def forward(self, actions):
        return Conditioning(self.embed(self.rows(actions)), None, self)


def targets(**classes):
    return {name: f"{__name__}:{target}" for name, target in classes.items()}


Plugin = plugin_of(
    environments=targets(drift="Drift", tiny_world="TinyWorld", slide="Slide", unread="Unread"),
    estimators=targets(slide="SquareEstimator"),
    codecs=targets(blocks="BlockCodec", tiny_codec="TinyCodec"),
    models=targets(
        linear="PointwiseModel",
        tiny_model="TinyModel",
        exact="Exact",
        blind="Blind",
        sighted="Sighted",
    ),
    conditioners=targets(
        linear="SumConditioner", raw="RawConditioner", tiny_conditioner="TinyConditioner"
    ),
    tasks=targets(**{"slide.place": "PLACE", "slide.shy": "SHY", "unread.place": "PLACE"}),
)


def register():
    if "tiny" not in catalog().plugins:
        catalog().add_plugin(Plugin, "tiny")


def pointwise_world_model(seed=0, actions=2, objective=FullSequence, **flow):
    torch.manual_seed(seed)
    codec = MeanCodec()
    model = PointwiseModel(latent_channels=codec.channels)
    conditioner = SumConditioner(
        action_size=actions, temporal_stride=4, width=model.width, layers=1, heads=1
    )
    bounds = [-2.0] * actions, [2.0] * actions
    return WorldModel(codec, model, conditioner, objective(**{"steps": 3, **flow}), *bounds)


def tiny_world_model(seed: int = 0, **params) -> WorldModel:
    torch.manual_seed(seed)
    codec = TinyCodec()
    model = TinyModel(latent_channels=codec.channels, **params)
    conditioner = TinyConditioner(
        action_size=2, temporal_stride=2, width=model.width, layers=1, heads=1
    )
    objective = FullSequence(prediction="clean", loss_on="clean", weighting="none", steps=2)
    return WorldModel(codec, model, conditioner, objective, (-1.0, -1.0), (1.0, 1.0))


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
    if "name" in sections.get("objective", {}):  # another one, with parameters of its own
        chosen["objective"] = sections["objective"]
    for name in parts:
        chosen[name] |= sections.get(name, {})
    return Recipe.from_dict(chosen)


def make_dataset(path, **episodes):
    counts = {"train": 2, "ind_test": 5, "ood_test": 4, **episodes}
    generate("drift", path, episodes=counts, workers=0, progress=False, shard_episodes=3)
    return path


def save_run(folder, recipe, card, step=16, change=lambda world_model: None):
    """A run folder with fresh weights that `change` changes, as training would leave it."""
    folder.mkdir(parents=True)
    (folder / "recipe.yaml").write_text(recipe.to_yaml())
    card.write(folder)
    world_model = build_world_model(recipe, card.environment)
    change(world_model)
    fingerprint = world_model.codec.fingerprint()
    save_weights(folder / "model.safetensors", world_model.state_dict(), fingerprint, step=step)
    return folder


def make_run(path, data, seed=0, parts=None, **evaluation):
    """A run of the drifting square that can be evaluated; `parts` replace its own."""
    recipe = Recipe.from_dict(
        {
            "env": {"name": "drift"},
            "codec": {"name": "blocks"},
            "model": {"name": "linear"},
            "conditioner": {"name": "linear"},
            "objective": {"steps": 2, "prediction": "clean"},
            "data": {"path": str(data), "clip_frames": 9},
            "evaluation": {**METRICS, "frames": 9, "device": "cpu", "steps_sweep": []} | evaluation,
            **(parts or {}),
        }
    )
    torch.manual_seed(seed)
    # A fresh network may start at zero.
    change = (lambda world_model: shaken(world_model.model)) if parts else (lambda _: None)
    save_run(path, recipe, DatasetCard.read(data), 7, change)
    rows = ["step,train/loss,val/loss", *(f"{i},{1 / (i + 1)}," for i in range(0, 60, 10))]
    (path / "metrics.csv").write_text("\n".join([*rows, "60,,0.02", ""]))
    return path


def make_slide_run(folder, episodes=1, parts=None):
    """A run whose model knows nothing of the sliding square, and data that it might be of."""
    data = folder / "data"
    generate("slide", data, episodes={"train": episodes}, workers=0, progress=False)
    return make_run(folder / "run", data, parts={"env": {"name": "slide"}} | (parts or {}))


def make_exact_run(folder, model="exact", environment="slide", **data):
    """A run whose model knows its world exactly, or `blind`, which ignores actions."""
    register()
    recipe = Recipe.from_dict(
        {
            "env": {"name": environment},
            "codec": {"name": "identity"},
            "model": {"name": model},
            "conditioner": {"name": "raw"},
            "objective": {"name": "regression"},
            "data": {"path": "data/none", "clip_frames": 13, **data},
            "evaluation": METRICS,
        }
    )
    card = catalog().component("environment", environment).load().card
    return save_run(folder, recipe, DatasetCard(card, {"train": 1}, 0, {}, {}, 1, {}))
