"""Bodies far from each other are problems of their own: neither moves because of the other."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from conftest import Shapes
from terms import Edges
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.modes.basis import ModalBasis
from torch_modal.solve.minimise import Status

DOUBLE = torch.float64
TIMES = torch.tensor([0.2, 0.5, 0.9], dtype=DOUBLE)
WEIGHTS = torch.tensor([[0.2, 0.3, 0.5], [0.6, 0.4, 0.0]], dtype=DOUBLE)
AWAY = 3.0
"""Diagonals from one body to the other."""


def turned(bars: Shapes) -> Shapes:
    """The bars, the second key-frame turned and moved: a body beside them would be swung around."""
    turn = torch.matrix_exp(torch.tensor([[0.0, -1.0, 0.2], [1.0, 0.0, 0.0], [-0.2, 0.0, 0.0]], dtype=DOUBLE))
    moved = bars.keyframes[1] @ turn.mT + torch.tensor([1.0, 3.0, -2.0])
    x = torch.stack([bars.keyframes[0], moved, bars.keyframes[2]])
    bases = [ModalBasis(y, b.eigenvalues, b.modes, b.rigid_eigenvalues) for y, b in zip(x, bars.bases, strict=True)]
    bases[1] = ModalBasis(x[1], bases[1].eigenvalues, bases[1].modes @ turn.mT, bases[1].rigid_eigenvalues)
    return Shapes(x, bars.faces, bases)


def beside(first: Shapes, keyframes: Tensor, modes: Tensor) -> Shapes:
    """A second body of the same connectivity. *Shape:* ``(K, V, 3), (k, V, 3)``."""
    x, n = torch.cat([first.keyframes, keyframes], 1), first.keyframes.shape[1]
    bases = []
    for shape, basis in zip(x, first.bases, strict=True):
        both = torch.cat([torch.cat([basis.modes, 0 * basis.modes], 1), torch.cat([0 * modes, modes], 1)])
        values = torch.cat([basis.eigenvalues, torch.ones(len(modes), dtype=DOUBLE)])
        bases.append(ModalBasis(shape, values, both, basis.rigid_eigenvalues))
    return Shapes(x, torch.cat([first.faces, first.faces + n]), bases)


@pytest.fixture(scope="module")
def alone(bars: Shapes) -> Shapes:
    return turned(bars)


@pytest.fixture(scope="module")
def both(alone: Shapes, bars: Shapes) -> Shapes:
    """With a second body that stands still."""
    diagonal = (alone.keyframes[0].amax(0) - alone.keyframes[0].amin(0)).norm()
    away = AWAY * diagonal * torch.tensor([0.6, 0.0, 0.8], dtype=DOUBLE)
    return beside(alone, (bars.keyframes[2] + away).expand(3, -1, -1), bars.bases[2].modes)


CALLS: dict[str, Callable[[Shapes], Tensor]] = {
    "InBetween": lambda s: tm.InBetween(s.bases[:2], s.faces)(*s.keyframes[:2], TIMES),
    "InBetween, torch": lambda s: tm.InBetween(s.bases[:2], s.faces, solver=tm.Solver(backend="torch"))(
        *s.keyframes[:2], TIMES
    ),
    "InBetween, fast": lambda s: tm.InBetween(s.bases[:2], s.faces, "fast")(*s.keyframes[:2], TIMES),
    "InBetween, no modes": lambda s: tm.InBetween(s.keyframes[:2], s.faces)(*s.keyframes[:2], TIMES),
    "MidShape": lambda s: tm.MidShape(s.bases[:2], s.faces)(*s.keyframes[:2])[None],
    "Blend": lambda s: tm.Blend(s.bases, s.faces)(s.keyframes, WEIGHTS),
    "Path": lambda s: tm.Path(s.bases, s.faces)(s.keyframes, 2 * TIMES),
    "Path, torch": lambda s: tm.Path(s.bases, s.faces, solver=tm.Solver(backend="torch"))(s.keyframes, 2 * TIMES),
    "Path, pairs": lambda s: tm.Path(s.bases, s.faces, smooth=False)(s.keyframes, 2 * TIMES),
    "PathEditor": lambda s: tm.PathEditor(tm.Path(s.bases, s.faces), s.keyframes, 3).shapes(),
    "subdivide": lambda s: tm.subdivide(s.keyframes, s.faces, 1, bases=s.bases, progress=False),
    "subdivide, a pair": lambda s: tm.subdivide(s.keyframes[:2], s.faces, 1, n_modes=6, n_frames=6, progress=False),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_body_that_stands_still_does_not_move_and_changes_nothing(name: str, alone: Shapes, both: Shapes) -> None:
    """As one problem, both had one frame, size and modes, and each moved because of the other."""
    found, truth, n = CALLS[name](both), CALLS[name](alone), alone.keyframes.shape[1]
    diagonal = (truth[0].amax(0) - truth[0].amin(0)).norm()
    assert (found[:, n:] - both.keyframes[0, n:]).norm(dim=-1).max() < 1e-9 * diagonal
    assert (found[:, :n] - truth).norm(dim=-1).max() < 1e-9 * diagonal


def test_modes_of_each_body(alone: Shapes, both: Shapes) -> None:
    n, k = alone.keyframes.shape[1], 6
    found = tm.extract_bases(both.keyframes[:2], both.faces, k, progress=False)
    first = tm.extract_bases(alone.keyframes[:2], alone.faces, k, progress=False)
    second = tm.extract_bases(both.keyframes[:2, n:], alone.faces, k, progress=False)
    for whole, one, other in zip(found, first, second, strict=True):
        assert whole.n_modes == 2 * k and bool((whole.eigenvalues.diff() >= 0).all())
        mine = whole.modes[:, :n].flatten(1).any(1)
        assert not whole.modes[mine][:, n:].any()
        torch.testing.assert_close(whole.eigenvalues[mine], one.eigenvalues, rtol=1e-9, atol=0)
        torch.testing.assert_close(whole.modes[mine][:, :n], one.modes, rtol=0, atol=1e-9)
        torch.testing.assert_close(whole.modes[~mine][:, n:], other.modes, rtol=0, atol=1e-9)


def test_gradients_are_those_of_each_alone(alone: Shapes, both: Shapes) -> None:
    n = alone.keyframes.shape[1]

    def gradients(shapes: Shapes) -> list[Tensor]:
        x, t = shapes.keyframes[:2].clone().requires_grad_(), TIMES.clone().requires_grad_()
        found = tm.InBetween(shapes.bases[:2], shapes.faces)(*x, t)[:, :n]
        return list(torch.autograd.grad((found * torch.linspace(1, 2, n, dtype=DOUBLE)[:, None]).sum(), [x, t]))

    (x, t), (x_alone, t_alone) = gradients(both), gradients(alone)
    torch.testing.assert_close(x[:, :n], x_alone, rtol=0, atol=1e-9)
    torch.testing.assert_close(t, t_alone, rtol=0, atol=1e-9)
    assert not x[:, n:].any()


def test_results_of_bodies_are_put_together(alone: Shapes, both: Shapes) -> None:
    """The energies add up, the status is the worst, and a state makes a layer of other bodies."""
    layer, single = (tm.InBetween(s.bases[:2], s.faces) for s in (both, alone))
    found, first = layer.solve(*both.keyframes[:2], TIMES), single.solve(*alone.keyframes[:2], TIMES)
    assert len(layer.cores) == 2
    torch.testing.assert_close(found.solution.energy, first.solution.energy, rtol=1e-9, atol=1e-9)
    assert torch.equal(found.solution.amplitudes[:, : first.solution.amplitudes.shape[1]], first.solution.amplitudes)
    broken = both.keyframes[1].clone()
    broken[-len(alone.keyframes[0]) :] = 0
    assert layer.solve(both.keyframes[0], broken, 0.5).solution.status == Status.INVALID
    near = both.keyframes.clone()
    near[:, len(alone.keyframes[0]) :] = near[:, : len(alone.keyframes[0])] + torch.tensor([0.0, 2.0, 0.0])
    together = tm.InBetween(near[:2], both.faces)
    assert len(together.cores) == 1
    together.load_state_dict(tm.InBetween(both.keyframes[:2], both.faces).state_dict())
    assert len(together.cores) == 2


@pytest.mark.parametrize("kind", ["terms", "stiffness", "paired"])
def test_what_may_be_between_bodies_is_one_problem(kind: str, both: Shapes) -> None:
    n = len(Connectivity(both.faces.numpy()).edges)
    changes: dict[str, Any] = {
        "terms": {"terms": (Edges(),)},
        "stiffness": {"alpha": torch.full((n,), 500.0)},
        "paired": {"space": "paired"},
    }[kind]
    layer = tm.InBetween(both.bases[:2], both.faces, objective=tm.Objective(**changes))
    assert len(layer.cores) == 1
    assert layer(*both.keyframes[:2], 0.5).isfinite().all()


@pytest.mark.parametrize("kind", ["pair", "path of pairs", "smooth path"])
def test_contact_is_of_all_bodies(kind: str, both: Shapes) -> None:
    """Two bodies that exchange their places, and would pass through each other on the way."""
    pytest.importorskip("ipctk")
    pytest.importorskip("igl")
    first = both.keyframes[0, : both.keyframes.shape[1] // 2]
    away = torch.tensor([0.0, 0.5, 9.0], dtype=DOUBLE)
    x = torch.stack([torch.cat([first, first + away]), torch.cat([first + away, first])])
    when = torch.linspace(0.34, 0.54, 6, dtype=DOUBLE)
    if kind == "smooth path":
        x = x[[0, 1, 0]]

    def motion(contact: bool) -> tuple[Any, Tensor]:
        if kind == "pair":
            layer = tm.InBetween(x, both.faces, contact=contact)
            return layer, layer(*x, when)
        path = tm.Path(x, both.faces, contact=contact)
        return (path.layers or [path])[0], path(x, when)

    (one, pushed), (several, free) = motion(True), motion(False)
    assert len(one.vertices) == 1 and len(several.vertices) == 2
    before, after = (len(tm.self_contacts(shapes, both.faces).pairs) for shapes in (free, pushed))
    assert before > 0 and after < before / 4
