"""Key-frames brought into the frame, and shapes back on the course of the rigid motion."""

import warp as wp

from torch_modal.geometry import rotations
from torch_modal.nn.kernels.elements import place, real, vec3
from torch_modal.nn.kernels.rotations import about, half_turn, quaternion_of, turned

SIDE = wp.constant(vec3(*rotations.HALF_TURN_SIDE))
WITHIN = wp.constant(real(rotations.HALF_TURN * 2.220446049250313e-16))


@wp.kernel(enable_backward=False)
def moments(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    weights: wp.array(dtype=real),
    n: int,
    a: wp.array(dtype=vec3),
    b: wp.array(dtype=vec3),
    threads: int,
):
    """Weighted sums of the vertices of both ends."""
    i = wp.tid()
    s = i // threads
    total_a = vec3()
    total_b = vec3()
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        weight = weights[place(k, 0)]
        total_a += weight * first[v]
        total_b += weight * second[v]
    wp.atomic_add(a, s, total_a)
    wp.atomic_add(b, s, total_b)


@wp.kernel(enable_backward=False)
def covariances(
    first: wp.array(dtype=vec3),
    second: wp.array(dtype=vec3),
    reference: wp.array(dtype=vec3),
    weights: wp.array(dtype=real),
    a: wp.array(dtype=vec3),
    b: wp.array(dtype=vec3),
    n: int,
    found: wp.array(dtype=wp.mat33d),
    threads: int,
):
    """Of the reference with the first end, and of the first with the second, about their centroids."""
    i = wp.tid()
    s = i // threads
    to_reference = wp.mat33d()
    to_first = wp.mat33d()
    for k in range(i - s * threads, n, threads):
        v = place(s * n, k)
        x = weights[place(k, 0)] * (first[v] - a[s])
        to_reference += wp.outer(reference[place(k, 0)], x)
        to_first += wp.outer(x, second[v] - b[s])
    wp.atomic_add(found, 2 * s, to_reference)
    wp.atomic_add(found, 2 * s + 1, to_first)


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
def course(
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
    columns = wp.matrix_from_cols(
        turned(there, vec3(real(1.0), real(0.0), real(0.0))),
        turned(there, vec3(real(0.0), real(1.0), real(0.0))),
        turned(there, vec3(real(0.0), real(0.0), real(1.0))),
    )
    back = wp.transpose(placed[s])
    turn[s] = (back * columns) / scale[0]
    reached = (source[s] + t * (target[s] - source[s])) / scale[0]
    moved[s] = back * (reached - placed_target[s]) + placed_source[s]
