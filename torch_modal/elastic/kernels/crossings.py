"""Faces whose boxes overlap: a tree of boxes against itself."""

import warp as wp

from torch_modal.elastic.kernels.types import place, real, vec3

box = wp.types.vector(length=6, dtype=real)
"""Its lowest corner, and the opposite of its highest."""
NOWHERE = wp.constant(box(*[1e300] * 6))


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


@wp.kernel(enable_backward=False)
def overlapping(
    x: wp.array[vec3], corners: wp.array[wp.vec3i], n: int, boxes: wp.array[box], stack: wp.array[wp.vec2i],
    room: int, pairs: wp.array[wp.vec2i], number: wp.array[int],
):  # fmt: skip
    """Pairs of faces that share no vertex and whose boxes overlap, as many as there is room for, and their number.

    Node ``i`` has the nodes ``2 i`` and ``2 i + 1`` below it, and the last ``n`` are the faces, or nothing. One thread
    goes down from the root, with the two nodes of each pair on the same level, or one above.
    """
    start = wp.tid()
    for f in range(start, n):
        face = corners[place(f, 0)]
        bounds = NOWHERE
        if face[0] >= 0:
            bounds = box_of(x[place(face[0], 0)], x[place(face[1], 0)], x[place(face[2], 0)])
        boxes[place(n, f)] = bounds
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
            elif not meet(corners[place(i, -n)], corners[place(j, -n)]):
                if count < room:
                    pairs[place(count, 0)] = wp.vec2i(i - n, j - n)
                count += 1
    number[start] = count
