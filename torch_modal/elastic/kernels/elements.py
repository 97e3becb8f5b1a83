"""Types and functions of one edge, hinge or face, shared by all kernels."""

import warp as wp

from torch_modal.elastic.bend import COLLAPSED

real = wp.float64
vec3 = wp.vec3d
vec4 = wp.vec4d
symmetric = wp.types.vector(length=6, dtype=real)
"""Entries ``xx, xy, xz, yy, yz, zz`` of a symmetric matrix."""
moments = wp.types.vector(length=5, dtype=real)
"""Sums over rest angles: doubled weight, then that times ``cos``, ``sin``, and ``cos``, ``sin`` of twice the angle."""
rested = wp.types.vector(length=7, dtype=real)
"""What an edge and its hinge are compared with: doubled weight and length of the edge, then the moments."""
linearised = wp.types.vector(length=15, dtype=real)
"""Factors of an edge and its hinge in the convex Hessian: unit vector, stiffness across and how much more along it;
gradients of the angle in the edge and in both tips, and the stiffness."""

TINY = wp.constant(real(1.4916681462400413e-154))  # vectors.tiny of float64
TINIEST = wp.constant(real(2.2250738585072014e-308))
FLAT = wp.constant(real(COLLAPSED))
HALF = wp.constant(real(0.5))
SIXTH = wp.constant(real(1 / 6))
LARGEST = wp.constant(0x7FFFFFFF)


@wp.struct
class Elements:
    record: wp.array(dtype=wp.vec4i)
    """Vertices of each edge and of its hinge, whose tips are -1 where it has none."""
    hinge: wp.array(dtype=wp.int32)
    """Number of the hinge of each edge."""
    capped_faces: wp.array(dtype=wp.vec3i)
    """Faces, and cones from the boundary to the centre, a vertex of -1."""
    n_vertices: int


@wp.func
def place(start: int, i: int):
    """Index of the i-th element of a row. The mask shows Warp that it is not negative (it would count from the end)."""
    return (start + i) & LARGEST


@wp.func
def length_of(e: vec3):
    return wp.sqrt(wp.max(wp.dot(e, e), TINY))


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


# ------------------------------------------------------------------------------------------------------------- hinges
@wp.struct
class Hinge:
    e: vec3
    a: vec3
    b: vec3
    n1: vec3
    n2: vec3
    length: real
    """Length of the edge."""
    per_both: real
    """One over the lengths of both normals."""
    per1: real
    """One over the square of a normal."""
    per2: real
    flat: bool


@wp.func
def hinge_of(x: wp.array(dtype=vec3), at: int, q: wp.vec4i):
    """The edge, the vectors to both tips, and the normals of the hinge of a record."""
    h = Hinge()
    origin = x[place(at, q[0])]
    h.e = x[place(at, q[1])] - origin
    h.a = x[place(at, q[2])] - origin
    h.b = x[place(at, q[3])] - origin
    h.n1 = wp.cross(h.e, h.a)
    h.n2 = wp.cross(h.b, h.e)
    h.length = length_of(h.e)
    square1 = wp.dot(h.n1, h.n1)
    square2 = wp.dot(h.n2, h.n2)
    h.per_both = real(1.0) / wp.sqrt(wp.max(square1 * square2, TINIEST))
    h.per1 = h.per_both * h.per_both * square2
    h.per2 = h.per_both * h.per_both * square1
    bound = FLAT * wp.dot(h.e, h.e)
    h.flat = wp.min(square1, square2) <= bound * bound + TINY
    return h


@wp.func
def phase_of(h: Hinge):
    """Cosine and sine of the dihedral angle of a hinge that is not flat."""
    return h.per_both * wp.vec2d(wp.dot(h.n1, h.n2), -h.length * wp.dot(h.n1, h.b))


@wp.func
def doubled(p: wp.vec2d):
    """Cosine and sine of twice the angle."""
    return wp.vec2d(p[0] * p[0] - p[1] * p[1], real(2.0) * p[0] * p[1])


@wp.func
def angle_gradients(h: Hinge):
    """Gradients of the dihedral angle in the edge and in both tips, of a hinge that is not flat."""
    ga = (-h.length * h.per1) * h.n1
    gb = (-h.length * h.per2) * h.n2
    per = real(1.0) / h.length
    ge = (-per * per) * (wp.dot(h.a, h.e) * ga + wp.dot(h.b, h.e) * gb)
    return ge, ga, gb


# The function of torch_modal.elastic.term.PeriodicTerm is 5/2 - 8/3 cos d + 1/6 cos 2d.
ALL = wp.constant(real(5 / 2))
ONCE = wp.constant(real(8 / 3))
FOUR_THIRDS = wp.constant(real(4 / 3))
THIRD = wp.constant(real(1 / 3))


@wp.struct
class Turn:
    """From the mean phase of the rest shapes: there, differences of sums as large as the weight would be rounding."""

    d: wp.vec2d
    """``1 - cos`` and ``sin`` of the angle."""
    e: wp.vec2d
    """The same of twice the angle."""
    once: real
    """Weighted sum of the phases, along the mean."""
    twice: wp.vec2d
    """That of the phases of twice the angle, along and across."""


@wp.func
def turn_to(p: wp.vec2d, w: rested):
    per_size = real(1.0) / wp.sqrt(wp.max(w[3] * w[3] + w[4] * w[4], TINIEST))
    c = w[3] * per_size
    s = w[4] * per_size
    off = p - wp.vec2d(c, s)
    mean = doubled(wp.vec2d(c, s))
    turn = Turn()
    turn.d = wp.vec2d(HALF * wp.dot(off, off), c * p[1] - s * p[0])
    turn.e = real(2.0) * turn.d[1] * wp.vec2d(turn.d[1], real(1.0) - turn.d[0])
    turn.once = c * w[3] + s * w[4]
    turn.twice = wp.vec2d(mean[0] * w[5] + mean[1] * w[6], mean[0] * w[6] - mean[1] * w[5])
    return turn


@wp.func
def bend_energy(p: wp.vec2d, w: rested):
    """Twice the energy of a hinge."""
    t = turn_to(p, w)
    least = ALL * w[2] - ONCE * t.once + SIXTH * t.twice[0]
    return least + ONCE * t.once * t.d[0] - SIXTH * (t.twice[0] * t.e[0] - t.twice[1] * t.e[1])


@wp.func
def bend_slope(p: wp.vec2d, w: rested):
    """First derivative of the energy in the angle."""
    t = turn_to(p, w)
    return FOUR_THIRDS * t.once * t.d[1] - SIXTH * (t.twice[0] * t.e[1] - t.twice[1] * (real(1.0) - t.e[0]))


@wp.func
def bend_beyond(p: wp.vec2d, w: rested):
    """Second derivative beyond that of the square."""
    t = doubled(p)
    return FOUR_THIRDS * (w[3] * p[0] + w[4] * p[1]) - THIRD * (w[5] * t[0] + w[6] * t[1]) - w[2]


# -------------------------------------------------------------------------------------------------------------- faces
@wp.func
def corner(x: wp.array(dtype=vec3), centre: vec3, at: int, v: int):
    found = centre
    if v >= 0:
        found = x[place(at, v)]
    return found


@wp.func
def middle_of(mesh: Elements, x: wp.array(dtype=vec3), centre: wp.array(dtype=vec3), sample: int):
    """The origin of volumes: the centre; any vertex where the surface is closed."""
    found = x[place(sample * mesh.n_vertices, mesh.capped_faces[0][0])]
    if centre:
        found = centre[sample]
    return found
