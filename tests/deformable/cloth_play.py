"""Episodes of cloth_move for tests."""

from acwm_deformable.cloth_move import ClothMove, ClothMove8D
from tests.sim.playing import start, undrawn

GROUND, SPHERE, CLOTH, HANDS = 0, 1, 2, (3, 4)

Unseen, Unseen8D = undrawn(ClothMove), undrawn(ClothMove8D)


def begin(env, index=0, **factors):
    """The state in which an episode begins."""
    return start(env, "train", index, **factors)[1]["state"]
