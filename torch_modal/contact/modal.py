r"""First displacement of a trajectory: in the modes, smooth in time, zero at both ends.

With amplitudes :math:`c_s` at the times of some shapes, and the cubic spline through them in between, it is the one of

.. math:: \min_c \sum_s E_s(x_s + \Phi c_s) + \lambda \sum_v A_v \int |\ddot d_v|^2 dt

for the energies with contact, of which the elastic part is replaced with its second-order model at the shapes.
"""

import torch
from torch import Tensor

from torch_modal.contact.active import ContactEnergy
from torch_modal.elastic.steps import step_length

SMOOTHNESS = 30.0
"""``lambda``, at a diagonal of 100, with the time between the ends as the unit."""
SOFTNESS = 0.1
"""Factor of the contact term: the modes alone would resolve contacts with far more energy than necessary."""
NEWTON_STEPS = 2
"""Newton steps."""


def modal_displacement(
    modes: Tensor,
    masses: Tensor,
    slope: Tensor,
    stiffness: Tensor,
    x: Tensor,
    contact: ContactEnergy,
    accelerations: Tensor,
) -> Tensor:
    """Take Newton steps, never uphill.

    Args:
        modes: *Shape:* ``(n, V, 3)``.
        masses: Masses of the vertices, parts of the whole. *Shape:* ``(V,)``.
        slope: Gradient of the elastic energy of each shape in the modes. *Shape:* ``(S, n)``.
        stiffness: Its Hessian. *Shape:* ``(S, n, n)``.
        x: The shapes. *Shape:* ``(S, V, 3)``.
        contact: Their active contacts.
        accelerations: Second differences of the spline through values of the shapes, between N even times.
            *Shape:* ``(N, S)``.

    Returns:
        The displacement of the shapes. *Shape:* ``(S, V, 3)``.
    """
    flat, rate = modes.flatten(1), len(accelerations) + 1
    # Half the Hessian of the squared acceleration, by row and column of the amplitudes of each shape.
    bend = rate**3 * accelerations.T @ accelerations
    smooth = SMOOTHNESS * bend[:, None, :, None] * ((modes * masses[:, None]).flatten(1) @ flat.T)[:, None, :]

    quadratic = 2 * smooth.reshape(slope.numel(), -1) + torch.block_diag(*stiffness)

    def displace(a: Tensor) -> Tensor:
        return x + (a.view_as(slope) @ flat).view_as(x)

    def value(a: Tensor) -> Tensor:
        return a @ (slope.flatten() + 0.5 * quadratic @ a) + SOFTNESS * contact.value(displace(a)).sum()

    a = torch.zeros_like(slope).flatten()
    for _ in range(NEWTON_STEPS):
        pushed, hardened = _in_modes(contact, displace(a), modes)
        gradient = slope.flatten() + quadratic @ a + SOFTNESS * pushed.flatten()
        hessian = quadratic + SOFTNESS * torch.block_diag(*hardened)
        ridge = 1e-9 * hessian.diagonal().mean()
        factor, info = torch.linalg.cholesky_ex(hessian + ridge * torch.eye(len(hessian)).to(hessian))
        if int(info):
            break
        step = -torch.cholesky_solve(gradient[:, None], factor)[:, 0]
        a = a + step_length(value(a), gradient @ step, value(a + step), step.abs().amax()) * step
    return displace(a) - x


def _in_modes(contact: ContactEnergy, x: Tensor, modes: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient and Gauss-Newton Hessian in the modes. *Shape:* ``(S, V, 3), (n, V, 3) -> (S, n), (S, n, n)``."""
    shortfall, gradients = contact.shortfall(x)
    n, (n_shapes, n_vertices) = len(modes), x.shape[:2]
    gradient, hessian = x.new_zeros(n_shapes, n), x.new_zeros(n_shapes, n, n)
    for i in contact.shapes[shortfall < 0].unique().tolist():
        rows = torch.nonzero((contact.shapes == i) & (shortfall < 0)).flatten()
        rates = torch.einsum("nkmc,kcm->mn", modes[:, contact.corners[:, rows] - i * n_vertices], gradients[..., rows])
        weighted = 2 * contact.weights[rows, None] * rates
        gradient[i], hessian[i] = shortfall[rows] @ weighted, rates.T @ weighted
    return gradient, hessian
