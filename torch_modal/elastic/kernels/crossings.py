"""Faces that pass through each other: a tree of boxes against itself."""

import warp as wp

from torch_modal.elastic.kernels.types import place, real, vec3

MARGIN = wp.constant(real(1e-12))
"""Relative to the cubed largest length in a determinant; above its rounding error."""
box = wp.types.vector(length=6, dtype=real)
"""Its lowest corner, and the opposite of its highest."""


@wp.func
def box_of(a: vec3, b: vec3, c: vec3):
    low = wp.min(a, wp.min(b, c))
    high = wp.max(a, wp.max(b, c))
    return box(low[0], low[1], low[2], -high[0], -high[1], -high[2])


@wp.func
def overlap(a: box, b: box) -> bool:
    return (
        a[0] + b[3] <= real(0.0)
        and a[1] + b[4] <= real(0.0)
        and a[2] + b[5] <= real(0.0)
        and b[0] + a[3] <= real(0.0)
        and b[1] + a[4] <= real(0.0)
        and b[2] + a[5] <= real(0.0)
    )


@wp.func
def meet(a: wp.vec3i, b: wp.vec3i):
    """True if two faces have a common vertex."""
    one = a[0] == b[0] or a[0] == b[1] or a[0] == b[2]
    other = a[1] == b[0] or a[1] == b[1] or a[1] == b[2]
    return one or other or a[2] == b[0] or a[2] == b[1] or a[2] == b[2]


@wp.func
def side_of(along: vec3, a: vec3, b: vec3):
    return wp.dot(wp.cross(a, b), along)


@wp.func
def through(start: vec3, end: vec3, height: real, end_height: real, margin: real, a: vec3, b: vec3, c: vec3) -> bool:
    """True if an edge passes through a triangle, or misses it by rounding only; with the heights of its ends."""
    result = wp.min(height, end_height) < margin and wp.max(height, end_height) > -margin
    if result:
        along = end - start
        first = side_of(along, a - start, b - start)
        second = side_of(along, b - start, c - start)
        third = side_of(along, c - start, a - start)
        result = wp.min(first, wp.min(second, third)) > -margin or wp.max(first, wp.max(second, third)) < margin
    return result


@wp.func
def pierces(p: vec3, q: vec3, r: vec3, a: vec3, b: vec3, c: vec3) -> bool:
    """True if an edge of the first triangle passes through the second, or misses it by rounding only."""
    reach = wp.max(wp.length(p - a), wp.max(wp.length(q - a), wp.length(r - a)))
    reach = wp.max(reach, wp.max(wp.length(b - a), wp.length(c - a)))
    margin = MARGIN * reach * reach * reach
    normal = wp.cross(b - a, c - a)
    p_height = wp.dot(p - a, normal)
    q_height = wp.dot(q - a, normal)
    r_height = wp.dot(r - a, normal)
    return (
        through(p, q, p_height, q_height, margin, a, b, c)
        or through(q, r, q_height, r_height, margin, a, b, c)
        or through(r, p, r_height, p_height, margin, a, b, c)
    )


@wp.func
def cross(x: wp.array[vec3], f: wp.vec3i, g: wp.vec3i) -> bool:
    """True if two faces without a common vertex pass through each other, or miss each other by rounding only."""
    result = not meet(f, g)
    if result:
        p = x[place(f[0], 0)]
        q = x[place(f[1], 0)]
        r = x[place(f[2], 0)]
        a = x[place(g[0], 0)]
        b = x[place(g[1], 0)]
        c = x[place(g[2], 0)]
        result = pierces(p, q, r, a, b, c) or pierces(a, b, c, p, q, r)
    return result


@wp.kernel(enable_backward=False)
def crossing(
    x: wp.array[vec3], corners: wp.array[wp.vec3i], n: int, boxes: wp.array[box], stack: wp.array[wp.vec2i],
    room: int, pairs: wp.array[wp.vec2i], number: wp.array[int],
):  # fmt: skip
    """Pairs of faces that cross or nearly do and share no vertex, as many as there is room for, and their number.

    Node ``i`` has the nodes ``2 i`` and ``2 i + 1`` below it, and the last ``n`` are the faces. One thread goes down
    from the root, with the two nodes of each pair on the same level, or one above.
    """
    start = wp.tid()
    for f in range(start, n):
        face = corners[place(f, 0)]
        a = x[place(face[0], 0)]
        b = x[place(face[1], 0)]
        c = x[place(face[2], 0)]
        boxes[place(n, f)] = box_of(a, b, c)
    for above in range(1, n):
        node = n - above
        boxes[place(node, 0)] = wp.min(boxes[place(node, node)], boxes[place(node, node + 1)])
    count = start
    depth = start + 1
    stack[0] = wp.vec2i(1, 1)
    while depth > 0:
        depth -= 1
        both = stack[place(depth, 0)]
        i = both[0]
        j = both[1]
        if i == j:
            if i < n:
                one = 2 * i
                stack[place(depth, 0)] = wp.vec2i(one, one)
                stack[place(depth, 1)] = wp.vec2i(one + 1, one + 1)
                depth += 2
                if overlap(boxes[place(one, 0)], boxes[place(one, 1)]):
                    stack[place(depth, 0)] = wp.vec2i(one, one + 1)
                    depth += 1
        else:
            # The smaller number is never farther down.
            split = wp.min(i, j)
            other = wp.max(i, j)
            if split < n:
                fixed = boxes[place(other, 0)]
                for k in range(2):
                    if overlap(boxes[place(2 * split, k)], fixed):
                        stack[place(depth, 0)] = wp.vec2i(2 * split + k, other)
                        depth += 1
            elif cross(x, corners[place(i, -n)], corners[place(j, -n)]):
                if count < room:
                    pairs[place(count, 0)] = wp.vec2i(i - n, j - n)
                count += 1
    number[start] = count
