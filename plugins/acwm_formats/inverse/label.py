"""Writes a dataset whose unlabelled episodes have actions that were read from their videos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.card import DatasetCard, package_versions
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import fill
from acwm_core.env.environment import EnvironmentCard, StateField
from acwm_core.env.episode import Episode, EpisodeSpec, Split
from acwm_core.env.state_field import without_dangling
from acwm_core.errors import DataError
from acwm_core.executors import LocalExecutor, progress_bar
from acwm_formats.inverse.reader import ActionEstimates, ActionReader, Quality

CONFIDENCE = "action_confidence"
"""The field of the state that holds the confidence of each action: 1 for recorded ones."""

SHARD_EPISODES = 32


@dataclass(frozen=True)
class Labelled:
    """What was labelled.

    Attributes:
        card: of the dataset that was written.
        quality: how well actions of held-out labelled episodes are read.
        confidence: mean confidence of each episode that was labelled and kept.
        left_out: number of episodes whose mean confidence was too low.
    """

    card: DatasetCard
    quality: Quality
    confidence: tuple[float, ...]
    left_out: int


def label(
    data: str | Path,
    labelled: str | Path,
    out: str | Path,
    *,
    steps: int = 1500,
    seed: int = 0,
    least: float = 0.0,
    progress: bool = True,
) -> Labelled:
    """Write the episodes of `labelled`, and those of `data` with actions read from their videos.

    Recorded episodes come first in `train`; the tests are those of `labelled`. Actions that `data`
    has are not used. The state field `action_confidence` tells recorded actions from others, and so
    does the card.

    Args:
        data: data folder whose training episodes are labelled.
        labelled: data folder with recorded actions of the same world and camera.
        out: data folder to create.
        steps: training steps of the inverse dynamics model.
        seed: of its weights and of the order of examples.
        least: mean confidence below which an episode is left out.
        progress: whether to show progress bars.

    Raises:
        DataError: the datasets do not fit, there are too few labelled episodes, no episode is sure
            enough, or `out` exists.
    """
    if Path(out).exists():
        raise DataError(f"{out} already exists: choose another --out, or delete it")
    recorded, unlabelled = EpisodeDataset(labelled, "train"), EpisodeDataset(data, "train")
    check_alike(unlabelled, recorded)
    reader = ActionReader(recorded, steps=steps, seed=seed, progress=progress)
    labels: dict[int, ActionEstimates] = {}
    with progress_bar("labelling", len(unlabelled), shown=progress) as report:
        for index in range(len(unlabelled)):
            labels[index] = reader.read(unlabelled.video(index))
            report(1)
    sure = {k: float(read.confidence.mean()) for k, read in labels.items()}
    kept = [index for index, confidence in sure.items() if confidence >= least]
    if not kept:
        raise DataError(
            f"no episode of {data} is labelled with a mean confidence of {least:g} or more (the "
            f"highest is {max(sure.values()):.2f}): record more labelled episodes, or lower --least"
        )
    card = _card(recorded, unlabelled, len(kept), reader.quality, steps, seed, least)
    source = _Source(recorded, unlabelled, {k: labels[k] for k in kept}, card.environment)
    written = fill(Path(out), card, source, LocalExecutor(0), progress=progress)
    confidences = tuple(sure[index] for index in kept)
    return Labelled(written, reader.quality, confidences, len(sure) - len(kept))


def check_alike(data: EpisodeDataset, labelled: EpisodeDataset) -> None:
    """Refuse recorded actions of another camera, size or rate than the videos.

    Raises:
        DataError: says how to import one of them again.
    """
    ours, theirs = data.card.environment, labelled.card.environment
    if ours.frame_size != theirs.frame_size or ours.views != theirs.views:
        sizes = ["×".join(map(str, environment.frame_size)) for environment in (ours, theirs)]
        raise DataError(
            f"{data.path} has frames of {sizes[0]}, and {labelled.path} of {sizes[1]}, or other "
            "cameras: import one of them again with the same --size and --cameras"
        )
    if abs(ours.fps / theirs.fps - 1) > 1e-3:
        raise DataError(
            f"{data.path} has {ours.fps:g} frames per second, and {labelled.path} {theirs.fps:g}: "
            f"import it again with --fps {theirs.fps:g}"
        )
    if labelled.card.source.get("unusable"):
        raise DataError(
            f"{labelled.path} has no recorded actions, so there is nothing to learn from"
        )


def _card(
    recorded: EpisodeDataset,
    unlabelled: EpisodeDataset,
    kept: int,
    quality: Quality,
    steps: int,
    seed: int,
    least: float,
) -> DatasetCard:
    old, count = recorded.card, len(recorded)
    splits: dict[Split, int] = {"train": count + kept}
    if "ind_test" in old.splits:
        splits["ind_test"] = old.splits["ind_test"]
    others = unlabelled.card.environment
    environment = old.environment
    same = environment.instances == others.instances
    instances = environment.instances if same else ("unlabelled",)
    text = "1 for a recorded action; else the share of its variance that is likely explained"
    shared = [field for field in environment.state if field in others.state]
    state = (*without_dangling(shared, instances), StateField(CONFIDENCE, (1,), "", text))
    name = environment.name if old.source else f"{environment.name}_labelled"
    environment = replace(
        environment,
        name=name,
        horizon=max(environment.horizon, others.horizon),
        factors=(),
        ood_shifts=(),
        state=state,
        instances=instances,
    )
    return DatasetCard(
        environment=environment,
        splits=splits,
        seed=seed,
        options={"size": [*environment.frame_size]},
        factors={},
        shard_episodes=SHARD_EPISODES,
        versions=package_versions(["torch"]),
        source=_about(recorded, unlabelled, kept, quality) | {"steps": steps, "least": least},
    )


def _about(
    recorded: EpisodeDataset, unlabelled: EpisodeDataset, kept: int, quality: Quality
) -> dict[str, Any]:
    """What the card says of the labels."""
    count, name = len(recorded), unlabelled.path.resolve().name
    measured = {
        key: [None if isinstance(v, float) and np.isnan(v) else v for v in value]
        if isinstance(value, tuple)
        else value
        for key, value in asdict(quality).items()
    }
    note = (
        f"The actions of train episodes {count} to {count + kept - 1} were not recorded but read "
        f"from their videos; on {quality.episodes} held-out recorded episodes this explains "
        f"{quality.mean:.0%} of the actions' variance."
    )
    return {
        "kind": "labels",
        "name": name,
        "recorded": {"from": recorded.path.resolve().name, "checksum": recorded.checksum},
        "labelled": {"checksum": unlabelled.checksum, "train": [count, count + kept]},
        "held_out": measured,
        "notes": [note],
    }


@dataclass(frozen=True)
class _Source:
    """The episodes of the dataset to write; see `EpisodeSource`."""

    recorded: EpisodeDataset
    unlabelled: EpisodeDataset
    labels: Mapping[int, ActionEstimates]
    environment: EnvironmentCard

    def __call__(self, specs: Sequence[EpisodeSpec]) -> Iterator[Episode]:
        tests = self.recorded
        if specs and specs[0].split != "train":
            tests = EpisodeDataset(self.recorded.path, specs[0].split)
        order = [*self.labels]
        for spec in specs:
            number = spec.index - len(self.recorded)
            if spec.split != "train":
                yield self._with(spec, tests[spec.index], None)
            elif number < 0:
                yield self._with(spec, self.recorded[spec.index], None)
            else:
                yield self._with(spec, self.unlabelled[order[number]], self.labels[order[number]])

    def _with(self, spec: EpisodeSpec, episode: Episode, labels: ActionEstimates | None) -> Episode:
        """An episode with these labels, or with the actions that were recorded."""
        actions, confidence = episode.actions, np.ones((len(episode.video), 1), np.float32)
        if labels is not None:
            actions = np.concatenate([labels.actions, np.zeros_like(labels.actions[:1])])
            confidence[:-1, 0], confidence[-1] = labels.confidence, labels.confidence[-1]
        states: dict[str, NDArray[Any]] = {CONFIDENCE: confidence}
        names = (field.name for field in self.environment.state)
        states |= {name: episode.states[name] for name in names if name != CONFIDENCE}
        blank = self.environment.instances == ("unlabelled",)
        masks = np.zeros_like(episode.masks) if blank else episode.masks
        contacts = episode.contacts[:0] if blank else episode.contacts
        return Episode(spec, episode.video, actions, states, masks, contacts, {}, None)
