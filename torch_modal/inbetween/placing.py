"""Key-frames of a batch in the frame, and which of them have something between them."""

import warnings

from torch import Tensor

from torch_modal.autograd import traced, transformed
from torch_modal.backends.torch.alignment import Pair
from torch_modal.backends.torch.backend import TorchBackend
from torch_modal.backends.torch.fine_energy import FineEnergy
from torch_modal.errors import MeshWarning
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.rigid import looks_mirrored
from torch_modal.inbetween.frame import Frame
from torch_modal.inbetween.samples import Samples

# A key-frame smaller than this part of the basis' reference is a point.
SMALLEST_SIZE = 1e-6

# A key-frame that is larger or smaller than the basis' reference by this factor is in other units, or another body.
OTHER_SIZE = 3.0


class Placing:
    """Brings the key-frames of samples into the frame.

    Args:
        frame: The frame.
        fine: The energy on the caller's mesh.
        backend: Aligns.
    """

    def __init__(self, frame: Frame, fine: FineEnergy, backend: TorchBackend) -> None:
        self.frame, self.fine, self.backend = frame, fine, backend
        self.closed = len(fine.mesh.connectivity.boundary_edges) == 0
        self.size_warned = False

    def __call__(self, samples: Samples) -> tuple[Pair, Tensor]:
        """The pairs of key-frames with their neighbours in time, and which have something between them.

        Those have not that are not finite, a point, or, where the surface is closed, mirror images. *Shape:* ``(P,)``.
        """
        pair, usable, sizes = self.backend.place(self.frame, samples.x_a, samples.x_b)
        self.warn_of_size(sizes)
        usable = usable & (sizes > SMALLEST_SIZE * CANONICAL_SIZE)
        if self.closed:
            usable = usable & ~self.mirrored(pair.first, pair.second)
        if samples.spacing is None:
            return pair, usable
        before, after = samples.before, samples.after
        if before is not None:
            before, finite = self.frame.finite(before)
            usable = usable & finite
        if after is not None:
            after, finite = self.frame.finite(after)
            usable = usable & finite
        return self.frame.surround(pair, before, after, samples.spacing), usable

    def warn_of_size(self, sizes: Tensor) -> None:
        """Say, once for a layer, that key-frames and bases seem to be in different units. *Shape:* ``(P,)``."""
        if self.size_warned or traced(sizes) or transformed(sizes):
            return
        reference = self.frame.reference
        ratios = sizes.detach() / (reference.amax(0) - reference.amin(0)).norm()
        other = (ratios > SMALLEST_SIZE) & ((ratios > OTHER_SIZE) | (ratios < 1 / OTHER_SIZE))
        if not bool(other.any()):
            return
        self.size_warned = True
        warnings.warn(
            f"key-frames are {float(ratios[other][0]):.3g} times as large as the shapes that the bases were made from; "
            "Eq. 5 depends on the size, so that the in-betweens differ from those of bases in the same units: "
            "scale the key-frames, or make the bases from them",
            MeshWarning,
            stacklevel=2,
        )

    def mirrored(self, first: Tensor, second: Tensor) -> Tensor:
        """Pairs with a mirrored key-frame, among those whose volumes differ in sign. *Shape:* ``(P, V, 3) -> (P,)``."""
        turned = self.fine.volumes(first, second).prod(-1) < 0
        if not traced(turned) and not transformed(turned) and not turned.any():
            return turned
        return turned & looks_mirrored(first, second, self.frame.faces)
