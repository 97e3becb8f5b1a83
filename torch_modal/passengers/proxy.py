"""A coarse carrier instead of a fine mesh, and the detail that it carries."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from torch_modal.autograd import outside_inference_mode
from torch_modal.modes.coarsening import coarsen
from torch_modal.passengers.passengers import Passengers

# Numbers of vertices: of the default carrier, of meshes above which it is the default, and of the smallest carrier.
PROXY_SIZE, PROXY_ABOVE, SMALLEST_PROXY = 20_000, 100_000, 100


def proxy_size(wanted: int | None, n_vertices: int) -> int:
    """Number of vertices of a mesh's carrier, 0 if it needs none; ``wanted`` as for :func:`torch_modal.subdivide`."""
    if wanted is None:
        return PROXY_SIZE if n_vertices > PROXY_ABOVE else 0
    if not isinstance(wanted, int) or wanted < 0 or 0 < wanted < SMALLEST_PROXY:
        raise ValueError(f"proxy must be 0, or a number of vertices of at least {SMALLEST_PROXY}; got {wanted!r}")
    return wanted if wanted < n_vertices else 0


class Proxy:
    """Key-frames ``(K, V, 3)`` of a fine mesh as a carrier of about ``n_vertices`` vertices, and the detail of each.

    Attributes:
        keyframes: The carrier in each key-frame, by the same edge collapses: means of clusters. *Shape:*
            ``(K, V_coarse, 3)``.
        faces: Of the carrier. *Shape:* ``(F_coarse, 3)``.
        passengers: The detail of each key-frame.
    """

    @outside_inference_mode
    def __init__(self, keyframes: Tensor, faces: Tensor, n_vertices: int) -> None:
        fine = keyframes.detach().double().cpu()
        coarse = coarsen(fine.numpy(), faces.detach().cpu().numpy(), 2 * n_vertices)
        self.faces = torch.from_numpy(coarse.faces)
        carriers = torch.from_numpy(coarse.restrict(fine.numpy()))
        first = Passengers(carriers[0], self.faces, fine[0], torch.from_numpy(coarse.clusters))
        others = zip(carriers[1:], fine[1:], strict=True)
        passengers = [first, *(Passengers(x, self.faces, y, weights=first.weights) for x, y in others)]
        self.passengers = [each.to(keyframes) for each in passengers]
        self.keyframes = carriers.to(keyframes)

    @torch.no_grad()
    def carry(self, shapes: Tensor, places: Sequence[int], keyframes: Tensor) -> Tensor:
        """Add the detail of the key-frames, blended from each to the next, to a sequence of the carrier.

        Places are the frame numbers of the key-frames, in a cycle with one more for the first again. *Shape:*
        ``(T, V_coarse, 3), (K,), (K, V, 3) -> (T, V, 3)``.
        """
        sequence = keyframes.new_empty(len(shapes), *keyframes.shape[1:])
        n = len(keyframes)
        for i, (start, end) in enumerate(pairwise(places)):
            sequence[start] = keyframes[i]
            for j in range(start + 1, end):
                before, after = (self.passengers[k % n](shapes[j]) for k in (i, i + 1))
                sequence[j] = torch.lerp(before, after, (j - start) / (end - start))
        if places[-1] < len(sequence):
            sequence[places[-1]] = keyframes[len(places) - 1]
        return sequence
