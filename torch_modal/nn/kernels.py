"""Kernels for NVIDIA Warp: the three terms of Eq. 5 and local rotations, each element read once and written once.

What they compute is what :mod:`torch_modal.energy` and :mod:`torch_modal.geometry.local_rotations` compute in many
passes over all elements, and is tested equal to it. Importing this needs the package ``warp-lang``;
:mod:`torch_modal.nn.launch` is the only module that does.

Arrays are flat: entry ``s * n + i`` is the i-th of the n vertices, edges or faces of sample ``s``. A record belongs to
an edge and to its hinge, where there is one: the vertices ``(i, j, k, l)`` of a row of
:attr:`~torch_modal.geometry.connectivity.Connectivity.hinges`, with ``k = -1`` where there is none.
"""

import warp as wp

from torch_modal.energy.measures import COLLAPSED
from torch_modal.energy.terms import MAX_BENDING_RATIO, SLACK
from torch_modal.geometry import rotations, triangle_frames
from torch_modal.nn import relax

real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d
packed_course = wp.types.vector(length=31, dtype=real)
"""A row of :meth:`torch_modal.geometry.local_rotations.Course`, in the order of its parts."""
symmetric = wp.types.vector(length=6, dtype=real)
"""Entries ``xx, xy, xz, yy, yz, zz`` of a symmetric matrix."""
stretched = wp.types.vector(length=5, dtype=real)
"""An edge: unit vector, stiffness across it, and how much more along it."""
bent = wp.types.vector(length=10, dtype=real)
"""A hinge: gradients of the angle in the edge and in both tips, and the stiffness."""

wide = wp.types.vector(length=8, dtype=real)
"""A row's entries of eight columns."""
six = wp.types.vector(length=6, dtype=wp.int32)
"""Where the blocks of an edge go, and the five of its hinge."""

TINY = wp.constant(real(1.4916681462400413e-154))  # vectors.tiny of float64
TINIEST = wp.constant(real(2.2250738585072014e-308))
FLAT = wp.constant(real(COLLAPSED))
RATIO = wp.constant(real(MAX_BENDING_RATIO))
SLACKNESS = wp.constant(real(SLACK))
TURN = wp.constant(real(6.283185307179586))
HALF = wp.constant(real(0.5))
RIDGE = wp.constant(real(relax.RIDGE))
NO_HEIGHT = wp.constant(real(triangle_frames.FLAT))
SMALL = wp.constant(real(rotations.SMALL))


# ------------------------------------------------------------------------------------------------------------- elements
@wp.func
def length_of(e: vec3):
    return wp.sqrt(wp.max(wp.dot(e, e), TINY))


@wp.func
def is_flat(e: vec3, n: vec3):
    bound = FLAT * wp.dot(e, e)
    return wp.dot(n, n) <= bound * bound + TINY


@wp.func
def wrapped(angle: real):
    return angle - TURN * wp.floor(angle / TURN + HALF)


@wp.func
def squared(g: vec3):
    return symmetric(g[0] * g[0], g[0] * g[1], g[0] * g[2], g[1] * g[1], g[1] * g[2], g[2] * g[2])


@wp.func
def applied(m: symmetric, g: vec3):
    return vec3(
        m[0] * g[0] + m[1] * g[1] + m[2] * g[2],
        m[1] * g[0] + m[3] * g[1] + m[4] * g[2],
        m[2] * g[0] + m[4] * g[1] + m[5] * g[2],
    )


@wp.func
def inverted(m: symmetric):
    trace = m[0] + m[3] + m[5]
    if trace <= real(0.0):
        trace = real(1.0)
    a = m[0] / trace + RIDGE
    d = m[3] / trace + RIDGE
    f = m[5] / trace + RIDGE
    b = m[1] / trace
    c = m[2] / trace
    e = m[4] / trace
    aa = d * f - e * e
    bb = c * e - b * f
    cc = b * e - c * d
    per = real(1.0) / ((a * aa + b * bb + c * cc) * trace)
    return symmetric(per * aa, per * bb, per * cc, per * (a * f - c * c), per * (b * c - a * e), per * (a * d - b * b))


@wp.func
def angle_of(e: vec3, a: vec3, b: vec3, n1: vec3, n2: vec3):
    return wp.atan2(-length_of(e) * wp.dot(n1, b), wp.dot(n1, n2))


# ----------------------------------------------------------------------------------------------------------- references
@wp.kernel(enable_backward=False)
def total_lengths(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    n: int,
    total: wp.array(dtype=wp.vec2d),
):
    """Of the edges of both rest shapes."""
    s, k = wp.tid()
    i = s * n + record[k][0]
    j = s * n + record[k][1]
    wp.atomic_add(total, s, wp.vec2d(length_of(first[j] - first[i]), length_of(second[j] - second[i])))


@wp.func
def bend_weight(e: vec3, n1: vec3, n2: vec3):
    base = wp.dot(e, e)
    area = HALF * (length_of(n1) + length_of(n2))
    return base / wp.max(area, base / RATIO)


@wp.kernel
def rest(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    hinge: wp.array(dtype=wp.int32),
    pull: wp.array(dtype=wp.vec2d),
    shortest: wp.array(dtype=wp.vec2d),
    alpha: wp.array(dtype=real),
    beta: wp.array(dtype=real),
    n: int,
    n_alpha: int,
    n_beta: int,
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    constant: wp.array(dtype=real),
):
    """Both rest shapes as one reference: Eq. 8. Weights are doubled, for derivatives."""
    s, k = wp.tid()
    v = s * n
    q = record[k]
    out = s * record.shape[0] + k
    e1 = first[v + q[1]] - first[v + q[0]]
    e2 = second[v + q[1]] - second[v + q[0]]
    l1 = length_of(e1)
    l2 = length_of(e2)
    both = pull[s]
    w1 = real(0.0)
    w2 = real(0.0)
    if l1 > shortest[s][0]:
        w1 = both[0] / l1
    if l2 > shortest[s][1]:
        w2 = both[1] / l2
    whole = w1 + w2
    share = real(0.0)
    if whole > real(0.0):
        share = w2 / whole
    own = alpha[s * n_alpha + wp.min(k, n_alpha - 1)]
    stretch[out] = wp.vec2d(real(2.0) * own * whole, l1 + share * (l2 - l1))
    wp.atomic_add(constant, s, own * w1 * share * (l2 - l1) * (l2 - l1))
    if q[2] >= 0:
        stiffness = real(2.0) * beta[s * n_beta + wp.min(hinge[k], n_beta - 1)]
        a1 = first[v + q[2]] - first[v + q[0]]
        b1 = first[v + q[3]] - first[v + q[0]]
        a2 = second[v + q[2]] - second[v + q[0]]
        b2 = second[v + q[3]] - second[v + q[0]]
        m1 = wp.cross(e1, a1)
        m2 = wp.cross(b1, e1)
        n1 = wp.cross(e2, a2)
        n2 = wp.cross(b2, e2)
        p1 = real(0.0)
        t1 = real(0.0)
        p2 = real(0.0)
        t2 = real(0.0)
        if not (is_flat(e1, m1) or is_flat(e1, m2)):
            p1 = stiffness * both[0] * bend_weight(e1, m1, m2)
            t1 = angle_of(e1, a1, b1, m1, m2)
        if not (is_flat(e2, n1) or is_flat(e2, n2)):
            p2 = stiffness * both[1] * bend_weight(e2, n1, n2)
            t2 = angle_of(e2, a2, b2, n1, n2)
        bend[out] = vec4(p1, t1, p2, t2)
    else:
        bend[out] = vec4()


# --------------------------------------------------------------------------------------------------- value, derivatives
@wp.kernel(enable_backward=False)
def value(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    n: int,
    n_references: int,
    energy: wp.array(dtype=real),
):
    """The energy but for the volume's; references come round where there are fewer than shapes."""
    s, k = wp.tid()
    v = s * n
    q = record[k]
    at = (s % n_references) * record.shape[0] + k
    origin = x[v + q[0]]
    e = x[v + q[1]] - origin
    wanted = stretch[at]
    d = length_of(e) - wanted[1]
    found = wanted[0] * d * d
    if q[2] >= 0:
        a = x[v + q[2]] - origin
        b = x[v + q[3]] - origin
        n1 = wp.cross(e, a)
        n2 = wp.cross(b, e)
        theta = real(0.0)
        if not (is_flat(e, n1) or is_flat(e, n2)):
            theta = angle_of(e, a, b, n1, n2)
        w = bend[at]
        d1 = wrapped(theta - w[1])
        d2 = wrapped(theta - w[3])
        found += w[0] * d1 * d1 + w[2] * d2 * d2
    wp.atomic_add(energy, s, HALF * found)


@wp.kernel
def linearise(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    n: int,
    energy: wp.array(dtype=real),
    gradient: wp.array(dtype=vec3),
    diagonal: wp.array(dtype=symmetric),
    edges: wp.array(dtype=stretched),
    hinges: wp.array(dtype=bent),
):
    """Energy, gradient, the 3 x 3 blocks of the convex Hessian's diagonal, and what a product with it needs."""
    s, k = wp.tid()
    v = s * n
    q = record[k]
    at = s * record.shape[0] + k
    origin = x[v + q[0]]
    e = x[v + q[1]] - origin
    base = wp.dot(e, e)
    length = length_of(e)
    per_length = real(0.0)
    if base > TINY:
        per_length = real(1.0) / length
    wanted = stretch[at]
    d = length - wanted[1]
    slope = wanted[0] * d
    unit = per_length * e
    width = SLACKNESS * wanted[0] * length
    across = HALF * (slope + wp.sqrt(slope * slope + width * width + TINIEST)) / length
    along = wanted[0] - across
    edges[at] = stretched(unit[0], unit[1], unit[2], across, along)
    block = along * squared(unit) + symmetric(across, real(0.0), real(0.0), across, real(0.0), across)
    pull = slope * unit
    wp.atomic_add(energy, s, HALF * slope * d)
    wp.atomic_add(gradient, v + q[0], -pull)
    wp.atomic_add(gradient, v + q[1], pull)
    wp.atomic_add(diagonal, v + q[0], block)
    wp.atomic_add(diagonal, v + q[1], block)
    if q[2] >= 0:
        a = x[v + q[2]] - origin
        b = x[v + q[3]] - origin
        n1 = wp.cross(e, a)
        n2 = wp.cross(b, e)
        w = bend[at]
        if is_flat(e, n1) or is_flat(e, n2):
            d3 = wrapped(-w[1])
            d4 = wrapped(-w[3])
            hinges[at] = bent()
            wp.atomic_add(energy, s, HALF * (w[0] * d3 * d3 + w[2] * d4 * d4))
        else:
            theta = angle_of(e, a, b, n1, n2)
            d1 = wrapped(theta - w[1])
            d2 = wrapped(theta - w[3])
            moment = w[0] * d1 + w[2] * d2
            stiffness = w[0] + w[2]
            ga = (-length / wp.dot(n1, n1)) * n1
            gb = (-length / wp.dot(n2, n2)) * n2
            ge = (-per_length * per_length) * (wp.dot(a, e) * ga + wp.dot(b, e) * gb)
            gi = -(ga + gb + ge)
            hinges[at] = bent(ge[0], ge[1], ge[2], ga[0], ga[1], ga[2], gb[0], gb[1], gb[2], stiffness)
            wp.atomic_add(energy, s, HALF * (w[0] * d1 * d1 + w[2] * d2 * d2))
            wp.atomic_add(gradient, v + q[0], moment * gi)
            wp.atomic_add(gradient, v + q[1], moment * ge)
            wp.atomic_add(gradient, v + q[2], moment * ga)
            wp.atomic_add(gradient, v + q[3], moment * gb)
            wp.atomic_add(diagonal, v + q[0], stiffness * squared(gi))
            wp.atomic_add(diagonal, v + q[1], stiffness * squared(ge))
            wp.atomic_add(diagonal, v + q[2], stiffness * squared(ga))
            wp.atomic_add(diagonal, v + q[3], stiffness * squared(gb))
    else:
        hinges[at] = bent()


@wp.kernel
def product(
    field: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    edges: wp.array(dtype=stretched),
    hinges: wp.array(dtype=bent),
    n: int,
    out: wp.array(dtype=vec3),
    form: wp.array(dtype=real),
):
    """The convex Hessian times a field, and the field times that."""
    s, k = wp.tid()
    v = s * n
    q = record[k]
    at = s * record.shape[0] + k
    origin = field[v + q[0]]
    e = field[v + q[1]] - origin
    r = edges[at]
    unit = vec3(r[0], r[1], r[2])
    rate = wp.dot(unit, e)
    to_j = r[3] * e + (r[4] * rate) * unit
    wp.atomic_add(form, s, wp.dot(to_j, e))
    if q[2] >= 0:
        h = hinges[at]
        ge = vec3(h[0], h[1], h[2])
        ga = vec3(h[3], h[4], h[5])
        gb = vec3(h[6], h[7], h[8])
        change = wp.dot(ge, e) + wp.dot(ga, field[v + q[2]] - origin) + wp.dot(gb, field[v + q[3]] - origin)
        moment = h[9] * change
        wp.atomic_add(form, s, moment * change)
        wp.atomic_add(out, v + q[0], -moment * (ga + gb + ge) - to_j)
        wp.atomic_add(out, v + q[1], moment * ge + to_j)
        wp.atomic_add(out, v + q[2], moment * ga)
        wp.atomic_add(out, v + q[3], moment * gb)
    else:
        wp.atomic_add(out, v + q[0], -to_j)
        wp.atomic_add(out, v + q[1], to_j)


@wp.func
def corner(x: wp.array(dtype=vec3), centre: vec3, at: int, v: int):
    found = centre
    if v >= 0:
        found = x[at + v]
    return found


@wp.kernel
def volume(
    x: wp.array(dtype=vec3),
    centre: wp.array(dtype=vec3),
    walls: wp.array(dtype=wp.vec3i),
    n: int,
    total: wp.array(dtype=real),
    gradient: wp.array(dtype=vec3),
    area: wp.array(dtype=real),
):
    """Volume of the tetrahedra from the centre to triangles, its gradient where the centre does not move, and the area.

    A vertex of -1 is the centre. Gradient and area are left out where there is no array for them.
    """
    s, k = wp.tid()
    v = s * n
    q = walls[k]
    middle = centre[s]
    a = x[v + q[0]] - middle
    b = x[v + q[1]] - middle
    c = corner(x, middle, v, q[2]) - middle
    bc = wp.cross(b, c)
    sixth = real(1.0) / real(6.0)
    wp.atomic_add(total, s, sixth * wp.dot(a, bc))
    if gradient:
        wp.atomic_add(gradient, v + q[0], sixth * bc)
        wp.atomic_add(gradient, v + q[1], sixth * wp.cross(c, a))
        if q[2] >= 0:
            wp.atomic_add(gradient, v + q[2], sixth * wp.cross(a, b))
    if area:
        wp.atomic_add(area, s, HALF * length_of(wp.cross(b - a, c - a)))


# --------------------------------------------------------------------------------------- through the columns of a space
@wp.kernel(enable_backward=False)
def jacobian(
    record: wp.array(dtype=wp.vec4i),
    hinge: wp.array(dtype=wp.int32),
    edges: wp.array(dtype=stretched),
    hinges: wp.array(dtype=bent),
    columns: wp.array(dtype=wide),
    extra: wp.array(dtype=vec3),
    n: int,
    n_columns: int,
    n_blocks: int,
    n_rows: int,
    out: wp.array(dtype=wide),
    entries: wp.array(dtype=real),
):
    """Change of each measure along the columns, and along one more that is the sample's own, by the root of its weight.

    A component of a vertex has a row of blocks of eight columns; those of the measures are the same memory twice.
    """
    s, k = wp.tid()
    v = s * n
    q = record[k]
    i = 3 * n_blocks * q[0]
    j = 3 * n_blocks * q[1]
    row = s * n_rows + k
    r = edges[s * record.shape[0] + k]
    root = wp.sqrt(r[3] + r[4])
    g = root * vec3(r[0], r[1], r[2])
    for c in range(n_blocks):
        y = c + n_blocks
        z = y + n_blocks
        out[row * n_blocks + c] = (
            g[0] * (columns[j + c] - columns[i + c])
            + g[1] * (columns[j + y] - columns[i + y])
            + g[2] * (columns[j + z] - columns[i + z])
        )
    if extra:
        entries[row * n_blocks * 8 + n_columns] = wp.dot(g, extra[v + q[1]] - extra[v + q[0]])
    if q[2] >= 0:
        row = s * n_rows + record.shape[0] + hinge[k]
        a = 3 * n_blocks * q[2]
        b = 3 * n_blocks * q[3]
        h = hinges[s * record.shape[0] + k]
        stiff = wp.sqrt(h[9])
        ge = stiff * vec3(h[0], h[1], h[2])
        ga = stiff * vec3(h[3], h[4], h[5])
        gb = stiff * vec3(h[6], h[7], h[8])
        gi = -(ge + ga + gb)
        for c in range(n_blocks):
            y = c + n_blocks
            z = y + n_blocks
            out[row * n_blocks + c] = (
                (gi[0] * columns[i + c] + gi[1] * columns[i + y] + gi[2] * columns[i + z])
                + (ge[0] * columns[j + c] + ge[1] * columns[j + y] + ge[2] * columns[j + z])
                + (ga[0] * columns[a + c] + ga[1] * columns[a + y] + ga[2] * columns[a + z])
                + (gb[0] * columns[b + c] + gb[1] * columns[b + y] + gb[2] * columns[b + z])
            )
        if extra:
            o = extra[v + q[0]]
            along = wp.dot(ge, extra[v + q[1]] - o) + wp.dot(ga, extra[v + q[2]] - o)
            entries[row * n_blocks * 8 + n_columns] = along + wp.dot(gb, extra[v + q[3]] - o)


@wp.func
def half_of_hinge(e: vec3, tip: vec3, normal: vec3, w: vec3, length: real):
    """One triangle's part of the dihedral angle's Hessian: measures.dihedral_hessian."""
    area = wp.dot(normal, normal)
    half = wp.outer((length / (area * area)) * normal, w)
    s = half + wp.transpose(half)
    u = wp.outer(e, normal / (length * area))
    r = wp.dot(tip, e) / (length * length)
    across = u - r * s
    base = length * length
    own = (r * r + HALF * area / (base * base)) * s - r * (u + wp.transpose(u)) + across
    return own, across, s + across


@wp.kernel(enable_backward=False)
def curved_edges(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=vec4),
    slots: wp.array(dtype=six),
    n: int,
    n_slots: int,
    out: wp.array(dtype=wp.mat33d),
):
    """The second-order term between the pairs of vertices of edges and hinges: assembly.Curvature."""
    s, k = wp.tid()
    v = s * n
    q = record[k]
    at = s * record.shape[0] + k
    to = s * n_slots
    slot = slots[k]
    origin = x[v + q[0]]
    e = x[v + q[1]] - origin
    base = wp.dot(e, e)
    length = length_of(e)
    wanted = stretch[at]
    slope = wanted[0] * (length - wanted[1])
    if base > TINY:
        unit = e / length
        wp.atomic_add(out, to + slot[0], (slope / length) * (wp.outer(unit, unit) - wp.identity(3, dtype=real)))
    if q[2] >= 0:
        a = x[v + q[2]] - origin
        b = x[v + q[3]] - origin
        n1 = wp.cross(e, a)
        n2 = wp.cross(b, e)
        if not (is_flat(e, n1) or is_flat(e, n2)):
            w = bend[at]
            theta = angle_of(e, a, b, n1, n2)
            moment = w[0] * wrapped(theta - w[1]) + w[2] * wrapped(theta - w[3])
            own1, across1, rest1 = half_of_hinge(e, a, n1, wp.cross(n1, e), length)
            own2, across2, rest2 = half_of_hinge(e, b, n2, wp.cross(e, n2), length)
            wp.atomic_add(out, to + slot[1], -moment * (own1 + own2))
            wp.atomic_add(out, to + slot[2], -moment * rest1)
            wp.atomic_add(out, to + slot[3], moment * across1)
            wp.atomic_add(out, to + slot[4], -moment * rest2)
            wp.atomic_add(out, to + slot[5], moment * across2)


@wp.kernel(enable_backward=False)
def curved_columns(
    pairs: wp.array(dtype=wp.vec2i),
    blocks: wp.array(dtype=wp.mat33d),
    columns: wp.array(dtype=wide),
    extra: wp.array(dtype=vec3),
    n: int,
    n_columns: int,
    n_blocks: int,
    out: wp.array(dtype=wide),
    entries: wp.array(dtype=real),
):
    """The operator of pairs of vertices on all columns, and on the sample's own: assembly.PairBlocks.push.

    The blocks of pairs in descending order follow the others. The results are the same memory twice.
    """
    s, k = wp.tid()
    first = pairs[k][0]
    second = pairs[k][1]
    b = blocks[(2 * s) * pairs.shape[0] + k] + wp.transpose(blocks[(2 * s + 1) * pairs.shape[0] + k])
    to_i = 3 * n_blocks * (s * n + first)
    to_j = 3 * n_blocks * (s * n + second)
    for c in range(n_blocks):
        i = 3 * n_blocks * first + c
        j = 3 * n_blocks * second + c
        dx = columns[j] - columns[i]
        dy = columns[j + n_blocks] - columns[i + n_blocks]
        dz = columns[j + 2 * n_blocks] - columns[i + 2 * n_blocks]
        for r in range(3):
            wp.atomic_add(out, to_i + r * n_blocks + c, b[r, 0] * dx + b[r, 1] * dy + b[r, 2] * dz)
            wp.atomic_add(out, to_j + r * n_blocks + c, -b[0, r] * dx - b[1, r] * dy - b[2, r] * dz)
    if extra:
        across = extra[s * n + second] - extra[s * n + first]
        up = b * across
        down = wp.transpose(b) * across
        for r in range(3):
            wp.atomic_add(entries, (to_i + r * n_blocks) * 8 + n_columns, up[r])
            wp.atomic_add(entries, (to_j + r * n_blocks) * 8 + n_columns, -down[r])


@wp.kernel(enable_backward=False)
def curved_walls(
    x: wp.array(dtype=vec3),
    centre: wp.array(dtype=vec3),
    walls: wp.array(dtype=wp.vec3i),
    slope: wp.array(dtype=real),
    slots: wp.array(dtype=wp.vec3i),
    n: int,
    n_slots: int,
    out: wp.array(dtype=wp.mat33d),
):
    """The same of the volume."""
    s, k = wp.tid()
    q = walls[k]
    v = s * n
    middle = centre[s]
    sixth = slope[s] / real(6.0)
    slot = slots[k]
    wp.atomic_add(out, s * n_slots + slot[0], -wp.skew(sixth * (corner(x, middle, v, q[2]) - middle)))
    wp.atomic_add(out, s * n_slots + slot[1], -wp.skew(sixth * (x[v + q[0]] - middle)))
    wp.atomic_add(out, s * n_slots + slot[2], -wp.skew(sixth * (x[v + q[1]] - middle)))


# -------------------------------------------------------------------------------------------------- conjugate gradients
@wp.kernel(enable_backward=False)
def begin(
    gradient: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    moment: wp.array(dtype=real),
    diagonal: wp.array(dtype=symmetric),
    n: int,
    residual: wp.array(dtype=vec3),
    direction: wp.array(dtype=vec3),
    solution: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    size: wp.array(dtype=real),
    swept: wp.array(dtype=real),
):
    s, i = wp.tid()
    v = s * n + i
    r = -(gradient[v] + moment[s] * normal[v])
    inverse = inverted(diagonal[v])
    z = applied(inverse, r)
    diagonal[v] = inverse
    residual[v] = r
    direction[v] = z
    solution[v] = vec3()
    product[v] = vec3()
    wp.atomic_add(size, s, wp.dot(r, z))
    wp.atomic_add(swept, s, wp.dot(normal[v], z))


@wp.func
def quotient(a: real, b: real):
    # A sample that is solved exactly has nothing left: 0 / 0.
    found = real(0.0)
    if b > real(0.0):
        found = a / b
    return found


@wp.kernel(enable_backward=False)
def advance(
    direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    normal: wp.array(dtype=vec3),
    inverse: wp.array(dtype=symmetric),
    stiffness: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    size: wp.array(dtype=real),
    form: wp.array(dtype=real),
    n: int,
    solution: wp.array(dtype=vec3),
    residual: wp.array(dtype=vec3),
    next_size: wp.array(dtype=real),
):
    s, i = wp.tid()
    v = s * n + i
    push = stiffness[s] * swept[s]
    step = quotient(size[s], form[s] + push * swept[s])
    solution[v] = solution[v] + step * direction[v]
    r = residual[v] - step * (product[v] + push * normal[v])
    residual[v] = r
    wp.atomic_add(next_size, s, wp.dot(r, applied(inverse[v], r)))


@wp.kernel(enable_backward=False)
def turn(
    residual: wp.array(dtype=vec3),
    inverse: wp.array(dtype=symmetric),
    normal: wp.array(dtype=vec3),
    size: wp.array(dtype=real),
    next_size: wp.array(dtype=real),
    n: int,
    direction: wp.array(dtype=vec3),
    product: wp.array(dtype=vec3),
    swept: wp.array(dtype=real),
):
    s, i = wp.tid()
    v = s * n + i
    d = applied(inverse[v], residual[v]) + quotient(next_size[s], size[s]) * direction[v]
    direction[v] = d
    product[v] = vec3()
    wp.atomic_add(swept, s, wp.dot(normal[v], d))


@wp.kernel(enable_backward=False)
def arrive(
    x: wp.array(dtype=vec3),
    direction: wp.array(dtype=vec3),
    stiffness: wp.array(dtype=real),
    swept: wp.array(dtype=real),
    size: wp.array(dtype=real),
    form: wp.array(dtype=real),
    n: int,
    solution: wp.array(dtype=vec3),
    reached: wp.array(dtype=vec3),
):
    s, i = wp.tid()
    v = s * n + i
    step = quotient(size[s], form[s] + stiffness[s] * swept[s] * swept[s])
    found = solution[v] + step * direction[v]
    solution[v] = found
    reached[v] = x[v] + found


# ------------------------------------------------------------------------------------------------------ local rotations
@wp.struct
class Triangle:
    e1: vec3
    e2: vec3
    normal: vec3
    length: real
    along: real
    height: real


@wp.func
def triangle(p: vec3, q: vec3, r: vec3):
    t = Triangle()
    first = q - p
    second = r - p
    t.length = length_of(first)
    t.e1 = first / t.length
    t.along = wp.dot(second, t.e1)
    rise = second - t.along * t.e1
    t.height = wp.max(length_of(rise), NO_HEIGHT * (t.length + wp.abs(t.along)))
    t.e2 = rise / t.height
    t.normal = wp.cross(t.e1, t.e2)
    return t


@wp.func
def quaternion(a: Triangle, b: Triangle):
    r = wp.outer(b.e1, a.e1) + wp.outer(b.e2, a.e2) + wp.outer(b.normal, a.normal)
    w = real(1.0) + r[0, 0] + r[1, 1] + r[2, 2]
    x = real(1.0) + r[0, 0] - r[1, 1] - r[2, 2]
    y = real(1.0) - r[0, 0] + r[1, 1] - r[2, 2]
    z = real(1.0) - r[0, 0] - r[1, 1] + r[2, 2]
    wx = r[2, 1] - r[1, 2]
    wy = r[0, 2] - r[2, 0]
    wz = r[1, 0] - r[0, 1]
    xy = r[0, 1] + r[1, 0]
    xz = r[0, 2] + r[2, 0]
    yz = r[1, 2] + r[2, 1]
    largest = wp.max(wp.max(w, x), wp.max(y, z))
    row = vec4(w, wx, wy, wz)
    if w < largest:
        if x == largest:
            row = vec4(wx, x, xy, xz)
        elif y == largest:
            row = vec4(wy, xy, y, yz)
        else:
            row = vec4(wz, xz, yz, z)
    return (HALF / wp.sqrt(wp.max(largest, real(2.220446049250313e-16)))) * row


@wp.kernel(enable_backward=False)
def turns(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    faces: wp.array(dtype=wp.vec3i),
    n: int,
    quaternions: wp.array(dtype=vec4),
    areas: wp.array(dtype=real),
):
    """Quaternions between the frames of triangles, and twice both areas."""
    s, k = wp.tid()
    v = s * n
    f = faces[k]
    a = triangle(first[v + f[0]], first[v + f[1]], first[v + f[2]])
    b = triangle(second[v + f[0]], second[v + f[1]], second[v + f[2]])
    quaternions[s * faces.shape[0] + k] = quaternion(a, b)
    areas[s * faces.shape[0] + k] = a.length * a.height + b.length * b.height


@wp.kernel(enable_backward=False)
def senses(
    quaternions: wp.array(dtype=vec4),
    areas: wp.array(dtype=real),
    order: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    piece: wp.array(dtype=wp.int32),
    n_pieces: int,
    sign: wp.array(dtype=real),
    vote: wp.array(dtype=real),
):
    """Signs passed down the tree, parents before children; then each piece votes. One thread for a sample."""
    s = wp.tid()
    n = order.shape[0]
    for j in range(n):
        k = order[j]
        own = real(1.0)
        if wp.dot(quaternions[s * n + k], quaternions[s * n + parent[k]]) < real(0.0):
            own = real(-1.0)
        if parent[k] != k:
            own = own * sign[s * n + parent[k]]
        sign[s * n + k] = own
        q = quaternions[s * n + k]
        vote[s * n_pieces + piece[k]] = vote[s * n_pieces + piece[k]] + areas[s * n + k] * own * q[0]
    for k in range(n):
        if vote[s * n_pieces + piece[k]] < real(0.0):
            sign[s * n + k] = -sign[s * n + k]


@wp.func
def rotated(real_part: real, axis: vec3, v: vec3):
    twice = real(2.0) * wp.cross(axis, v)
    return v + real_part * twice + wp.cross(axis, twice)


@wp.func
def sinc(squared_angle: real):
    # Of the square: with all derivatives at zero.
    found = real(1.0) - squared_angle / real(6.0) * (
        real(1.0) - squared_angle / real(20.0) * (real(1.0) - squared_angle / real(42.0))
    )
    if squared_angle >= SMALL:
        angle = wp.sqrt(squared_angle)
        found = wp.sin(angle) / angle
    return found


@wp.func
def half_turn(q: vec4):
    """Axis times half the angle: rotations._arc."""
    axis = vec3(q[1], q[2], q[3])
    sine = wp.dot(axis, axis)
    factor = real(0.0)
    if sine < SMALL * q[0] * q[0] and q[0] > real(0.0):
        t = sine / (q[0] * q[0])
        factor = (
            real(1.0)
            - t
            * (
                real(1.0) / real(3.0)
                - t * (real(1.0) / real(5.0) - t * (real(1.0) / real(7.0) - t * real(1.0) / real(9.0)))
            )
        ) / q[0]
    else:
        root = wp.sqrt(wp.max(sine, TINIEST))
        factor = wp.atan2(root, q[0]) / root
    return factor * axis


@wp.func
def add_sides(total: wp.array(dtype=vec4), edge: int, e: wp.vec3i, g: vec3, area: real, first: vec3, second: vec3):
    s1 = (area * g[0]) * first
    s2 = (area * g[1]) * (second - first)
    s3 = (-area * g[2]) * second
    wp.atomic_add(total, edge + e[0], vec4(s1[0], s1[1], s1[2], area))
    wp.atomic_add(total, edge + e[1], vec4(s2[0], s2[1], s2[2], area))
    wp.atomic_add(total, edge + e[2], vec4(s3[0], s3[1], s3[2], area))


@wp.func
def turned(half: vec3, v: vec3):
    """A vector turned about an axis by twice its length."""
    angle = wp.dot(half, half)
    return rotated(wp.cos(wp.sqrt(wp.max(angle, TINIEST))), sinc(angle) * half, v)


@wp.kernel
def turned_edges(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    time: wp.array(dtype=real),
    faces: wp.array(dtype=wp.vec3i),
    sides: wp.array(dtype=wp.vec3i),
    signs: wp.array(dtype=vec3),
    sense: wp.array(dtype=real),
    n: int,
    n_edges: int,
    total: wp.array(dtype=vec4),
):
    """Sides of all triangles at their times, summed on the edges by area, and the areas."""
    s, k = wp.tid()
    v = s * n
    f = faces[k]
    a = triangle(first[v + f[0]], first[v + f[1]], first[v + f[2]])
    b = triangle(second[v + f[0]], second[v + f[1]], second[v + f[2]])
    t = time[s]
    half = t * half_turn(sense[s * faces.shape[0] + k] * quaternion(a, b))
    x = a.length + t * (b.length - a.length)
    y = a.along + t * (b.along - a.along)
    z = a.height + t * (b.height - a.height)
    one = turned(half, x * a.e1)
    two = turned(half, y * a.e1 + z * a.e2)
    add_sides(total, s * n_edges, sides[k], signs[k], a.length * a.height + b.length * b.height, one, two)


@wp.kernel
def course_edges(
    course: wp.array(dtype=packed_course),
    which: wp.array(dtype=wp.int32),
    time: wp.array(dtype=real),
    sides: wp.array(dtype=wp.vec3i),
    signs: wp.array(dtype=vec3),
    n_edges: int,
    total: wp.array(dtype=vec4),
):
    """The same of triangles on a smooth course."""
    s, k = wp.tid()
    c = course[which[s] * sides.shape[0] + k]
    e1 = vec3(c[0], c[1], c[2])
    e2 = vec3(c[3], c[4], c[5])
    normal = vec3(c[6], c[7], c[8])
    u = time[s]
    a = u * (real(1.0) - u) * (real(1.0) - u)
    b = -u * (real(1.0) - u) * u
    straight = (HALF * u) * vec3(c[12], c[13], c[14])
    bend = HALF * (a * vec3(c[18], c[19], c[20]) + b * vec3(c[24], c[25], c[26]))
    unit = c[30]
    length = c[9] + unit * (u * c[15] + a * c[21] + b * c[27])
    along = c[10] + unit * (u * c[16] + a * c[22] + b * c[28])
    height = c[11] + unit * (u * c[17] + a * c[23] + b * c[29])
    one = turned(straight, turned(bend, vec3(length, real(0.0), real(0.0))))
    two = turned(straight, turned(bend, vec3(along, height, real(0.0))))
    area = c[9] * c[11] + (c[9] + unit * c[15]) * (c[11] + unit * c[17])
    first = one[0] * e1 + one[1] * e2 + one[2] * normal
    second = two[0] * e1 + two[1] * e2 + two[2] * normal
    add_sides(total, s * n_edges, sides[k], signs[k], area, first, second)


@wp.kernel(enable_backward=False)
def pulls(
    wanted: wp.array(dtype=vec3),
    weights: wp.array(dtype=real),
    ends: wp.array(dtype=wp.vec2i),
    n: int,
    out: wp.array(dtype=vec3),
):
    """What edges ask of their ends: the right side of the Poisson problem."""
    s, k = wp.tid()
    pull = weights[k] * wanted[s * ends.shape[0] + k]
    wp.atomic_add(out, s * n + ends[k][0], -pull)
    wp.atomic_add(out, s * n + ends[k][1], pull)


@wp.kernel(enable_backward=False)
def substituted(
    right: wp.array(dtype=vec3),
    order: wp.array(dtype=wp.int32),
    start: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int32),
    entry: wp.array(dtype=real),
    pivot: wp.array(dtype=real),
    n: int,
    work: wp.array(dtype=vec3),
    out: wp.array(dtype=vec3),
):
    """Substitution with ``L D L^T``, ``L`` by its columns below the diagonal. One thread for a sample."""
    s = wp.tid()
    n_free = order.shape[0]
    at = s * n_free
    for k in range(n_free):
        work[at + k] = right[s * n + order[k]]
    for k in range(n_free):
        found = work[at + k]
        for p in range(start[k], start[k + 1]):
            work[at + row[p]] = work[at + row[p]] - entry[p] * found
    for j in range(n_free):
        k = n_free - 1 - j
        found = work[at + k] / pivot[k]
        for p in range(start[k], start[k + 1]):
            found = found - entry[p] * work[at + row[p]]
        work[at + k] = found
        out[s * n + order[k]] = found
