"""Training on data that grows: each pass takes the episodes that are finished when it begins."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, cast

import torch

from acwm_core.data.clips import hold_out
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.errors import DataError
from acwm_core.training.data import ClipData


class Pass(NamedTuple):
    """One pass over the clips of the episodes that were finished when it began."""

    start: int  # its first place in the stream of clips
    episodes: int  # how many episodes were finished, from the first on
    clips: int  # how many clips it takes: those of its episodes, in whole steps


class GrowingClipData(ClipData):
    """Clips of a data folder that `acwm generate` is filling.

    The first episodes are held out, not the last, so that they stay the same. Checkpoints hold the
    passes, so a resumed run repeats those that it has begun with the same clips. Two runs see the
    same passes only if the data grows in the same way.
    """

    def _divided(self) -> tuple[Sequence[int], range]:
        there, promised = len(self.episodes), self.episodes.card.splits["train"]
        held = len(hold_out(promised, self.config.validation_episodes)[1])
        if there <= held:
            raise DataError(
                f"{self.episodes.path} holds {there} finished episodes so far, and the first "
                f"{held} are held out: start again once there are more, or set "
                "data.validation_episodes"
            )
        return range(held, there), range(held)

    def setup(self, stage: str) -> None:
        """Open the clips of the episodes that are finished; encode those that are not encoded."""
        self._passes = list[Pass]()
        self._open(None)
        self._validation = self._clips(self._split[1], self._stride, cached=self._cached)

    def train_dataloader(self) -> Any:
        """The stream of clips, pass by pass, starting after those of the steps done so far."""
        return _Endless(self)

    def batches(self) -> Iterator[dict[str, Any]]:
        """Batches of one pass after the other, without end."""
        trainer = self._trainer()
        position = trainer.global_step * self.clips_per_step
        while True:
            number = self._pass_at(position)
            now = self._passes[number]
            end = now.start + now.clips
            loader = self._loader(self._train, self.seed + number, position, now.start)
            left = (end - position) // self.clips_per_step * trainer.accumulate_grad_batches
            yield from itertools.islice(loader, left)
            position = end

    def _pass_at(self, position: int) -> int:
        """The number of the pass at a position, begun if it is new; opens its clips."""
        for number, passed in enumerate(self._passes):
            if passed.start <= position < passed.start + passed.clips:
                self._open(passed.episodes)
                return number
        if position:  # the first pass takes what `setup` opened a moment ago
            self._open(None)
        clips = max(1, len(self._train) // self.clips_per_step) * self.clips_per_step
        self._passes.append(Pass(position, self._split[0][-1] + 1, clips))
        return len(self._passes) - 1

    def _open(self, count: int | None) -> None:
        """Open the clips of the first `count` episodes, or of all that are finished now."""
        self.episodes = EpisodeDataset(self.config.path, "train", growing=True)
        strategy = cast(Any, self._trainer().strategy)
        there = torch.tensor(len(self.episodes), device=strategy.root_device)
        seen = int(strategy.reduce(there, reduce_op="min"))  # what all processes see
        if count is not None and seen < count:
            raise DataError(
                f"{self.episodes.path} holds {seen} finished episodes, but this run was "
                f"trained on {count}: simulate them again with "
                f"`{self.episodes.card.command(self.config.path)}`"
            )
        held = self._split[1]
        self._split = range(len(held), count or seen), held
        if self._cached:
            self._encode()
        self._train = self._training_clips()

    def state_dict(self) -> dict[str, Any]:
        """As without growing, and the passes begun so far."""
        return {**super().state_dict(), "passes": [list(passed) for passed in self._passes]}

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Go on with the passes of the run.

        Raises:
            TrainingError: an optimiser step takes a different number of clips than before.
        """
        super().load_state_dict(state_dict)
        self._passes = [Pass(*values) for values in state_dict["passes"]]


class _Endless:
    """The batches of growing data, as Lightning wants them."""

    def __init__(self, data: GrowingClipData) -> None:
        self._data = data

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return self._data.batches()
