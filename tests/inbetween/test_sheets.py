"""In-betweens of sheets: flat, open, and rolled up."""

import math
import warnings
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch
from helpers.shapes import edge_error, edge_lengths, rigid_blend
from helpers.sheets import cylinder, folded, rectangle, rolled
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic.minimise import Status
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import encloses
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.inbetween.coarse import ENOUGH_FACES, coarsen_until_resolved
from torch_modal.modes.coarsening import coarsen, collapse

BACKENDS = ["torch", "warp"]
Direction = Callable[[np.ndarray], np.ndarray]


@cache
def strip() -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of 6 by 1."""
    return rectangle(6.0, 1.0, 0.13)


def roll(time: float, turns: float = 3) -> Tensor:
    return torch.from_numpy(cylinder(strip()[0], time, lambda s: rolled(s, 6.0, turns), math.radians(80)))


def fold(time: float, degrees: float = 170, width: float = 0.6) -> Tensor:
    angle = math.radians(degrees)
    return torch.from_numpy(cylinder(strip()[0], time, lambda s: folded(s, 3.0, width, angle)))


def faces() -> Tensor:
    return torch.tensor(strip()[1])


def bases(*shapes: Tensor, k: int = 20) -> list[tm.ModalBasis]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", tm.MeshWarning)
        return tm.extract_bases(torch.stack(shapes), faces(), k, method="shell", cache=False, progress=False)


def linear(x_a: Tensor, x_b: Tensor) -> Tensor:
    return rigid_blend(x_a, x_b, torch.tensor(0.5, dtype=torch.float64), torch.ones(len(x_a), dtype=torch.float64))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("turns", [1, 3])
def test_a_strip_rolls_up(backend: str, dtype: torch.dtype, turns: float) -> None:
    flat, end = roll(0, turns), roll(1, turns)
    layer = tm.InBetween(bases(flat, end), faces(), solver=tm.Solver(backend=backend)).to(dtype)
    t = torch.tensor([0.25, 0.5, 0.75], dtype=dtype)
    result = layer.solve(flat.to(dtype), end.to(dtype), t)
    assert (result.solution.status == Status.CONVERGED).all()
    for x, time in zip(result.shapes, t, strict=True):
        truth = roll(float(time), turns)
        assert edge_error(x.double(), truth, faces()) < 0.03 * edge_error(linear(flat, end), roll(0.5, turns), faces())
    assert edge_error(result.shapes[1].double(), roll(0.5, turns), faces()) < 0.01


@pytest.mark.parametrize("backend", BACKENDS)
def test_flat_key_frames_align_without_a_mirror_image(backend: str) -> None:
    """A flat sheet that was moved, and one turned over: no bend in between, and gradients that are finite."""
    flat = roll(0)
    layer = tm.InBetween(bases(flat, roll(0.3)), faces(), solver=tm.Solver(backend=backend))
    for axis in torch.eye(3, dtype=torch.float64):
        turned = flat @ torch.matrix_exp(torch.linalg.cross(torch.eye(3).double(), 2.5 * axis.expand(3, 3))) + axis
        flat = flat.detach().requires_grad_()
        turned.requires_grad_()
        half = layer(flat, turned, 0.5)
        torch.testing.assert_close(edge_lengths(half, faces()), edge_lengths(flat, faces()), rtol=1e-7, atol=1e-7)
        for gradient in torch.autograd.grad(half.square().sum(), [flat, turned]):
            assert gradient.isfinite().all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_flat_sheet_with_a_rolled_one_has_gradients(backend: str) -> None:
    """With a rank of two, the rotation that lays one on the other is smooth."""
    flat, end = (x.requires_grad_() for x in (roll(0), roll(1, 0.5)))
    layer = tm.InBetween(bases(flat.detach(), end.detach()), faces(), solver=tm.Solver(backend=backend))
    half = layer(flat, end, 0.5)
    assert edge_error(half.detach(), roll(0.5, 0.5), faces()) < 0.003
    assert all(g.isfinite().all() for g in torch.autograd.grad(half.square().sum(), [flat, end]))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("degrees", "width"), [(170, 0.6), (180, 0.3), (180, 1e-3)])
def test_a_page_is_folded(backend: str, degrees: float, width: float) -> None:
    """Also to a closed fold along one line of edges, whose angle is at the end of its range."""
    end = fold(1, degrees, width)
    layer = tm.InBetween(bases(fold(0), end), faces(), solver=tm.Solver(backend=backend))
    result = layer.solve(fold(0), end, 0.5)
    assert result.shapes.isfinite().all()
    truth, wrong = fold(0.5, degrees, width), linear(fold(0), end)
    assert edge_error(result.shapes, truth, faces()) < 0.1 * edge_error(wrong, truth, faces())


@pytest.mark.parametrize("backend", BACKENDS)
def test_sheets_have_no_volume(backend: str) -> None:
    """The stiffness of the volume has no effect, and no gradient."""
    flat, end = roll(0, 0.5), roll(1, 0.5)
    gamma = torch.tensor(1e6, dtype=torch.float64, requires_grad=True)
    solver = tm.Solver(backend=backend)
    given = tm.InBetween(bases(flat, end), faces(), objective=tm.Objective(gamma=gamma), solver=solver)
    none = tm.InBetween(bases(flat, end), faces(), objective=tm.Objective(gamma=0.0), solver=solver)
    half = given(flat, end, 0.5)
    torch.testing.assert_close(half.detach(), none(flat, end, 0.5), rtol=0, atol=1e-13)
    assert torch.autograd.grad(half.sum(), gamma)[0] == 0


def test_what_encloses_a_volume() -> None:
    sphere, sphere_faces = _sphere()
    open_faces = sphere_faces[1:]
    assert encloses(sphere, Connectivity(sphere_faces))
    assert encloses(sphere, Connectivity(open_faces))  # a small hole
    assert not encloses(sphere, Connectivity(sphere_faces[sphere.numpy()[sphere_faces].mean(1)[:, 2] > 0]))
    assert not encloses(sphere * torch.tensor([1.0, 1.0, 0.0]), Connectivity(sphere_faces))
    assert encloses(sphere * torch.tensor([1.0, 1.0, 0.02]), Connectivity(sphere_faces))  # thin, and still a body
    assert not encloses(roll(1), Connectivity(strip()[1]))


def _sphere() -> tuple[Tensor, np.ndarray]:
    import pyvista

    ball = pyvista.Icosphere(nsub=3)
    return torch.from_numpy(np.array(ball.points, dtype=np.float64)), ball.regular_faces.astype(np.int64)


def test_the_coarse_mesh_is_that_of_the_curved_key_frame() -> None:
    """Edge collapses of a flat sheet are arbitrary, and leave no more edges where it is going to bend.

    It does not show how many are needed there: all that a coarse mesh may have are kept.
    """
    shapes, whole = torch.stack([fold(0), fold(1)]) * 20, Mesh(Connectivity(strip()[1]))
    found = coarsen_until_resolved(shapes, whole, 100, ())
    assert len(found.faces) >= min(ENOUGH_FACES, len(strip()[1]))
    curved = collapse(shapes[1].numpy(), strip()[1], len(found.faces))
    np.testing.assert_array_equal(found.clusters, curved.clusters)
    both_flat = coarsen_until_resolved(shapes[:1].repeat(2, 1, 1), whole, 100, ())
    np.testing.assert_array_equal(both_flat.clusters, coarsen(shapes[:1].numpy(), strip()[1], 1000).clusters)


def test_a_path_goes_through_a_roll() -> None:
    """By one and a half turns from key-frame to key-frame, where triangles turn evenly."""
    keyframes = torch.stack([roll(0), roll(0.5), roll(1)])
    path = tm.Path(bases(*keyframes), faces())
    found = path(keyframes, torch.tensor([0.5, 1.5]))
    for x, time in zip(found, (0.25, 0.75), strict=True):
        assert edge_error(x, roll(time), faces()) < 0.01


def test_layers_of_a_sheet_that_are_close_are_no_contact() -> None:
    """Neighbours in a narrow fold are not held apart, and nothing becomes NaN."""
    pytest.importorskip("igl")
    flat, end = fold(0), fold(1, 175, 0.4)
    made = [tm.InBetween(bases(flat, end), faces(), contact=contact) for contact in (False, True)]
    free, held = (layer.solve(flat, end, torch.tensor([0.5, 0.9])) for layer in made)
    torch.testing.assert_close(held.shapes, free.shapes, rtol=0, atol=1e-12)
    assert (held.solution.n_crossing == 0).all()
