"""Modes that are the same wherever they are computed: of one key-frame, by the deterministic mesher.

Two machines round differently. A mode then comes with either sign, and modes of nearly the same eigenvalue come mixed.
What does not depend on that is the space of each cluster of eigenvalues, and in it the basis that is symmetric positive
definite at a few chosen coordinates. Which coordinates, and where clusters end, the file says.
"""

import warnings
from typing import NamedTuple

import numpy as np
import torch
from scipy.linalg import qr
from torch import Tensor

from torch_modal.errors import MeshWarning
from torch_modal.precompute.modes import extract_modes

GAP = 1e-3
"""Relative gap between neighbouring eigenvalues that ends a cluster."""
SPARE = 6
"""Further modes that are computed, so that the last cluster is whole."""


class FixedModes(NamedTuple):
    """Modes whose signs and mixtures are fixed."""

    modes: Tensor
    """*Shape:* ``(k, V, 3)``."""
    clusters: Tensor
    """How many modes each cluster has. *Shape:* ``(C,)``."""
    pivots: Tensor
    """One coordinate, ``3 v + axis``, for each mode. *Shape:* ``(k,)``."""


def fixed_modes(
    reference: Tensor,
    faces: Tensor,
    n_modes: int,
    clusters: Tensor | None = None,
    pivots: Tensor | None = None,
    cache_dir: str | None = None,
    cache: bool = True,
) -> FixedModes:
    """The lowest modes of a shape.

    Args:
        reference: *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: How many; a few more or fewer, if that would cut a cluster.
        clusters: As they were found elsewhere. Default: found here.
        pivots: Likewise.
        cache_dir: As for :func:`torch_modal.extract_modes`.
        cache: Likewise.

    Raises:
        MeshError: The shape cannot have modes.
        ValueError: More modes than the shape has.
    """
    most = max(3 * len(faces.unique()) - 6, n_modes)
    with warnings.catch_warnings():
        # Rounding makes faces without area of small ones.
        warnings.simplefilter("ignore", MeshWarning)
        basis = extract_modes(
            reference, faces, min(n_modes + SPARE, most), mesher="lattice", cache_dir=cache_dir, cache=cache
        )
    if clusters is None or pivots is None:
        clusters = _clusters(basis.eigenvalues, n_modes)
    k = int(clusters.sum())
    flat = basis.modes[:k].flatten(1).double()
    parts, chosen, start = [], [], 0
    for size in clusters.tolist():
        own = flat[start : start + size]
        if pivots is None:
            rows = np.sort(qr(own.numpy(), mode="r", pivoting=True)[1][:size]).tolist()
        else:
            rows = pivots[start : start + size].tolist()
        u, _, vh = torch.linalg.svd(own[:, rows].mT)
        # own.T @ rotation has u diag(s) u^T at the chosen rows.
        parts.append((own.mT @ (vh.mT @ u.mT)).mT)
        chosen += rows
        start += size
    modes = torch.cat(parts).unflatten(1, (-1, 3))
    return FixedModes(modes, clusters, torch.tensor(chosen))


def _clusters(eigenvalues: Tensor, n_modes: int) -> Tensor:
    """Sizes of clusters of eigenvalues, of at least so many modes if there are that many."""
    values = eigenvalues.double()
    gaps = values.diff() > GAP * values[1:].abs()
    ends = torch.nonzero(gaps).flatten() + 1
    whole = [int(end) for end in ends if end < len(values)]
    if not whole or whole[-1] < n_modes:
        whole = [*whole, len(values)] if len(values) >= n_modes else whole
    last = next((end for end in whole if end >= n_modes), whole[-1])
    bounds = [0, *[end for end in whole if end <= last]]
    return torch.tensor(np.diff(bounds))
