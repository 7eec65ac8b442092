"""`collect`: episodes in which a policy acts in the simulator, added to a dataset."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import CARD, DatasetCard, package_versions
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import SHARD_EPISODES, fill
from acwm_core.data.shards import MEMBERS, Packed, open_shard
from acwm_core.data.simulate import make_environment, simulate
from acwm_core.env.card import check_episode
from acwm_core.env.environment import EnvironmentCard
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.env.task import SolvedAtStartError, TaskEnvironment
from acwm_core.errors import RecipeError
from acwm_core.executors import LocalExecutor
from acwm_core.plugins import catalog
from acwm_planning.policies.saved import SavedPolicy
from acwm_policy.evaluate import task_of


@dataclass(frozen=True)
class Collection:
    """A dataset that begins with given episodes, or with those of the behaviour policy, and grows.

    Every further part is what one policy does, at its task and with noise. An episode is a function
    of its spec and of that policy's file, so a killed collection goes on where it was.

    Attributes:
        card: of the environment, with the frame size.
        policies: folders of policies; each collects one part, in this order.
        episodes: number of episodes of a part.
        noise: deviation of the noise of each decision, as a share of half an action's range.
        seed: of the episodes, if there is no `base`.
        base: a simulated dataset whose training episodes come first, in whole shards; by default as
            many episodes of the behaviour policy as a part has.
    """

    card: EnvironmentCard
    policies: tuple[Path, ...]
    episodes: int
    noise: float
    seed: int = 0
    base: Path | None = None

    @property
    def shard(self) -> int:
        """Number of episodes per shard; parts consist of whole shards."""
        return math.gcd(self.episodes, SHARD_EPISODES)

    @property
    def first(self) -> int:
        """Number of the first episode that a policy collects."""
        if self.base is None:
            return self.episodes
        return len(EpisodeDataset(self.base, "train")) // self.shard * self.shard

    def dataset(self) -> DatasetCard:
        """The card of the dataset.

        Raises:
            RecipeError: the episodes of `base` were recorded, so none can be added.
        """
        splits = {"train": self.first + self.episodes * len(self.policies)}
        size = {"size": list(self.card.frame_size)}
        card = DatasetCard(self.card, {}, self.seed, size, {}, self.shard, {})
        if self.base is not None:
            card = DatasetCard.read(self.base)
            if card.source or card.environment.name != self.card.name:
                raise RecipeError(
                    f"{self.base} holds no simulated episodes of {self.card.name}: name data of "
                    f"`acwm generate {self.card.name}`"
                )
        facts = {"kind": "policy", "name": self.card.name, "first": self.first}
        requires = catalog().component("environment", self.card.name).requires
        return replace(
            card,
            splits=splits,
            shard_episodes=self.shard,
            versions=package_versions(requires),
            actions={},
            checksums={},
            source={**facts, "episodes": self.episodes, "noise": self.noise},
        )

    def __call__(self, specs: Sequence[EpisodeSpec]) -> Iterator[Episode | Packed]:
        """The episodes of a shard; see `acwm_core.data.generate.EpisodeSource`."""
        base = self.base and EpisodeDataset(self.base, "train")
        if base and specs[-1].index < self.first:
            yield from (packed(base, spec) for spec in specs)
            return
        with closing(make_environment(self.card.name, specs[0].options)) as environment:
            for spec in specs:
                part = (spec.index - self.first) // self.episodes
                acts = None
                if part >= 0:
                    policy = SavedPolicy.read(self.policies[part])
                    task = TaskEnvironment(environment, task_of(policy, environment.card))
                    acts = self.actions(task, policy, spec)
                episode = simulate(environment, spec, acts)
                check_episode(episode, environment.card)
                yield episode

    def actions(
        self, task: TaskEnvironment, policy: SavedPolicy, spec: EpisodeSpec
    ) -> NDArray[np.float32] | None:
        """What a policy does in an episode, `[T − 1, A]`; None if it is solved at its start."""
        environment, action = task.environment, self.card.action
        try:
            task.reset(options={"spec": spec})
        except SolvedAtStartError:
            return None
        policy.reset(task.goal)
        random, taken = spec.rng("collection"), list[NDArray[np.float32]]()
        low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
        while len(taken) < self.card.horizon - 1:
            noise = self.noise * (high - low) / 2 * random.standard_normal(action.size)
            chosen = policy.predict(environment.observe_state()) + noise.astype(np.float32)
            for _ in range(policy.card.repeat):
                taken.append(chosen.clip(low, high))
                environment.advance(taken[-1])
        return np.stack(taken[: self.card.horizon - 1])


def packed(episodes: EpisodeDataset, spec: EpisodeSpec) -> Packed:
    """An episode of another dataset as its shard has it."""
    shard = episodes.shard_of(spec.index)
    reader = open_shard(episodes.shard_path(shard))
    position = spec.index - episodes.shards[shard][0]
    members = {name: reader.read(position, name) for name in MEMBERS}
    return Packed(spec, episodes.actions(spec.index), members)


def collect(
    collection: Collection, out: Path, *, workers: int | None = None, progress: bool = False
) -> DatasetCard:
    """Add what the folder `out` lacks of a collection; it may hold one of fewer policies.

    Raises:
        DataError: the folder holds other data, or an episode failed.
    """
    wanted = collection.dataset()
    if (out / CARD).exists():
        there = DatasetCard.read(out)
        grows = there.splits["train"] < wanted.splits["train"]
        if grows and dict(there.source) == wanted.source:
            replace(there, splits=wanted.splits).write(out)
    return fill(out, wanted, collection, LocalExecutor(workers), progress=progress)
