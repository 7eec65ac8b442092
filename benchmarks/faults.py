"""Faults to put into the simulators, for `violations.py`: events that break physics.

A fault changes an environment in the middle of an episode. From then on the drawing is wrong (a
cube is not drawn, a link is drawn longer), or there is less sand or water.
"""
# pyright: basic, reportPrivateUsage=false
# (It accesses private attributes of the environments on purpose.)

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from acwm_core.data.simulate import simulate
from acwm_core.env.environment import Environment
from acwm_core.env.episode import Episode, EpisodeSpec
from acwm_core.errors import AcwmError

Fault = Callable[[Any], None]

LESS = 0.2
"""Share of the water, the sand or the rope that is removed."""

STRETCH = 1.3
"""Scale factor of the stretched link and of the swollen sphere."""

UNDER_THE_FLOOR = (0.0, 0.0, -5.0)
"""A position where nothing is visible."""

Places = NDArray[np.float64]


class NotPossibleError(AcwmError):
    """The fault is not possible in this episode."""


def with_fault(
    environment: Environment,
    spec: EpisodeSpec,
    actions: NDArray[np.float32],
    fault: Fault,
    at: int,
) -> Episode:
    """Simulate the episode with these actions, and the fault from frame `at` on."""
    world: Any = environment
    render, done = world._render, False

    def faulty() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        nonlocal done
        if world._frame_index == at and not done:
            done = True
            fault(world)
        return render()

    world._render = faulty
    try:
        return simulate(environment, spec, actions, frames=len(actions))
    finally:
        del world._render
        for owner, name in ((world.drawing.scene, "render"), (world.drawing, "draw")):
            owner.__dict__.pop(name, None)


def delete_cube(world: Any) -> None:
    """push_cube: one of the cubes disappears."""
    world.drawing.scene.set_visible(world.pushers + world.simulation.cubes.slots[-1], False)


def add_cube(world: Any) -> None:
    """push_cube: a cube of a new colour appears."""
    _another(world, _unused(world))


def double_cube(world: Any) -> None:
    """push_cube: a second cube appears in the colour of an existing one."""
    _another(world, _unused(world), world.simulation.cubes.slots[-1])


def split_cube(world: Any) -> None:
    """push_cube: a cube is cut in two halves, one edge length apart."""
    drawing, table = world.drawing, world.simulation
    slot, spare = table.cubes.slots[-1], _unused(world)
    first, second = world.pushers + slot, world.pushers + spare
    drawing.scene.set_visible(second, True)
    drawing.scene.set_color(second, _paint(world, slot))

    def change(places: Places, turns: Places) -> None:
        along = turns[first][:, 0] / np.linalg.norm(turns[first][:, 0])
        turns[first] = turns[second] = turns[first] @ np.diag([0.5, 1, 1])
        middle = places[first].copy()
        places[first] = middle - 0.75 * table.cubes.edge * along
        places[second] = middle + 0.75 * table.cubes.edge * along

    _redraw(drawing, change)


def merge_cubes(world: Any) -> None:
    """push_cube: a cube lies half within another."""
    drawing, table = world.drawing, world.simulation
    if len(table.cubes.slots) < 2:
        raise NotPossibleError
    first, second = (world.pushers + slot for slot in table.cubes.slots[:2])

    def change(places: Places, turns: Places) -> None:
        along = turns[second][:, 0] / np.linalg.norm(turns[second][:, 0])
        inward = -np.sign(places[second] @ along) or 1.0  # away from the nearer wall
        places[first] = places[second] + 0.5 * table.cubes.edge * inward * along
        places[first, 2] += 0.001  # avoids equal heights where both overlap
        turns[first] = turns[second]

    _redraw(drawing, change)


def delete_a_cube(world: Any) -> None:
    """stack_cube: the more visible cube disappears."""
    from acwm_rigid.stack_simulation import GREEN_ID, RED_ID

    drawing = world.drawing
    _, masks = drawing.draw(world.simulation)
    gone = drawing.first_cube + _most_seen(masks, (RED_ID, GREEN_ID))
    _redraw(drawing, lambda places, turns: places.__setitem__(gone, UNDER_THE_FLOOR))


def swell_sphere(world: Any) -> None:
    """cloth_move: the sphere is drawn larger until the next episode."""
    drawing = world.drawing
    camera, light = drawing.scene.camera, drawing.scene.light
    drawing.rebuild(drawing.pattern, STRETCH * drawing.radius)
    drawing.scene.set_camera(camera)
    drawing.scene.set_light(light)


def delete_post(world: Any) -> None:
    """robot_arm: the most visible post disappears."""
    from acwm_kinematics.arm_drawing import FIRST_POST_ID

    drawing, posts = world.drawing, range(len(world.simulation.posts))
    _, masks = drawing.draw(world.simulation)
    ids = tuple(FIRST_POST_ID + k for k in posts)
    drawing.scene.set_visible(drawing.first_post + _most_seen(masks, ids), False)


def stretch_forearm(world: Any) -> None:
    """reacher: the forearm is drawn longer, with the fingertip at its end."""
    fore, tip = 1, 3

    def change(places: Places, turns: Places) -> None:
        turns[fore] = turns[fore] @ np.diag([STRETCH, 1, 1])
        places[tip, :2] += (STRETCH - 1) * (places[tip, :2] - places[fore, :2])

    _redraw(world.drawing, change)


def shorten_rope(world: Any) -> None:
    """push_rope: a part of the rope disappears."""
    drawing = world.drawing
    draw = drawing.draw

    def shorter(rope: Any) -> Any:
        nodes = rope.nodes
        at = np.linspace(0, (1 - LESS) * (len(nodes) - 1), len(nodes))
        kept = [np.interp(at, np.arange(len(nodes)), axis) for axis in nodes.T]
        return draw(SimpleNamespace(nodes=np.stack(kept, 1), pole=rope.pole))

    drawing.draw = shorter


def less_water(world: Any) -> None:
    """pour_water: random particles vanish, and the others settle."""
    water = world.simulation
    kept = _kept(len(water._x))
    for name in ("_x", "velocities", "_last", "_mix", "density", "_near", "_rows", "_order"):
        setattr(water, name, getattr(water, name)[kept].copy())
    water.number = np.arange(len(kept), dtype=np.int32)


def less_sand(world: Any) -> None:
    """push_sand: the grains at the left end vanish; random ones would only leave gaps."""
    sand = world.simulation
    kept = np.argsort(sand.grains[:, 0])[round(LESS * len(sand.grains)) :]
    for name in ("grains", "velocities", "_last", "_order", "_near", "_held"):
        setattr(sand, name, getattr(sand, name)[kept].copy())


FAULTS: dict[str, dict[str, Fault]] = {
    "push_cube": {
        "a deleted cube": delete_cube,
        "an extra cube": add_cube,
        "a doubled cube": double_cube,
        "a split cube": split_cube,
        "a cube within another": merge_cubes,
    },
    "stack_cube": {"a deleted cube": delete_a_cube},
    "cloth_move": {"a sphere swollen by 30 %": swell_sphere},
    "robot_arm": {"a deleted post": delete_post},
    "reacher": {"a link stretched by 30 %": stretch_forearm},
    "push_rope": {"a rope shorter by 20 %": shorten_rope},
    "pour_water": {"20 % less water": less_water},
    "push_sand": {"20 % less sand": less_sand},
}
"""Faults by environment and description."""


def _kept(count: int) -> NDArray[np.int64]:
    """Draw the indices of the particles that stay, out of `count`."""
    rng = np.random.default_rng(count)
    return np.sort(rng.permutation(count)[round(LESS * count) :])


def _most_seen(masks: NDArray[np.uint8], ids: tuple[int, ...]) -> int:
    """Index of the instance that covers most of the frame; not possible if none is visible."""
    areas = [int((masks == each).sum()) for each in ids]
    if not any(areas):
        raise NotPossibleError
    return int(np.argmax(areas))


def _unused(world: Any) -> int:
    """The slot of a cube that is not in the episode."""
    free = [k for k in range(5) if k not in world.simulation.cubes.slots]
    if not free:
        raise NotPossibleError
    return free[0]


def _paint(world: Any, slot: int) -> Any:
    from acwm_rigid.push_drawing import PALETTES

    return PALETTES[str(world._factors["colors"])][slot]


def _another(world: Any, spare: int, like: int | None = None) -> None:
    """Draw the unused cube in the emptiest corner of the table, in the colour of another."""
    drawing, table = world.drawing, world.simulation
    part = world.pushers + spare
    drawing.scene.set_visible(part, True)
    drawing.scene.set_color(part, _paint(world, spare if like is None else like))
    bodies = table.poses[0][:, :2]
    corners = np.array([[x, y] for x in (-0.2, 0.2) for y in (-0.2, 0.2)])
    apart = np.linalg.norm(corners[:, None] - bodies[None], axis=-1).min(1)
    place = [*corners[apart.argmax()], table.cubes.edge / 2]
    turn = np.eye(3) * table.cubes.edge / 0.08

    def change(places: Places, turns: Places) -> None:
        places[part], turns[part] = place, turn

    _redraw(drawing, change)


def _redraw(drawing: Any, change: Callable[[Places, Places], None]) -> None:
    """Change places `[n, 3]` and rotations `[n, 3, 3]` of moving parts before they are drawn."""
    render = drawing.scene.render

    def changed(places: Places, turns: Places) -> Any:
        places, turns = places.copy(), turns.copy()
        change(places, turns)
        return render(places, turns)

    drawing.scene.render = changed
