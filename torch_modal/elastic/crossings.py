"""Triangles that pass through each other, by a kernel of NVIDIA Warp: one tree of faces serves all shapes."""

import numpy as np
import torch

from torch_modal.autograd import outside_inference_mode
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import FloatArray, IntArray

FIRST_ROOM = 4096
"""Pairs that there is room for at first."""


def leaves(faces: IntArray, shapes: FloatArray) -> IntArray:
    """Faces as leaves of a binary tree, split on each level along the longest axis of their centres.

    Node 1 is the root, node ``i`` has the children ``2 i`` and ``2 i + 1``, and the last ``F`` nodes are the leaves.
    The faces of a node are close in all of the shapes. *Shape:* ``(F, 3), (K, V, 3) -> (F,)``.
    """
    points = np.concatenate(shapes[:, faces].mean(2), 1)
    n = len(points)
    first_nodes = [1 << k for k in range((n - 1).bit_length())]  # of each inner level
    sizes = np.ones(2 * n, np.int64)
    for start in reversed(first_nodes):
        level = np.arange(start, min(2 * start, n))
        sizes[level] = sizes[2 * level] + sizes[2 * level + 1]
    order, nodes = np.arange(n), np.ones(n, np.int64)
    for start in first_nodes:
        # Finished leaves come last.
        level = np.arange(start, min(2 * start, n))
        size = sizes[level]
        firsts, m = np.cumsum(size) - size, int(size.sum())
        inner = points[order[:m]]
        low = np.minimum.reduceat(inner, firsts)
        extent = np.maximum.reduceat(inner, firsts) - low
        axis, node = extent.argmax(1), np.repeat(np.arange(len(level)), size)
        longest = np.maximum(extent[np.arange(len(level)), axis], 1e-300)
        share = (inner[np.arange(m), axis[node]] - low[node, axis[node]]) / longest[node]
        order[:m] = order[:m][np.argsort(2 * node + share)]
        nodes[:m] = np.repeat(np.arange(2 * level[0], 2 * level[-1] + 2), sizes[2 * level[0] : 2 * level[-1] + 2])
    order_of_leaves = np.empty(n, np.int64)
    order_of_leaves[nodes - n] = order
    return order_of_leaves


class WarpPairs:
    """Pairs of triangles that cross, or miss each other by rounding only, and share no vertex.

    The tree is made once, of what lies together in given shapes; of others, only its boxes are made.

    Args:
        mesh: The connectivity.
        shapes: One or more. *Shape:* ``(K, V, 3)``.
    """

    @outside_inference_mode
    def __init__(self, mesh: Connectivity, shapes: FloatArray) -> None:
        self.order = leaves(mesh.faces, shapes)
        self._corners = torch.from_numpy(mesh.faces[self.order]).int()

    def __call__(self, x: FloatArray) -> IntArray:
        """The pairs, in no order. *Shape:* ``(V, 3) -> (P, 2)``."""
        n, room = len(self.order), FIRST_ROOM
        positions, number = torch.as_tensor(x).contiguous(), torch.zeros(1, dtype=torch.int32)
        boxes = torch.empty(2 * n, 6, dtype=torch.float64)
        # Of a pair, at most two more stay behind on each level.
        stack = torch.empty(4 * n.bit_length() + 1, 2, dtype=torch.int32)
        while True:
            pairs = torch.empty(room, 2, dtype=torch.int32)
            args = [positions, self._corners, n, boxes, stack, room, pairs, number]
            launch(kernels("crossings").crossing, (1,), args)
            if int(number) <= room:
                return self.order[pairs[: int(number)].numpy()]
            room = int(number)
