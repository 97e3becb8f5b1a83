"""Order of faces in a bounding-box tree. NumPy only."""

import numpy as np

from torch_modal.arrays import FloatArray, IntArray


def leaves(faces: IntArray, shapes: FloatArray) -> IntArray:
    """Faces as leaves of a binary tree, split on each level along the longest axis of their centres.

    Node 1 is the root, node ``i`` has the children ``2 i`` and ``2 i + 1``, and the last ``F`` nodes are the leaves.

    Args:
        faces: *Shape:* ``(F, 3)``.
        shapes: Shapes in which the faces of a node should be close. *Shape:* ``(K, V, 3)``.

    Returns:
        Face of each leaf. *Shape:* ``(F,)``.
    """
    points = np.concatenate(shapes[:, faces].mean(2), 1)
    n = len(points)
    sizes = np.ones(2 * n, np.int64)
    for start in reversed(_levels(n)):
        own = np.arange(start, min(2 * start, n))
        sizes[own] = sizes[2 * own] + sizes[2 * own + 1]
    order, nodes = np.arange(n), np.ones(n, np.int64)
    for start in _levels(n):
        # Finished leaves come last.
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
    """The first node of each inner level."""
    return [1 << k for k in range((n - 1).bit_length())]
