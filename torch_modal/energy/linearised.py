"""What Eq. 5 measures on shapes, and its derivatives: energies of several rest shapes from one set of measures."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.energy.shell import (
    Measures,
    Rest,
    ShellEnergy,
    Stiffness,
    dihedral_angle,
    dihedral_gradient,
    length_gradient,
)
from torch_modal.geometry.vectors import norm


class Reference(NamedTuple):
    """A rest shape that pulls, and how strongly."""

    rest: Rest
    pull: Tensor
    """Factor of its energy. *Shape:* ``(B,)``."""


def references_between(
    shell: ShellEnergy, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor
) -> list[Reference]:
    """Both key-frames as references of the in-between at ``t``. *Shape:* ``(B, V, 3), (B, V, 3), (B,)``.

    Args:
        shell: The energy.
        first: Key-frames at 0.
        second: Key-frames at 1.
        t: Times.
        *stiffness: ``alpha``, ``beta`` and ``gamma``. *Shape of each:* ``(B,)``.
    """
    # Both at once: what a single sample costs is the number of operations.
    measures, weights = shell.rest(torch.stack([first, second]), Stiffness(*stiffness))
    return [
        Reference(Rest(Measures(*(m[i] for m in measures)), Measures(*(w[i] for w in weights))), pull)
        for i, pull in enumerate((1 - t, t))
    ]


def slopes_of(measures: Measures, references: Sequence[Reference]) -> tuple[Measures, Measures]:
    """First and second derivative of the energy in each measure, summed over the references."""
    slopes, curvatures = [], []
    for rest, pull in references:
        differences = ShellEnergy.differences(measures, rest)
        pulls = (pull[:, None], pull[:, None], pull)
        doubled = [2 * p * w for p, w in zip(pulls, rest.weights, strict=True)]
        slopes.append([w * d for w, d in zip(doubled, differences, strict=True)])
        curvatures.append(doubled)
    return (
        Measures(*(sum(parts) for parts in zip(*slopes, strict=True))),
        Measures(*(sum(parts) for parts in zip(*curvatures, strict=True))),
    )


def energy_of(shell: ShellEnergy, measures: Measures, references: Sequence[Reference]) -> Tensor:
    """Energy of shapes that were measured, summed over the references. *Shape:* ``(..., B)``."""
    return sum(pull * shell.energy(measures, rest) for rest, pull in references)  # type: ignore[return-value]


class Linearised(NamedTuple):
    """Derivatives of everything that Eq. 5 measures, at given shapes. Components come first."""

    measures: Measures
    slope: Measures
    """First derivative of the energy in each measure."""
    curvature: Measures
    """Second derivative."""
    edges: Tensor
    """*Shape:* ``(3, B, E)``."""
    spokes: Tensor
    """*Shape:* ``(3, 3, B, H)``."""
    to_edges: Tensor
    """Gradients of the lengths. *Shape:* ``(3, B, E)``."""
    to_hinges: Tensor
    """Gradients of the angles in the spokes. *Shape:* ``(3, 3, B, H)``."""
    to_volume: Tensor
    """*Shape:* ``(3, B, V)``."""


def linearise(shell: ShellEnergy, rows: Tensor, references: Sequence[Reference]) -> Linearised:
    """Measure shapes and differentiate. *Shape:* ``(3, B, V)``."""
    edges, spokes = shell.edge_vectors(rows), shell.hinge_spokes(rows)
    measures = Measures(norm(edges), dihedral_angle(spokes), shell.volume(rows))
    slope, curvature = slopes_of(measures, references)
    local = length_gradient(edges), dihedral_gradient(spokes)
    return Linearised(measures, slope, curvature, edges, spokes, *local, shell.volume_gradient(rows))


def gradient(shell: ShellEnergy, at: Linearised) -> Tensor:
    """Gradient of the energy. *Shape:* ``(3, B, V)``."""
    return gather(shell, at.slope.length * at.to_edges, at.slope.angle * at.to_hinges, at.slope.volume, at.to_volume)


def gather(shell: ShellEnergy, on_edges: Tensor, on_hinges: Tensor, factor: Tensor, to_volume: Tensor) -> Tensor:
    """From edge vectors and spokes to vertices."""
    to_e, to_a, to_b = on_hinges
    parts = [-on_edges, on_edges, -(to_e + to_a + to_b), to_e, to_a, to_b]
    index = torch.cat([shell.edges.T.flatten(), shell.hinges.T.flatten()])
    return (factor[:, None] * to_volume).index_add(-1, index, torch.cat(parts, -1))
