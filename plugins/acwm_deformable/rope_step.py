"""The one kernel that advances rope and pole by a frame: each launch costs some 50 µs.

Arrays are those of `acwm_deformable.rope_solver`, and

    pole    [2]  where the pole is, metres
    move    [2]  how far it goes in this frame, at constant speed
    touched [1]  set to 1 when rope and pole touch
"""
# pyright: basic, reportInvalidTypeForm=false, reportArgumentType=false, reportIndexIssue=false
# pyright: reportCallIssue=false, reportOperatorIssue=false, reportAttributeAccessIssue=false
# pyright: reportGeneralTypeIssues=false
# (Taichi compiles these functions from their source; Python's types do not apply inside.)

from acwm_deformable.rope_solver import (
    Vec2,
    bend,
    factor_bending,
    find_pairs,
    hold_back,
    meet_itself,
    meet_pole,
    predict,
    stretch,
    update_velocity,
)
from acwm_sim.arrays import F1, F2, I1, I2
from acwm_sim.engine import ti


@ti.kernel
def advance_rope(
    x: F2,
    old: F2,
    v: F2,
    drag: F2,
    tension: F1,
    work: F2,
    band: F2,
    pairs: I2,
    count: I1,
    p: F1,
    pole: F1,
    move: F1,
    touched: I1,
    substeps: ti.i32,
    passes: ti.i32,
):
    """Simulate `substeps` substeps of `passes` passes over contacts, stretch and friction."""
    ti.loop_config(serialize=True)
    for s in range(substeps):
        if s == 0:  # here, because loops outside of a serial one would run in parallel
            factor_bending(band, p)
        step = Vec2(move[0], move[1]) / substeps
        predict(x, old, v, drag, tension, p)
        pole[0] += step.x
        pole[1] += step.y
        bend(x, band, work, p)
        find_pairs(x, p, pairs, count)
        for _ in range(passes):
            hold_back(x, old, drag, p)
            meet_itself(x, old, p, pairs, count)
            meet_pole(x, old, pole, step, p, touched)
            stretch(x, work, tension, p)
        update_velocity(x, old, v, p)
