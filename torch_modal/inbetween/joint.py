"""The joint space: one unknown shape in the sum of the modal spaces of all bases."""

from torch import Tensor, nn

from torch_modal.backends.torch.energies import RestShapes
from torch_modal.energy.modal_energy import Placement
from torch_modal.inbetween.multilevel import MultilevelEnergy
from torch_modal.inbetween.subspace import SubspaceBasis


class JointSpace(nn.Module):
    r"""In-betweens ``x(a) = base + U a`` of least :math:`\sum_k w_k\, d(x_k, x) + \tfrac{1}{2} \rho\, |a|^2`.

    The basis is orthonormal under vertex weights that add up to one, so that the anchor ``rho`` holds the mean squared
    distance from the base: without it, the minimiser jumps between far minima of almost the same energy.

    Args:
        levels: The energy of the modal solve.
        basis: The basis of the subspace, ``U``.
        anchor: ``rho``.
    """

    def __init__(self, levels: MultilevelEnergy, basis: SubspaceBasis, anchor: float) -> None:
        super().__init__()
        self.levels, self.basis = levels, basis
        self.energy = levels.modal(basis, anchor)

    def place(self, base: Tensor, rests: RestShapes, mu: Tensor) -> tuple[Placement, ...]:
        """The affine space and the reference of each sample.

        Args:
            base: *Shape:* ``(B, V, 3)``.
            rests: The key-frames, or other rest shapes. *Shape:* ``(B, K, V, 3)``.
            mu: Plays no part.
        """
        return self.levels.place(self.energy, base, rests, soften=True)

    def lift(self, a: Tensor, base: Tensor) -> Tensor:
        """The fine shape of amplitudes. *Shape:* ``(B, n), (B, V, 3) -> (B, V, 3)``."""
        return self.basis.added(base, a)
