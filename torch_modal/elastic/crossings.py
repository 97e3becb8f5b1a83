"""Triangles that pass through each other, by a kernel of NVIDIA Warp: one tree of faces serves all shapes."""

import torch

from torch_modal.autograd import outside_inference_mode
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.geometry.closest import leaves
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import FloatArray, IntArray

ROOM = 4096
"""Pairs that there is room for at first."""


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
        n, room = len(self.order), ROOM
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
