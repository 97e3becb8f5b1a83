r"""A motion as linear blend skinning: smooth skinning decomposition (Le and Deng 2012).

The squared error needs few sums. With :math:`p = (x, 1)` at rest and bones :math:`T_{tj}`: for new weights
:math:`\sum_t T_{tj}^T T_{tk}` and :math:`\sum_t T_{tj}^T x_{tv}`, for new bones
:math:`\sum_v w_{vj} w_{vk}\, p_v p_v^T` and :math:`\sum_v w_{vj}\, x_{tv}\, p_v^T`.
"""

import bisect
import functools
import warnings
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from torch_modal.arrays import Array
from torch_modal.errors import MeshWarning
from torch_modal.geometry.connectivity import merge_seams
from torch_modal.geometry.inspect import diagonals
from torch_modal.geometry.rigid import best_rotation
from torch_modal.geometry.rotations import exp, log, matrix
from torch_modal.geometry.skin import WEIGHT_STEPS, Skin, blend_bones
from torch_modal.io.write import check_frames
from torch_modal.times import Times, check_times

MOST_ROUNDS = 20  # at most; fewer where one lowers the error by less than a hundredth
SWEEPS = 2  # over the bones in a round
LEAST_BONE_VERTICES = 4  # vertices of a new bone; fewer leave its rotation undetermined
EQUAL = 1e-5  # mean distance of a cluster's vertices, over the diagonal, below which it is one bone
PRODUCTS_AT_ONCE = 2**22  # products of bones at vertices, in memory at a time
TINY, RIDGE = 1e-30, 1e-10
TIED = 8  # further rounds, in which the rotations of a bone are tied to the rotations in the neighbouring frames
TIES = 0.01, 1.0  # first and largest weight of it, over the squared error of all vertices; fourfold where bones turn on
LARGEST_TURN = np.cos(np.radians(15))  # of a bone between frames, relative to its vertices
IDENTITY_SHARE = 1e-4  # part of the identity in the rotation of a bone's vertices, which may lie on a line


@torch.no_grad()
def bake(
    frames: Array,
    faces: Array,
    bones: int = 40,
    influences: int = 4,
    times: Times = None,
    tolerance: float | None = None,
) -> Skin:
    """A motion as linear blend skinning: bones that move rigidly, and their weights at each vertex.

    Bones start from clusters of vertices that move alike, split where the error is largest; then weights and bones are
    fitted in turns (Le and Deng 2012, Smooth Skinning Decomposition with Rigid Bones). Rotations are tied to the
    neighbouring frames, as players interpolate between them. Copies of a vertex along seams have equal weights.

    Args:
        frames: Vertex positions, two frames or more. Frame 0 is the rest shape. *Shape:* ``(T, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        bones: Most bones.
        influences: Most bones of a vertex, 1 to 4.
        times: When the frames are, ascending, for :func:`torch_modal.save_animation`; of a cycle, with the time when it
            begins again.
        tolerance: Take the fewest bones with an error, the root mean square distance over the bounding-box diagonal, of
            at most this. The search makes several fits.

    Returns:
        The skin, in the coordinates, dtype and device of the frames; without gradients.

    Raises:
        ValueError: An argument cannot be used; the message says why.

    Warns:
        MeshWarning: That many bones do not meet the tolerance.
    """
    shapes, triangles = check_frames(frames, faces)
    n, n_vertices = shapes.shape[:2]
    if n < 2 or n_vertices < LEAST_BONE_VERTICES:
        raise ValueError(f"bones need 2 frames and {LEAST_BONE_VERTICES} vertices or more, got {n} of {n_vertices}")
    if not isinstance(bones, int) or not 1 <= bones <= n_vertices:
        raise ValueError(f"bones must be a whole number from 1 to the number of vertices, {n_vertices}; got {bones!r}")
    if influences not in (1, 2, 3, 4):
        raise ValueError(f"influences must be 1, 2, 3 or 4 bones of a vertex, got {influences!r}")
    if tolerance is not None and not 0 < tolerance < np.inf:
        raise ValueError(f"tolerance must be a positive part of the diagonal, such as 0.001; got {tolerance}")
    when = None if times is None else check_times(times, n, None, "frame")
    diagonal = float(diagonals(shapes[:1])[0])
    if diagonal == 0:
        raise ValueError("frame 0, the rest shape, is a single point; bones need a shape")
    like = frames.detach() if isinstance(frames, Tensor) else torch.from_numpy(np.array(frames))
    like = like if like.is_floating_point() else like.double()
    copies = merge_seams(shapes, triangles)
    first = np.unique(copies, return_index=True)[1]
    centres = shapes.mean(1, keepdims=True)
    fit = _Decomposition(torch.from_numpy((shapes[:, first] - centres) / diagonal).to(like.device), influences)

    @functools.cache
    def skin(most: int) -> Skin:
        weights, fitted = (x.cpu() for x in fit.solve(most))
        after = torch.from_numpy(centres)
        transforms = torch.eye(4, dtype=torch.float64).repeat(*fitted.shape[:2], 1, 1)
        transforms[..., :3, :3] = fitted[..., :3]
        transforms[..., :3, 3] = fitted[..., 3] * diagonal + after - fitted[..., :3] @ after[0, 0]
        skin = Skin(like[0], weights[copies].to(like), transforms.to(like), 0.0, 0.0, when)
        goal = torch.from_numpy(shapes)
        at, between = (
            float(off.square().sum(-1).mean().sqrt()) / diagonal
            for off in (skin.shapes().double().cpu() - goal, _halfway_errors(skin, goal))
        )
        return replace(skin, error_at_frames=at, error_between_frames=between)

    best = skin(bones)
    if tolerance is not None and best.error > tolerance:
        message = (
            f"{bones} bones leave an error of {best.error:.2g} of the diagonal, above the tolerance of {tolerance:g}"
        )
        warnings.warn(message, MeshWarning, stacklevel=2)
    elif tolerance is not None:
        fewer = range(1, best.weights.shape[1])
        n = bisect.bisect_left(fewer, True, key=lambda most: skin(most).error <= tolerance)
        return skin(fewer[n]) if n < len(fewer) else best
    return best


class _Decomposition:
    """Fits bones ``(T, J, 3, 4)`` and weights ``(V, J)`` to shapes ``(T, V, 3)``."""

    def __init__(self, x: Tensor, influences: int) -> None:
        self.influences = influences
        self.rest = torch.nn.functional.pad(x[0], (0, 1), value=1)
        self.shapes, self.rows = x, x.mT.flatten(0, 1)
        self.still = torch.eye(3, 4).to(x).repeat(len(x), 1, 1, 1)

    def solve(self, most: int) -> tuple[Tensor, Tensor]:
        """Weights in whole parts of :data:`WEIGHT_STEPS`, and bones."""
        bones = self._cluster_bones(most)
        weights, error = self._fit_weights(bones, self.influences)
        for _ in range(MOST_ROUNDS):
            last, bones = error.mean(), self._fit_bones(bones, weights)
            weights, error = self._fit_weights(bones, self.influences)
            if error.mean() > 0.98 * last:
                break
        ties, total = torch.full_like(bones[0, :, 0, 0], TIES[0]), error.sum() + EQUAL**2 * len(error)
        for _ in range(TIED):
            bones = self._fit_bones(bones, weights, total * ties)
            steps = bones[1:, ..., :3] @ bones[:-1, ..., :3].mT
            beyond = (steps * _frame_rotations(self.shapes, weights)[0]).sum((-2, -1)) < 1 + 2 * LARGEST_TURN
            ties = torch.where(beyond.any(0), (4 * ties).clamp_max(TIES[1]), ties)
            weights, error = self._fit_weights(bones, self.influences)
        used = weights.sum(0) * WEIGHT_STEPS >= 1
        weights, bones, ties = weights[:, used], bones[:, used], ties[used]
        whole = (weights * WEIGHT_STEPS).floor()
        rank = (weights * WEIGHT_STEPS - whole).argsort(1, descending=True).argsort(1)
        weights = (whole + (rank < WEIGHT_STEPS - whole.sum(1, keepdim=True))) / WEIGHT_STEPS
        return weights, self._fit_bones(bones, weights, total * ties)

    def _cluster_bones(self, most: int) -> Tensor:
        """Bones of clusters of vertices that move alike; those with the largest errors are halved."""
        weights = torch.ones_like(self.rest[:, :1])
        bones = self._fit_bones(self.still, weights)
        weights, error = self._fit_weights(bones, 1)
        while (n := bones.shape[1]) < most:
            label = weights.argmax(1)
            total, halves = error.new_zeros(n).index_add(0, label, error), []
            for j in total.argsort(descending=True)[: most - n].tolist():
                members = (label == j).nonzero()[:, 0]
                if len(members) >= 2 * LEAST_BONE_VERTICES and total[j] > EQUAL**2 * len(members):
                    away = (self.rest[members] - self.rest[members[error[members].argmax()]]).norm(dim=1)
                    halves.append(torch.zeros_like(error).index_fill(0, members[away <= away.median()], 1))
            if not halves:
                break
            split = self._fit_bones(self.still.repeat(1, len(halves), 1, 1), torch.stack(halves, 1))
            bones = torch.cat([bones, split], 1)
            for _ in range(4):
                weights, error = self._fit_weights(bones, 1)
                bones = self._fit_bones(bones, weights)
        return bones

    def _fit_weights(self, bones: Tensor, influences: int) -> tuple[Tensor, Tensor]:
        """Weights of least squared distance, and its mean over the frames at each vertex.

        Bones are added one by one: that towards which a straight step lowers the distance most.
        """
        n_frames, n = bones.shape[:2]
        columns = bones.transpose(1, 2).reshape(3 * n_frames, 4 * n)
        grams = (columns.mT @ columns).view(n, 4, n, 4).transpose(1, 2).reshape(n * n, 16)
        weights, errors = self.rest.new_zeros(len(self.rest), n), []
        for rows in torch.arange(len(self.rest), device=bones.device).split(max(1, PRODUCTS_AT_ONCE // n**2)):
            p, x = self.rest[rows], self.rows[:, rows]
            squares = ((p[:, :, None] * p[:, None]).flatten(1) @ grams.mT).unflatten(1, (n, n))
            products = ((columns.mT @ x).unflatten(0, (n, 4)) * p.mT).sum(1).mT
            norms = squares.diagonal(dim1=1, dim2=2)
            chosen = (norms - 2 * products).argmin(1, keepdim=True)
            convex, error = _convex_weights(squares, products, chosen)
            for _ in range(1, min(influences, n)):
                towards = (convex[:, :, None] * squares.gather(1, chosen[:, :, None].expand(-1, -1, n))).sum(1)
                here = (convex * towards.gather(1, chosen)).sum(1, keepdim=True)
                slope = products - (convex * products.gather(1, chosen)).sum(1, keepdim=True) - towards + here
                length = (norms - 2 * towards + here).clamp_min(TINY)
                step = (slope / length).clamp(0, 1)
                gain = (step * (2 * slope - step * length)).scatter(1, chosen, -1)
                chosen = torch.cat([chosen, gain.argmax(1, keepdim=True)], 1)
                convex, error = _convex_weights(squares, products, chosen)
            weights[rows] = weights[rows].scatter(1, chosen, convex)
            errors.append((error + x.square().sum(0)).clamp_min(0) / n_frames)
        return weights, torch.cat(errors)

    def _fit_bones(self, bones: Tensor, weights: Tensor, ties: Tensor | None = None) -> Tensor:
        """Bones one after the other, each by the best rigid motion for its part of the vertices.

        Ties ``(J,)`` add the squared change of a rotation between frames, without the turn of the bone's vertices.
        """
        n_frames, n = bones.shape[:2]
        weighted = (weights[:, :, None] * self.rest[:, None]).flatten(1)
        sums, moments = weighted.mT @ weighted, self.rows @ weighted
        columns = bones.transpose(1, 2).reshape(3 * n_frames, 4 * n).clone()
        steps = None if ties is None else _frame_rotations(self.shapes, weights)[0]
        for block in [slice(4 * j, 4 * j + 4) for j in range(n)] * SWEEPS:
            *_, mass = middle = sums[block, block][3]
            if mass > TINY:
                moment = moments[:, block] - columns @ sums[:, block] + columns[:, block] @ sums[block, block]
                moment, middle = moment.unflatten(0, (n_frames, 3)) / mass, middle[:3] / mass
                covariance = moment[..., :3] - moment[..., 3:] * middle
                if ties is None or steps is None:
                    rotation = best_rotation(covariance)
                else:
                    j, rotation = block.start // 4, columns[:, block].unflatten(0, (n_frames, 3))[..., :3].clone()
                    for some in (slice(0, None, 2), slice(1, None, 2)):  # frames whose neighbours are the others
                        neighbours = torch.zeros_like(rotation)
                        neighbours[1:] += steps[:, j] @ rotation[:-1]
                        neighbours[:-1] += steps[:, j].mT @ rotation[1:]
                        rotation[some] = best_rotation((covariance + ties[j] / mass * neighbours)[some])
                shift = moment[..., 3] - rotation @ middle
                columns[:, block] = torch.cat([rotation, shift[..., None]], 2).flatten(0, 1)
        return columns.reshape(n_frames, 3, n, 4).transpose(1, 2)


def _frame_rotations(x: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations of each bone's vertices from frame to frame, and their centres.

    *Shape:* ``(T, V, 3), (V, J) -> (T - 1, J, 3, 3), (T, J, 3)``.
    """
    parts = weights / weights.sum(0).clamp_min(TINY)
    centres = parts.mT @ x
    sums = x.mT.flatten(0, 1) @ (parts[:, :, None] * x[0, :, None]).flatten(1)
    moments = sums.view(len(x), 3, -1, 3).transpose(1, 2) - centres[..., None] * centres[0, :, None]
    width = moments[0].diagonal(dim1=1, dim2=2).sum(1)[:, None, None]
    turns = best_rotation(moments + IDENTITY_SHARE * width * torch.eye(3).to(x))
    return turns[1:] @ turns[:-1].mT, centres


def _halfway_errors(skin: Skin, shapes: Tensor) -> Tensor:
    """Errors of what players show half-way between frames, against the mean of both. *Shape:* ``(T - 1, V, 3)``.

    The mean is taken after the turns of the body and, in its frame, of the bones' vertices, both put back by half.
    """
    bind, turns, shifts = skin.tracks()
    weights, rest, middles = skin.weights.double().cpu(), skin.rest.double().cpu(), bind[1:, :3, 3:]
    rotations = matrix(turns).movedim((0, 1), (2, 3))
    local = (shapes - shifts[:, :1]) @ rotations[:, 0]
    steps, centres = _frame_rotations(local, weights)
    half = exp(0.5 * log(steps))
    played = rotations[:-1, 1:] @ exp(0.5 * log(rotations[:-1, 1:].mT @ rotations[1:, 1:]))
    shift = 0.5 * (shifts[:-1, 1:] + shifts[1:, 1:])[..., None] - played @ middles
    off = blend_bones(weights, torch.cat([played, shift], 3), rest.expand(len(half), -1, -1))
    centres = centres[..., None]
    for turn, middle, x in ((half, centres[:-1], local[:-1]), (half.mT, centres[1:], local[1:])):
        off -= 0.5 * blend_bones(weights, torch.cat([turn, middle - turn @ middle], 3), x)
    return off


def _convex_weights(squares: Tensor, products: Tensor, chosen: Tensor) -> tuple[Tensor, Tensor]:
    """Convex weights ``w`` of k bones of least ``w^T K w - 2 c^T w``, of all 2^k - 1 supports, and that.

    *Shape:* ``(n, J, J), (n, J), (n, k) -> (n, k), (n,)``.
    """
    k = chosen.shape[1]
    square = squares.gather(1, chosen[:, :, None].expand(-1, -1, squares.shape[1]))
    square = square.gather(2, chosen[:, None].expand(-1, k, -1))
    product = products.gather(1, chosen)[:, None]
    supports = (torch.arange(1, 2**k)[:, None] >> torch.arange(k) & 1).to(square)
    # [K 1; 1^T 0] [w; m] = [c; 1], with rows of the unit matrix for bones that are not in the support.
    system = square.new_zeros(len(square), len(supports), k + 1, k + 1)
    ridge = RIDGE * square.diagonal(dim1=1, dim2=2).mean(1) + TINY  # bones may move as one
    regular = square + ridge[:, None, None] * torch.eye(k).to(square)
    system[..., :k, :k] = regular[:, None] * supports[:, :, None] * supports[:, None] + torch.diag_embed(1 - supports)
    system[..., :k, k] = system[..., k, :k] = supports
    right = torch.cat([product * supports, torch.ones_like(system[..., :1, 0])], 2)
    weights = torch.linalg.solve_ex(system, right[..., None]).result[..., :k, 0] * supports
    error = ((weights @ square - 2 * product) * weights).sum(2)
    error, best = error.masked_fill(~(weights >= 0).all(2), torch.inf).min(1)
    return weights.gather(1, best[:, None, None].expand(-1, 1, k))[:, 0], error
