"""Environments with one flaw each; `FLAWS` says which check must find it."""

import multiprocessing
from dataclasses import replace
from itertools import count

import gymnasium
import numpy as np

from acwm_core.checks.disc import GAIN, SHADE, Disc
from acwm_core.env.camera import Camera
from acwm_core.env.environment import Environment, StateField
from acwm_core.env.episode import Factor
from tests.checks.results import Flaws

FLAWS = Flaws()


@FLAWS.caught_by("simulates an episode", "out of its bounds")
class WildPolicy(Disc):
    def policy(self, rng):
        return lambda: rng.uniform(-2, 2, 2)


@FLAWS.caught_by("gymnasium api", "")
class OtherObservations(Disc):
    def __init__(self, **params):
        super().__init__(**params)
        self.observation_space = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)


@FLAWS.caught_by("card is complete", "background")
class Nameless(Disc):
    card = replace(Disc.card.recorded, instances=("background",))


@FLAWS.caught_by("card survives json", "JSON")
class ListsForTuples(Disc):
    card = replace(Disc.card, factors=(replace(GAIN, train=[0.8, 1.0]), SHADE))


@FLAWS.caught_by("factors have ranges", "outside training")
class OverlappingRanges(Disc):
    card = replace(Disc.card, factors=(replace(GAIN, ood=((0.85, 0.95),)), SHADE))


@FLAWS.caught_by("factors have ranges", "inside training")
class NominalOutside(Disc):
    card = replace(Disc.card, factors=(replace(GAIN, nominal=3.0), SHADE))


@FLAWS.caught_by("factors have ranges", "not a factor of the card")
class ShiftsNothing(Disc):
    card = replace(Disc.card, ood_shifts=("gian",))


@FLAWS.caught_by("splits are labelled", "labelled None")
class Unlabelled(Disc):
    def observe(self):
        frame, info = super().observe()
        return frame, {**info, "ood_label": None}


@FLAWS.caught_by("state matches card", "the card says")
class OtherState(Disc):
    card = replace(Disc.card, state=(StateField("position", (3,), "m", ""),))


@FLAWS.caught_by("state matches card", "not finite")
class BrokenState(Disc):
    def _state(self):
        return {**super()._state(), "position": np.full(2, np.nan)}


@FLAWS.caught_by("states are of their kinds", "length 1")
class StretchedQuaternion(Disc):
    card = replace(
        Disc.card,
        state=(*Disc.card.state, StateField("turn", (4,), "", "of the disc", "quaternion")),
    )

    def _state(self):
        return {**super()._state(), "turn": np.array([1.0, 0.1, 0.0, 0.0])}


@FLAWS.caught_by("states are of their kinds", "0 or 1")
class HalfThere(Disc):
    card = replace(
        Disc.card, state=(*Disc.card.state, StateField("there", (1,), "", "", "presence"))
    )

    def _state(self):
        return {**super()._state(), "there": np.array([0.5])}


@FLAWS.caught_by("states follow", "does not follow from still")
class FollowsNothing(Disc):
    position, bearing = Disc.card.state
    card = replace(
        Disc.card,
        state=(
            replace(position, follows=("still",)),
            bearing,
            StateField("still", (1,), "m", "what stands"),
        ),
    )

    def _state(self):
        return {**super()._state(), "still": np.zeros(1)}


@FLAWS.caught_by("states follow", "does not follow from bearing")
class FollowsInPart(Disc):
    position, bearing = Disc.card.state
    card = replace(Disc.card, state=(replace(position, follows=("bearing",)), bearing))


@FLAWS.caught_by("positions are in the masks", "of the frame's height away")
class YUp(Disc):
    card = replace(Disc.card, camera=Camera.flat(0.5))


@FLAWS.caught_by("masks match card", "no name")
class UnknownInstance(Disc):
    def _render(self):
        frame, mask = super()._render()
        return frame, mask * np.uint8(7)


@FLAWS.caught_by("masks match card", "background")
class EmptyMask(Disc):
    def _render(self):
        frame, mask = super()._render()
        return frame, np.zeros_like(mask)


@FLAWS.caught_by("contacts match card", "itself")
class TouchesItself(Disc):
    def _contacts(self):
        return [(1, 1)]


@FLAWS.caught_by("contacts match card", "names no instance")
class TouchesTheUnknown(Disc):
    def _contacts(self):
        return [(1, 2)]


@FLAWS.caught_by("results are fresh", "overwrote 'position'")
class SharedState(Disc):
    def _advance(self, action):
        before = self.position
        super()._advance(action)
        before[:] = self.position
        self.position = before

    def _state(self):
        return {"position": self.position}


@FLAWS.caught_by("policy moves something", "single action")
class IdlePolicy(Disc):
    def policy(self, rng):
        return lambda: np.zeros(2)


@FLAWS.caught_by("policy moves something", "nothing visibly moves")
class Invisible(Disc):
    def _render(self):
        frame, mask = super()._render()
        return np.full_like(frame, 200 if self.shade == "light" else 60), mask


@FLAWS.caught_by("actions matter", "same video")
class Deaf(Disc):
    def _advance(self, action):
        super()._advance(np.full(2, 0.3))


@FLAWS.caught_by("still action is possible", "bounds")
class RestlessAction(Disc):
    def still_action(self):
        return np.full(2, 1.5, np.float32)


@FLAWS.caught_by("perturbed start is close", "gives different starts")
class PerturbedAtRandom(Disc):
    def _perturb(self, amount, rng):
        super()._perturb(amount, np.random.default_rng())


@FLAWS.caught_by("perturbed start is close", "changes nothing")
class PerturbsNothing(Disc):
    def _perturb(self, amount, rng):
        rng.normal(0, amount, 2)


@FLAWS.caught_by("perturbed start is close", "is visible")
class PerturbsFar(Disc):
    def _perturb(self, amount, rng):
        super()._perturb(200 * amount, rng)


@FLAWS.caught_by("perturbed start is close", "not at rest")
class PerturbedIntoMotion(Disc):
    def _start(self, factors, rng):
        super()._start(factors, rng)
        self.drift = np.zeros(2)

    def _perturb(self, amount, rng):
        super()._perturb(amount, rng)
        self.drift = np.full(2, 0.03 * amount)

    def _advance(self, action):
        super()._advance(action)
        self.position = self.position + self.drift


@FLAWS.caught_by("factors matter", "'shade'")
class OneShade(Disc):
    def _start(self, factors, rng):
        super()._start({**factors, "shade": "light"}, rng)


@FLAWS.caught_by("size changes only resolution", "depends on the frame size")
class MovesByPixels(Disc):
    def _advance(self, action):
        super()._advance(action * 16 / self.frame_size[0])


@FLAWS.caught_by("size changes only resolution", "picture differs")
class Cropped(Disc):
    def _render(self):
        frame, mask = super()._render()
        cut = frame.copy()
        cut[64:] = 0
        return cut, mask


@FLAWS.caught_by("same spec same bytes", "a second time")
class GlobalRandomness(Disc):
    def _start(self, factors, rng):
        super()._start(factors, rng)
        self.position = np.random.default_rng().uniform(-0.2, 0.2, 2)


@FLAWS.caught_by("same bytes after other episodes", "after other episodes")
class Remembers(Disc):
    def __init__(self, **params):
        super().__init__(**params)
        self.strain = 0.0

    def _advance(self, action):
        self.strain += 1e-3 * (self.gain > 1.2)
        super()._advance(action * (1 - self.strain))


@FLAWS.caught_by("same bytes in a fresh process", "in a fresh process")
class ProcessDependent(Disc):
    def _start(self, factors, rng):
        super()._start(factors, rng)
        elsewhere = multiprocessing.parent_process() is not None
        self.position = self.position + 1e-3 * elsewhere


@FLAWS.caught_by("replayed actions reproduce the episode", "replayed")
class PolicyCheats(Disc):
    def policy(self, rng):
        steps = count()

        def act():
            self.position = self.position * (0.5 if next(steps) == 3 else 1.0)
            return rng.uniform(-1, 1, 2)

        return act


@FLAWS.caught_by("snapshot returns to its moment", "after returning to a snapshot")
class ForgetsTheMoment(Disc):
    def _snapshot(self):
        position = self.position
        return lambda: self.position.__setitem__(slice(None), position + 1e-3)


@FLAWS.caught_by("card is complete", "occurs twice")
class TwinFactors(Disc):
    card = replace(
        Disc.card,
        factors=(GAIN, SHADE, Factor.discrete("gain", "", train=(1,), ood=(2,), nominal=1)),
    )


@FLAWS.caught_by("symmetries hold", "form a group: turned180")
class HalfAGroup(Disc):
    card = replace(Disc.card, symmetries=Disc.card.symmetries[:2])


@FLAWS.caught_by("symmetries hold", "no transformed start")
class OnlyDeclares(Disc):
    _transform = Environment._transform


@FLAWS.caught_by("symmetries hold", "state 'position' differs")
class LeansToTheRight(Disc):
    def _advance(self, action):
        super()._advance(action + np.float32([0.3, 0]))


@FLAWS.caught_by("symmetries hold", "masks of 'disc' overlap")
class SeenFromTheSide(Disc):
    def _render(self):
        frame, mask = super()._render()
        return np.roll(frame, 8, 1), np.roll(mask, 8, 1)


@FLAWS.caught_by("symmetries hold", "colour of 'disc' differs")
class PaintedBySide(Disc):
    def _render(self):
        frame, mask = super()._render()
        frame[mask == 1] = (220, 40, 40) if self.position[0] < 0 else (40, 40, 220)
        return frame, mask
