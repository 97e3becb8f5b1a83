"""Key-frames brought into the frame, and shapes back along the rigid motion."""

import warp as wp

from torch_modal.backends.warp.kernels.elements import place, real, vec3, vec4
from torch_modal.backends.warp.kernels.rotations import about, half_turn, quaternion_of, turned
from torch_modal.geometry import rotations

SIDE = wp.constant(vec3(*rotations.HALF_TURN_SIDE))
WITHIN = wp.constant(real(rotations.HALF_TURN * 2.220446049250313e-16))


@wp.kernel(enable_backward=False)
def moments(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    reference: wp.array(dtype=vec3),
    weights: wp.array(dtype=real),
    n: int,
    sums: wp.array(dtype=vec3),
    total: wp.array(dtype=real),
    threads: int,
):
    """Weighted sums of the vertices of both ends and of the reference, and of the weights."""
    i = wp.tid()
    s = i // threads
    of_first = vec3()
    of_second = vec3()
    of_reference = vec3()
    whole = real(0.0)
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        weight = weights[place(k, 0)]
        of_first += weight * first[v]
        of_second += weight * second[v]
        of_reference += weight * reference[place(k, 0)]
        whole += weight
    wp.atomic_add(sums, 3 * s, of_first)
    wp.atomic_add(sums, 3 * s + 1, of_second)
    wp.atomic_add(sums, 3 * s + 2, of_reference)
    wp.atomic_add(total, s, whole)


@wp.kernel(enable_backward=False)
def covariances(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    reference: wp.array(dtype=vec3),
    weights: wp.array(dtype=real),
    sums: wp.array(dtype=vec3),
    total: wp.array(dtype=real),
    n: int,
    found: wp.array(dtype=wp.mat33d),
    threads: int,
):
    """Of the reference with the first end, and of the first with the second, about their centroids."""
    i = wp.tid()
    s = i // threads
    a = sums[3 * s] / total[s]
    b = sums[3 * s + 1] / total[s]
    to_reference = wp.mat33d()
    to_first = wp.mat33d()
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        x = weights[place(k, 0)] * (first[v] - a)
        to_reference += wp.outer(reference[place(k, 0)], x)
        to_first += wp.outer(x, second[v] - b)
    wp.atomic_add(found, 2 * s, to_reference)
    wp.atomic_add(found, 2 * s + 1, to_first)


@wp.func
def matrix_of(q: vec4):
    return wp.matrix_from_cols(
        turned(q, vec3(real(1.0), real(0.0), real(0.0))),
        turned(q, vec3(real(0.0), real(1.0), real(0.0))),
        turned(q, vec3(real(0.0), real(0.0), real(1.0))),
    )


@wp.func
def best_rotation(a: wp.mat33d, n_sweeps: int):
    """As rigid.best_rotation: of Horn's matrix (1987) the vector of the largest eigenvalue, by Jacobi's rotations."""
    m = wp.mat44d()
    v = wp.identity(4, dtype=real)
    m[0, 0] = a[0, 0] + a[1, 1] + a[2, 2]
    m[1, 1] = a[0, 0] - a[1, 1] - a[2, 2]
    m[2, 2] = a[1, 1] - a[0, 0] - a[2, 2]
    m[3, 3] = a[2, 2] - a[0, 0] - a[1, 1]
    m[0, 1] = a[2, 1] - a[1, 2]
    m[0, 2] = a[0, 2] - a[2, 0]
    m[0, 3] = a[1, 0] - a[0, 1]
    m[1, 2] = a[0, 1] + a[1, 0]
    m[1, 3] = a[0, 2] + a[2, 0]
    m[2, 3] = a[1, 2] + a[2, 1]
    for _sweep in range(n_sweeps):
        for p in range(3):
            for q in range(p + 1, 4):
                if m[p, q] != real(0.0):
                    ratio = (m[q, q] - m[p, p]) / (real(2.0) * m[p, q])
                    tangent = real(1.0) / (wp.abs(ratio) + wp.sqrt(ratio * ratio + real(1.0)))
                    if ratio < real(0.0):
                        tangent = -tangent
                    cosine = real(1.0) / wp.sqrt(tangent * tangent + real(1.0))
                    sine = tangent * cosine
                    m[p, p] = m[p, p] - tangent * m[p, q]
                    m[q, q] = m[q, q] + tangent * m[p, q]
                    m[p, q] = real(0.0)
                    for r in range(4):
                        if r != p and r != q:
                            low = wp.min(r, p)
                            high = wp.max(r, p)
                            other_low = wp.min(r, q)
                            other_high = wp.max(r, q)
                            own = m[low, high]
                            other = m[other_low, other_high]
                            m[low, high] = cosine * own - sine * other
                            m[other_low, other_high] = sine * own + cosine * other
                        along = v[r, p]
                        across = v[r, q]
                        v[r, p] = cosine * along - sine * across
                        v[r, q] = sine * along + cosine * across
    largest = m[0, 0]
    found = vec4(v[0, 0], v[1, 0], v[2, 0], v[3, 0])
    for p in range(1, 4):
        if m[p, p] > largest:
            largest = m[p, p]
            found = vec4(v[0, p], v[1, p], v[2, p], v[3, p])
    return matrix_of(wp.normalize(found))


@wp.kernel(enable_backward=False)
def aligned(
    found: wp.array(dtype=wp.mat33d),
    sums: wp.array(dtype=vec3),
    total: wp.array(dtype=real),
    scale: wp.array(dtype=real),
    n_samples: int,
    n_sweeps: int,
    turn: wp.array(dtype=wp.mat33d),
    between: wp.array(dtype=wp.mat33d),
    scaled: wp.array(dtype=wp.mat33d),
    centres: wp.array(dtype=vec3),
    targets: wp.array(dtype=vec3),
    highest: wp.array(dtype=vec3),
    lowest: wp.array(dtype=vec3),
):
    """The motions of frame.Alignment.place. Of centres, targets and rotations by the scale, all of one end come first.

    The targets are in the frame, of both ends, and in the caller's units.
    """
    s = wp.tid()
    own = best_rotation(found[2 * s], n_sweeps)
    unturned = own * best_rotation(found[2 * s + 1], n_sweeps)
    first = sums[3 * s] / total[s]
    second = sums[3 * s + 1] / total[s]
    target = sums[3 * s + 2] / total[s]
    turn[s] = own
    between[s] = own * wp.transpose(unturned)
    scaled[s] = scale[0] * own
    scaled[n_samples + s] = scale[0] * unturned
    centres[s] = first
    centres[n_samples + s] = second
    targets[s] = target
    targets[n_samples + s] = target + scale[0] * (own * (second - first))
    targets[2 * n_samples + s] = target / scale[0]
    far = vec3(wp.inf, wp.inf, wp.inf)
    for k in range(2):
        highest[k * n_samples + s] = -far
        lowest[k * n_samples + s] = far


@wp.kernel(enable_backward=False)
def carried(
    x: wp.array(dtype=vec3),
    centre: wp.array(dtype=vec3),
    turn: wp.array(dtype=wp.mat33d),
    target: wp.array(dtype=vec3),
    n: int,
    out: wp.array(dtype=vec3),
    highest: wp.array(dtype=vec3),
    lowest: wp.array(dtype=vec3),
    threads: int,
):
    """``turn (x - centre) + target``, and how far that reaches, where there is room for it."""
    i = wp.tid()
    s = i // threads
    own = turn[s]
    start = centre[s]
    end = target[s]
    high = own * (x[s * n] - start) + end
    low = high
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        found = own * (x[v] - start) + end
        out[v] = found
        high = wp.max(high, found)
        low = wp.min(low, found)
    if highest:
        wp.atomic_max(highest, s, high)
        wp.atomic_min(lowest, s, low)


@wp.kernel(enable_backward=False)
def trajectory(
    time: wp.array(dtype=real),
    rotation: wp.array(dtype=wp.mat33d),
    source: wp.array(dtype=vec3),
    target: wp.array(dtype=vec3),
    placed: wp.array(dtype=wp.mat33d),
    placed_source: wp.array(dtype=vec3),
    placed_target: wp.array(dtype=vec3),
    scale: wp.array(dtype=real),
    turn: wp.array(dtype=wp.mat33d),
    moved: wp.array(dtype=vec3),
):
    """The way back to the caller at a time of the geodesic: see frame.Alignment.restore and rotations.log."""
    s = wp.tid()
    t = time[s]
    q = quaternion_of(rotation[s])
    axis = vec3(q[1], q[2], q[3])
    side = q[0]
    if wp.abs(q[0]) <= WITHIN:
        side = wp.dot(SIDE, axis)
    if side < real(0.0):
        q = -q
    there = about(t * half_turn(q))
    back = wp.transpose(placed[s])
    turn[s] = (back * matrix_of(there)) / scale[0]
    reached = (source[s] + t * (target[s] - source[s])) / scale[0]
    moved[s] = back * (reached - placed_target[s]) + placed_source[s]
