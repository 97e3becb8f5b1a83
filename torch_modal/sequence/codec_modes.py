"""Modes that are the same wherever they are computed: of one key-frame, by the deterministic mesher.

Two machines round differently. A mode then comes with either sign, and modes of nearly the same eigenvalue come mixed.
What does not depend on that is the space of each cluster of eigenvalues, and in it the basis whose products with as
many scattered directions are a symmetric positive definite matrix. Which directions, and where clusters end, the file
says.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.errors import MeshWarning
from torch_modal.precompute.eigen import EXACT
from torch_modal.precompute.modes import extract_modes

GAP = 1e-3
"""Relative gap between neighbouring eigenvalues that ends a cluster."""
SPARE = 6
"""Further modes that are computed, so that the last cluster is whole."""
N_SEEDS = 16
"""Choices of directions, of which the clearest for all clusters is taken."""


class FixedModes(NamedTuple):
    """Modes whose signs and mixtures are fixed."""

    modes: Tensor
    """*Shape:* ``(k, V, 3)``."""
    clusters: Tensor
    """How many modes each cluster has. *Shape:* ``(C,)``."""
    seed: int
    """Of the directions."""


def fixed_modes(
    reference: Tensor,
    faces: Tensor,
    n_modes: int,
    clusters: Tensor | None = None,
    seed: int | None = None,
    cache_dir: str | None = None,
    cache: bool = True,
) -> FixedModes:
    """The lowest modes of a shape.

    Args:
        reference: *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: How many; a few more or fewer, if that would cut a cluster.
        clusters: As they were found elsewhere. Default: found here.
        seed: Likewise.
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
            reference,
            faces,
            min(n_modes + SPARE, most),
            mesher="lattice",
            tolerance=EXACT,
            cache_dir=cache_dir,
            cache=cache,
        )
    if clusters is None:
        clusters = _clusters(basis.eigenvalues, n_modes)
    sizes = clusters.tolist()
    clusters_of_modes = basis.modes[: sum(sizes)].flatten(1).double().split(sizes)
    if seed is None:
        seed = max(range(N_SEEDS), key=lambda one: _clearness(clusters_of_modes, one))
    directions = _directions(clusters_of_modes[0].shape[1], max(sizes), seed)
    parts = []
    for own in clusters_of_modes:
        u, _, vh = torch.linalg.svd(own @ directions[: len(own)].mT)
        parts.append(vh.mT @ u.mT @ own)  # of products vh.T diag(s) vh
    return FixedModes(torch.cat(parts).unflatten(1, (-1, 3)), clusters, seed)


def _directions(n: int, count: int, seed: int) -> Tensor:
    """Scattered numbers from -1 to 1, by whole numbers alone. *Shape:* ``(count, n)``."""
    found = np.arange(count * n, dtype=np.uint64) + np.uint64(seed << 40)
    for factor in (0xBF58476D1CE4E5B9, 0x94D049BB133111EB):  # SplitMix64
        found = (found ^ (found >> np.uint64(30))) * np.uint64(factor)
    return torch.from_numpy((found >> np.uint64(40)).astype(np.float64) / 2**23 - 1).reshape(count, n)


def _clearness(clusters_of_modes: Sequence[Tensor], seed: int) -> float:
    """The smallest singular value of a cluster's products with the directions, over the sizes of its modes."""
    sizes = [len(own) for own in clusters_of_modes]
    directions = _directions(clusters_of_modes[0].shape[1], max(sizes), seed)
    products = torch.cat(list(clusters_of_modes)) @ directions.mT
    return min(
        float(torch.linalg.svdvals(mine[:, : len(own)])[-1] / own.norm(dim=1).max())
        for own, mine in zip(clusters_of_modes, products.split(sizes), strict=True)
    )


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
