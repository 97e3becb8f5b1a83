"""Objective, solver and presets: the settings of all in-betweens."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torch_modal.elastic.backend import BACKENDS
from torch_modal.elastic.bend import Bend, SquaredBend
from torch_modal.elastic.energy import Energy
from torch_modal.elastic.shell import ALPHA, BETA, GAMMA
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Term
from torch_modal.elastic.volume import Volume
from torch_modal.geometry.crossings import require_contact


def _choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise ValueError(f"{name} is one of {', '.join(map(repr, choices))}; got {value!r}")


def _whole(name: str, value: int, lowest: int) -> None:
    if not isinstance(value, int) or isinstance(value, bool) or value < lowest:
        raise ValueError(f"{name} is a whole number, {lowest} or more; got {value!r}")


@dataclass(frozen=True)
class Objective:
    r"""The objective, with Eq. 5 for ``d``: :math:`(1-t) d(x_a, x) + t d(x_b, x)`, in modes with a term more, or Eq. 4.

    Attributes:
        space: None (no modes: the blend by local rotations, then steps of all vertices), ``"joint"`` (before these
            steps, one shape in the sum of both modal spaces, with :math:`\tfrac{1}{2} \rho |a|^2`) or ``"paired"``
            (Eq. 4 of the paper: one near each key-frame, pulled together, and the mean of both; t = 1/2 only). Further
            terms act through modes: with them, None is ``"joint"`` (:attr:`modal_space`).
        alpha: Stretching stiffness of Eq. 5: a number, or a tensor or parameter whose last dimension counts the edges,
            or is 1, and whose others broadcast against the samples. *Shape:* ``()``, ``(..., E)`` or ``(..., 1)``.
        beta: Bending stiffness, likewise with the hinges. *Shape:* ``()``, ``(..., H)`` or ``(..., 1)``.
        gamma: Volume stiffness; of no effect on open surfaces, such as sheets. *Shape:* ``()`` or ``(..., 1)``.
        mu: Weight of the similarity of Eq. 4 on the coarse mesh, of no effect in the joint space: a number, or a tensor
            or parameter that broadcasts against the samples. *Shape:* ``(...)``.
        terms: Further terms of the energy.
        anchor: ``rho``, the weight of the mean squared distance of the shape from the blend by local rotations, at a
            size of 100, in the joint space. Without it there are many minima of almost the same energy, between which
            shapes jump.
        coarse_faces: Faces of the mesh that the energy is evaluated on in the modal space.
        contact: True to keep parts from passing through each other (docs/contact.md). It needs the extra
            ``contact``.

    Raises:
        ValueError: A choice that does not exist, or a number out of range.
    """

    space: Literal["joint", "paired"] | None = None
    alpha: float | Tensor = ALPHA
    beta: float | Tensor = BETA
    gamma: float | Tensor = GAMMA
    mu: float | Tensor = 1.0
    terms: tuple[Term, ...] = ()
    anchor: float = 3000.0
    coarse_faces: int = 1000
    contact: bool = False

    def __post_init__(self) -> None:
        if self.space is not None:
            _choice("space", self.space, ("joint", "paired"))
        _whole("coarse_faces", self.coarse_faces, 4)
        if not 0 <= self.anchor < math.inf:
            raise ValueError(f"anchor is a finite number, 0 or more; got {self.anchor!r}")
        if self.contact and self.space == "paired":
            raise ValueError("contact needs one shape for each in-between; space='paired' has two")
        wrong = [term for term in self.terms if not isinstance(term, Term)]
        if wrong:
            raise ValueError(f"terms holds a {type(wrong[0]).__name__}; each is an instance of torch_modal.Term")

    @property
    def modal_space(self) -> Literal["joint", "paired"] | None:
        """The modal space that is minimised in, if any."""
        return self.space or ("joint" if self.terms else None)

    def all_terms(self) -> list[Term]:
        """The terms of Eq. 5 and the further terms."""
        bend = SquaredBend if self.space == "paired" else Bend
        return [Stretch(self.alpha), bend(self.beta), Volume(self.gamma), *self.terms]


@dataclass(frozen=True)
class Solver:
    """The way to solve.

    Attributes:
        max_steps: Newton steps at most in the modal space.
        tolerance: Bound on the gradient norm there, relative to the one at the start. Gradients of the layer are as
            exact as that. It is the same whether gradients are recorded or not, and so is the result.
        unconverged: What happens when samples did not converge: ``"warn"`` warns and lets no gradient flow through
            their amplitudes, ``"raise"`` raises where gradients are recorded.
        local_steps: Newton steps of all vertices. Gradients go through them; they cost memory in proportion to V.
        polish: Further steps on the fine mesh, each four times as long; two come within 2 % of the optimum.
        regions: In the paired space, the segments that are interpolated once more on the fine mesh, the rest fixed:
            of 24, the worst reached by the modes (section 3.2 of the paper). They are chosen once, by the references of
            the bases: no gradient goes through the choice. Two bases of one reference have none.
        backend: ``"warp"`` (kernels of NVIDIA Warp for the local rotations and the local steps), ``"torch"``, or
            ``"auto"`` (kernels where Warp is installed). Kernels, and the modal solve, compute in float64, also in a
            layer of float32. Terms of your own without a :attr:`~torch_modal.Term.formula` are computed by
            torch.

    Raises:
        ValueError: A choice that does not exist, or a number out of range.
    """

    max_steps: int = 80
    tolerance: float = 3e-7
    unconverged: Literal["warn", "raise"] = "warn"
    local_steps: int = 2
    polish: int = 0
    regions: int = 0
    backend: str = "auto"

    def __post_init__(self) -> None:
        _choice("unconverged", self.unconverged, ("warn", "raise"))
        _choice("backend", self.backend, ("auto", *BACKENDS))
        for name in ("max_steps", "local_steps", "polish", "regions"):
            _whole(name, getattr(self, name), 0)
        if not self.tolerance >= 0:
            raise ValueError(f"tolerance bounds a relative gradient norm and is 0 or more; got {self.tolerance!r}")


class Settings(NamedTuple):
    """Objective and solver."""

    objective: Objective
    solver: Solver


Preset = Literal["accurate", "fast", "modal", "paper"]

PRESETS = {
    "accurate": Settings(Objective(), Solver()),
    "fast": Settings(Objective(), Solver(local_steps=0)),
    "modal": Settings(Objective(space="joint"), Solver()),
    "paper": Settings(Objective(space="paired"), Solver(max_steps=10, local_steps=0, regions=8)),
}
"""The presets; docs/layer.md compares them."""


def settings(
    preset: str,
    objective: Objective | None = None,
    solver: Solver | None = None,
    regions: int | None = None,
    **changes: Any,
) -> Settings:
    """The settings of a preset, with another objective or solver, and with changes of the objective that are not None.

    Raises:
        ValueError: There is no such preset, or ``mu`` or regions do not fit the space.
        MissingPackageError: Contact without that extra.
    """
    _choice("preset", preset, tuple(PRESETS))
    chosen = PRESETS[preset]
    changes = {name: value for name, value in changes.items() if value is not None}
    objective, solver = objective or chosen.objective, solver or chosen.solver
    objective = replace(objective, **changes) if changes else objective
    solver = solver if regions is None else replace(solver, regions=regions)
    if objective.modal_space != "paired" and ("mu" in changes or solver.regions):
        what = "mu weighs the similarity" if "mu" in changes else f"regions={solver.regions} are interpolated"
        raise ValueError(f"{what} of the two shapes of Eq. 4, which only preset='paper' has")
    if objective.contact:
        require_contact()
    return Settings(objective, solver)


def expand_to_samples(name: str, values: float | Tensor, n: int, like: Tensor, lead: torch.Size) -> Tensor:
    """Values of elements for each sample of a flat batch. *Shape:* ``(..., n)`` or ``(..., 1)``, to ``(B, n or 1)``.

    Raises:
        ValueError: There is neither one value nor one of each element, or they do not broadcast.
    """
    values = torch.as_tensor(values, dtype=like.dtype, device=like.device)
    values = values[None] if values.dim() == 0 else values
    try:
        if values.shape[-1] not in (1, n):
            raise RuntimeError
        return values.expand(*lead, values.shape[-1]).reshape(-1, values.shape[-1])
    except RuntimeError:
        raise ValueError(
            f"{name} has shape {tuple(values.shape)}; its last dimension counts the {n} elements or is 1, its others "
            f"broadcast against samples of {tuple(lead)}: one for each sample is values[:, None]"
        ) from None


def stiffnesses(terms: Iterable[Term], energy: Energy, like: Tensor, lead: torch.Size, encloses: bool) -> list[Tensor]:
    """Stiffnesses of terms in a flat batch, 0 of volumes that are not enclosed. *Shape of each:* ``(B, M or 1)``."""
    flat = []
    for term, summand in zip(terms, energy.parts, strict=True):
        n = 1 if term.total else summand.corners.shape[1]
        values = expand_to_samples(f"a stiffness of {type(term).__name__}", term.stiffness, n, like, lead)
        flat.append(values if encloses or not isinstance(term, Volume) else 0 * values)
    return flat
