"""Eq. 5 through the columns of a modal space: the Jacobian, and the second-order term."""

import warp as wp

from torch_modal.backends.warp.kernels.elements import (
    HALF,
    SIXTH,
    TINY,
    Elements,
    angle_gradients,
    bend_beyond,
    bend_slope,
    corner,
    hinge_of,
    length_of,
    middle_of,
    phase_of,
    place,
    real,
    rested,
    vec3,
)

wide = wp.types.vector(length=8, dtype=real)
"""A row's entries of eight columns."""
seven = wp.types.vector(length=7, dtype=wp.int32)
"""Places of the block of an edge, and of the six of its hinge."""


@wp.struct
class Slots:
    edges: wp.array(dtype=seven)
    faces: wp.array(dtype=wp.vec3i)
    pairs: wp.array(dtype=wp.vec2i)


@wp.func
def along_edge(columns: wp.array(dtype=wide), g: vec3, start: int, end: int, n_blocks: int, c: int):
    """Change of an edge vector along eight columns, projected on a vector."""
    y = c + n_blocks
    z = y + n_blocks
    return (
        g[0] * (columns[place(end, c)] - columns[place(start, c)])
        + g[1] * (columns[place(end, y)] - columns[place(start, y)])
        + g[2] * (columns[place(end, z)] - columns[place(start, z)])
    )


@wp.kernel(enable_backward=False)
def jacobian(
    mesh: Elements,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    columns: wp.array(dtype=wide),
    n_columns: int,
    n_blocks: int,
    n_rows: int,
    out: wp.array(dtype=wide),
    entries: wp.array(dtype=real),
    stiffness: wp.array(dtype=real),
    threads: int,
):
    """Change of each measure along the columns, and the measure's residual.

    All by the root of its weight. The residual comes in the column after the last. A component of a vertex has a row of
    blocks of eight columns; those of the measures are the same memory twice.
    """
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    total = real(0.0)
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        w = rests[place(s * mesh.record.shape[0], k)]
        o = 3 * n_blocks * q[0]
        j = 3 * n_blocks * q[1]
        row = s * n_rows + k
        e = x[place(v, q[1])] - x[place(v, q[0])]
        length = length_of(e)
        root = wp.sqrt(w[0])
        g = vec3()
        if wp.dot(e, e) > TINY:
            g = (root / length) * e
        for c in range(n_blocks):
            out[place(row * n_blocks, c)] = along_edge(columns, g, o, j, n_blocks, c)
        entries[place(row * n_blocks * 8, n_columns)] = root * (length - w[1])
        total += w[0]
        if q[2] >= 0:
            row = s * n_rows + mesh.record.shape[0] + mesh.hinge[place(k, 0)]
            h = hinge_of(x, v, q)
            ge = vec3()
            ga = vec3()
            gb = vec3()
            off = real(0.0)
            stiff = real(0.0)
            if not h.flat:
                stiff = wp.sqrt(w[2])
                ge, ga, gb = angle_gradients(h)
                if stiff > real(0.0):
                    off = bend_slope(phase_of(h), w) / stiff
                total += w[2]
            ge = stiff * ge
            ga = stiff * ga
            gb = stiff * gb
            for c in range(n_blocks):
                out[place(row * n_blocks, c)] = (
                    along_edge(columns, ge, o, j, n_blocks, c)
                    + along_edge(columns, ga, o, 3 * n_blocks * q[2], n_blocks, c)
                    + along_edge(columns, gb, o, 3 * n_blocks * q[3], n_blocks, c)
                )
            entries[place(row * n_blocks * 8, n_columns)] = off
    wp.atomic_add(stiffness, s, total)


@wp.func
def half_of_hinge(e: vec3, tip: vec3, normal: vec3, w: vec3, length: real):
    """One triangle's part of the dihedral angle's Hessian: bend.dihedral_hessian."""
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
def curvature(
    mesh: Elements,
    slots: Slots,
    x: wp.array(dtype=vec3),
    rests: wp.array(dtype=rested),
    centre: wp.array(dtype=vec3),
    moment: wp.array(dtype=real),
    out: wp.array(dtype=wp.mat33d),
    threads: int,
):
    """The second-order term between pairs of vertices: assembly.Curvature. The moment is the volume's."""
    i = wp.tid()
    s = i // threads
    v = s * mesh.n_vertices
    to = 2 * s * slots.pairs.shape[0]
    for k in range(i - s * threads, mesh.record.shape[0], threads):
        q = mesh.record[place(k, 0)]
        w = rests[place(s * mesh.record.shape[0], k)]
        slot = slots.edges[place(k, 0)]
        e = x[place(v, q[1])] - x[place(v, q[0])]
        length = length_of(e)
        if wp.dot(e, e) > TINY:
            unit = e / length
            slope = w[0] * (length - w[1]) / length
            wp.atomic_add(out, place(to, slot[0]), slope * (wp.outer(unit, unit) - wp.identity(3, dtype=real)))
        if q[2] >= 0:
            h = hinge_of(x, v, q)
            if not h.flat:
                phase = phase_of(h)
                slope = bend_slope(phase, w)
                beyond = bend_beyond(phase, w)
                ge, ga, gb = angle_gradients(h)
                gi = -(ga + gb + ge)
                own1, across1, rest1 = half_of_hinge(e, h.a, h.n1, wp.cross(h.n1, e), length)
                own2, across2, rest2 = half_of_hinge(e, h.b, h.n2, wp.cross(e, h.n2), length)
                wp.atomic_add(out, place(to, slot[1]), beyond * wp.outer(gi, ge) - slope * (own1 + own2))
                wp.atomic_add(out, place(to, slot[2]), beyond * wp.outer(ga, gi) - slope * rest1)
                wp.atomic_add(out, place(to, slot[3]), beyond * wp.outer(ga, ge) + slope * across1)
                wp.atomic_add(out, place(to, slot[4]), beyond * wp.outer(gb, gi) - slope * rest2)
                wp.atomic_add(out, place(to, slot[5]), beyond * wp.outer(gb, ge) + slope * across2)
                wp.atomic_add(out, place(to, slot[6]), beyond * wp.outer(ga, gb))
    middle = middle_of(mesh, x, centre, s)
    sixth = SIXTH * moment[s]
    for k in range(i - s * threads, mesh.capped_faces.shape[0], threads):
        face = mesh.capped_faces[place(k, 0)]
        places = slots.faces[place(k, 0)]
        wp.atomic_add(out, place(to, places[0]), -wp.skew(sixth * (corner(x, middle, v, face[2]) - middle)))
        wp.atomic_add(out, place(to, places[1]), -wp.skew(sixth * (x[place(v, face[0])] - middle)))
        wp.atomic_add(out, place(to, places[2]), -wp.skew(sixth * (x[place(v, face[1])] - middle)))


@wp.kernel(enable_backward=False)
def curved_columns(
    slots: Slots,
    blocks: wp.array(dtype=wp.mat33d),
    columns: wp.array(dtype=wide),
    n: int,
    n_blocks: int,
    out: wp.array(dtype=wide),
    threads: int,
):
    """The operator of pairs of vertices on all columns: assembly.PairBlocks.push.

    The blocks of pairs in descending order follow the others.
    """
    i = wp.tid()
    s = i // threads
    n_pairs = slots.pairs.shape[0]
    for k in range(i - s * threads, n_pairs, threads):
        first = slots.pairs[place(k, 0)][0]
        second = slots.pairs[place(k, 0)][1]
        b = blocks[place(2 * s * n_pairs, k)] + wp.transpose(blocks[place((2 * s + 1) * n_pairs, k)])
        to_i = 3 * n_blocks * (s * n + first)
        to_j = 3 * n_blocks * (s * n + second)
        for c in range(n_blocks):
            from_i = place(3 * n_blocks * first, c)
            from_j = place(3 * n_blocks * second, c)
            dx = columns[from_j] - columns[from_i]
            dy = columns[place(from_j, n_blocks)] - columns[place(from_i, n_blocks)]
            dz = columns[place(from_j, 2 * n_blocks)] - columns[place(from_i, 2 * n_blocks)]
            for r in range(3):
                wp.atomic_add(out, place(to_i + r * n_blocks, c), b[r, 0] * dx + b[r, 1] * dy + b[r, 2] * dz)
                wp.atomic_add(out, place(to_j + r * n_blocks, c), -b[0, r] * dx - b[1, r] * dy - b[2, r] * dz)
