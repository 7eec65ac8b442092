"""Writes a dataset whose actions are latent ones, which were learnt from its videos alone."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from acwm_core.data.card import DatasetCard, package_versions
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.generate import fill
from acwm_core.env.environment import ActionSpec, EnvironmentCard
from acwm_core.env.episode import Episode, EpisodeSpec, Split
from acwm_core.errors import DataError
from acwm_core.executors import LocalExecutor
from acwm_formats.inverse.action_decoder import DecoderQuality
from acwm_formats.inverse.label import SHARD_EPISODES, check_alike
from acwm_formats.inverse.latent_network import HIGHEST
from acwm_formats.inverse.latent_reader import (
    LatentQuality,
    LatentReader,
    check_lengths,
)

KEPT: tuple[Split, ...] = ("train", "ind_test")
"""Splits whose episodes get latent actions, if the dataset has them."""


@dataclass(frozen=True)
class LatentLabelled:
    """What was labelled.

    Attributes:
        card: of the dataset that was written.
        quality: what the latent actions say of held-out episodes.
        decoder: how they relate to recorded actions; None if none were given.
    """

    card: DatasetCard
    quality: LatentQuality
    decoder: DecoderQuality | None


def label_latent(
    data: str | Path,
    out: str | Path,
    dimensions: int,
    labelled: str | Path | None = None,
    *,
    steps: int = 1500,
    seed: int = 0,
    progress: bool = True,
) -> LatentLabelled:
    """Write the episodes of `data` with latent actions in the place of their own.

    Args:
        data: data folder whose videos are learnt from; actions that it has are not used.
        out: data folder to create.
        dimensions: number of whole numbers from −`HIGHEST` to `HIGHEST` in an action.
        labelled: data folder with recorded actions of the same world and camera, to which the
            latent ones are related.
        steps: training steps.
        seed: of the weights and the order of examples.
        progress: whether to show progress bars.

    Raises:
        DataError: the datasets do not fit, there is nothing to learn from, or `out` exists.
    """
    if Path(out).exists():
        raise DataError(f"{out} already exists: choose another --out, or delete it")
    episodes = EpisodeDataset(data, "train")
    recorded = None if labelled is None else EpisodeDataset(labelled, "train")
    if recorded is not None:
        check_alike(episodes, recorded)
        check_lengths(recorded)
    kept: list[Split] = [name for name in KEPT if name in episodes.card.splits]
    splits: dict[Split, EpisodeDataset] = {name: EpisodeDataset(data, name) for name in kept}
    for split in splits.values():
        check_lengths(split, least=2 if split.split == "train" else 0)
    reader = LatentReader(episodes, dimensions, steps=steps, seed=seed, progress=progress)
    decoder = None if recorded is None else reader.fit_decoder(recorded)
    card = _card(episodes, recorded, reader, decoder)
    card = replace(card, source={**card.source, "steps": steps, "seed": seed})
    written = fill(Path(out), card, _Source(splits, reader), LocalExecutor(0), progress=progress)
    return LatentLabelled(written, reader.quality, decoder)


def _card(
    episodes: EpisodeDataset,
    recorded: EpisodeDataset | None,
    reader: LatentReader,
    decoder: DecoderQuality | None,
) -> DatasetCard:
    old, size = episodes.card, reader.dimensions
    quality = reader.quality
    note = (
        f"The actions are latent: {size} whole numbers from -{HIGHEST} to {HIGHEST}, learnt from "
        f"the videos alone and not recorded. With them {quality.explained:.0%} of the changes "
        f"between frames is predicted in {quality.episodes} held-out episodes, and "
        f"{quality.shuffled:.0%} with those of other moments."
    )
    source: dict[str, Any] = {
        "kind": "latent actions",
        "name": episodes.path.resolve().name,
        "videos": {"checksum": episodes.checksum},
        "held_out": asdict(quality),
        "notes": [note],
    }
    if recorded is not None and decoder is not None:
        source["action_decoder"] = {
            "from": recorded.path.resolve().name,
            "checksum": recorded.checksum,
            "actions": [*recorded.card.environment.action.names],
            "explained": [None if np.isnan(share) else share for share in decoder.explained],
            "weights": decoder.decoder.weights.tolist(),
            "offset": decoder.decoder.offset.tolist(),
        }
    return DatasetCard(
        environment=_with_latent_actions(old.environment, size),
        splits={name: old.splits[name] for name in KEPT if name in old.splits},
        seed=old.seed,
        options={"size": [*old.environment.frame_size]},
        factors={},
        shard_episodes=SHARD_EPISODES,
        versions=package_versions(["torch"]),
        source=source,
    )


def _with_latent_actions(environment: EnvironmentCard, size: int) -> EnvironmentCard:
    """A card of the same world whose actions are latent, which no symmetry transforms."""
    names = tuple(f"latent_{number}" for number in range(size))
    lowest, highest = (-float(HIGHEST),) * size, (float(HIGHEST),) * size
    return replace(
        environment,
        name=f"{environment.name}_latent",
        action=ActionSpec(names, ("",) * size, lowest, highest, "delta"),
        factors=(),
        ood_shifts=(),
        symmetries=(),
    )


@dataclass(frozen=True)
class _Source:
    """The episodes of the dataset to write; see `EpisodeSource`."""

    splits: dict[Split, EpisodeDataset]
    reader: LatentReader

    def __call__(self, specs: Sequence[EpisodeSpec]) -> Iterator[Episode]:
        for spec in specs:
            split = self.splits[spec.split]
            latents = self.reader.read(split.video(spec.index))
            actions = np.concatenate([latents, np.zeros_like(latents[:1])])
            episode = split[spec.index]
            yield replace(episode, spec=spec, actions=actions, factors={}, ood_label=None)
