"""push_cube: a round pusher moves coloured cubes on a walled table, seen from above."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.env.environment import ActionSpec, EnvironmentCard, Policy
from acwm_core.env.episode import Factor
from acwm_core.env.symmetry import Axes, Symmetry, group
from acwm_core.errors import RecipeError
from acwm_rigid.physics import PUSHER_RADIUS
from acwm_rigid.push_drawing import PushDrawing, TwoPusherDrawing
from acwm_rigid.push_policy import Pusher, Region
from acwm_rigid.push_simulation import Cubes, PushSimulation
from acwm_rigid.states import CUBES, MAX_CUBES, TABLE_CAMERA, push_cube_state
from acwm_sim.environment import LIGHT, Factors, SceneEnvironment, appearance

REACH = 0.26
"""Distance in metres from the middle of the table that corresponds to an action of 1."""

_MAX_DRAWS = 5_000  # most attempts to draw starting positions

STARTS = {"central": Region(0.0, 0.15), "edge": Region(0.19, 0.235)}
"""Where the cubes start, by the factor `placement`."""

GOALS = {"central": Region(0.0, 0.18), "edge": Region(0.17, 0.25)}
"""Where the behaviour policy pushes the cubes, by the factor `placement`."""

_FACTORS = (
    Factor.discrete(
        "placement",
        "where cubes start and are pushed to",
        train=("central",),
        ood=("edge",),
        nominal="central",
        active=True,
    ),
    Factor.discrete(
        "cube_count", "how many cubes", train=(1, 2, 3), ood=(4, 5), nominal=2, active=True
    ),
    Factor.continuous(
        "friction",
        "Coulomb friction of cubes on the table",
        train=(0.4, 0.6),
        ood=((0.15, 0.25), (0.9, 1.1)),
        nominal=0.5,
    ),
    Factor.continuous(
        "mass",
        "mass of a cube",
        train=(0.08, 0.12),
        ood=((0.02, 0.04), (0.3, 0.5)),
        nominal=0.1,
        unit="kg",
    ),
    Factor.continuous(
        "cube_size",
        "length of a cube's edge",
        train=(0.075, 0.085),
        ood=((0.05, 0.06), (0.095, 0.105)),
        nominal=0.08,
        unit="m",
    ),
    appearance("colors", "colours of the cubes", "bright", "pastel"),
    LIGHT,
)


_LIMITS = {"friction": (0.0, 5.0), "mass": (0.005, 10.0), "cube_size": (0.02, 0.15)}
"""The factor values that the simulation accepts."""


def _symmetry(pushers: int, axes: Axes, **of_frames: Any) -> Symmetry:
    """A symmetry of the square table; `axes` say what it does to (x, y)."""
    targets = [axis + (2 * k if axis > 0 else -2 * k) for k in range(pushers) for axis in axes]
    return Symmetry(tuple(targets), **of_frames)


def _card(name: str, summary: str, pushers: int, ood_shifts: tuple[str, ...]) -> EnvironmentCard:
    names = ["pusher"] if pushers == 1 else [f"pusher_{k + 1}" for k in range(pushers)]
    axes = [f"{who}_target_{axis}" for who in names for axis in "xy"]
    return EnvironmentCard(
        name=name,
        summary=summary,
        action=ActionSpec(
            names=tuple(axes),
            units=("",) * len(axes),
            low=(-1.0,) * len(axes),
            high=(1.0,) * len(axes),
            kind="absolute",
        ),
        frame_size=(240, 240),
        fps=10,
        horizon=66,
        factors=_FACTORS,
        ood_shifts=ood_shifts,
        state=push_cube_state(tuple(names)),
        instances=("table", "wall", *names, *CUBES),
        engine="MuJoCo",
        episodes={"train": 1987, "ind_test": 100, "ood_test": 100},
        citation="ACWM-Phys, arXiv:2605.08567",
        symmetries=group(
            _symmetry(pushers, (-1, 2), mirrored=True),
            _symmetry(pushers, (-2, 1), quarter_turns=1),
        ),
        camera=TABLE_CAMERA,
    )


class PushCube(SceneEnvironment[PushSimulation]):
    """A pusher and one to five cubes on a table with walls.

    The action is the absolute target of the pusher in [-1, 1]²; 1 is 0.26 m from the table's
    middle, +x is right and +y up in the frame. The pusher follows with critical damping and
    limited speed.
    """

    drawn_by = PushDrawing
    limits = _LIMITS
    pushers = 1
    card = replace(
        _card(
            "push_cube",
            "A round pusher moves coloured cubes about a walled table, seen from above.",
            1,
            ("placement", "cube_count"),
        ),
        variants=("push_cube_4cube", "push_cube_two_pushers"),
    )

    def _begin(self, factors: Factors, rng: np.random.Generator) -> PushSimulation:
        count, edge = int(factors["cube_count"]), float(factors["cube_size"])
        slots = tuple(sorted(rng.permutation(MAX_CUBES)[:count].tolist()))
        xy, pushers = _scatter(STARTS[str(factors["placement"])], count, self.pushers, edge, rng)
        yaw = rng.uniform(-np.pi, np.pi, count)
        cubes = Cubes(slots, xy, yaw, edge, float(factors["mass"]), float(factors["friction"]))
        self._pushers = pushers
        self._touched: set[tuple[int, int]] = set()
        return PushSimulation(cubes, pushers)

    def _perturb(self, amount: float, rng: np.random.Generator) -> None:
        """Move cubes and pushers and rotate cubes; by less if they would touch."""
        cubes = self.simulation.cubes
        slide, turn, push = (
            rng.normal(0, 1e-3, each.shape) for each in (cubes.xy, cubes.yaw, self._pushers)
        )
        while True:
            moved = replace(cubes, xy=cubes.xy + amount * slide, yaw=cubes.yaw + amount * turn)
            self.simulation = PushSimulation(moved, self._pushers + amount * push)
            if not self.simulation.touching:
                break
            amount /= 2

    def _transform(self, symmetry: Symmetry) -> None:
        cubes, plane = self.simulation.cubes, symmetry.plane
        yaw = np.pi - cubes.yaw if symmetry.mirrored else cubes.yaw
        yaw = yaw + symmetry.quarter_turns * np.pi / 2
        self._pushers = self._pushers @ plane.T
        self.put(cubes.xy @ plane.T, yaw, self._pushers)

    def still_action(self) -> NDArray[np.float32]:
        """The action that keeps the pushers where they are."""
        place = self.simulation.pusher_position.ravel() / REACH
        return np.clip(place, -1.0, 1.0).astype(np.float32)

    def _advance(self, action: NDArray[np.float32]) -> None:
        target = action.astype(np.float64).reshape(self.pushers, 2) * REACH
        self._touched = self.simulation.advance(target, 1 / self.card.fps)

    def _state(self) -> dict[str, NDArray[Any]]:
        table, slots = self.simulation, list(self.simulation.cubes.slots)
        state = {f.name: np.zeros(f.shape, np.float32) for f in self.card.state}
        pose, velocity = table.cube_pose, table.cube_velocity
        yaw = (pose[:, 3] + np.pi) % (2 * np.pi) - np.pi
        state["pusher_position"][:] = table.pusher_position
        state["pusher_velocity"][:] = table.pusher_velocity
        state["cube_present"][slots] = 1
        state["cube_position"][slots] = pose[:, :3]
        state["cube_quaternion"][slots, 0] = np.cos(yaw / 2)
        state["cube_quaternion"][slots, 3] = np.sin(yaw / 2)
        state["cube_yaw"][slots] = yaw
        state["cube_velocity"][slots] = velocity[:, :3]
        state["cube_angular_velocity"][slots, 2] = velocity[:, 3]
        return dict(state)

    def _contacts(self) -> Iterable[tuple[int, int]]:
        return self._touched

    @property
    def region(self) -> Region:
        """The region that cubes of the current episode are pushed to."""
        return GOALS[str(self._factors["placement"])]

    def put(
        self, xy: NDArray[np.float64], yaw: NDArray[np.float64], pushers: NDArray[np.float64]
    ) -> None:
        """Place cubes ([n, 2] metres, yaw [n] rad) and pushers ([P, 2] metres) at rest."""
        cubes = replace(self.simulation.cubes, xy=xy, yaw=yaw)
        self.simulation, self._touched = PushSimulation(cubes, pushers), set()

    def policy(self, rng: np.random.Generator) -> Policy:
        """Mostly push cubes towards goals, otherwise wander or pause."""
        region = self.region
        hands = [Pusher(self.simulation, k, region, REACH, rng) for k in range(self.pushers)]

        return self.clipped(lambda: np.concatenate([h.next_target() for h in hands]) / REACH)


class PushCubeCrowded(PushCube):
    """push_cube with an out-of-distribution test of four and five cubes only."""

    card = replace(
        PushCube.card,
        name="push_cube_4cube",
        summary="push_cube, tested out of distribution on four and five cubes only.",
        ood_shifts=("cube_count",),
        variants=(),
    )


class PushCubeTwoPushers(PushCube):
    """push_cube with two pushers; the action holds the targets of both."""

    drawn_by = TwoPusherDrawing
    pushers = 2
    card = _card(
        "push_cube_two_pushers",
        "Two pushers move coloured cubes about a walled table at once, seen from above.",
        2,
        ("placement", "cube_count"),
    )


def _scatter(
    region: Region, cubes: int, pushers: int, edge: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Starting positions of cubes [n, 2] and pushers [P, 2] that do not touch, in metres.

    Raises:
        RecipeError: the cubes do not fit on the table.
    """
    diagonal = edge * np.sqrt(2)
    limit, anywhere = 0.295 - diagonal / 2, Region(0.0, 0.22)
    for _ in range(_MAX_DRAWS):
        placed = [np.clip(region.sample(rng), -limit, limit) for _ in range(cubes)]
        placed += [anywhere.sample(rng) for _ in range(pushers)]
        points = np.array(placed)
        apart = np.linalg.norm(points[:, None] - points[None], axis=-1)
        need = np.full(len(points), diagonal / 2 + 0.002)
        need[cubes:] = PUSHER_RADIUS + 0.01
        gaps = apart - (need[:, None] + need[None])
        if (gaps[np.triu_indices(len(points), 1)] > 0).all():
            return points[:cubes], points[cubes:]
    raise RecipeError(f"{cubes} cubes of {edge:g} m do not fit: use fewer or smaller ones")
