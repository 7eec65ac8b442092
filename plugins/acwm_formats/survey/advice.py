"""Which overlay of `acwm fit small` suits a dataset, by what moves in its video.

The limits lie between what was measured on acwm's eight worlds and on fourteen videos of other
programs (docs/your-own-data.md says how).
"""

from __future__ import annotations

import itertools
from pathlib import Path

from acwm_core.data.card import CARD, DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.env.episode import Split
from acwm_core.recipe.advice import Advice
from acwm_formats.survey.movement import Movement, movement
from acwm_formats.survey.sample import Unread, stretches

BORDER = 0.15  # from which the camera moves: at most 0.06 where it stands, 0.31 where it drives
CROWD = 8.0  # things from which they are a crowd: at most 6.1 in a scene, 10 and more of sprites
APART = 0.15  # from which all episodes look different at rest: 0.11 of hills, 0.20 of sand
MOVES = 0.002  # share of the picture from which something moves: at least 0.004 of a small ball
EPISODES = 100  # recordings from which points are known to learn how actions move them

STRETCHES = 24  # examined before a training begins


def advice_for(path: Path) -> Advice | None:
    """What suits the recordings in a data folder; None for data that acwm simulated."""
    if not (path / CARD).is_file():
        return None
    card = DatasetCard.read(path)
    if not card.source:
        return None
    data: dict[Split, EpisodeDataset] = {"train": EpisodeDataset(path, "train")}
    sample = itertools.islice(stretches(data, Unread()), STRETCHES)
    return advice_on(card, movement(stretch.video for stretch in sample))


def advice_on(card: DatasetCard, motion: Movement | None) -> Advice:
    """What suits data with this card, in which this moves."""
    if motion is None:
        return Advice("", "its episodes are too short to see what moves")
    if motion.border >= BORDER:
        return Advice("", "the camera moves, and a scene needs one that stands still")
    if card.environment.camera is not None and card.environment.state:
        return Advice("scene", "states are recorded, and the card declares the camera")
    if motion.changed < MOVES:
        return Advice("", "hardly anything moves")
    things = f"about {round(motion.things)} thing" + "s" * (round(motion.things) != 1)
    if motion.things >= CROWD:
        return Advice("", f"{things} move at once, more than points tell apart")
    if motion.apart >= APART:
        return Advice("", "the ground is another one in each episode, and points would look there")
    if (count := card.splits.get("train", 0)) < EPISODES:
        return Advice("", f"there are {count} recordings, and points need {EPISODES} or more")
    where = f"{things} in {motion.changed:.1%} of the picture"
    return Advice("points", f"the camera stands still and what moves is {where}")
