"""XPBD of one sheet of cloth: Taichi functions that predict a substep and project its constraints.

Extended position-based dynamics (Macklin, Müller and Chentanez 2016) with one pass over the
constraints in each of many small substeps (Macklin et al. 2019). Arrays that they share, for a
sheet of `rows` × `columns` = N nodes, numbered row by row:

    x, old [N, 3]   positions now and at the start of the substep, metres
    v      [N, 3]   velocities, m/s
    w      [N]      1 for a free node, 0 for a held one; all nodes have the same mass
    p      [LENGTH] numbers of the episode, see the offsets below

A constraint C of compliance α moves nodes by Δx = −C ∇C / (Σ |∇C|² + s), with unit inverse masses.
XPBD has s = α m / dt², where m is the mass of a node, and converges to the right force over many
passes. In one pass, what stands in the denominator is what the cloth feels at rest: a force of
C m / (Σ |∇C|² + s) / dt². So s is α m / dt² − Σ |∇C|² here, which makes that C / α, for all that is
not too stiff for one pass.
"""

from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec3, get3, set3

DT = 0  # seconds in a substep
GRAVITY = 1  # m/s²
DRAG = 2  # rate at which air slows a node, 1/s
SPACING = 3  # rest length of a structural edge, metres
SHEAR = 4  # s of the diagonals
BEND = 5  # s of bending over neighbours
WIDE = 6  # s of bending over nodes two edges apart, negative if there is none
FRICTION = 7  # Coulomb coefficient on sphere and ground
THICKNESS = 8  # distance that the cloth keeps from sphere and ground, metres
LAYER = 9  # distance that two layers of cloth keep, metres
LAYER_FRICTION = 10  # Coulomb coefficient between layers
SPHERE = 11  # 4: centre, radius, metres
HAND = 15  # radius of a gripper, metres
BOX = 16  # 6: least and largest x, y, z of a gripper, metres
LENGTH = 22

TOLERANCE = 0.035
"""Strain of the worst edge that is left in a frame."""

MAX_PASSES = 60
"""After so many passes a frame is left as it is, even if some edge is strained more."""


@ti.func
def predict(x: Array, old: Array, v: Array, w: Array, p: Array):
    """Free flight under gravity and linear air drag (drag implicitly, so it never overshoots)."""
    dt = p[DT]
    for i in range(x.shape[0]):
        set3(old, i, get3(x, i))
        if w[i] > 0:
            velocity = get3(v, i)
            velocity.z -= p[GRAVITY] * dt
            set3(x, i, get3(x, i) + velocity * (dt / (1 + p[DRAG] * dt)))


@ti.func
def reach_limits(x: Array, w: Array, held: Array, columns, p: Array):
    """No node is further from a held one than along the flat cloth.

    Long-range attachments (Kim, Chentanez and Müller 2012): what hangs from a gripper cannot
    stretch, however few the passes over the edges are.
    """
    for k in range(held.shape[0]):
        if held[k] >= 0:
            row, column, anchor = held[k] // columns, held[k] % columns, get3(x, held[k])
            for i in range(x.shape[0]):
                down, across = float(i // columns - row), float(i % columns - column)
                limit = p[SPACING] ** 2 * (down * down + across * across)
                away = get3(x, i) - anchor
                far = away.dot(away)
                if far > limit and w[i] > 0:
                    set3(x, i, anchor + away * ti.sqrt(limit / far))


@ti.func
def pull(x: Array, w: Array, a, b, rest, soft):
    """Bring two nodes towards their rest distance, with s = `soft`."""
    total = w[a] + w[b]
    if total > 0:
        apart = get3(x, a) - get3(x, b)
        length = apart.norm() + 1e-9
        apart *= (length - rest) / (length * (total + soft))
        set3(x, a, get3(x, a) - apart * w[a])
        set3(x, b, get3(x, b) + apart * w[b])


@ti.func
def set_edge(x: Array, w: Array, a, b, p: Array):
    """Bring neighbours to their rest distance.

    Returns:
        The strain that the edge had, positive when stretched.
    """
    total, strain = w[a] + w[b], 0.0
    if total > 0:
        apart = get3(x, a) - get3(x, b)
        length = apart.norm() + 1e-9
        apart *= (length - p[SPACING]) / (length * total)
        strain = length / p[SPACING] - 1
        set3(x, a, get3(x, a) - apart * w[a])
        set3(x, b, get3(x, b) + apart * w[b])
    return strain


@ti.func
def stretch(x: Array, w: Array, rows, columns, p: Array, backwards):
    """Structural edges, without compliance, in sweeps down and across that turn every time.

    Inner loops run over edges that share no node, which a processor can overlap.

    Returns:
        The least and the largest strain that an edge had when its turn came.
    """
    least, most = 0.0, 0.0
    for q in range(rows - 1):
        r = rows - 2 - q if backwards else q
        for c in range(columns):
            i = r * columns + c
            strain = set_edge(x, w, i, i + columns, p)
            least, most = ti.min(least, strain), ti.max(most, strain)
    for q in range(columns - 1):
        c = columns - 2 - q if backwards else q
        for r in range(rows):
            i = r * columns + c
            strain = set_edge(x, w, i, i + 1, p)
            least, most = ti.min(least, strain), ti.max(most, strain)
    return least, most


@ti.func
def leash(x: Array, w: Array, a, b, rest):
    """Bring two nodes closer, if they are further apart than `rest`."""
    apart = get3(x, a) - get3(x, b)
    far, total = apart.dot(apart), w[a] + w[b]
    if far > rest * rest and total > 0:
        apart *= (1 - rest / ti.sqrt(far)) / total
        set3(x, a, get3(x, a) - apart * w[a])
        set3(x, b, get3(x, b) + apart * w[b])


@ti.func
def tether(x: Array, w: Array, span: ti.template(), rows, columns, p: Array):
    """Nodes `span` edges apart in a row or column are no further apart than these edges are long.

    That follows from the edges; said once more, it carries a pull across the cloth in a few
    substeps, where edge by edge it would take many.
    """
    rest = span * p[SPACING]
    for r in range(rows):
        for c in range(columns):
            i = r * columns + c
            if r < rows - span:
                leash(x, w, i, i + span * columns, rest)
            if c < columns - span:
                leash(x, w, i, i + span, rest)


@ti.func
def shear(x: Array, w: Array, rows, columns, p: Array):
    """Both diagonals of every cell, soft."""
    diagonal = p[SPACING] * ti.sqrt(2.0)
    for r in range(rows - 1):
        for c in range(columns - 1):
            i = r * columns + c
            pull(x, w, i, i + columns + 1, diagonal, p[SHEAR])
            pull(x, w, i + 1, i + columns, diagonal, p[SHEAR])


@ti.func
def flatten(x: Array, w: Array, a, b, c, soft):
    """Bending of three nodes in a row: C = x_a − 2 x_b + x_c, a vector that is zero when straight.

    With nodes a distance d apart, C / d² is the curvature and B h² |C|² / (2 d⁴) the energy that
    a cell of side h has from bending stiffness B.
    """
    total = w[a] + 4 * w[b] + w[c]
    if total > 0:
        step = (get3(x, a) - 2 * get3(x, b) + get3(x, c)) / (total + soft)
        set3(x, a, get3(x, a) - step * w[a])
        set3(x, b, get3(x, b) + step * (2 * w[b]))
        set3(x, c, get3(x, c) - step * w[c])


@ti.func
def bend(x: Array, w: Array, span: ti.template(), rows, columns, soft):
    """Bending along both directions of the weave, over nodes `span` edges apart."""
    for r in range(rows):
        for c in range(columns):
            i = r * columns + c
            if r < rows - 2 * span:
                flatten(x, w, i, i + span * columns, i + 2 * span * columns, soft)
            if c < columns - 2 * span:
                flatten(x, w, i, i + span, i + 2 * span, soft)


@ti.func
def slowed(slide, pressed):
    """What Coulomb friction leaves of a sideways step, when it can undo `pressed` metres of it."""
    return slide * (1 - ti.min(1.0, pressed / (slide.norm() + 1e-9)))


@ti.func
def outside(q, p: Array):
    """The point nearest to q that is clear of sphere and ground, and what was in its way.

    Returns:
        The point; whether q was inside the sphere; whether it was below the ground.
    """
    center, reach = Vec3(p[SPHERE], p[SPHERE + 1], p[SPHERE + 2]), p[SPHERE + 3] + p[THICKNESS]
    floor = p[THICKNESS]
    away = q - center
    in_sphere, in_ground = away.dot(away) < reach * reach, q.z < floor
    if in_sphere:
        q = center + away.normalized(1e-9) * reach
    if q.z < floor:
        q.z = floor
        flat = Vec3(q.x - center.x, q.y - center.y, 0.0)
        # Under the sphere there is no room but beside the ring where it leaves the ground.
        ring = ti.sqrt(ti.max(reach * reach - (center.z - floor) ** 2, 0.0))
        if flat.norm() < ring:
            flat *= ring / (flat.norm() + 1e-9)
            q = Vec3(center.x + flat.x, center.y + flat.y, floor)
    return q, in_sphere, in_ground


@ti.func
def collide(x: Array, old: Array, w: Array, p: Array, touched: Array):
    """Keep free nodes off the sphere and the ground, with friction."""
    for i in range(x.shape[0]):
        if w[i] > 0:
            q, before = get3(x, i), get3(old, i)
            clear, in_sphere, in_ground = outside(q, p)
            if in_sphere:
                touched[0] = 1
            if in_ground:
                touched[1] = 1
            if in_sphere or in_ground:
                out = clear - q
                pen = out.norm()
                n = out / (pen + 1e-9)
                step = clear - before
                along = n * n.dot(step)
                clear = before + along + slowed(step - along, p[FRICTION] * pen)
                clear, in_sphere, in_ground = outside(clear, p)
                set3(x, i, clear)


@ti.func
def push_out(x: Array, w: Array, p: Array):
    """Free nodes out of sphere and ground, without friction."""
    for i in range(x.shape[0]):
        if w[i] > 0:
            clear, in_sphere, in_ground = outside(get3(x, i), p)
            if in_sphere or in_ground:
                set3(x, i, clear)


@ti.func
def tidy(x: Array, w: Array, rows, columns, p: Array):
    """Move nodes, and leave their velocities, until every edge is within tolerance.

    One pass a substep leaves edges strained by some per cent where cloth lands or is crushed.
    """
    passes, least, most = 0, -1.0, 1.0
    while ti.max(-least, most) > TOLERANCE and passes < MAX_PASSES:
        least, most = stretch(x, w, rows, columns, p, passes % 2)
        push_out(x, w, p)
        passes += 1


@ti.func
def longest_edge(x: Array, rows, columns, p: Array):
    """Strain of the edge that is stretched most."""
    most = 0.0
    for r in range(rows):
        for c in range(columns):
            i = r * columns + c
            if r < rows - 1:
                down = get3(x, i + columns) - get3(x, i)
                most = ti.max(most, down.dot(down))
            if c < columns - 1:
                across = get3(x, i + 1) - get3(x, i)
                most = ti.max(most, across.dot(across))
    return ti.sqrt(most) / p[SPACING] - 1


@ti.func
def update_velocity(x: Array, old: Array, v: Array, p: Array):
    """Velocities from the positions that the constraints left."""
    for i in range(x.shape[0]):
        set3(v, i, (get3(x, i) - get3(old, i)) / p[DT])
