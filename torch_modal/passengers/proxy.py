"""A coarse carrier in the place of a fine mesh, and the detail that it carries."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor

from torch_modal.autograd import lasting
from torch_modal.modes.coarsening import coarsen
from torch_modal.passengers.passengers import Passengers

# Number of vertices of the carrier, of the meshes above which it is the default, and of the smallest one.
PROXY_SIZE, ABOVE, SMALLEST = 20_000, 100_000, 100


def proxy_size(wanted: int | None, n_vertices: int) -> int:
    """Vertices of the carrier of a mesh, 0 where it needs none; wanted as for :func:`torch_modal.subdivide`."""
    if wanted is None:
        return PROXY_SIZE if n_vertices > ABOVE else 0
    if not isinstance(wanted, int) or wanted < 0 or 0 < wanted < SMALLEST:
        raise ValueError(f"proxy is 0, or a number of vertices from {SMALLEST} on; got {wanted!r}")
    return wanted if wanted < n_vertices else 0


class Proxy:
    """Key-frames ``(K, V, 3)`` of a fine mesh as a carrier of about so many vertices, and the detail of each.

    Attributes:
        keyframes: The carrier in each key-frame, by the same edge collapses: means of clusters. *Shape:*
            ``(K, V_coarse, 3)``.
        faces: Of the carrier. *Shape:* ``(F_coarse, 3)``.
        passengers: The detail of each key-frame.
    """

    @lasting
    def __init__(self, keyframes: Tensor, faces: Tensor, n_vertices: int) -> None:
        fine = keyframes.detach().double().cpu()
        coarse = coarsen(fine.numpy(), faces.detach().cpu().numpy(), 2 * n_vertices)
        self.faces = torch.from_numpy(coarse.faces)
        own = torch.from_numpy(coarse.restrict(fine.numpy()))
        first = Passengers(own[0], self.faces, fine[0], torch.from_numpy(coarse.clusters))
        passengers = [first, *(first.rebound(x, y) for x, y in zip(own[1:], fine[1:], strict=True))]
        self.passengers = [each.to(keyframes) for each in passengers]
        self.keyframes = own.to(keyframes)

    @torch.no_grad()
    def carried(self, shapes: Tensor, places: Sequence[int], keyframes: Tensor) -> Tensor:
        """A sequence of the carrier with the detail of the key-frames, blended from each to the next.

        Places are the frames of the key-frames; one more than there are, if the first comes again. *Shape:*
        ``(T, V_coarse, 3), (K,), (K, V, 3) -> (T, V, 3)``.
        """
        found = keyframes.new_empty(len(shapes), *keyframes.shape[1:])
        n = len(keyframes)
        for i, (start, end) in enumerate(pairwise(places)):
            found[start] = keyframes[i]
            for j in range(start + 1, end):
                one, other = (self.passengers[k % n](shapes[j]) for k in (i, i + 1))
                found[j] = torch.lerp(one, other, (j - start) / (end - start))
        if places[-1] < len(found):
            found[places[-1]] = keyframes[len(places) - 1]
        return found
