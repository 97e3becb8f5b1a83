"""Steps of the one displacement that pushes all shapes of a course apart: in the modes, and of the vertices near by."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from torch_modal.nn.between import Between
from torch_modal.nn.contact import Contacts
from torch_modal.nn.modal_energy import SumOfEnergies
from torch_modal.nn.relax import STEP_LENGTHS, conjugate_gradients, inverse_of_symmetric
from torch_modal.nn.samples import Samples
from torch_modal.sequence.acceleration import AccelerationLimit, Excess
from torch_modal.sequence.region import Region
from torch_modal.sequence.splines import splines

SMOOTHNESS = 100.0
"""``lambda``, at a diagonal of 100, with the time between two key-frames as the unit."""
MODAL_STEPS = 2
FINE_PRODUCTS = 40


class Coupled:
    """Steps of the displacement of all times."""

    def __init__(self, member: Between, samples: Samples, pair: Any, rows: Tensor, limit: AccelerationLimit) -> None:
        self.member, self.samples, self.pair, self.rows, self.limit = member, samples, pair, rows, limit
        self.basis, bend = splines(samples.t)
        self.bend = SMOOTHNESS * bend
        self.area = limit.area
        self.coarse = member.coarse_reference(samples, pair)

    def moved(self, at: Tensor) -> Tensor:
        """The shapes. *Shape:* ``(3, J, V) -> (3, T, V)``."""
        return self.rows + self.expand(at)

    def expand(self, at: Tensor) -> Tensor:
        """From the spline to the times. *Shape:* ``(3, J, V) -> (3, T, V)``."""
        return self.basis @ at

    def gather(self, field: Tensor) -> Tensor:
        """The adjoint of :meth:`expand`. *Shape:* ``(3, T, V) -> (3, J, V)``."""
        return self.basis.T @ field

    def bent(self, at: Tensor, area: Tensor) -> Tensor:
        """Half the gradient of the squared acceleration. *Shape:* ``(3, J, V), (V,) -> (3, J, V)``."""
        return (self.bend @ at) * area

    def fine(self, at: Tensor, held: Contacts, near: Tensor, n_steps: int) -> Tensor:
        """Steps of a truncated Newton method on the vertices near by, at all times, never uphill.

        Args:
            at: *Shape:* ``(3, J, V)``.
            held: Of all times.
            near: The vertices that may move. *Shape:* ``(V,)``.
            n_steps: How many.
        """
        local = Region(self.member, self.samples, self.pair, near).hold(held)
        chosen = local.vertices.to(at.device)
        rows, own, limit = self.rows[..., chosen], at[..., chosen], self.limit.of(chosen)
        for _ in range(n_steps):
            value, gradient, blocks, hessians = local.linearised(rows + self.expand(own))
            bent, excess = self.bent(own, limit.area), limit.linearised(own)
            before = value + (own * bent).sum() + excess.value
            right = -self.gather(gradient) - 2 * bent - excess.gradient
            step = self._solved(local, hessians, limit, excess, blocks, right * local.free)
            for length in STEP_LENGTHS:
                there = own + length * step
                smooth = (there * self.bent(there, limit.area)).sum() + limit.value(there)
                if bool(local.value(rows + self.expand(there)) + smooth < before):
                    own = there
                    break
            else:
                break
        return at.index_copy(2, chosen, own)

    def _solved(
        self,
        local: Region,
        hessians: Any,
        limit: AccelerationLimit,
        excess: Excess,
        blocks: Tensor,
        right: Tensor,
    ) -> Tensor:
        # Of each function of the spline at each vertex.
        eye = torch.eye(3).to(blocks)[..., None, None]
        own = (self.basis**2).T @ blocks + 2 * self.bend.diagonal()[:, None] * limit.area * eye
        inverse = inverse_of_symmetric(limit.add_diagonal(excess, own))

        def product(field: Tensor) -> Tensor:
            found = self.gather(local.product(hessians, self.expand(field))) + 2 * self.bent(field, limit.area)
            return limit.add_product(excess, field, found) * local.free

        def precondition(residual: Tensor) -> Tensor:
            return (inverse * residual).sum(1)

        def dot(a: Tensor, b: Tensor) -> Tensor:
            return (a * b).sum()

        return conjugate_gradients(product, precondition, dot, right, FINE_PRODUCTS)

    def modal(self, at: Tensor, held: Contacts) -> Tensor:
        """Newton steps in the modes, with the energy of the coarse mesh, never uphill. *Shape:* ``(3, J, V)``."""
        member = self.member
        columns = member.space.columns
        inner, contact = member.space.energy.parts[0], held.modal(member.mesh, columns.fine)
        n, j = len(columns), self.basis.shape[1]
        weighted = (columns.fine * self.area[:, None]).flatten(1)
        gram = weighted @ columns.fine.flatten(1).T
        for _ in range(MODAL_STEPS):
            x = self.moved(at).movedim(0, -1)
            zero = x.new_zeros(len(x), n)
            places = (
                (inner, inner.place(member.frame.coarsen(x), self.coarse)),
                (contact, held.place(contact, x, None)),
            )
            found = SumOfEnergies(inner, contact).derivatives(zero, [place for _, place in places], second_order=False)
            stiffness, slope = found.gauss_newton.to(x), found.gradient.to(x)
            hessian = torch.einsum("ti,tj,tab->iajb", self.basis, self.basis, stiffness)
            hessian = hessian + 2 * self.bend[:, None, :, None] * gram[:, None, :]
            excess = self.limit.linearised(at)
            hessian = (hessian + self.limit.in_columns(excess, columns.fine)).reshape(n * j, n * j)
            pulled = (2 * self.bent(at, self.area) + excess.gradient).permute(1, 2, 0).flatten(1)
            pulled = pulled @ columns.fine.flatten(1).T
            gradient = (self.basis.T @ slope + pulled).reshape(-1)
            ridge = 1e-9 * hessian.diagonal().mean()
            factor, info = torch.linalg.cholesky_ex(hessian + ridge * torch.eye(n * j).to(hessian))
            if int(info):
                return at
            step = -torch.cholesky_solve(gradient[:, None], factor).reshape(j, n)
            field = columns.combine(step).permute(2, 0, 1)
            value = partial(self._along, places, at, field, self.basis @ step)
            before = value(0.0)
            taken = next((length for length in STEP_LENGTHS if value(length) < before), 0.0)
            at = at + taken * field
            if not taken:
                break
        return at

    def _along(self, places: Any, at: Tensor, field: Tensor, step: Tensor, length: float) -> float:
        """What is minimised after a part of a step in the modes."""
        bent = at + length * field
        total = sum(energy.value((length * step).to(place.base.dtype), place).sum() for energy, place in places)
        return float(total + (bent * self.bent(bent, self.area)).sum() + self.limit.value(bent))
