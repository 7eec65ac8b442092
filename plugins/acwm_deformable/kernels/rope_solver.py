"""XPBD of a rope that lies on a table: Taichi functions that project the constraints of a substep.

Extended position-based dynamics (Macklin, Müller and Chentanez 2016) in small substeps (Macklin et
al. 2019). A rope is a chain, so the constraints of bending and of stretching form two banded
systems. They are solved directly instead of one constraint after the other: no stretch is left,
stiffness does not depend on the number of passes, and neither end of the rope is favoured. The rope
never leaves the table, so motion is planar and its weight acts only through friction. Arrays:

    x, old  [N, 2]    positions now and at the start of the substep, metres
    v       [N, 2]    velocities, m/s
    drag    [N, 2]    displacement by which the table's friction holds each node back, metres
    tension [N - 1]   displacement by which each segment pulls its two nodes together, metres
    work    [N, 4]    scratch space
    band    [N, 3]    factors of the bending system: diagonal and the two bands below it
    pairs   [P, 2]    nodes that may touch in this substep; `count[0]` of them
    p       [LENGTH]  numbers of the episode, see the offsets below

All nodes have the same mass, so displacements within a substep represent impulses. Friction and
tension are kept from substep to substep, so that a bent rope held by friction rests exactly and
does not creep.

`advance_rope` is the single kernel that advances rope and pole by a frame, as each launch costs
about 50 µs. It also takes

    pole    [2]  position of the pole, metres
    move    [2]  displacement of the pole in this frame, at constant speed
    touched [1]  set to 1 when rope and pole touch
"""

from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import F1, F2, I1, I2, Array, Vec2

DT = 0  # seconds in a substep
SPACING = 1  # rest length of a segment, metres
BEND = 2  # B dt² / (m h³): bending stiffness, mass of a node, spacing
GRIP = 3  # μ g dt²: largest displacement that the table's friction can hold back, metres
RADIUS = 4  # radius of the rope, metres
POLE_RADIUS = 5  # metres
POLE_FRICTION = 6  # Coulomb coefficient of rope on pole
SELF_FRICTION = 7  # Coulomb coefficient of rope on rope
APART = 8  # nodes fewer than this many segments apart do not collide
LENGTH = 9


@ti.func
def get2(x: Array, i):
    """Row i as a vector."""
    return Vec2(x[i, 0], x[i, 1])


@ti.func
def set2(x: Array, i, value):
    """Write a vector to row i."""
    x[i, 0] = value.x
    x[i, 1] = value.y


@ti.func
def predict(x: Array, old: Array, v: Array, drag: Array, tension: Array, p: Array):
    """Move nodes by their inertia, with friction and tension as in the previous substep."""
    most = 0.5 * x.shape[0] * p[GRIP]  # the largest tension that friction can hold at rest
    for i in range(x.shape[0]):
        set2(old, i, get2(x, i))
    for i in range(x.shape[0]):
        set2(x, i, get2(x, i) + get2(v, i) * p[DT] + get2(drag, i))
        if i >= 1:
            tension[i - 1] = ti.math.clamp(tension[i - 1], -most, most)
            pull = (get2(old, i) - get2(old, i - 1)).normalized(1e-9) * tension[i - 1]
            set2(x, i - 1, get2(x, i - 1) + pull)
            set2(x, i, get2(x, i) - pull)


@ti.func
def factor_bending(band: Array, p: Array):
    """Factor I + k Σ c cᵀ as L D Lᵀ: c = (1, −2, 1) at each inner node, k = B dt² / (m h³)."""
    n, k = band.shape[0], p[BEND]
    for i in range(n):
        band[i, 0], band[i, 1], band[i, 2] = 1.0, 0.0, 0.0
    for i in range(1, n - 1):
        band[i - 1, 0] += k
        band[i, 0] += 4 * k
        band[i + 1, 0] += k
        band[i - 1, 1] -= 2 * k
        band[i, 1] -= 2 * k
        band[i - 1, 2] += k
    for i in range(n):
        if i >= 1:
            band[i, 0] -= band[i - 1, 1] ** 2 * band[i - 1, 0]
            band[i, 1] -= band[i - 1, 1] * band[i - 1, 2] * band[i - 1, 0]
        if i >= 2:
            band[i, 0] -= band[i - 2, 2] ** 2 * band[i - 2, 0]
        band[i, 1] /= band[i, 0]
        band[i, 2] /= band[i, 0]


@ti.func
def bend(x: Array, band: Array, work: Array, p: Array):
    """Bending of every three nodes in a row, C = x₋ − 2 x + x₊, with compliance h³ / B.

    C / h² is the curvature, so ½ B |C|² / h³ is the bending energy of one segment length of rope.
    The energy is quadratic, so one solve is exact. It solves for the correction, which keeps
    rounding errors small.
    """
    n, k = x.shape[0], p[BEND]
    for i in range(n):
        set2(work, i, Vec2(0.0))
    for i in range(1, n - 1):
        c = k * ((get2(x, i + 1) - get2(x, i)) - (get2(x, i) - get2(x, i - 1)))
        set2(work, i - 1, get2(work, i - 1) - c)
        set2(work, i, get2(work, i) + 2 * c)
        set2(work, i + 1, get2(work, i + 1) - c)
    for i in range(1, n):
        y = get2(work, i) - band[i - 1, 1] * get2(work, i - 1)
        if i >= 2:
            y -= band[i - 2, 2] * get2(work, i - 2)
        set2(work, i, y)
    for q in range(n):
        i = n - 1 - q
        y = get2(work, i) / band[i, 0]
        if q >= 1:
            y -= band[i, 1] * get2(work, i + 1)
        if q >= 2:
            y -= band[i, 2] * get2(work, i + 2)
        set2(work, i, y)
    for i in range(n):
        set2(x, i, get2(x, i) + get2(work, i))


@ti.func
def stretch(x: Array, work: Array, tension: Array, p: Array):
    """Bring all segments to their rest length at once, without compliance.

    One Newton step: a tridiagonal system for the multipliers λ, whose row j is
    −nⱼ₋₁·nⱼ λⱼ₋₁ + 2 λⱼ − nⱼ·nⱼ₊₁ λⱼ₊₁ = |segment j| − h, with n the directions of the segments.
    """
    n = x.shape[0] - 1
    before, upper, value = Vec2(0.0), 0.0, 0.0
    for j in range(n):  # forward elimination
        d = get2(x, j + 1) - get2(x, j)
        length = d.norm() + 1e-9
        d /= length
        off = -before.dot(d)
        pivot = 2 - off * upper
        value = (length - p[SPACING] - off * value) / pivot
        work[j, 2] = value
        if j >= 1:
            work[j - 1, 3] = upper
        following = Vec2(0.0)
        if j < n - 1:
            following = (get2(x, j + 2) - get2(x, j + 1)).normalized(1e-9)
        upper = -d.dot(following) / pivot
        set2(work, j, d)
        before = d
    value = 0.0
    for q in range(n):  # back substitution
        j = n - 1 - q
        here = work[j, 2]
        if q >= 1:
            here -= work[j, 3] * value
        value = here
        tension[j] += value
        step = get2(work, j) * value
        set2(x, j, get2(x, j) + step)
        set2(x, j + 1, get2(x, j + 1) - step)


@ti.func
def slowed(slide, pressed):
    """The rest of a sideways step after Coulomb friction undoes up to `pressed` metres of it."""
    return slide * (1 - ti.min(1.0, pressed / (slide.norm() + 1e-9)))


@ti.func
def meet_pole(x: Array, old: Array, pole: Array, step, p: Array, touched: Array):
    """Push nodes out of the pole, which moves by `step` in this substep and drags them along."""
    reach = p[RADIUS] + p[POLE_RADIUS]
    for i in range(x.shape[0]):
        away = get2(x, i) - Vec2(pole[0], pole[1])
        far = away.norm()
        if far < reach:
            n, pen = away / (far + 1e-9), reach - far
            slide = get2(x, i) - get2(old, i) - step
            slide -= n * n.dot(slide)
            rub = slide - slowed(slide, p[POLE_FRICTION] * pen)
            set2(x, i, get2(x, i) + n * pen - rub)
            touched[0] = 1


@ti.func
def find_pairs(x: Array, p: Array, pairs: Array, count: Array):
    """List pairs of nodes that are close to each other but not neighbours along the rope."""
    near = (2.5 * p[RADIUS]) ** 2
    apart = int(p[APART])
    count[0] = 0
    for i in range(x.shape[0]):
        for j in range(i + apart, x.shape[0]):
            away = get2(x, i) - get2(x, j)
            if away.dot(away) < near and count[0] < pairs.shape[0]:
                pairs[count[0], 0], pairs[count[0], 1] = i, j
                count[0] += 1


@ti.func
def meet_itself(x: Array, old: Array, p: Array, pairs: Array, count: Array):
    """Keep listed nodes a rope's thickness apart, with friction."""
    for q in range(count[0]):
        i, j = pairs[q, 0], pairs[q, 1]
        away = get2(x, i) - get2(x, j)
        far = away.norm()
        if far < 2 * p[RADIUS]:
            n, pen = away / (far + 1e-9), 2 * p[RADIUS] - far
            slide = get2(x, i) - get2(old, i) - get2(x, j) + get2(old, j)
            slide -= n * n.dot(slide)
            rub = slide - slowed(slide, p[SELF_FRICTION] * pen)
            step = 0.5 * (n * pen - rub)
            set2(x, i, get2(x, i) + step)
            set2(x, j, get2(x, j) - step)


@ti.func
def hold_back(x: Array, old: Array, drag: Array, p: Array):
    """Coulomb friction on the table: hold each node in place, as far as its weight allows."""
    for i in range(x.shape[0]):
        so_far = get2(drag, i)
        wanted = so_far + get2(old, i) - get2(x, i)
        allowed = wanted * ti.min(1.0, p[GRIP] / (wanted.norm() + 1e-12))
        set2(x, i, get2(x, i) + allowed - so_far)
        set2(drag, i, allowed)


@ti.func
def update_velocity(x: Array, old: Array, v: Array, p: Array):
    """Compute velocities from the positions after the constraints."""
    for i in range(x.shape[0]):
        set2(v, i, (get2(x, i) - get2(old, i)) / p[DT])


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
        if s == 0:  # here, because loops outside the serial one would run in parallel
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
