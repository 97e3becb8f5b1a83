r"""One displacement in the modes that pushes all shapes of a trajectory apart.

It is a cubic spline in time that vanishes at the key-frames, :math:`d(t) = \sum_j B_j(t)\, c_j`. What is minimised is
the sum of the energies of all shapes, on the coarse mesh, with the contact term, and of its squared acceleration:

.. math:: \sum_i E_i(x_i + d(t_i)) + \lambda \sum_v A_v \int |\ddot d_v|^2 dt
"""

import torch
from torch import Tensor

from torch_modal.backends.torch.alignment import Pair
from torch_modal.backends.torch.fine_steps import step_length
from torch_modal.contact.search import Contacts
from torch_modal.contact.splines import splines
from torch_modal.energy.modal_energy import SumOfEnergies
from torch_modal.inbetween.between import Between
from torch_modal.inbetween.samples import Samples

SMOOTHNESS = 30.0
"""``lambda``, at a diagonal of 100, with the time between two key-frames as the unit."""
SOFTNESS = 0.1
"""Of the contact term: the modes alone would resolve contacts with far more energy than necessary."""
STEPS = 2


def together(member: Between, samples: Samples, pair: Pair, x: Tensor, active: Contacts, some: Tensor) -> Tensor:
    """The displacement after Newton steps, never uphill.

    Args:
        member: In-betweens of the pair of key-frames.
        samples: Of that pair, with the times of the shapes.
        pair: The key-frames in the frame.
        x: The shapes. *Shape:* ``(T, V, 3)``.
        active: Of all shapes.
        some: Those whose energy is seen. *Shape:* ``(S,)``.

    Returns:
        Of all shapes. *Shape:* ``(T, V, 3)``.
    """
    every, bend = splines(samples.t)
    x, basis = x[some], every[some]
    columns, mass = member.space.columns, member.frame.weights / member.frame.weights.sum()
    inner, contact = member.space.energy.parts[0], active.modal(member.mesh, columns.fine)
    energy, coarse = SumOfEnergies(inner, contact), member.coarse_reference(samples.rows(some), pair)
    soft = active.rows(some)._replace(weights=SOFTNESS * active.weights[some])
    places = inner.place(member.frame.coarsen(x), coarse), soft.place(contact, x, None)
    gram = (columns.fine * mass[:, None]).flatten(1) @ columns.fine.flatten(1).T
    # Half the Hessian of the squared acceleration, by row and column of the amplitudes of each function.
    smooth = SMOOTHNESS * bend[:, None, :, None] * gram[:, None, :]

    def value(at: Tensor) -> Tensor:
        return energy.value(basis @ at, places).sum() + torch.einsum("ia,iajb,jb->", at, smooth, at)

    at = x.new_zeros(basis.shape[1], len(columns))
    for _ in range(STEPS):
        found = energy.derivatives(basis @ at, places, second_order=False)
        stiffness, slope = found.gauss_newton.to(at), found.gradient.to(at)
        hessian = torch.einsum("ti,tj,tab->iajb", basis, basis, stiffness) + 2 * smooth
        hessian = hessian.reshape(at.numel(), -1)
        gradient = basis.T @ slope + 2 * torch.einsum("iajb,jb->ia", smooth, at)
        ridge = 1e-9 * hessian.diagonal().mean()
        factor, info = torch.linalg.cholesky_ex(hessian + ridge * torch.eye(len(hessian)).to(hessian))
        if int(info):
            break
        step = -torch.cholesky_solve(gradient.reshape(-1, 1), factor).reshape(at.shape)
        length = step_length(value(at), (gradient * step).sum(), value(at + step), step.abs().amax())
        at = at + length * step
    return torch.tensordot(every, columns.combine(at), 1)
