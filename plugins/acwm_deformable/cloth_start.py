"""The initial state of cloth_move: a cloth hangs at rest from two grippers, beside the sphere."""

import math

import numpy as np
from numpy.typing import NDArray

from acwm_deformable.cloth import ROOM, THICKNESS, Cloth, Sheet
from acwm_deformable.states import CLOTH_NODES

NODES = CLOTH_NODES

CELLS = NODES - 1
"""Number of edges along each side of the cloth."""

CORNERS = (0, CELLS)
"""The nodes that the grippers hold initially: both ends of the upper hem."""

PLACEMENTS = {"right": -32.0, "behind": 90.0, "left": 212.0, "front": 270.0}
"""Initial direction of the cloth from the sphere: degrees from +x (right in the frame)."""

_SETTLE, _SETTLE_DRAG = (0.2,) * 7 + (0.1,) * 3, 1.0


def sheet_of(size: float, **material: float) -> Sheet:
    """A square cloth with sides of `size` metres; `material` as in `Sheet`."""
    return Sheet(NODES, size / CELLS, **material)


def hang(sheet: Sheet, placement: str, rng: np.random.Generator, *, together: bool) -> Cloth:
    """A cloth that hangs at rest from two grippers, at a random position in region `placement`.

    Its upper hem is roughly perpendicular to the line to the sphere. The hem sags, because the
    grippers are closer together than it is long.
    """
    size = sheet.spacing * CELLS
    angle = math.radians(PLACEMENTS[placement] + rng.uniform(-25, 25))
    turn = angle + math.radians(rng.uniform(-25, 25))
    outward, across = _heading(angle), _heading(turn + math.pi / 2)
    middle = outward * (sheet.sphere + rng.uniform(0.24, 0.38))
    middle[2] = min(rng.uniform(0.9, 1.2) * size, rng.uniform(0.78, 0.9))
    half = 0.5 * size * rng.uniform(0.72, 0.94) * across
    hands = np.clip(np.stack([middle - half, middle + half]), *np.transpose(ROOM))
    return settled(sheet, hands, bulge=_heading(turn), together=together)


def settled(
    sheet: Sheet, hands: NDArray[np.float64], bulge: NDArray[np.float64], *, together: bool
) -> Cloth:
    """A cloth at rest, held at its upper corners by grippers at `hands` [2, 3].

    Args:
        sheet: the cloth.
        hands: positions in metres, closer together than the cloth is wide.
        bulge: unit vector towards the side to which the cloth falls.
        together: as for `Cloth`.
    """
    cloth = Cloth(sheet, _curtain(sheet, hands, bulge), hands, CORNERS, together=together)
    still = np.zeros((2, 3))
    for seconds in _SETTLE:
        cloth.advance(still, seconds, drag=_SETTLE_DRAG)
    cloth.velocities[:] = 0
    return cloth


def _curtain(
    sheet: Sheet, hands: NDArray[np.float64], bulge: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Nodes of a cloth that hangs straight down from an arc between the grippers, [N, 3]."""
    apart = hands[1] - hands[0]
    chord = float(np.linalg.norm(apart))
    half = _half_angle(chord / (sheet.spacing * CELLS))
    angle = np.linspace(-half, half, NODES)
    along = 0.5 + 0.5 * np.sin(angle) / math.sin(half)
    out = 0.5 * chord * (np.cos(angle) - math.cos(half)) / math.sin(half)
    hem = hands[0] + along[:, None] * apart + out[:, None] * bulge
    drop = np.arange(NODES)[:, None] * sheet.spacing
    lying = np.maximum(drop - (hem[:, 2] - THICKNESS), 0.0)  # the excess lies on the ground
    nodes = hem + lying[..., None] * bulge
    nodes[..., 2] -= drop - lying
    return nodes.reshape(-1, 3)


def _half_angle(ratio: float) -> float:
    """Half the angle of an arc whose chord is `ratio` times as long: sin(a) / a = ratio."""
    low, high = 1e-4, math.pi
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if math.sin(middle) / middle > ratio else (low, middle)
    return low


def _heading(angle: float) -> NDArray[np.float64]:
    return np.array([math.cos(angle), math.sin(angle), 0.0])
