"""push_cube's tasks: push every cube to its place. Does not import a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import Environment, Policy
from acwm_core.env.physics import Observation
from acwm_core.env.task import Goal, Task

if TYPE_CHECKING:
    from acwm_rigid.push_cube import PushCube


class Place(Task):
    """Push every cube to its place, in any orientation.

    The distance is the mean of the cubes' distances to their places on the table; for success each
    of them is within the tolerance. The position of the pusher does not matter. Places are 6 to
    14 cm from where the cubes start, and straight pushes to them do not touch other cubes. A cube
    without room for this may stay where it is.
    """

    name = "place"
    summary = "every cube to its place, within 1.5 cm"
    unit = "m"
    tolerance = 0.015
    max_steps = 100
    # Where the pusher ends does not matter, so the cost reads the cubes. Actions are positions:
    # four straight moves of 8 frames reach around a cube, at the speed of the pushes in the data.
    planning = (
        *("planner.interpolation=linear", "planner.action_block=8", "planner.horizon=4"),
        *("planner.candidates=512", "planner.iterations=5", "planner.elites=20"),
        *("cost=state", "cost.frames=2"),
    )

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """Draw places for all cubes, with the pusher behind one of them as after its push."""
        from acwm_rigid.push_solution import draw_places

        env = cast("PushCube", environment)
        cubes = env.simulation.cubes
        while True:
            places, pushers = draw_places(env.simulation, env.region, rng)
            env.put(places, cubes.yaw, pushers)
            if not env.simulation.touching:
                return Goal.now(environment)

    def gaps(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Distance of each cube in the episode from its place, `[T, n]` m."""
        there = goal.state["cube_present"] > 0
        places = np.asarray(goal.state["cube_position"], np.float64)[there, :2]
        cubes = np.asarray(seen.states["cube_position"], np.float64)[:, there, :2]
        return np.linalg.norm(cubes - places, axis=-1)

    def distance(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Mean distance over the cubes in metres."""
        return self.gaps(seen, goal).mean(-1)

    def success(self, seen: Observation, goal: Goal) -> NDArray[np.bool_]:
        """Whether every cube is at its place."""
        return np.all(self.gaps(seen, goal) <= self.tolerance, axis=-1)

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """Push one cube after the other straight to its place, repeatedly if needed."""
        return self._push(cast("PushCube", environment), goal.state["cube_position"])

    def _push(self, env: PushCube, places: NDArray[np.floating]) -> Policy:
        from acwm_rigid.push_solution import REACH, Placer

        there = list(env.simulation.cubes.slots)
        placer = Placer(env.simulation, places[there, :2].astype(np.float64))
        return lambda: placer.next_targets().ravel() / REACH


class PlaceAndTurn(Place):
    """Push every cube to its place, with the orientation of the goal.

    The distance is between the corners of a cube's top and their places: the root mean square over
    corners and the mean over cubes. Quarter turns do not matter. Goals are states reached by
    pushing cubes to drawn places; the solution knows these places (``goal.state["pushed_to"]``).
    """

    name = "place_and_turn"
    summary = "every cube to its place, turned as in the goal: corners within 2 cm"
    tolerance = 0.02

    def sample_goal(self, environment: Environment, rng: np.random.Generator) -> Goal:
        """The state after pushing the cubes to drawn places."""
        env = cast("PushCube", environment)
        places = super().sample_goal(environment, rng).state["cube_position"]
        env.reset(options={"spec": env.episode_spec})
        act = self._push(env, places)
        for _ in range(self.max_steps):
            env.step(act())
        goal = Goal.now(environment)
        return goal._replace(state={**goal.state, "pushed_to": places})

    def solution(self, environment: Environment, goal: Goal, rng: np.random.Generator) -> Policy:
        """The pushes that led to the goal."""
        return self._push(cast("PushCube", environment), goal.state["pushed_to"])

    def gaps(self, seen: Observation, goal: Goal) -> NDArray[np.float64]:
        """Distance of each cube's corners from their places, `[T, n]` m."""
        there = goal.state["cube_present"] > 0
        apart = super().gaps(seen, goal)
        yaw = np.asarray(seen.states["cube_yaw"], np.float64)[:, there]
        turn = yaw - np.asarray(goal.state["cube_yaw"], np.float64)[there]
        turn -= np.pi / 2 * np.round(turn / (np.pi / 2))
        out = np.asarray(goal.state["cube_position"], np.float64)[there, 2] * np.sqrt(2)
        # A turn moves the corners in different directions, so on average the squares add up.
        return np.hypot(apart, 2 * out * np.sin(np.abs(turn) / 2))


PLACE, PLACE_AND_TURN = Place(), PlaceAndTurn()
