"""Checks of an environment: what every dataset, model and metric requires of it."""

from __future__ import annotations

import functools
import json
import multiprocessing
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from acwm_core.checks.result import NotTried, expect, expect_equal, expect_is_a
from acwm_core.checks.scene import wrong_numbers, wrongly_following, wrongly_seen
from acwm_core.checks.task import TaskChecks
from acwm_core.checks.trial import BEGINNING
from acwm_core.data.simulate import simulate
from acwm_core.env.environment import Environment, EnvironmentCard, Policy, StateField
from acwm_core.env.episode import Episode, EpisodeSpec, Factor
from acwm_core.env.states import encode
from acwm_core.env.symmetry import Symmetry, group

CLOSE = 0.01
"""Mean difference of two frames, as a fraction of white, that counts as hardly visible."""

UNLABELLED = ("unlabelled",)
"""The instances of a world that shows no masks, such as one of Gymnasium or recordings."""

SOME = BEGINNING // 2
"""Frames that are simulated once more to show that nothing but spec and actions counts."""

OVERLAP, PAINT, OFF = 0.5, 0.1, 0.02
"""What a symmetry must keep: the least overlap of the masks of every instance (intersection over
union; edges of small ones fall into other pixels), the largest mean difference of its colours as a
fraction of white (light and floor need not follow), and the largest error of a declared field of
the state as a fraction of its largest value."""

DOUBT = 2.0
"""How many times as far as from a perturbed start the state may get: where a cloth folds, the order
in which the simulator solves its nodes decides."""


class EnvironmentChecks(TaskChecks):
    """Checks of an `acwm_core.env.environment.Environment` on episodes of small frames.

    The last five check that an `EpisodeSpec` and actions determine every byte. One of them imports
    the environment in a fresh process, so it must be importable.
    """

    def simulates_an_episode(self) -> None:
        """Construct the environment and run its policy through one episode."""
        expect_is_a(self.environment, Environment)
        expect_equal("frames of the episode:", len(self.episode.video), self.card.horizon)

    def gymnasium_api(self) -> None:
        """Pass Gymnasium's own `check_env`."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            check_env(self.make(size=self.size), skip_render_check=True)

    def card_is_complete(self) -> None:
        """State everything a user needs to know on the card."""
        card, action = self.card, self.card.action
        expect(self.name in (None, card.name), f"its card calls it {card.name!r}")
        for attribute in ("name", "summary", "engine", "state"):
            expect(getattr(card, attribute), f"the card's {attribute} is empty")
        expect(card.horizon >= 2, f"a horizon of {card.horizon} frames leaves no action to take")
        expect(action.size > 0, "the action has no dimension")
        named = card.instances[1:] or card.instances == UNLABELLED
        expect(named, "the card names nothing but the background in `instances`")
        for names in (action.names, [f.name for f in card.factors], [s.name for s in card.state]):
            expect(len(set(names)) == len(names), f"a name occurs twice in {', '.join(names)}")

    def card_survives_json(self) -> None:
        """Survive a round trip through JSON, since datasets store the card in a file."""
        restored = EnvironmentCard.from_dict(json.loads(json.dumps(self.card.to_dict())))
        expect(restored == self.card, "the card changes on its way through JSON")

    def factors_have_ranges(self) -> None:
        """Declare factors whose nominal value is in distribution and whose OoD values are not."""
        card = self.card
        if card.instances == UNLABELLED and not card.factors:
            raise NotTried("it is a world of others, whose card declares no factors")
        expect(card.factors, "the card declares no factor of variation")
        for factor in card.factors:
            expect(factor.train and factor.ood, f"{factor.name!r} lacks a train or OoD range")
            for value in (factor.nominal, *factor.train):
                inside = not factor.severity(value)
                expect(inside, f"{factor.name}={value} must lie inside training")
            for shift in factor.ood:
                value = shift if factor.kind == "discrete" else sum(shift) / 2
                outside = factor.severity(value) > 0
                expect(outside, f"{factor.name}={value} must lie outside training")
        names = [factor.name for factor in card.factors]
        expect(card.ood_shifts, "ood_shifts is empty: ood_test would equal training")
        for name in card.ood_shifts:
            expect(name in names, f"ood_shifts names {name!r}, which is not a factor of the card")

    def splits_are_labelled(self) -> None:
        """In `ood_test`, shift the factors of `ood_shifts` in turn; shift none in other splits."""
        for split in ("train", "ind_test"):
            for index in range(2):
                label = self._started(self.spec(split, index))[1]["ood_label"]
                expect(label is None, f"{split} has an episode labelled OoD")
        shifts = self.card.ood_shifts
        for index, wanted in enumerate((*shifts, *shifts[:1])):
            label = self._started(self.spec("ood_test", index))[1]["ood_label"]
            named = [shift.split("=")[0] for shift in (label or "").split("+")]
            what = f"episode {index} of ood_test is labelled {label!r}, not {wanted!r}"
            expect(wanted in named, what)

    def state_matches_card(self) -> None:
        """Return exactly the state fields of the card, in their shapes, as finite numbers."""
        states = self.episode.states
        actual = {name: values.shape[1:] for name, values in states.items()}
        declared = {field.name: field.shape for field in self.card.state}
        expect(actual == declared, f"the state has {actual}; the card says {declared}")
        for name, values in states.items():
            expect(values.dtype.kind in "fiub", f"state {name!r} is {values.dtype}, not numbers")
            expect(np.all(np.isfinite(values)), f"state {name!r} is not finite")

    def masks_match_card(self) -> None:
        """Show instances in the mask, all of them named on the card."""
        masks, names = self.episode.masks, self.card.instances
        expect_equal("masks are", masks.shape[1:], self.environment.frame_size)
        expect_equal("masks are", masks.dtype, np.dtype(np.uint8))
        expect(masks.max() < len(names), f"mask id {masks.max()} has no name in `instances`")
        if names == UNLABELLED:
            raise NotTried("its instances are unlabelled")
        expect(masks.any(), "the mask shows nothing but background")

    def states_are_of_their_kinds(self) -> None:
        """Hold what the card declares: quaternions of length 1, presences of 0 or 1."""
        for field in self.card.state:
            problem = wrong_numbers(field, self.episode)
            expect(not problem, problem)

    def states_follow(self) -> None:
        """Let a field that follows from others be alike whenever these are, in an episode."""
        for field in self.card.state:
            if field.follows:
                sources = [self.card.fields[name] for name in field.follows]
                problem = wrongly_following(field, sources, self.episode)
                expect(not problem, problem)

    def positions_are_in_the_masks(self) -> None:
        """Show instances where the card's camera sees their positions."""
        for field in self.card.state:
            problem = wrongly_seen(field, self.card, self.beginning)
            expect(not problem, problem)

    def contacts_match_card(self) -> None:
        """Report contacts between two different instances of the card."""
        known = range(len(self.card.instances))
        for _, first, second in self.episode.contacts.tolist():
            expect(first != second, f"instance {first} is in contact with itself")
            named = first in known and second in known
            expect(named, f"contact ({first}, {second}) names no instance")

    def results_are_fresh(self) -> None:
        """Return arrays that later steps do not change."""
        actions = self.beginning.actions[:8]
        frame, info = self._started(self.spec())
        kept = {"frame": frame, "mask": info["mask"], **info["state"]}
        copies = {name: np.array(value) for name, value in kept.items()}
        for action in actions:
            self.environment.step(action)
        for name, copy in copies.items():
            same = np.array_equal(kept[name], copy)
            expect(same, f"a later step overwrote {name!r} of the first")

    def policy_moves_something(self) -> None:
        """Collect data worth learning from: actions within bounds that vary, frames that change."""
        actions, action = self.episode.actions[:-1], self.card.action
        low, high = np.array(action.low, np.float32), np.array(action.high, np.float32)
        expect(np.all((actions >= low) & (actions <= high)), "the policy leaves the action bounds")
        expect(np.ptp(actions, axis=0).any(), "the policy repeats a single action")
        change = np.ptp(self.episode.video, axis=0).max()
        expect(change > 16, "nothing visibly moves in an episode of the policy")

    def actions_matter(self) -> None:
        """Give a different video for different actions from the same start."""
        usual, action, rng = self.beginning, self.card.action, np.random.default_rng(0)
        self._started(self.spec())
        differ = self._looks_different(
            usual, lambda: rng.uniform(action.low, action.high, action.size)
        )
        expect(differ, "other actions lead to the same video")

    def still_action_is_possible(self) -> None:
        """Provide an action that asks for no motion, within the bounds."""
        action, spec = np.asarray(self._still_action()), self.card.action
        expect(action.shape == (spec.size,), f"still_action() has shape {action.shape}")
        inside = np.all((action >= spec.low) & (action <= spec.high))
        expect(inside, "still_action() leaves the action bounds")

    def perturbed_start_is_close(self) -> None:
        """Start close to the usual start, and at rest, when asked for a perturbed start."""
        if not self.environment.can_be_perturbed:
            raise NotTried("its start cannot be perturbed")
        still, spec = np.tile(self._still_action(), (6, 1)), self.spec()
        usual, same, moved, again = (
            simulate(self.environment, spec, still, frames=len(still), perturbation=amount)
            for amount in (0.0, 0.0, 1.0, 1.0)
        )
        expect(same.digests() == usual.digests(), "a perturbation of 0 changes the episode")
        alike = moved.digests() == again.digests()
        expect(alike, "perturbing the same spec twice gives different starts")
        starts = ((usual.states[name][0], values[0]) for name, values in moved.states.items())
        unmoved = all(np.array_equal(*pair) for pair in starts)
        expect(not unmoved, "a perturbation changes nothing in the state of the first frame")
        first, *_, last = np.abs(moved.video.astype(float) - usual.video).mean((1, 2, 3)) / 255
        expect(first < CLOSE, f"a perturbed start is visible: it differs by {first:.1%} on average")
        what = f"without any action the picture differs by {last:.2%} soon, {first:.2%} at first"
        expect(last < 3 * first + CLOSE / 4, f"a perturbed start is not at rest: {what}")

    def symmetries_hold(self) -> None:
        """Lead from a transformed start, by transformed actions, to the transformed video."""
        card = self.card
        if not card.symmetries:
            raise NotTried("its card declares no symmetries")
        whole = {symmetry.name for symmetry in group(*card.symmetries)}
        declared = {symmetry.name for symmetry in card.symmetries}
        lacking = ", ".join(sorted(whole - declared))
        expect(
            declared == whole, f"the symmetries do not form a group: {lacking} follows from them"
        )
        for symmetry in card.symmetries:
            actions = symmetry.of_actions(self.beginning.actions)
            turned = simulate(
                self.environment, self.spec(), actions, frames=BEGINNING, symmetry=symmetry
            )
            broken = self._breach(symmetry, turned)
            expect(not broken, f"{symmetry.name!r} is no symmetry: {broken}")

    @functools.cached_property
    def _spread(self) -> dict[str, float]:
        """How far the states get from those of a perturbed start: the doubt of the world itself."""
        if not self.environment.can_be_perturbed:
            return {}
        usual = self.beginning
        moved = simulate(
            self.environment, self.spec(), usual.actions, frames=BEGINNING, perturbation=1.0
        )
        return {
            field.name: np.abs(_code(field, moved) - _code(field, usual)).max()
            for field in self.card.state
        }

    def _error(self, field: StateField, symmetry: Symmetry, turned: Episode) -> tuple[float, float]:
        """How far a field of `turned` is from what `symmetry` makes of it, and its largest value.

        Values that look alike are equal, and those of rows that do not exist do not count.
        """
        usual, values = (
            np.asarray(episode.states[field.name], np.float64)
            for episode in (self.beginning, turned)
        )
        wanted = self.card.transformed(symmetry, field.name, usual)
        if field.name in symmetry.headings:
            off, largest = np.angle(np.exp(1j * (values - wanted)))[usual != 0], np.pi
        else:
            off = encode(field, values) - encode(field, wanted)
            largest = np.abs(encode(field, wanted)).max()
            if field.present:
                there = np.asarray(self.beginning.states[field.present]).reshape(len(off), -1) > 0
                off = off[there]
        return float(np.abs(off).max(initial=0.0)), float(largest)

    def _breach(self, symmetry: Symmetry, turned: Episode) -> str:
        """What of `turned` is not as in the usual episode after `symmetry`; empty if nothing."""
        usual = self.beginning
        for field in self.card.state:
            if self.card.transforms(symmetry, field.name) and field.kind != "vector":
                error, largest = self._error(field, symmetry, turned)
                differs = error > OFF * largest + 1e-6
                if differs and error > DOUBT * self._spread.get(field.name, 0.0):
                    return f"state {field.name!r} differs by {error:.2g}"
        masks = symmetry.of_frames(usual.masks)
        colours = symmetry.of_frames(np.moveaxis(usual.video, -1, 1))
        unlike = np.abs(colours.astype(float) - np.moveaxis(turned.video, -1, 1)).mean(1) / 255
        for number, name in enumerate(self.card.instances):
            here, there = masks == number, turned.masks == number
            both, either = here & there, here | there
            if either.any() and both.sum() < OVERLAP * either.sum():
                return f"masks of {name!r} overlap by {both.sum() / either.sum():.0%}"
            painted = both.any() and name not in symmetry.repainted
            if painted and unlike[both].mean() > PAINT:
                return f"the colour of {name!r} differs by {unlike[both].mean():.0%}"
        return ""

    def factors_matter(self) -> None:
        """Change the episode when a factor is shifted (one of four episodes is enough)."""
        hidden = list(self.card.factors)
        for index in range(4):
            usual = simulate(self.environment, self.spec(index=index)) if index else self.episode
            hidden = [factor for factor in hidden if not self._shift_shows(usual, factor)]
            if not hidden:
                return
        names = ", ".join(repr(factor.name) for factor in hidden)
        expect(False, f"shifting {names} out of distribution changes no frame")

    def size_changes_only_resolution(self) -> None:
        """Show the same world at twice the frame size, in the same framing."""
        usual, (height, width) = self.beginning, self.size
        size, frames = (2 * height, 2 * width), min(SOME // 2, len(usual.video))
        large = self.make(size=size)
        episode = simulate(large, self.spec(), usual.actions[:frames], frames=frames)
        expect_equal(f"size={size} gives frames", episode.video.shape[1:], (*size, 3))
        for name, values in usual.states.items():
            same = np.array_equal(values[:frames], episode.states[name], equal_nan=True)
            expect(same, f"state {name!r} depends on the frame size")
        halved = episode.video.reshape(-1, height, 2, width, 2, 3).mean((2, 4))
        error = np.abs(halved - usual.video[:frames]).mean() / 255
        expect(error < 0.03, f"at twice the size the picture differs by {error:.0%} on average")

    def same_spec_same_bytes(self) -> None:
        """Give the same episode twice in a row."""
        _expect_same(_first(self.episode, BEGINNING), self.beginning.digests(), "a second time")

    def same_bytes_after_other_episodes(self) -> None:
        """Keep no state of earlier episodes: an instance that ran other episodes agrees."""
        environment = self.make(size=self.size)
        others = [self.spec("ood_test", index) for index in range(len(self.card.ood_shifts))]
        for spec in (self.spec("train", 1), *others):
            environment.reset(options={"spec": spec})
            for _ in range(3):
                environment.step(np.array(self.card.action.high, np.float32))
        again = simulate(environment, self.spec(), frames=SOME)
        _expect_same(_first(self.beginning, SOME), again.digests(), "after other episodes")

    def same_bytes_in_a_fresh_process(self) -> None:
        """Give the same episode whatever this process did before."""
        make = functools.partial(self.make, size=self.size)
        digests = digests_elsewhere(make, self.spec(), BEGINNING)
        _expect_same(self.beginning, digests, "in a fresh process")

    def replayed_actions_reproduce_the_episode(self) -> None:
        """Depend on the policy only through its actions."""
        usual = _first(self.beginning, SOME)
        again = simulate(self.environment, self.spec(), usual.actions, frames=len(usual.video))
        _expect_same(usual, again.digests(), "when its recorded actions are replayed")

    def snapshot_returns_to_its_moment(self) -> None:
        """Go on from a snapshot as the episode went on, twice, if it can take one."""
        usual = self.beginning
        self._started(self.spec())
        if self.environment.snapshot() is None:
            raise NotTried("it takes no snapshots")
        middle = len(usual.actions) // 2
        end = min(middle + SOME // 2, len(usual.video) - 1)
        for action in usual.actions[:middle]:
            self.environment.step(action)
        back = self.environment.snapshot()
        expect(back is not None, "there is a snapshot at the start and none later")
        for _ in range(2):
            assert back is not None
            self.environment.step(np.array(self.card.action.low, np.float32))
            back()
            for index in range(middle, end):
                other = self._other_than(usual, index)
                after = f"{index + 1 - middle} frames after returning to a snapshot"
                expect(not other, f"{after}, the same actions give other {', '.join(other)}")

    def _other_than(self, usual: Episode, index: int) -> list[str]:
        """Take the usual action, and name what of the next frame is not as it was then."""
        frame, *_, info = self.environment.step(usual.actions[index])
        reached = {**info["state"], "video": frame}
        wanted = {**usual.states, "video": usual.video}
        return [
            name
            for name, value in reached.items()
            if not np.array_equal(value, wanted[name][index + 1], equal_nan=True)
        ]

    def _started(self, spec: EpisodeSpec) -> tuple[NDArray[np.uint8], dict[str, Any]]:
        return self.environment.reset(options={"spec": spec})

    def _still_action(self) -> NDArray[np.float32]:
        self._started(self.spec())
        return self.environment.still_action()

    def _shift_shows(self, usual: Episode, factor: Factor) -> bool:
        spec = replace(usual.spec, factors={factor.name: "ood"})
        frame, _ = self._started(spec)
        if not np.array_equal(frame, usual.video[0]):
            return True
        return self._looks_different(usual, self.environment.policy(spec.rng("policy")))

    def _looks_different(self, usual: Episode, act: Policy) -> bool:
        """Whether a started episode differs from the usual one; stops at the first difference."""
        steps = (self.environment.step(np.asarray(act(), np.float32)) for _ in usual.video[1:])
        pairs = zip(steps, usual.video[1:], strict=True)
        return any(not np.array_equal(frame, expected) for (frame, *_), expected in pairs)


def _first(episode: Episode, frames: int) -> Episode:
    """The first frames of an episode, as they are when no more are simulated."""
    frames = min(frames, len(episode.video))
    actions = episode.actions[:frames].copy()
    actions[-1] = 0
    return replace(
        episode,
        video=episode.video[:frames],
        actions=actions,
        states={name: values[:frames] for name, values in episode.states.items()},
        masks=episode.masks[:frames],
        contacts=episode.contacts[episode.contacts[:, 0] < frames],
    )


def _expect_same(episode: Episode, digests: dict[str, str], when: str) -> None:
    expected = episode.digests()
    expect(expected.keys() == digests.keys(), f"the state fields differ {when}")
    for name, digest in expected.items():
        expect(digests[name] == digest, f"the same spec gives other {name} {when}")


def digests_elsewhere(
    make: Callable[[], Environment], spec: EpisodeSpec, frames: int
) -> dict[str, str]:
    """Hashes of the first `frames` frames of an episode, from a new process without torch."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_digests, make, spec, frames).result()


def _digests(make: Callable[[], Environment], spec: EpisodeSpec, frames: int) -> dict[str, str]:
    return simulate(make(), spec, frames=frames).digests()


def _code(field: StateField, episode: Episode) -> NDArray[np.float64]:
    """The values of a field, alike where the world is: ``[T, rows, E]``."""
    return encode(field, np.asarray(episode.states[field.name], np.float64))
