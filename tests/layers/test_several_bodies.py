"""Bodies far from each other are problems of their own: neither moves because of the other."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from conftest import Shapes
from helpers.terms import Edges
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic.minimise import Status
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.inbetween.results import InBetweenResult, join_bodies, trivial_solution
from torch_modal.modes.basis import ModalBasis

DOUBLE = torch.float64
TIMES = torch.tensor([0.2, 0.5, 0.9], dtype=DOUBLE)
WEIGHTS = torch.tensor([[0.2, 0.3, 0.5], [0.6, 0.4, 0.0]], dtype=DOUBLE)
AWAY = 3.0
"""Diagonals from one body to the other."""

pytestmark = pytest.mark.filterwarnings("ignore::torch_modal.MeshWarning")


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
    # It is open, so that it has no volume to be kept, and some of its vertices have no face.
    return Shapes(x, torch.cat([first.faces, first.faces[40:] + n]), bases)


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


def test_order_of_the_vertices_does_not_matter(alone: Shapes, both: Shapes) -> None:
    n = alone.keyframes.shape[1]
    place = torch.arange(2 * n).roll(n)  # the second body comes first
    order = place.argsort()
    bases = [
        ModalBasis(b.reference[order], b.eigenvalues, b.modes[:, order], b.rigid_eigenvalues) for b in both.bases[:2]
    ]
    layer = tm.InBetween(bases, place[both.faces])
    assert layer.vertices[0].tolist() == list(range(n))
    found = layer(*both.keyframes[:2, order], TIMES)[:, place]
    torch.testing.assert_close(found[:, :n], CALLS["InBetween"](alone), rtol=0, atol=1e-9)
    torch.testing.assert_close(found[:, n:], both.keyframes[:1, n:].expand(3, -1, -1), rtol=0, atol=1e-9)


def test_modes_of_each_body(alone: Shapes, both: Shapes) -> None:
    n, k = alone.keyframes.shape[1], 6
    faces = torch.cat([alone.faces, alone.faces + n])
    found = tm.extract_bases(both.keyframes[:2], faces, k, progress=False)
    first = tm.extract_bases(alone.keyframes[:2], alone.faces, k, progress=False)
    second = tm.extract_bases(both.keyframes[:2, n:], alone.faces, k, progress=False)
    for whole, one, other in zip(found, first, second, strict=True):
        assert whole.n_modes == 2 * k and bool((whole.eigenvalues.diff() >= 0).all())
        mine = whole.modes[:, :n].flatten(1).any(1)
        assert not whole.modes[mine][:, n:].any()
        torch.testing.assert_close(whole.eigenvalues[mine], one.eigenvalues, rtol=1e-9, atol=0)
        torch.testing.assert_close(whole.modes[mine][:, :n], one.modes, rtol=0, atol=1e-9)
        torch.testing.assert_close(whole.modes[~mine][:, n:], other.modes, rtol=0, atol=1e-9)


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


def test_status_is_the_worst() -> None:
    """That a body fell back is no failure, although it has the highest number."""
    good, steps, stalled, invalid, fell = map(int, Status)
    first = [good, good, steps, stalled, invalid, fell, fell]
    second = [good, fell, fell, steps, fell, stalled, good]
    results = []
    for own in (first, second):
        x = torch.zeros(len(own), 2, 3, dtype=DOUBLE)
        known = trivial_solution(x, torch.tensor(own) == good)
        ones = torch.ones(len(own), dtype=DOUBLE)
        changed = {"status": torch.tensor(own), "energy": ones, "gradient_norm": ones, "distortion_ratio": ones}
        changed["start_weights"] = torch.eye(7, 2, dtype=DOUBLE) if own is first else torch.zeros(7, 2, dtype=DOUBLE)
        results.append(InBetweenResult(x, known._replace(**changed)))
    found = join_bodies(results, [torch.tensor([0, 3]), torch.tensor([1, 2])])
    assert found.solution.status.tolist() == [good, fell, steps, stalled, invalid, stalled, fell]
    assert bool((found.solution.energy == 2).all() and (found.solution.gradient_norm == 1).all())
    assert found.shapes.shape == (7, 4, 3) and torch.equal(found.solution.start_weights, torch.eye(7, 2, dtype=DOUBLE))


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
def test_contact_is_of_all_bodies(kind: str, bars: Shapes) -> None:
    """Two bodies that exchange their places, and would pass through each other on the way."""
    pytest.importorskip("igl")
    first, n = bars.keyframes[0], bars.keyframes.shape[1]
    faces = torch.cat([bars.faces, bars.faces + n])
    away = torch.tensor([0.0, 0.5, 9.0], dtype=DOUBLE)
    x = torch.stack([torch.cat([first, first + away]), torch.cat([first + away, first])])
    when = torch.linspace(0.34, 0.54, 6, dtype=DOUBLE)
    if kind == "smooth path":
        x = x[[0, 1, 0]]

    def motion(contact: bool) -> tuple[Any, Tensor]:
        if kind == "pair":
            layer = tm.InBetween(x, faces, contact=contact)
            return layer, layer(*x, when)
        path = tm.Path(x, faces, contact=contact)
        return (path.layers or [path])[0], path(x, when)

    (one, pushed), (several, free) = motion(True), motion(False)
    assert len(one.vertices) == 1 and len(several.vertices) == 2
    before, after = (len(tm.self_contacts(shapes, faces).pairs) for shapes in (free, pushed))
    assert before > 0 and after < before / 4
