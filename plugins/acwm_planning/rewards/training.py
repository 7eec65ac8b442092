"""`train_reward`: learns a head of a recorded column, and measures it on held-out episodes."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from acwm_core.data.clips import hold_out
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.state_field import StateField
from acwm_core.errors import DataError, RecipeError, suggest
from acwm_core.evaluation.statistics import ClipScores
from acwm_core.executors import progress_bar
from acwm_core.files import writing
from acwm_core.model.world_model import WorldModel
from acwm_core.training.run import load_run
from acwm_planning.policies.networks import layers_of
from acwm_planning.rewards.columns import Column, find_column, is_outcome
from acwm_planning.rewards.head import HeldOut, RewardCard, RewardHead, codes_of, scaled

WIDTHS = 64, 64
"""Of the network's hidden layers."""

BATCH, RATE, DECAY = 256, 3e-3, 1e-2

TINY = 1e-300
"""A divisor where there is nothing to divide by."""

NOT_MEASURED = HeldOut(0, 0, 0.0, 0.0, None, None)
"""The error of a head before it is measured."""

FEWEST = 3
"""Number of episodes below which none can be held out."""


class Frames(NamedTuple):
    """Frames of one or several episodes: what a head looks at `[N, E]`, and rewards `[N]`."""

    inputs: Tensor
    rewards: Tensor


@dataclass(frozen=True)
class _Inputs:
    """What a head looks at: fields of the state, or latents of a codec."""

    state: tuple[StateField, ...]
    world: WorldModel | None

    def of(self, episodes: EpisodeDataset, index: int, column: Column) -> Frames:
        """Those frames of an episode whose reward and inputs are known."""
        rewards = torch.from_numpy(column.rewards(episodes, index))
        if self.world is None:
            fields = {f.name: episodes.states(index, [f.name]) for f in self.state}
            inputs, ends = codes_of(fields, self.state), torch.arange(len(rewards))
        else:
            inputs, ends = self._latents(self.world, episodes, index)
        rewards = rewards[ends]
        known = rewards.isfinite() & inputs.isfinite().all(1)
        return Frames(inputs[known], rewards[known])

    @staticmethod
    @torch.no_grad()
    def _latents(world: WorldModel, episodes: EpisodeDataset, index: int) -> tuple[Tensor, Tensor]:
        """Latent frames of an episode but the first, and the last video frame of each."""
        stride, whole = world.codec.temporal_stride, episodes.video(index)
        span, parts = world.clip_frames - 1, list[Tensor]()
        last = (len(whole) - 1) // stride * stride
        for first in range(0, last, span):
            clip = torch.from_numpy(whole[first : min(first + span, last) + 1])
            latents = world.encode(clip[None].to(world.device).float() / 255)
            parts.append(latents[0, 1:].flatten(1).double().cpu())
        if not parts:
            return torch.zeros(0, 0), torch.zeros(0, dtype=torch.int64)
        return torch.cat(parts), torch.arange(stride, last + 1, stride)

    def latent(self, card_size: tuple[int, int]) -> tuple[int, ...]:
        """Shape of a latent frame; none for states."""
        if self.world is None:
            return ()
        codec = self.world.codec
        return codec.channels, *codec.latent_size(*card_size)


def train_reward(
    data: str | Path,
    name: str,
    out: Path,
    *,
    run: str | Path | None = None,
    states: Sequence[str] = (),
    latents: bool = False,
    steps: int = 2000,
    seed: int = 0,
    progress: bool = False,
) -> RewardHead:
    """Train a head of a column, and write it.

    Args:
        data: data folder.
        name: name of the column.
        out: the head's folder.
        run: a model that is to predict what the head looks at: states if it predicts any, else
            latents.
        states: names of the fields to look at; by default all, or those that the model predicts.
        latents: look at latents of the model's codec in any case.
        steps: steps of the optimiser.
        seed: of the weights and the order of the frames.
        progress: show a progress bar.

    Raises:
        DataError: there is no such column, it is constant or not finite, there are too few
            episodes, or nothing to look at.
        RecipeError: an option does not fit the data or the model.
    """
    train = EpisodeDataset(data, "train")
    column = find_column(train, name)
    inputs = _inputs_of(train, column, run, states, latents)
    learnt, tested = _split(train, inputs, column)
    frames, values = Frames(*map(torch.cat, zip(*learnt, strict=True))), _values(learnt, column)
    mean, std = _scale(frames.inputs)
    centre, spread = float(frames.rewards.mean()), float(frames.rewards.std(correction=0))
    whole = scaled(frames.inputs, mean, std).float()
    target = ((frames.rewards - centre) / spread).float()[:, None]
    network = _fit(Frames(whole, target), steps, seed, f"reward of {train.path}" * progress)
    codec, environment = inputs.world and inputs.world.codec, train.card.environment
    card = RewardCard(
        *(environment.name, column.name, column.ahead, len(values) == 2),
        *(values[-1], values[0], centre, spread),
        state=inputs.state,
        latent=inputs.latent(environment.frame_size),
        latents=codec.latents_fingerprint() if codec else "",
        input_mean=mean,
        input_std=std,
        layers=layers_of(network),
        held_out=NOT_MEASURED,
        training={
            "data": str(data),
            "checksum": train.checksum,
            "episodes": len(learnt),
            "frames": len(whole),
            "run": None if run is None else str(run),
            "steps": steps,
            "seed": seed,
        },
    )
    measured = measure(RewardHead(card, network), tested)
    head = RewardHead(replace(card, held_out=measured), network)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
    head.save(out)
    return RewardHead.read(out)


def measure(head: RewardHead, tested: Sequence[Frames]) -> HeldOut:
    """The error of a head on episodes that it did not learn from."""
    errors, usual = list[float](), list[float]()
    for part in tested:
        error = head.of_inputs(part.inputs) - part.rewards
        errors.append(float(error.square().sum()))
        usual.append(float((part.rewards - head.card.mean).square().sum()))
    wrong, weights = np.array(errors), np.array(usual)
    count = sum(len(part.rewards) for part in tested)
    clips = np.array([(number, 0) for number in range(len(tested))])
    # Of shares with these weights, the mean is the share of the sums.
    scores = ClipScores(wrong / np.maximum(weights, TINY), weights, clips, bounds=(0.0, np.inf))
    share = scores.estimate()
    if share.value is None:
        raise DataError("no held-out frame has a reward that differs from the mean")
    root = float(np.sqrt(wrong.sum() / count))
    return HeldOut(len(tested), count, root, share.value, share.low, share.high)


def _inputs_of(
    train: EpisodeDataset,
    column: Column,
    run: str | Path | None,
    states: Sequence[str],
    latents: bool,
) -> _Inputs:
    """What a head is to look at; see `train_reward`."""
    fields = train.card.environment.fields
    others = [f.name for f in fields.values() if f.name != column.name]
    for name in states:
        if name not in others:
            raise RecipeError(
                f"--states {name}: {train.path} has no such state beside {column.name}"
                f"{suggest(name, others)}"
            )
    world = None if run is None else _world_of(run, train)
    if latents and (world is None or states):
        raise RecipeError("--latents needs a model: name it by --run, and omit --states")
    predicted = [*world.state_shapes] if world is not None else others
    if latents or (world is not None and not (predicted or states)):
        return _Inputs((), world)
    for name in states:
        if name not in predicted:
            raise RecipeError(f"--states {name}: {run} predicts {', '.join(predicted) or 'none'}")
    usual = [name for name in predicted if name in others and not is_outcome(fields[name])]
    chosen = tuple(fields[name] for name in states or usual)
    if not chosen:
        raise DataError(
            f"{train.path} has no states beside {column.name} to look at: name a model by --run, "
            "for latents of its codec"
        )
    return _Inputs(chosen, None)


def _world_of(run: str | Path, train: EpisodeDataset) -> WorldModel:
    bundle, ours = load_run(run), train.card.environment
    theirs = bundle.card
    if (theirs.name, theirs.frame_size) != (ours.name, ours.frame_size):
        names = [f"{c.name} of {'×'.join(map(str, c.frame_size))}" for c in (theirs, ours)]
        raise RecipeError(f"{run} is a model of {names[0]}, and {train.path} has {names[1]}")
    return bundle.world_model


def _split(
    train: EpisodeDataset, inputs: _Inputs, column: Column
) -> tuple[list[Frames], list[Frames]]:
    """The episodes to learn from and those to measure on, without any that knows no reward."""
    if "ind_test" in train.card.splits:
        chosen, tests = range(len(train)), EpisodeDataset(train.path, "ind_test")
        held: Sequence[int] = range(len(tests))
    else:
        if len(train) < FEWEST:
            raise DataError(
                f"{train.path} has {len(train)} episodes: {FEWEST} are needed, to hold some out"
            )
        tests = train
        chosen, held = hold_out(len(train), max(len(train) // 10, min(5, len(train) // 3)))
    learnt, tested = (
        [part for index in numbers if len((part := inputs.of(episodes, index, column)).rewards)]
        for episodes, numbers in ((train, chosen), (tests, held))
    )
    if not learnt or not tested:
        raise DataError(
            f"{train.path} has too few frames of which {column.name} and the inputs are known"
        )
    return learnt, tested


def _values(learnt: Sequence[Frames], column: Column) -> list[float]:
    """The values that a column takes, in order; at least two."""
    values = torch.cat([part.rewards for part in learnt]).unique().tolist()
    if len(values) < 2:
        raise DataError(
            f"{column.name} is {values[0]:g} in all frames to learn from, so nothing can be learnt"
        )
    return values


def _scale(inputs: Tensor) -> tuple[list[float], list[float]]:
    """Means and standard deviations of inputs `[N, E]`; 1 where nothing changes."""
    std = inputs.std(0, correction=0)
    return inputs.mean(0).tolist(), torch.where(std > 1e-9, std, 1.0).tolist()


def _fit(frames: Frames, steps: int, seed: int, label: str) -> nn.Sequential:
    """A network from scaled inputs to scaled rewards."""
    random = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        layers: list[nn.Module] = []
        for inner, outer in itertools.pairwise((frames.inputs.shape[1], *WIDTHS)):
            layers += [nn.Linear(inner, outer), nn.ReLU()]
        network = nn.Sequential(*layers, nn.Linear(WIDTHS[-1], 1))
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=DECAY)
    with progress_bar(label, steps, unit="steps", shown=bool(label)) as report:
        for step in range(steps):
            optimiser.param_groups[0]["lr"] = RATE * (1 - step / steps)
            rows = torch.randint(len(frames.rewards), (BATCH,), generator=random)
            loss = nn.functional.mse_loss(network(frames.inputs[rows]), frames.rewards[rows])
            optimiser.zero_grad()
            loss.backward()  # pyright: ignore[reportUnknownMemberType]
            optimiser.step()
            report(1)
    return network
