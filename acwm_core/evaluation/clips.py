"""Which clips are predicted, and what predicts them. Does not import torch."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.clips import window_actions
from acwm_core.env.episode import SPLITS, Episode
from acwm_core.errors import AcwmWarning, DataError
from acwm_core.evaluation.config import EvaluationConfig
from acwm_core.evaluation.protocol import protocol_named

if TYPE_CHECKING:
    from acwm_core.data.dataset import EpisodeDataset
    from acwm_core.model import shapes

Predictor = Literal[
    "model",
    "mean_of_draws",
    "best_of_draws",
    "shuffled",
    "copy",
    "codec",
    "truth",
    "perturbed",
]
"""A row of the results, named after what made its prediction:

* ``model``: the world model with the clip's actions; if several draws are scored, their mean score.
* ``mean_of_draws``: the mean frames of the model's draws.
* ``best_of_draws``: in each metric, the draw of the clip that is best in it.
* ``shuffled``: the same model and noise with another episode's actions.
* ``copy``: the first frame, repeated.
* ``codec``: the codec's reconstruction of the truth, a ceiling for every model that uses it.
* ``truth``: the true video itself, for metrics that read states from video. It gives their noise
  floor: smaller scores say more about the estimator than about a model.
* ``perturbed``: the simulator with the clip's actions, started slightly elsewhere, for a few clips.
  It shows what no model can predict.
"""

DRAWN: tuple[Predictor, ...] = ("mean_of_draws", "best_of_draws")
"""The rows that are made of the model's draws, after the row ``model``."""

PREDICTORS: tuple[Predictor, ...] = ("model", "shuffled", "copy", "codec", "truth")
"""The rows that need only the dataset and the model."""


@dataclass(frozen=True)
class Clip:
    """One clip to predict, decided before any video is read.

    It is identified by split, episode and start.

    Attributes:
        split: test split.
        episode: number of the episode within the split.
        start: the episode's frame with which the clip starts; the model is given this frame.
        frames: length of the clip.
        donor: the other episode, whose actions the ``shuffled`` row is given.
        donor_start: the donor's frame from which its actions are taken.
        seed: seed of the sampling noise; depends on the evaluation's seed, split, episode and
            start only.
        noise_floor: whether states are read from the true video and the codec's reconstruction.
        given: number of context frames.
    """

    split: str = ""
    episode: int = 0
    start: int = 0
    frames: int = 0
    donor: int = 0
    donor_start: int = 0
    seed: int = 0
    noise_floor: bool = True
    given: int = 1

    @property
    def where(self) -> str:
        """A description of the clip for messages."""
        return f"in episode {self.episode} of {self.split}, from frame {self.start}"


def sound_clips(
    episodes: EpisodeDataset, config: EvaluationConfig, given: int
) -> tuple[list[Clip], dict[str, str]]:
    """The clips of the episodes that can be read, and why others cannot, by their names.

    Raises:
        DataError: fewer than two can be read, or as `plan_clips`.
    """
    split = episodes.split
    chosen = protocol_named(config.protocol).episodes(len(episodes), config.episodes)
    damage = {episode: why for episode in chosen if (why := episodes.damage(episode))}
    if damage:
        first, why = next(iter(damage.items()))
        unreadable = f"{len(damage)} of {len(chosen)} episodes of {split} cannot be read"
        if len(chosen) - len(damage) < 2:
            raise DataError(f"{unreadable}, and evaluation needs two; {why}")
        warnings.warn(
            f"{unreadable} and are left out, e.g. episode {first}: {why}", AcwmWarning, stacklevel=2
        )
    clips = plan_clips(split, episodes.lengths, config, given, without=damage)
    return clips, {f"episode {episode} of {split}": why for episode, why in damage.items()}


def plan_clips(
    split: str,
    lengths: Sequence[int],
    config: EvaluationConfig,
    given: int = 1,
    without: Collection[int] = (),
) -> list[Clip]:
    """The clips of a split with episodes of these lengths, in order, with `given` context frames.

    Args:
        without: numbers of episodes that are left out.

    Raises:
        DataError: fewer than two episodes, so that there are no other episode's actions to use; or
            a clip that is not longer than its context frames.
    """
    protocol = protocol_named(config.protocol)
    chosen = [
        episode
        for episode in protocol.episodes(len(lengths), config.episodes)
        if episode not in without
    ]
    if len(chosen) < 2:
        raise DataError(
            f"{split} has {len(chosen)} episode(s), but evaluation needs two, to predict one with "
            "the actions of the other: generate more"
        )
    donors = [chosen[place] for place in derangement(len(chosen), config.seed)]
    clips = [
        Clip(
            split,
            episode,
            start,
            frames,
            donor=donor,
            donor_start=max(0, min(start, lengths[donor] - frames)),
            seed=noise_seed(config.seed, split, episode, start),
            noise_floor=number < config.noise_floor_episodes,
            given=given,
        )
        for number, (episode, donor) in enumerate(zip(chosen, donors, strict=True))
        for start, frames in protocol.windows(lengths[episode], config.frames, config.cuts)
    ]
    short = [clip for clip in clips if given > 1 and clip.frames <= given]
    if short:
        raise DataError(
            f"a clip of episode {short[0].episode} of {split} has {short[0].frames} frames, of "
            f"which {given} are given: set a lower evaluation.context_frames"
        )
    return clips


def derangement(count: int, seed: int) -> list[int]:
    """A permutation of ``range(count)``, count ≥ 2, in which nothing keeps its place.

    It is a single cycle through all elements, drawn uniformly (Sattolo 1986).
    """
    rng = np.random.default_rng(seed)
    order = list(range(count))
    for last in range(count - 1, 0, -1):
        other = int(rng.integers(last))
        order[last], order[other] = order[other], order[last]
    return order


def noise_seed(seed: int, split: str, episode: int, start: int = 0) -> int:
    """The seed of one clip's sampling noise, independent of which other clips are evaluated."""
    identity = [seed, [*map(str, SPLITS)].index(split), episode, start]
    return int(np.random.SeedSequence(identity).generate_state(1)[0])


def draw_seeds(seed: int, draws: int) -> list[int]:
    """The seeds of several draws of a clip; the first is the clip's own seed."""
    more = (np.random.SeedSequence([seed, draw]) for draw in range(1, draws))
    return [seed, *(int(sequence.generate_state(1)[0]) for sequence in more)]


def read_clips(clips: Iterable[Clip], episodes: EpisodeDataset) -> Iterator[tuple[Clip, Episode]]:
    """Each clip with its part of the episode; consecutive clips of one episode decode it once."""
    for number, group in itertools.groupby(clips, lambda clip: clip.episode):
        episode = episodes[number]
        for clip in group:
            yield clip, cut_episode(episode, clip.start, clip.frames)


def donor_actions(
    clip: Clip, own: NDArray[np.float32], episodes: EpisodeDataset
) -> NDArray[np.float32]:
    """The other episode's actions for a clip, `[T, A]`; between context frames, the clip's `own`.

    The last row is zero.
    """
    actions = window_actions(episodes.actions(clip.donor), clip.donor_start, clip.frames)
    actions[: clip.given - 1] = own[: clip.given - 1]
    return actions


def as_clip(video: NDArray[np.uint8]) -> shapes.Clip:
    """A video `[T, H, W, 3]` uint8 as a clip `[T, 3, H, W]` float32 in [0, 1].

    It is contiguous with channels first, like predictions: pixel metrics then take a third of the
    time.
    """
    import torch  # planning clips does not need it

    return torch.as_tensor(video).permute(0, 3, 1, 2).contiguous().float() / 255


def cut_episode(episode: Episode, start: int, frames: int) -> Episode:
    """The frames ``start … start + frames − 1`` of an episode, as if it had begun with them.

    Frame numbers of contacts are relative to the window's first frame; contacts in the interval
    before it are kept as frame 0. The last row of actions leads out of the window and is zero.
    """
    inside = slice(start, start + frames)
    contacts = episode.contacts - np.array([start, 0, 0], episode.contacts.dtype)
    kept = (contacts[:, 0] >= 0) & (contacts[:, 0] < frames)
    return replace(
        episode,
        video=episode.video[inside],
        actions=window_actions(episode.actions, start, frames),
        states={name: values[inside] for name, values in episode.states.items()},
        masks=episode.masks[inside],
        contacts=contacts[kept],
    )
