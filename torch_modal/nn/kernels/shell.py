"""Eq. 5 towards two rest shapes: references, value, gradient, convex Hessian, products with it."""

import warp as wp

from torch_modal.energy.terms import MAX_BENDING_RATIO, SLACK
from torch_modal.nn.kernels.elements import (
    HALF,
    TINIEST,
    TINY,
    angle_of,
    bent,
    corner,
    is_flat,
    length_of,
    real,
    squared,
    stretched,
    symmetric,
    vec3,
    vec4,
    wrapped,
)

RATIO = wp.constant(real(MAX_BENDING_RATIO))
SLACKNESS = wp.constant(real(SLACK))


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


@wp.kernel(enable_backward=False)
def product(
    field: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    edges: wp.array(dtype=stretched),
    hinges: wp.array(dtype=bent),
    n: int,
    out: wp.array(dtype=vec3),
    form: wp.array(dtype=real),
):
    """The convex Hessian times a field, and the field times that, where there is an array for it."""
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
    if form:
        wp.atomic_add(form, s, wp.dot(to_j, e))
    if q[2] >= 0:
        h = hinges[at]
        ge = vec3(h[0], h[1], h[2])
        ga = vec3(h[3], h[4], h[5])
        gb = vec3(h[6], h[7], h[8])
        change = wp.dot(ge, e) + wp.dot(ga, field[v + q[2]] - origin) + wp.dot(gb, field[v + q[3]] - origin)
        moment = h[9] * change
        if form:
            wp.atomic_add(form, s, moment * change)
        wp.atomic_add(out, v + q[0], -moment * (ga + gb + ge) - to_j)
        wp.atomic_add(out, v + q[1], moment * ge + to_j)
        wp.atomic_add(out, v + q[2], moment * ga)
        wp.atomic_add(out, v + q[3], moment * gb)
    else:
        wp.atomic_add(out, v + q[0], -to_j)
        wp.atomic_add(out, v + q[1], to_j)


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
