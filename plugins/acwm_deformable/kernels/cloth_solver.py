"""XPBD of a sheet of cloth: Taichi functions that predict a substep and project its constraints.

Extended position-based dynamics (Macklin, Müller and Chentanez 2016) with one pass over the
constraints in each of many small substeps (Macklin et al. 2019). Shared arrays, for a sheet of
`rows` × `columns` = N nodes, numbered row by row:

    x, old [N, 3]   positions now and at the start of the substep, metres
    v      [N, 3]   velocities, m/s
    w      [N]      1 for a free node, 0 for a held one; all nodes have the same mass
    p      [LENGTH] numbers of the episode, see the offsets below

A constraint C of compliance α moves nodes by Δx = −C ∇C / (Σ |∇C|² + s), with unit inverse masses.
XPBD has s = α m / dt², where m is the mass of a node, and converges to the right force over many
passes. With a single pass, the denominator sets the force at rest, C m / (Σ |∇C|² + s) / dt². So
here s = α m / dt² − Σ |∇C|², which makes this force C / α for every constraint that is not too
stiff for one pass.
"""

from acwm_sim.engine import ti
from acwm_sim.kernels.arrays import Array, Vec3, get3, set3

DT = 0  # seconds in a substep
GRAVITY = 1  # m/s²
DRAG = 2  # rate at which air slows a node, 1/s
SPACING = 3  # rest length of a structural edge, metres
SHEAR = 4  # s of the diagonals
BEND = 5  # s of bending over neighbours
WIDE = 6  # s of bending over nodes two edges apart, negative if not used
FRICTION = 7  # Coulomb coefficient on sphere and ground
THICKNESS = 8  # distance of the cloth from sphere and ground, metres
LAYER = 9  # distance between two layers of cloth, metres
LAYER_FRICTION = 10  # Coulomb coefficient between layers
SPHERE = 11  # 4: centre, radius, metres
HAND = 15  # radius of a gripper, metres
BOX = 16  # 6: least and largest x, y, z of a gripper, metres
LENGTH = 22

TOLERANCE = 0.035
"""Largest strain of an edge that a frame may keep."""

MAX_PASSES = 60
"""After this many passes a frame is left as it is, even if an edge has a larger strain."""


@ti.func
def predict(x: Array, old: Array, v: Array, w: Array, p: Array):
    """Free flight under gravity and linear air drag (implicit, so that it never overshoots)."""
    dt = p[DT]
    for i in range(x.shape[0]):
        set3(old, i, get3(x, i))
        if w[i] > 0:
            velocity = get3(v, i)
            velocity.z -= p[GRAVITY] * dt
            set3(x, i, get3(x, i) + velocity * (dt / (1 + p[DRAG] * dt)))


@ti.func
def reach_limits(x: Array, w: Array, held: Array, columns, p: Array):
    """Limit the distance of nodes from a held node to their distance on the flat cloth.

    Long-range attachments (Kim, Chentanez and Müller 2012): cloth that hangs from a gripper cannot
    stretch, even with few passes over the edges.
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
    """Move two nodes towards their rest distance, with s = `soft`."""
    total = w[a] + w[b]
    if total > 0:
        apart = get3(x, a) - get3(x, b)
        length = apart.norm() + 1e-9
        apart *= (length - rest) / (length * (total + soft))
        set3(x, a, get3(x, a) - apart * w[a])
        set3(x, b, get3(x, b) + apart * w[b])


@ti.func
def set_edge(x: Array, w: Array, a, b, p: Array):
    """Move neighbours to their rest distance.

    Returns:
        The strain of the edge before, positive if stretched.
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
    """Project structural edges without compliance, in sweeps down and across.

    `backwards` reverses the sweeps. Inner loops run over edges that share no node, which a
    processor can overlap.

    Returns:
        The least and the largest strain of an edge just before its projection.
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
    """Move two nodes closer if they are further apart than `rest`."""
    apart = get3(x, a) - get3(x, b)
    far, total = apart.dot(apart), w[a] + w[b]
    if far > rest * rest and total > 0:
        apart *= (1 - rest / ti.sqrt(far)) / total
        set3(x, a, get3(x, a) - apart * w[a])
        set3(x, b, get3(x, b) + apart * w[b])


@ti.func
def tether(x: Array, w: Array, span: ti.template(), rows, columns, p: Array):
    """Limit the distance of nodes `span` edges apart in a row or column to the rest length.

    This follows from the single edges. The additional constraint carries a pull across the cloth in
    a few substeps, where edge by edge it would take many.
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
    """Project both diagonals of every cell, softly."""
    diagonal = p[SPACING] * ti.sqrt(2.0)
    for r in range(rows - 1):
        for c in range(columns - 1):
            i = r * columns + c
            pull(x, w, i, i + columns + 1, diagonal, p[SHEAR])
            pull(x, w, i + 1, i + columns, diagonal, p[SHEAR])


@ti.func
def flatten(x: Array, w: Array, a, b, c, soft):
    """Bending of three nodes in a row: C = x_a − 2 x_b + x_c, a vector that is zero if straight.

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
    """The rest of a sideways step after Coulomb friction undoes up to `pressed` metres of it."""
    return slide * (1 - ti.min(1.0, pressed / (slide.norm() + 1e-9)))


@ti.func
def outside(q, p: Array):
    """The nearest point to q outside sphere and ground, and which of them q was in.

    Returns:
        The point, whether q was inside the sphere, and whether it was below the ground.
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
        # Under the sphere, the only room is outside the ring where it meets the ground.
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
    """Move free nodes out of sphere and ground, without friction."""
    for i in range(x.shape[0]):
        if w[i] > 0:
            clear, in_sphere, in_ground = outside(get3(x, i), p)
            if in_sphere or in_ground:
                set3(x, i, clear)


@ti.func
def tidy(x: Array, w: Array, rows, columns, p: Array):
    """Move nodes until every edge is within tolerance, without changing velocities.

    One pass per substep leaves strains of some per cent where cloth lands or is crushed.
    """
    passes, least, most = 0, -1.0, 1.0
    while ti.max(-least, most) > TOLERANCE and passes < MAX_PASSES:
        least, most = stretch(x, w, rows, columns, p, passes % 2)
        push_out(x, w, p)
        passes += 1


@ti.func
def longest_edge(x: Array, rows, columns, p: Array):
    """Strain of the most stretched edge."""
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
    """Compute velocities from the positions after the constraints."""
    for i in range(x.shape[0]):
        set3(v, i, (get3(x, i) - get3(old, i)) / p[DT])
