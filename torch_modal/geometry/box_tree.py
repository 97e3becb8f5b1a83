"""A tree of the faces of a surface, for boxes around what lies together. NumPy only."""

import numpy as np

from torch_modal.arrays import FloatArray, IntArray


def leaves(faces: IntArray, shapes: FloatArray) -> IntArray:
    """Faces as leaves of a binary tree: on each level halved across where their centres reach farthest.

    Node 1 is the root, node ``i`` has the nodes ``2 i`` and ``2 i + 1`` below it, and the last ``F`` are the leaves.

    Args:
        faces: *Shape:* ``(F, 3)``.
        shapes: In all of which the faces of a node are to lie together. *Shape:* ``(K, V, 3)``.

    Returns:
        The faces of the leaves, in their order. *Shape:* ``(F,)``.
    """
    points = np.concatenate(shapes[:, faces].mean(2), 1)
    n = len(points)
    sizes = np.ones(2 * n, np.int64)
    for start in reversed(_levels(n)):
        own = np.arange(start, min(2 * start, n))
        sizes[own] = sizes[2 * own] + sizes[2 * own + 1]
    order, nodes = np.arange(n), np.ones(n, np.int64)
    for start in _levels(n):
        # What is a leaf already comes last.
        own = np.arange(start, min(2 * start, n))
        size = sizes[own]
        firsts, m = np.cumsum(size) - size, int(size.sum())
        there = points[order[:m]]
        low = np.minimum.reduceat(there, firsts)
        reach = np.maximum.reduceat(there, firsts) - low
        axis, which = reach.argmax(1), np.repeat(np.arange(len(own)), size)
        most = np.maximum(reach[np.arange(len(own)), axis], 1e-300)
        share = (there[np.arange(m), axis[which]] - low[which, axis[which]]) / most[which]
        order[:m] = order[:m][np.argsort(2 * which + share)]
        nodes[:m] = np.repeat(np.arange(2 * own[0], 2 * own[-1] + 2), sizes[2 * own[0] : 2 * own[-1] + 2])
    found = np.empty(n, np.int64)
    found[nodes - n] = order
    return found


def _levels(n: int) -> list[int]:
    """The first node of each level with nodes below."""
    return [1 << k for k in range((n - 1).bit_length())]
