"""The scripted behaviour policy that collects robot_arm data."""

from collections.abc import Iterator

import numpy as np

from acwm_kinematics.arm_layout import ArmLayout, Workspace
from acwm_kinematics.arm_planner import Joints, plan
from acwm_kinematics.arm_simulation import MAX_STEP, ArmSimulation
from acwm_kinematics.arm_timing import rounded, timed

_RETREAT = 0.4  # rad; how far the arm moves back after touching something


class Reacher:
    """Visits the goals in turn along planned motions, then other places of the workspace.

    In between it sometimes rests or tries small motions.

    Args:
        world: the simulation, of which it reads the joint targets and the reached goals.
        layout: the goals and the collision checker.
        workspace: where it may move.
        frame: seconds between two actions.
        rng: source of all its randomness.

    Attributes:
        failures: number of motions for which no path was found.
        plans: the motions so far, each as its polyline [K, 7] and its angles per frame [N, 7].
    """

    def __init__(
        self,
        world: ArmSimulation,
        layout: ArmLayout,
        workspace: Workspace,
        frame: float,
        rng: np.random.Generator,
    ) -> None:
        self._world, self._layout, self._workspace = world, layout, workspace
        self._frame, self._rng = frame, rng
        self.failures = 0
        self.plans = list[tuple[Joints, Joints]]()
        self._only: Joints | None = None
        self._steps = self._live()

    def next_turn(self) -> Joints:
        """The next action: what is added to the joint targets, [7] rad."""
        turn = next(self._steps) - self._world.target
        if np.abs(turn).max() > MAX_STEP:  # the arm was blocked: make a new plan
            self._steps = self._live()
            turn = next(self._steps) - self._world.target
        return turn

    def insist(self, pose: Joints) -> None:
        """From now on go only to this pose."""
        self._only = pose
        self._steps = self._live()

    def _live(self) -> Iterator[Joints]:
        """Yield joint targets endlessly."""
        while self._only is not None:
            yield from self._go(self._only)
            yield from self._rest(1, 3)
        for goal, reached in zip(self._layout.poses, self._world.reached, strict=True):
            if reached:
                continue
            if self._rng.random() < 0.25:
                yield from self._explore()
            yield from self._go(goal)
            yield from self._rest(1, 5)
        while True:
            choice = self._rng.random()
            if choice < 0.25:
                yield from self._explore()
            elif choice < 0.5:
                yield from self._go(self._layout.poses[self._rng.integers(len(self._layout.poses))])
            else:
                pose, _ = self._workspace.draw(self._layout.clearance, self._rng)
                yield from self._go(pose)
            yield from self._rest(1, 7)

    def _rest(self, low: int, high: int) -> Iterator[Joints]:
        here = self._world.target
        for _ in range(int(self._rng.integers(low, high))):
            yield here

    def _go(self, pose: Joints) -> Iterator[Joints]:
        """Move to a pose; rest a little if no path is found, and back off from contacts."""
        clearance, here = self._layout.clearance, self._world.target.copy()
        if not clearance.is_free(here):
            away = self._layout.start - here
            away *= min(1.0, _RETREAT / float(np.linalg.norm(away)))
            yield from timed(np.array([here, here + away]), self._frame, 0.5)
            return
        path = plan(clearance, here, pose, self._workspace.box, self._rng)
        if path is None:
            self.failures += 1
            yield from self._rest(2, 6)
        else:
            yield from self._follow(rounded(clearance, path), self._rng.uniform(0.65, 1.0))

    def _explore(self) -> Iterator[Joints]:
        """Make a few small motions of some joints around the current pose."""
        clearance, box = self._layout.clearance, self._workspace.box
        for _ in range(int(self._rng.integers(1, 3))):
            here = self._world.target.copy()
            some = self._rng.random(7) < 0.6
            pose = np.clip(here + some * self._rng.normal(0, 0.22, 7), *box)
            if np.abs(pose - here).max() > 0.03 and clearance.is_edge_free(here, pose):
                yield from self._follow(np.array([here, pose]), self._rng.uniform(0.5, 1.0))

    def _follow(self, path: Joints, haste: float) -> Iterator[Joints]:
        motion = timed(path, self._frame, haste)
        self.plans.append((path, motion))
        yield from motion
