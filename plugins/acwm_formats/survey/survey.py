"""`survey`: look at a dataset and say what is good and bad in it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from acwm_core.data.card import DatasetCard
from acwm_core.data.dataset import EpisodeDataset
from acwm_core.data.remote import data_folder
from acwm_core.env.episode import Split
from acwm_core.evaluation.statistics import MIN_EPISODES
from acwm_formats.survey.action_rate import ActionRate
from acwm_formats.survey.actions import ActionSummary, action_facts
from acwm_formats.survey.advice import advice_on
from acwm_formats.survey.following import SHIFTS, Following, Moments, following
from acwm_formats.survey.frames import FrameFacts
from acwm_formats.survey.motion import small
from acwm_formats.survey.movement import Movement, Movements
from acwm_formats.survey.near_duplicates import NearDuplicate, near_duplicates
from acwm_formats.survey.sample import Unread, stretches

SURE = 0.9  # confidence from which a delay is stated and a shift is advised

PHRASES = {
    "dark": "black",
    "flat": "of one colour",
    "repeated": "repeated amid motion, as when dropped frames are filled or a video is stretched",
    "frozen": "frozen while actions change",
    "blurred": "far less sharp than those around them",
}


@dataclass(frozen=True)
class Finding:
    """One sentence about a dataset.

    Attributes:
        level: ``"bad"`` if a model would learn something wrong or nothing, ``"note"`` if it is for
            the reader to judge, ``"good"`` if it is as it should be.
        text: the sentence.
    """

    level: Literal["bad", "note", "good"]
    text: str


@dataclass(frozen=True)
class Survey:
    """What was found in a dataset.

    Attributes:
        path: the data folder.
        card: its card.
        lengths: frames of every episode, by split.
        actions: each action.
        frames: counts of defective frames in the sample.
        following: whether the video follows the actions; None if that cannot be told.
        near_duplicates: test episodes that nearly equal training episodes.
        compared: number of test episodes that were compared.
        unread: episodes that cannot be read, of those that were looked at.
        movement: what moves in the video; None if episodes are too short to say.
        findings: what to know first; the worst come first.
    """

    path: Path
    card: DatasetCard
    lengths: dict[Split, list[int]]
    actions: list[ActionSummary]
    frames: FrameFacts
    following: Following | None
    near_duplicates: list[NearDuplicate]
    compared: int
    unread: Unread
    movement: Movement | None = None

    @property
    def findings(self) -> list[Finding]:
        """All sentences, the bad ones first."""
        every = [
            *_of_unread(self.unread),
            *_of_rate(self.rate),
            *_of_following(self),
            *_of_actions(self),
            *_of_frames(self),
            *_of_duplicates(self),
            *(_of_tests(self.lengths) if self.card.source else ()),
            *(_of_model(self) if self.card.source and self.movement else ()),
        ]
        return sorted(every, key=lambda finding: ("bad", "note", "good").index(finding.level))

    @property
    def rate(self) -> ActionRate | None:
        """How often actions came in the recordings; None if once per frame, or nothing tells."""
        return ActionRate.of_source(self.card.source or {})

    @property
    def headline(self) -> str:
        """The verdict: whether the video follows the actions, and when."""
        following = self.following
        if following is None:
            return "Too little to tell whether the video follows the actions"
        if not following.follows:
            return "Nothing in the video follows the actions"
        if self.rate and self.rate.is_open:
            return "The video follows the actions; the delay is unknown until their kind is known"
        if following.delay is None:
            return "The video follows the actions; the delay is unknown"
        if following.confidence < SURE:
            return "The video follows the actions; the delay is uncertain"
        if not following.delay:
            return "The video follows the actions, at once"
        late = "late" if following.delay > 0 else "early"
        return f"The video follows the actions {_counted(abs(following.delay), 'frame')} {late}"


def survey(path: str | Path) -> Survey:
    """Look at the data folder `path`.

    A sample is read, one stretch at a time, so memory and time hardly depend on the number of
    episodes.

    Raises:
        DataError: there is no dataset, or it is unfinished, or none of its episodes can be read.
    """
    path = data_folder(path)
    card = DatasetCard.read(path)
    data: dict[Split, EpisodeDataset] = {
        split: EpisodeDataset(path, split) for split in card.splits
    }
    frames, moments, unread = FrameFacts(), list[Moments](), Unread()
    movements = Movements()
    for stretch in stretches(data, unread):
        place = stretch.split, stretch.episode
        frames.add((*place, stretch.start), stretch.video, stretch.actions, card.environment.views)
        movements.add(stretch.video)
        moments.append(Moments(place, stretch.start, small(stretch.video), stretch.actions))
    duplicates, compared = near_duplicates(data, unread)
    return Survey(
        path=path,
        card=card,
        lengths={split: split_data.lengths for split, split_data in data.items()},
        actions=action_facts(data, card.environment.action, unread),
        frames=frames,
        following=following(moments),
        near_duplicates=duplicates,
        compared=compared,
        unread=unread,
        movement=movements.summary(),
    )


def short_form(survey: Survey) -> list[str]:
    """The verdict and what is wrong, in lines for a terminal."""
    marks = {"bad": "✗", "note": "·", "good": "✓"}
    lines = [f"{marks[finding.level]} {finding.text}" for finding in survey.findings]
    return [*lines, f"all of it, with videos: acwm data report {shlex.quote(str(survey.path))}"]


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'s' * (count != 1)}"


def _sure(confidence: float) -> str:
    return "over 99 %" if confidence > 0.99 else f"{confidence:.0%}"


def _of_unread(unread: Unread) -> Iterator[Finding]:
    if unread.places:
        (split, index), why = next(iter(unread.places.items()))
        count = f"{len(unread.places)} of {len(unread.tried)} episodes looked at"
        yield Finding("bad", f"{count} cannot be read, e.g. {split} {index}: {why}")


def _of_rate(rate: ActionRate | None) -> Iterator[Finding]:
    if rate and rate.is_open:
        level = "bad" if rate.follows == "sum" else "note"
        yield Finding(level, f"{rate.sentence}. {rate.question[0].upper()}{rate.question[1:]}")


def _of_following(survey: Survey) -> Iterator[Finding]:
    seen, says = survey.following, survey.headline
    if seen is None:
        why = "a verdict needs at least four episodes of a dozen frames, and actions that change"
        yield Finding("note", f"{says}: {why}")
    elif not seen.follows:
        why = (
            f"in {seen.episodes} episodes, frames show no more of their own actions than of others"
        )
        first = "; state their kind first" if survey.rate and survey.rate.is_open else ""
        yield Finding("bad", f"{says}: {why}; a model would learn to ignore them{first}")
    elif survey.rate and survey.rate.is_open:
        yield Finding("note", says)
    elif seen.delay is None:
        yield Finding("note", f"{says}: actions change too steadily")
    elif seen.confidence < SURE:
        likely = f"{_counted(seen.delay, 'frame')} in {seen.confidence:.0%} of resamples"
        yield Finding("note", f"{says} ({likely}): more episodes would decide")
    elif seen.delay:
        edge = " (or more: no larger delay was tried)" if abs(seen.delay) == SHIFTS else ""
        advice = f"import it with --shift {seen.delay} if your robot has no such offset"
        yield Finding("bad", f"{says}{edge}, confidence {_sure(seen.confidence)}: {advice}")
    else:
        yield Finding("good", f"{says}: delay 0, confidence {_sure(seen.confidence)}")


def _of_actions(survey: Survey) -> Iterator[Finding]:
    constant = [action.name for action in survey.actions if action.constant]
    if constant:
        yield Finding("note", f"constant: {', '.join(constant)}; nothing can be learned from them")
    recorded = bool(survey.card.source)  # the bounds of a simulator are not taken from its data
    for action in survey.actions:
        if action.narrow is not None and not action.constant:
            near, far = action.quantiles
            text = (
                f"{action.name} has outliers: 98 % of its values lie from {near:.4g} to {far:.4g}, "
                f"in {action.narrow:.1%} of its bounds {action.bounds[0]:.4g} to "
                f"{action.bounds[1]:.4g}"
            )
            advice = "; import it with --bounds quantile"
            yield Finding("bad", text + advice) if recorded else Finding("note", text)
        if action.choices and recorded:
            text = (
                f"{action.name} takes the {action.choices} whole numbers from {action.least:g} to "
                f"{action.most:g}: models take them as an amount. If they are choices, record "
                "a column of 0 and 1 for each"
            )
            yield Finding("note", text)
        if action.outside:
            yield Finding("note", f"{action.outside:.2%} of {action.name} are outside its bounds")


def _of_frames(survey: Survey) -> Iterator[Finding]:
    facts = survey.frames
    asked = PHRASES if survey.card.source else PHRASES.keys() - {"repeated", "frozen"}
    counts = {name: getattr(facts, name) for name in PHRASES if name in asked}
    if not any(counts.values()):
        yield Finding("good", f"{facts.frames:,} frames were looked at; none is defective")
    for name, count in counts.items():
        if not count:
            continue
        split, episode, frame = facts.examples[name][0]
        where = f"e.g. frame {frame} of {split} {episode}"
        level = "bad" if count > 0.05 * facts.frames else "note"
        yield Finding(level, f"{count} of {facts.frames:,} frames are {PHRASES[name]} ({where})")


def _of_tests(lengths: dict[Split, list[int]]) -> Iterator[Finding]:
    if not lengths.keys() - {"train"}:
        yield Finding("note", f"no test episodes: a verdict needs {MIN_EPISODES}")
    for split, episodes in lengths.items():
        if split != "train" and len(episodes) < MIN_EPISODES:
            yield Finding(
                "note",
                f"{split} has {_counted(len(episodes), 'episode')}: an interval and a verdict need "
                f"{MIN_EPISODES}. Record more, or import again with --test-episodes {MIN_EPISODES}",
            )


def _of_model(survey: Survey) -> Iterator[Finding]:
    advice = advice_on(survey.card, survey.movement)
    model = f"+{advice.overlay}" if advice.overlay else "its recurrent model"
    yield Finding("good", f"acwm fit small takes {model}: {advice.why}")


def _of_duplicates(survey: Survey) -> Iterator[Finding]:
    if survey.near_duplicates:
        first, count = survey.near_duplicates[0], len(survey.near_duplicates)
        yield Finding(
            "bad",
            f"{count} of {survey.compared} test episodes nearly equal training episodes, e.g. "
            f"{first.split} {first.episode} and train {first.trained}: scores will be too good",
        )
    elif survey.compared:
        yield Finding("good", f"none of {survey.compared} test episodes equals a training episode")
