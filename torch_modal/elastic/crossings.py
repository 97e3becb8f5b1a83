"""Candidates for triangles that cross, by a kernel of NVIDIA Warp: one tree of faces for all shapes."""

import numpy as np
import torch
from scipy.spatial import cKDTree

from torch_modal.autograd import outside_inference_mode
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import FloatArray, IntArray

FIRST_ROOM = 4096
"""Pairs that there is room for at first."""


def order_of_leaves(faces: IntArray, shape: FloatArray) -> IntArray:
    """Faces as leaves of a full binary tree, whose centres are split in halves on each level along the longest axis.

    The number of leaves is a power of two: F stands where there is no face. *Shape:* ``(F, 3), (V, 3) -> (2^k,)``.
    """
    centres, n = shape[faces].mean(1), len(faces)
    n_empty = 2 ** (n - 1).bit_length() - n
    beyond = centres.max(0) + np.arange(n_empty)[:, None]
    return np.minimum(cKDTree(np.concatenate([centres, beyond]), leafsize=1).indices, n)


class WarpPairs:
    """Pairs of triangles that share no vertex and whose boxes overlap.

    The tree is made once, of what lies together in a given shape; of others, only its boxes are made.

    Args:
        mesh: The connectivity.
        shape: *Shape:* ``(V, 3)``.
    """

    @outside_inference_mode
    def __init__(self, mesh: Connectivity, shape: FloatArray) -> None:
        self.order = order_of_leaves(mesh.faces, shape)
        self._corners = torch.from_numpy(np.append(mesh.faces, [[-1, -1, -1]], 0)[self.order]).int()

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
            launch(kernels("crossings").overlapping, (1,), args)
            if int(number) <= room:
                return self.order[pairs[: int(number)].numpy()]
            room = int(number)
