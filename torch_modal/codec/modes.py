"""Modes that are the same wherever they are computed: of one key-frame, by the deterministic mesher.

Rounding differs between machines. It changes the signs of modes, and mixes modes of nearly the same eigenvalue. The
space that a cluster of eigenvalues spans does not change. The basis of a cluster is therefore the one whose products
with a set of pseudo-random directions form a symmetric positive definite matrix. The file stores the seed of the
directions and the sizes of the clusters.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.errors import MeshError, MeshWarning
from torch_modal.precompute.eigen import ModalAnalysisError
from torch_modal.precompute.extract import extract_modes
from torch_modal.precompute.tetrahedra import TetrahedralizationError

GAP = 1e-3
"""Relative gap between neighbouring eigenvalues that ends a cluster."""
SPARE = 6
"""Further modes that are computed, so that the last cluster is whole."""
N_SEEDS = 16
"""Sets of directions, of which the best conditioned is taken."""
N_PROBES = 8


class ReproducibleModes(NamedTuple):
    """Modes whose signs and mixtures are fixed."""

    modes: Tensor
    """*Shape:* ``(k, V, 3)``."""
    clusters: Tensor
    """Number of modes in each cluster. *Shape:* ``(C,)``."""
    seed: int
    """Of the directions."""

    def probe(self) -> Tensor:
        """A few entries, relative to each mode's size, by which another machine checks its own. *Shape:* ``(8,)``."""
        flat = self.modes.flatten(1)
        rms = flat.square().mean(1, keepdim=True).sqrt()
        columns = torch.linspace(0, flat.shape[1] - 1, N_PROBES).long()
        rows = torch.linspace(0, len(flat) - 1, N_PROBES).long()
        return (flat / rms)[rows, columns]


def reproducible_modes(
    reference: Tensor,
    faces: Tensor,
    n_modes: int,
    clusters: Tensor | None = None,
    seed: int | None = None,
    cache_dir: str | None = None,
    cache: bool = True,
) -> ReproducibleModes:
    """The lowest modes of a shape.

    Args:
        reference: *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_modes: How many; a few more or fewer, if that would cut a cluster.
        clusters: Sizes of the clusters, as a file has them. Default: found here.
        seed: Of the directions, as a file has it. Default: found here.
        cache_dir: As for :func:`torch_modal.extract_modes`.
        cache: As for :func:`torch_modal.extract_modes`.

    Raises:
        MeshError: The shape cannot have modes.
        ValueError: More modes than the shape has.
    """
    available = max(3 * len(faces.unique()) - 6, n_modes)
    options = {"mesher": "lattice", "cache_dir": cache_dir, "cache": cache}
    with warnings.catch_warnings():
        # Rounding makes faces without area of small ones.
        warnings.simplefilter("ignore", MeshWarning)
        count = min(n_modes + SPARE, available)
        try:
            basis = extract_modes(reference, faces, count, method="solid", **options)  # type: ignore[arg-type]
        except (MeshError, TetrahedralizationError, ModalAnalysisError):  # a sheet has modes, too
            basis = extract_modes(reference, faces, count, method="shell", **options)  # type: ignore[arg-type]
    if clusters is None:
        clusters = _clusters(basis.eigenvalues, n_modes)
    sizes = clusters.tolist()
    groups = basis.modes[: sum(sizes)].flatten(1).double().split(sizes)
    if seed is None:
        seed = max(range(N_SEEDS), key=lambda one: _conditioning(groups, one))
    directions = _directions(groups[0].shape[1], max(sizes), seed)
    parts = []
    for group in groups:
        u, _, vh = torch.linalg.svd(group @ directions[: len(group)].mT)
        parts.append(vh.mT @ u.mT @ group)  # its products with the directions are vh.T diag(s) vh
    return ReproducibleModes(torch.cat(parts).unflatten(1, (-1, 3)), clusters, seed)


def _directions(n: int, count: int, seed: int) -> Tensor:
    """Pseudo-random numbers from -1 to 1, by integer arithmetic alone (SplitMix64). *Shape:* ``(count, n)``."""
    found = np.arange(count * n, dtype=np.uint64) + np.uint64(seed << 40)
    for factor in (0xBF58476D1CE4E5B9, 0x94D049BB133111EB):
        found = (found ^ (found >> np.uint64(30))) * np.uint64(factor)
    return torch.from_numpy((found >> np.uint64(40)).astype(np.float64) / 2**23 - 1).reshape(count, n)


def _conditioning(groups: Sequence[Tensor], seed: int) -> float:
    """The smallest singular value of a cluster's products with the directions, over the sizes of its modes."""
    sizes = [len(group) for group in groups]
    products = torch.cat(list(groups)) @ _directions(groups[0].shape[1], max(sizes), seed).mT
    return min(
        float(torch.linalg.svdvals(own[:, : len(group)])[-1] / group.norm(dim=1).max())
        for group, own in zip(groups, products.split(sizes), strict=True)
    )


def _clusters(eigenvalues: Tensor, n_modes: int) -> Tensor:
    """Sizes of clusters of eigenvalues: the fewest that hold ``n_modes``, or as many as there are."""
    values = eigenvalues.double()
    gaps = values.diff() > GAP * values[1:].abs()
    ends = (torch.nonzero(gaps).flatten() + 1).tolist()
    if len(values) >= n_modes and (not ends or ends[-1] < n_modes):
        ends.append(len(values))
    last = next((end for end in ends if end >= n_modes), ends[-1])
    return torch.tensor(np.diff([0, *(end for end in ends if end <= last)]))
