"""Eq. 5 through the columns of a modal space: the Jacobian, and the second-order term."""

import warp as wp

from torch_modal.backends.warp.kernels.elements import (
    HALF,
    TINY,
    bend_beyond,
    bend_slope,
    corner,
    is_flat,
    length_of,
    middle_of,
    moments,
    phase_of,
    place,
    real,
    vec3,
)

wide = wp.types.vector(length=8, dtype=real)
"""A row's entries of eight columns."""
seven = wp.types.vector(length=7, dtype=wp.int32)
"""Where the block of an edge goes, and the six of its hinge."""


@wp.kernel(enable_backward=False)
def jacobian(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    hinge: wp.array(dtype=wp.int32),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=moments),
    columns: wp.array(dtype=wide),
    extra: wp.array(dtype=vec3),
    n: int,
    n_columns: int,
    n_blocks: int,
    n_rows: int,
    out: wp.array(dtype=wide),
    entries: wp.array(dtype=real),
    stiffness: wp.array(dtype=real),
    threads: int,
):
    """Change of each measure along the columns and along one more that is the sample's own, and the measure's residual.

    All by the root of its weight. The residual comes in the column after the last. A component of a vertex has a row of
    blocks of eight columns; those of the measures are the same memory twice.
    """
    i = wp.tid()
    s = i // threads
    v = s * n
    residual = n_columns
    if extra:
        residual += 1
    total = real(0.0)
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        at = place(s * record.shape[0], k)
        o = 3 * n_blocks * q[0]
        j = 3 * n_blocks * q[1]
        row = s * n_rows + k
        origin = x[place(v, q[0])]
        e = x[place(v, q[1])] - origin
        length = length_of(e)
        wanted = stretch[at]
        root = wp.sqrt(wanted[0])
        g = vec3()
        if wp.dot(e, e) > TINY:
            g = (root / length) * e
        for c in range(n_blocks):
            y = c + n_blocks
            z = y + n_blocks
            out[place(row * n_blocks, c)] = (
                g[0] * (columns[place(j, c)] - columns[place(o, c)])
                + g[1] * (columns[place(j, y)] - columns[place(o, y)])
                + g[2] * (columns[place(j, z)] - columns[place(o, z)])
            )
        if extra:
            entries[place(row * n_blocks * 8, n_columns)] = wp.dot(g, extra[place(v, q[1])] - extra[place(v, q[0])])
        entries[place(row * n_blocks * 8, residual)] = root * (length - wanted[1])
        total += wanted[0]
        if q[2] >= 0:
            row = s * n_rows + record.shape[0] + hinge[place(k, 0)]
            a = 3 * n_blocks * q[2]
            b = 3 * n_blocks * q[3]
            tip_a = x[place(v, q[2])] - origin
            tip_b = x[place(v, q[3])] - origin
            n1 = wp.cross(e, tip_a)
            n2 = wp.cross(tip_b, e)
            w = bend[at]
            ge = vec3()
            ga = vec3()
            gb = vec3()
            off = real(0.0)
            if not (is_flat(e, n1) or is_flat(e, n2)):
                stiff = wp.sqrt(w[0])
                if stiff > real(0.0):
                    off = bend_slope(phase_of(e, tip_b, n1, n2), w) / stiff
                ga = (-stiff * length / wp.dot(n1, n1)) * n1
                gb = (-stiff * length / wp.dot(n2, n2)) * n2
                ge = (real(-1.0) / wp.dot(e, e)) * (wp.dot(tip_a, e) * ga + wp.dot(tip_b, e) * gb)
                total += w[0]
            gi = -(ge + ga + gb)
            for c in range(n_blocks):
                y = c + n_blocks
                z = y + n_blocks
                out[place(row * n_blocks, c)] = (
                    (gi[0] * columns[place(o, c)] + gi[1] * columns[place(o, y)] + gi[2] * columns[place(o, z)])
                    + (ge[0] * columns[place(j, c)] + ge[1] * columns[place(j, y)] + ge[2] * columns[place(j, z)])
                    + (ga[0] * columns[place(a, c)] + ga[1] * columns[place(a, y)] + ga[2] * columns[place(a, z)])
                    + (gb[0] * columns[place(b, c)] + gb[1] * columns[place(b, y)] + gb[2] * columns[place(b, z)])
                )
            if extra:
                start = extra[place(v, q[0])]
                along = wp.dot(ge, extra[place(v, q[1])] - start) + wp.dot(ga, extra[place(v, q[2])] - start)
                entries[place(row * n_blocks * 8, n_columns)] = along + wp.dot(gb, extra[place(v, q[3])] - start)
            entries[place(row * n_blocks * 8, residual)] = off
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
def curved_edges(
    x: wp.array(dtype=vec3),
    record: wp.array(dtype=wp.vec4i),
    stretch: wp.array(dtype=wp.vec2d),
    bend: wp.array(dtype=moments),
    slots: wp.array(dtype=seven),
    n: int,
    n_slots: int,
    out: wp.array(dtype=wp.mat33d),
    threads: int,
):
    """The second-order term between the pairs of vertices of edges and hinges: assembly.Curvature."""
    i = wp.tid()
    s = i // threads
    v = s * n
    to = s * n_slots
    for k in range(i - s * threads, record.shape[0], threads):
        q = record[place(k, 0)]
        at = place(s * record.shape[0], k)
        slot = slots[place(k, 0)]
        origin = x[place(v, q[0])]
        e = x[place(v, q[1])] - origin
        base = wp.dot(e, e)
        length = length_of(e)
        wanted = stretch[at]
        slope = wanted[0] * (length - wanted[1])
        if base > TINY:
            unit = e / length
            wp.atomic_add(
                out, place(to, slot[0]), (slope / length) * (wp.outer(unit, unit) - wp.identity(3, dtype=real))
            )
        if q[2] >= 0:
            a = x[place(v, q[2])] - origin
            b = x[place(v, q[3])] - origin
            n1 = wp.cross(e, a)
            n2 = wp.cross(b, e)
            if not (is_flat(e, n1) or is_flat(e, n2)):
                w = bend[at]
                phase = phase_of(e, b, n1, n2)
                moment = bend_slope(phase, w)
                beyond = bend_beyond(phase, w)
                ga = (-length / wp.dot(n1, n1)) * n1
                gb = (-length / wp.dot(n2, n2)) * n2
                ge = (real(-1.0) / base) * (wp.dot(a, e) * ga + wp.dot(b, e) * gb)
                gi = -(ga + gb + ge)
                own1, across1, rest1 = half_of_hinge(e, a, n1, wp.cross(n1, e), length)
                own2, across2, rest2 = half_of_hinge(e, b, n2, wp.cross(e, n2), length)
                wp.atomic_add(out, place(to, slot[1]), beyond * wp.outer(gi, ge) - moment * (own1 + own2))
                wp.atomic_add(out, place(to, slot[2]), beyond * wp.outer(ga, gi) - moment * rest1)
                wp.atomic_add(out, place(to, slot[3]), beyond * wp.outer(ga, ge) + moment * across1)
                wp.atomic_add(out, place(to, slot[4]), beyond * wp.outer(gb, gi) - moment * rest2)
                wp.atomic_add(out, place(to, slot[5]), beyond * wp.outer(gb, ge) + moment * across2)
                wp.atomic_add(out, place(to, slot[6]), beyond * wp.outer(ga, gb))


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
    threads: int,
):
    """The operator of pairs of vertices on all columns, and on the sample's own: assembly.PairBlocks.push.

    The blocks of pairs in descending order follow the others. The results are the same memory twice.
    """
    i = wp.tid()
    s = i // threads
    for k in range(i - s * threads, pairs.shape[0], threads):
        first = pairs[place(k, 0)][0]
        second = pairs[place(k, 0)][1]
        b = blocks[place(2 * s * pairs.shape[0], k)] + wp.transpose(blocks[place((2 * s + 1) * pairs.shape[0], k)])
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
        if extra:
            across = extra[place(s * n, second)] - extra[place(s * n, first)]
            up = b * across
            down = wp.transpose(b) * across
            for r in range(3):
                wp.atomic_add(entries, place((to_i + r * n_blocks) * 8, n_columns), up[r])
                wp.atomic_add(entries, place((to_j + r * n_blocks) * 8, n_columns), -down[r])


@wp.kernel(enable_backward=False)
def curved_faces(
    x: wp.array(dtype=vec3),
    centre: wp.array(dtype=vec3),
    capped_faces: wp.array(dtype=wp.vec3i),
    slope: wp.array(dtype=real),
    slots: wp.array(dtype=wp.vec3i),
    n: int,
    n_slots: int,
    out: wp.array(dtype=wp.mat33d),
    threads: int,
):
    """The same of the volume."""
    i = wp.tid()
    s = i // threads
    v = s * n
    to = s * n_slots
    middle = middle_of(x, centre, capped_faces, s, v)
    sixth = slope[s] / real(6.0)
    for k in range(i - s * threads, capped_faces.shape[0], threads):
        q = capped_faces[place(k, 0)]
        slot = slots[place(k, 0)]
        wp.atomic_add(out, place(to, slot[0]), -wp.skew(sixth * (corner(x, middle, v, q[2]) - middle)))
        wp.atomic_add(out, place(to, slot[1]), -wp.skew(sixth * (x[place(v, q[0])] - middle)))
        wp.atomic_add(out, place(to, slot[2]), -wp.skew(sixth * (x[place(v, q[1])] - middle)))
