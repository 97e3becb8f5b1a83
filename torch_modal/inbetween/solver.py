"""The in-between of K key-frames with weights, top to bottom; all layers use it."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.elastic.backend import choose
from torch_modal.elastic.energy import Energy, RestShapes
from torch_modal.elastic.implicit import solve_implicit
from torch_modal.elastic.minimise import Solution, Status
from torch_modal.elastic.term import Mesh, Term
from torch_modal.inbetween.alignment import KeyframeAlignment, Pose
from torch_modal.inbetween.blend import RotationBlend
from torch_modal.inbetween.coarse import CoarseMesh
from torch_modal.inbetween.comparison import DISTORTION_SLACK, blend_towards_starts
from torch_modal.inbetween.joint import JointSpace
from torch_modal.inbetween.paired import PairedSpace
from torch_modal.inbetween.regions import LocalInterpolation, worst_regions
from torch_modal.inbetween.results import InBetweenResult, Samples, trivial_solution
from torch_modal.inbetween.settings import Objective, Solver
from torch_modal.inbetween.subspace import elastic_subspace

# Products with the Hessian in each local step, and in each step of the polish: with two local steps, what closes 97 %
# of the gap in energy between linear interpolation and the optimum over all vertices, and often 99 % (docs/quality.md).
LOCAL_PRODUCTS = 4
POLISH_PRODUCTS = 20


class InBetweenSolver(nn.Module):
    r"""Shapes of little :math:`\sum_k w_k\, d(x_k, x)`: a blend by local rotations, perhaps a modal solve, local steps.

    The result depends on the key-frames and their weights as on a set of weighted points: not on their order, nor on
    key-frames without a weight, nor on whether one stands there twice with half of its weight.

    Args:
        references: Of the bases, float64 on the CPU. *Shape:* ``(K, V, 3)``.
        modes: Of the bases, if the objective has a modal space, or contact. *Shape of each:* ``(k, V, 3)``.
        mesh: The caller's mesh.
        terms: The terms of the energy, Eq. 5 first; the layer owns them.
        objective: What is minimised.
        solver: How.
    """

    def __init__(
        self,
        references: Tensor,
        modes: Sequence[Tensor],
        mesh: Mesh,
        terms: Sequence[Term],
        objective: Objective,
        solver: Solver,
    ) -> None:
        super().__init__()
        backend, others = choose(solver.backend), objective.terms
        self.solver, self.mesh, self.backend = solver, mesh, backend
        self.alignment = KeyframeAlignment(references, mesh.connectivity, backend)
        self.fine = backend.fine_energy(mesh, terms)
        #: Products with the Hessian in each step of all vertices.
        self.products = [LOCAL_PRODUCTS] * solver.local_steps + [POLISH_PRODUCTS] * solver.polish
        self.distortion = backend.distortion(mesh, Energy(mesh, others) if others else None)
        paired = objective.space == "paired"
        self.blend = None if paired else RotationBlend(mesh.connectivity, self.alignment.references, backend)
        #: The space of the modal solve, or of the displacements that separate contacts.
        self.space: Any = self._space(modes, objective) if any(len(each) for each in modes) else None
        #: True where amplitudes are minimised before the steps of all vertices.
        self.modal = self.space is not None and objective.modal_space is not None
        self.local: LocalInterpolation | None = None
        if solver.regions and isinstance(self.space, PairedSpace):
            region = worst_regions(self.space, self.alignment.references, solver.regions)
            self.local = LocalInterpolation(mesh, self.fine.energy, region) if region.any() else None

    def _space(self, modes: Sequence[Tensor], objective: Objective) -> JointSpace | PairedSpace:
        """The space that the modal solve minimises in."""
        alignment, rotations = self.alignment, self.alignment.turns
        aligned_modes = [basis @ rotation.mT for basis, rotation in zip(modes, rotations, strict=True)]
        coarse = CoarseMesh(alignment.references, self.mesh, objective.coarse_faces, alignment.weights, aligned_modes)
        if self.blend is not None:
            return JointSpace(coarse, self.fine, elastic_subspace(aligned_modes, alignment, coarse), objective.anchor)
        each = (elastic_subspace([basis], alignment, coarse) for basis in aligned_modes)
        return PairedSpace(*(JointSpace(coarse, self.fine, basis) for basis in each))

    def forward(self, samples: Samples) -> InBetweenResult:
        """Solve.

        Args:
            samples: The batch.
        """
        weights = samples.weights
        shapes, pose, usable = self.alignment(samples.keyframes, weights)
        anchors = self.fine.energy.anchors if any(self.fine.energy.n_anchors) else None
        if anchors is not None:
            anchors = self.alignment.to_frame(anchors.to(weights).expand(len(weights), -1, -1), pose)
        rests = RestShapes(shapes, weights, samples.stiffness, anchors)
        straight = torch.bmm(weights[:, None], shapes.flatten(2)).view_as(shapes[:, 0])
        base = straight if self.blend is None else self.blend(shapes, weights, straight)
        x, solution = base, trivial_solution(base, usable)
        if self.modal:
            solution = self.minimise_amplitudes(base, rests, samples.mu, usable)
            if self.blend is None:
                return self.finish_paired(rests, solution, pose)
            x = self.space.lift(solution.amplitudes, base)
        if self.products and len(x):
            x = self.fine.relax(x, rests, self.products)
        # No shape is better for being far from a key-frame with a weight below zero.
        compared = rests._replace(weights=weights.clamp_min(0))
        x, solution = blend_towards_starts(x, [base, straight], solution, self.distortion, compared, DISTORTION_SLACK)
        x, solution = self.finish(x, solution, rests)
        valid = (solution.status != Status.INVALID)[:, None, None]
        return InBetweenResult(torch.where(valid, self.alignment.to_caller(x, pose), torch.nan), solution)

    def finish_paired(self, rests: RestShapes, solution: Solution, pose: Pose) -> InBetweenResult:
        """The two shapes of Eq. 4, interpolated locally, and their mean, as in the paper."""
        ends = self.space.lift(solution.amplitudes, rests.shapes)
        if self.local is not None:
            ends, status = self.local(ends, rests, solution.status != Status.INVALID)
            solution = solution._replace(status=torch.where(solution.converged, status, solution.status))
        x = (ends[0] + ends[1]) / 2
        if self.products and len(x):
            x = self.fine.relax(x, rests, self.products)
        valid = (solution.status != Status.INVALID)[:, None, None]
        first, second, x = (torch.where(valid, self.alignment.to_caller(y, pose), torch.nan) for y in (*ends, x))
        return InBetweenResult(x, solution, first, second)

    def minimise_amplitudes(self, base: Tensor, rests: RestShapes, mu: Tensor, usable: Tensor) -> Solution:
        """Amplitudes of least energy in the modal space. *Shape:* of ``mu`` and ``usable`` ``(B,)``."""
        # In float64, whatever goes in and comes out.
        placement = self.space.place(*trees.map_leaves((base, rests, mu), Tensor.double))
        solution = solve_implicit(self.space, placement, usable, self.solver.max_steps, self.solver.tolerance)
        values = (value.to(base) if value.is_floating_point() else value for value in solution if value is not None)
        return Solution(*values)

    def finish(self, x: Tensor, solution: Solution, rests: RestShapes) -> tuple[Tensor, Solution]:
        """Shapes and solutions as they are; a solver with contacts goes on from them. *Shape:* ``(B, V, 3)``."""
        return x, solution
