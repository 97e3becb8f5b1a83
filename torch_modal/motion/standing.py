"""Translations and small corrections by which a body stands where another one does."""

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torch_modal.geometry.poisson import Reconstruction
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian, solve_by

_STILL = 0.03  # speed over the body's below which a vertex stands
_MOVING = 1e-5  # weight of vertices that move, over vertices that stand
_STEADY = 4.0  # frames in which errors of steps are forgotten
_FIRM = 100.0  # frames in which a standing vertex may move by an error
_LEAST = 1e-6  # stiffness of vertices without a standing one in their piece, over an edge's


def stand(shapes: Tensor, carried: Tensor, shares: Tensor, scale: Tensor, reconstruction: Reconstruction) -> Tensor:
    """Move shapes so that vertices move as the source's, scaled, where these hardly move: feet stand.

    A translation of each frame follows the vertices that stand. Where several do, each on a place of its own, the
    surface between them gives way smoothly. The first shape stays as it is.

    Args:
        shapes: In the order of their times. *Shape:* ``(T, W, 3)``.
        carried: Places of their vertices on the source. *Shape:* ``(T, W, 3)``.
        shares: Areas of the vertices that have a counterpart; they add up to one. *Shape:* ``(W,)``.
        scale: Size of the body over the source's.
        reconstruction: Of the body, for its edges and loose pieces.

    Returns:
        *Shape:* ``(T, W, 3)``.
    """
    moves, steps = carried.diff(dim=0), shapes.diff(dim=0)
    speed = moves.square().sum(-1)
    least = _STILL**2 * (speed @ shares)[:, None] + torch.finfo(speed.dtype).tiny
    still = (1 + speed / least) ** -2
    weights = shares * (still + _MOVING)
    weights = (weights / weights.sum(1, keepdim=True))[..., None]
    wanted = (weights * (scale * moves - steps)).sum(1)
    # The source's path is scaled as the sum of steps is, and places of standing vertices with it: no drift.
    source = shares @ moves
    length = source.square().sum()
    ratio = ((wanted + shares @ steps) * source).sum() / length.clamp_min(torch.finfo(length.dtype).tiny)
    ratio = torch.where(length > 0, ratio.clamp(0.5 * scale, 2 * scale), scale)
    weights = torch.cat([weights[:1], torch.maximum(weights[1:], weights[:-1]), weights[-1:]])
    off = ratio * (carried - carried[0]) - (shapes - shapes[0])
    goal = (weights * off).sum(1) / weights.sum(1)
    path = goal + _smooth(torch.full_like(speed[:, :1], _STEADY**2), (wanted - goal.diff(dim=0))[:, None])[:, 0]
    shapes = shapes + (path - path[0])[:, None]

    stands = torch.nonzero((still.amax(0) > 0.5) & (shares > 0))[:, 0]
    if not len(stands):
        return shapes
    still, left = still[:, stands], (scale * moves - shapes.diff(dim=0))[:, stands]
    given = _smooth(_FIRM**2 * still + _STEADY**2, left * (still / (still + (_STEADY / _FIRM) ** 2))[..., None])
    pinned = np.zeros(shapes.shape[1])
    pinned[stands.cpu().numpy()] = 1
    edges = reconstruction.edges.cpu().numpy()
    matrix = graph_laplacian(edges, np.ones(len(edges)), len(pinned)) + sparse.diags(pinned + _LEAST)
    given = torch.zeros_like(shapes).index_copy(1, stands, given)
    moved = solve_by(SparseSolver(matrix), given)
    for piece, anchors in reconstruction.loose:
        nearby = moved[:, anchors.to(moved.device)].mean(1, keepdim=True)
        moved = moved.index_copy(1, piece.to(moved.device), nearby.expand(-1, len(piece), -1))
    return shapes + moved


def _smooth(weights: Tensor, steps: Tensor) -> Tensor:
    """Minimises ``sum_t w_t |d_(t+1) - d_t - s_t|^2 + |d_t|^2``, with ``d_0 = 0``.

    *Shape:* ``(T - 1, n), (T - 1, n, 3) -> (T, n, 3)``.
    """
    after, pulls = torch.cat([weights[1:], torch.zeros_like(weights[:1])]), weights[..., None] * steps
    diagonal, right = 1 + weights + after, torch.cat([pulls[:-1] - pulls[1:], pulls[-1:]])
    pivots, rows = [diagonal[0]], [right[0]]  # elimination of a tridiagonal matrix
    for own, value, between in zip(diagonal[1:], right[1:], weights[1:], strict=True):
        factor = between / pivots[-1]
        rows.append(value + factor[:, None] * rows[-1])
        pivots.append(own - factor * between)
    found = [rows[-1] / pivots[-1][:, None]]
    for pivot, value, between in zip(pivots[-2::-1], rows[-2::-1], weights[1:].flip(0), strict=True):
        found.append((value + between[:, None] * found[-1]) / pivot[:, None])
    return torch.stack([torch.zeros_like(found[0]), *found[::-1]])
