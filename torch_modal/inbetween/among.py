"""The weighted in-between of K key-frames: what :mod:`~torch_modal.inbetween.between` is for two."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.backends.torch.rests import Rests
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.rigid import RigidMotion, best_rotation, centroid
from torch_modal.geometry.rotations import agreeing, mean, quaternion, rotate
from torch_modal.inbetween.between import Between
from torch_modal.inbetween.comparison import SLACK
from torch_modal.inbetween.frame import Frame
from torch_modal.inbetween.joint import JointProblem, JointSpace
from torch_modal.inbetween.placing import SMALLEST_SIZE
from torch_modal.inbetween.samples import InBetweenResult, warn_of_starts
from torch_modal.solve.adjoint import Minimisation, solve_implicit, solve_unrolled
from torch_modal.solve.solver import Solution, Status

# Rounds in which all key-frames are turned on to their mean, and the last of them, which have derivatives: of the poses
# of a gallop, each leaves a tenth.
ROUNDS, LAST_ROUNDS = 6, 5

# Principal components whose variances differ by less than this part have no first one to differentiate.
GAP = 1e-6


class Group(NamedTuple):
    """K key-frames of each sample, centred, scaled and turned on to each other."""

    shapes: Tensor
    """*Shape:* ``(B, K, V, 3)``."""
    weights: Tensor
    """*Shape:* ``(B, K)``."""
    motion: RigidMotion
    """From the frame to the weighted mean of the poses of the key-frames, in the caller's units."""


class WeightedSamples(NamedTuple):
    """A flat batch of weighted in-betweens."""

    keyframes: Tensor
    """*Shape:* ``(B, K, V, 3)``."""
    weights: Tensor
    """*Shape:* ``(B, K)``."""
    stiffness: list[Tensor]
    """Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""


class Among(Between):
    r"""Weighted in-betweens of any number of key-frames, in the joint space of all bases.

    What is minimised is :math:`\sum_k w_k\, d(x_k, x)`. The result depends on the key-frames and their weights as on
    a set of weighted points: not on their order, nor on key-frames without a weight, nor on whether one stands there
    twice with half of its weight.
    """

    space: JointSpace

    def weighted(self, samples: WeightedSamples, report: Callable[[Solution], None] | None) -> InBetweenResult:
        """Solve.

        Args:
            samples: The batch.
            report: Receives the solution.
        """
        space, weights, stiffness = self.space, samples.weights, samples.stiffness
        group, usable = self.grouped(samples)
        anchors = self._brought(group)
        problem = self.weighted_problem(group, space.levels.stiffness(stiffness), anchors)
        limits = self.solver.max_steps, self.solver.tolerance
        minimisation = Minimisation(self.step, *limits, False, lambda _: None, report)
        solve = solve_implicit if self.solver.gradient == "implicit" else solve_unrolled
        start = weights.new_zeros(len(weights), space.n_unknowns)
        solution = solve(minimisation, problem.placement, start, usable, weights[:, 0])
        rests = Rests(group.shapes.unbind(1), None, weights, stiffness, anchors)
        x = self.refined(space.lift(solution.amplitudes, problem), rests)
        # No shape is better for being far from a key-frame with a weight below zero.
        compared = rests._replace(t=weights.clamp_min(0))
        x, solution = self.judged(x, problem.starts, solution, compared, SLACK)
        if report is not None:
            warn_of_starts(solution)
        shapes = group.motion.apply(x / self.frame.scale)
        valid = solution.status != Status.INVALID
        return InBetweenResult(torch.where(valid[:, None, None], shapes, torch.nan), solution)

    def grouped(self, samples: WeightedSamples) -> tuple[Group, Tensor]:
        """The key-frames in the frame, and which samples have an in-between. *Shape:* ``(B,)``."""
        weights = samples.weights
        flat, finite = self.frame.finite(samples.keyframes.flatten(0, 1))
        sized = (flat.amax(1) - flat.amin(1)).norm(dim=1) * self.frame.scale > SMALLEST_SIZE * CANONICAL_SIZE
        # The reference stands in for what cannot be used: without a weight, it must do no harm.
        flat = torch.where(sized[:, None, None], flat, self.frame.reference / self.frame.scale)
        group = _aligned(self.frame, flat.unflatten(0, weights.shape), weights)
        shapes, usable = group.shapes.detach(), (finite & sized).view_as(weights)
        self.placing.warn_of_size((shapes.amax(-2) - shapes.amin(-2)).norm(dim=-1).amin(1))
        if self.placing.closed:
            rows = torch.arange(len(weights), device=weights.device)
            heaviest = shapes[rows, weights.argmax(1)][:, None].expand_as(shapes)
            mirrored = self.placing.mirrored(heaviest.flatten(0, 1), shapes.flatten(0, 1))
            usable = usable & ~mirrored.view_as(weights)
        return group, (usable | (weights == 0)).all(1)

    def weighted_problem(self, group: Group, stiffness: list[list[Tensor]], anchors: Tensor | None) -> JointProblem:
        """The minimisation of each sample.

        Args:
            group: The key-frames.
            stiffness: On each level.
            anchors: Of the terms, in the frame. *Shape:* ``(B, P, 3)``.
        """
        space, frame, weights = self.space, self.frame, group.weights
        levels, fine, coarse = space.levels, group.shapes, frame.coarsen(group.shapes)
        straight, coarse_straight = _combined(weights, fine), _combined(weights, coarse)
        parts = _largest_difference(coarse - coarse_straight[:, None], frame.coarse.weights, weights)
        difference, column = space.difference(_combined(parts, fine), _combined(parts, coarse), straight)
        extras = levels.seen(space.column(difference), column) if levels.sampled else [column] * len(levels.energies)
        references = levels.among(levels.seen(fine, coarse), weights, stiffness)
        starts: tuple[Tensor, ...] = (straight,)
        base, seen = straight, levels.seen(straight, coarse_straight)
        if space.blend is not None:
            base = space.blend.among(fine, weights, straight)
            starts, seen = (base, straight), levels.seen(base, frame.coarsen(base))
            references = levels.softened(references, seen)
        placement = levels.place(space.energy, seen, references, extras, anchors)
        return JointProblem(placement, None, base, starts, difference)

    def _brought(self, group: Group) -> Tensor | None:
        """The anchors of all terms, in the frame. *Shape:* ``(B, P, 3)``."""
        points = self.fine.energy.anchors
        if points is None:
            return None
        back = group.motion.inverse()
        return back.apply(points.to(group.weights).expand(len(group.weights), -1, -1)) * self.frame.scale


def _combined(weights: Tensor, shapes: Tensor) -> Tensor:
    """Weighted sums. *Shape:* ``(B, K), (B, K, V, 3) -> (B, V, 3)``."""
    return torch.bmm(weights[:, None], shapes.flatten(2)).view(len(shapes), *shapes.shape[2:])


def _aligned(frame: Frame, keyframes: Tensor, weights: Tensor) -> Group:
    """The key-frames turned on to their weighted mean, and this to the reference. *Shape:* ``(B, K, V, 3), (B, K)``.

    Generalised Procrustes analysis: the squared distances of all pairs are least. Of two, it is their best fit.
    """
    centres = centroid(keyframes, frame.weights)
    centred = keyframes - centres[..., None, :]
    reference = (frame.reference / frame.scale).expand(len(keyframes), 1, -1, -1)
    rows = (torch.cat([reference, centred], 1) * frame.weights.sqrt()[:, None]).movedim(-1, -2).flatten(1, 2)
    products = (rows @ rows.mT).unflatten(2, (-1, 3)).unflatten(1, (-1, 3)).transpose(2, 3)  # (B, 1 + K, 1 + K, 3, 3)
    to_reference, among = products[:, 0, 1:], products[:, 1:, 1:]
    pulls = weights[..., None, None]
    with torch.no_grad():
        turns = best_rotation(to_reference)
        for _ in range(ROUNDS):
            turns = best_rotation(((pulls * turns)[:, :, None] @ among).sum(1))
    turns = turns.detach()  # forward mode goes through no_grad
    for _ in range(LAST_ROUNDS):
        turns = best_rotation(((pulls * turns)[:, :, None] @ among).sum(1))
    turns = best_rotation((pulls * to_reference @ turns.mT).sum(1))[:, None] @ turns
    poses = quaternion(turns.mT.movedim((-2, -1), (0, 1)))  # (4, B, K)
    signs = agreeing(torch.einsum("ibk,ibl->bkl", poses, poses).detach(), weights.detach())
    pose = mean((signs * poses)[..., None], weights[..., None])
    rotation = rotate(pose, torch.eye(3).to(poses)[:, None]).movedim(0, 1)
    target = (weights[..., None] * centres).sum(1)
    return Group(centred @ turns.mT * frame.scale, weights, RigidMotion(rotation, torch.zeros_like(target), target))


def _largest_difference(off: Tensor, masses: Tensor, weights: Tensor) -> Tensor:
    """Coefficients of the key-frames in the first principal component of them; of two, in their difference.

    Args:
        off: How far each is from the weighted mean. *Shape:* ``(B, K, V, 3)``.
        masses: Of the vertices. *Shape:* ``(V,)``.
        weights: *Shape:* ``(B, K)``.

    Returns:
        They add up to zero. *Shape:* ``(B, K)``.
    """
    gram = (off * masses[:, None]).flatten(2) @ off.flatten(2).mT
    product = gram * weights[:, None]
    with torch.no_grad():
        # The eigenvectors of the product are those of a symmetric matrix, times the root.
        values, vectors = torch.linalg.eigh(gram)
        root = (vectors * values.clamp_min(0).sqrt()[:, None]) @ vectors.mT
        values, vectors = torch.linalg.eigh(root @ (weights[..., None] * root))
        largest, second = values[:, -1], values[:, -2:-1].sum(-1)
        # Key-frames that are the same, to rounding, have none.
        exists = largest > (1e3 * torch.finfo(values.dtype).eps * CANONICAL_SIZE) ** 2
        apart = (exists & (largest - second > GAP * largest))[:, None, None]
        largest = torch.where(exists, largest, 1)
        found = (root @ vectors[..., -1:]).squeeze(-1) / largest.sqrt()[:, None]
        projection = found[..., None] * (weights * found)[:, None]
        eye = torch.eye(weights.shape[1]).to(weights)
        system = torch.where(apart, largest[:, None, None] * eye - product + projection, eye)
        resolvent = torch.where(apart, torch.linalg.inv_ex(system).inverse - projection, 0)
    found, resolvent = found.detach(), resolvent.detach()  # as above
    # One Newton step, which changes nothing, has the derivatives of the eigenvector.
    found = found + (resolvent @ product @ found[..., None]).squeeze(-1)
    parts = torch.where(exists[:, None], weights * found, 0)
    parts = parts - parts.sum(1, keepdim=True) * weights
    return parts / parts.detach().abs().sum(1, keepdim=True).clamp_min(torch.finfo(parts.dtype).tiny)
