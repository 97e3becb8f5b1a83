"""Rotations and strains of triangles against truth by hand, and the Poisson problem against known shapes."""

import pickle
from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import torch
import trimesh
from conftest import Shapes
from scipy import sparse

from torch_modal.autograd import linear_map
from torch_modal.geometry import sparse as sparse_systems
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.poisson import Poisson, Reconstruction
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian, solve_by
from torch_modal.geometry.triangle_frames import (
    bend,
    bend_sides,
    bend_slopes,
    edge_means,
    frames,
    mirror_sides,
    sides,
    transform,
)
from torch_modal.geometry.vectors import cross

F64 = torch.float64


def rows(x: torch.Tensor) -> torch.Tensor:
    """Of a batch of one. *Shape:* ``(V, 3) -> (3, 1, V)``."""
    return x.mT[:, None]


def test_frames_are_orthonormal_and_give_the_sides_back(bars: Shapes) -> None:
    given = sides(bars.keyframes.movedim(-1, 0), bars.faces)
    own = frames(given)
    axes = torch.stack([own.e1, own.e2, own.normal]).movedim((0, 1), (-2, -1))
    identity = torch.eye(3, dtype=F64).expand(3, len(bars.faces), 3, 3)
    torch.testing.assert_close(axes @ axes.mT, identity)
    for side, truth in zip(transform(own.xx, own.xy, own.xy, own.yy), given, strict=True):
        torch.testing.assert_close(own.world(*side), truth)
    torch.testing.assert_close(2 * own.twice_areas, 2 * cross(*given).norm(dim=0))
    assert bool((own.xx * own.yy > own.xy**2).all())


def test_a_rotation_field_is_a_turn_without_strain(bars: Shapes) -> None:
    x, faces = rows(bars.keyframes[1]), bars.faces
    omega = torch.tensor([0.3, -0.2, 0.5], dtype=F64)
    field = rows(torch.linalg.cross(omega.expand(len(bars.keyframes[1]), 3), bars.keyframes[1]) + 7.0)
    turn, strain = bend(sides(field, faces), frames(sides(x, faces)))
    torch.testing.assert_close(turn, omega[:, None, None].expand_as(turn))
    torch.testing.assert_close(strain, torch.zeros_like(strain), atol=1e-12, rtol=0)


def test_a_linear_field_has_its_symmetric_part_as_strain() -> None:
    # A triangle in the plane z = 0 that is symmetric to the middle of its first side, along x: its frame is that of
    # the world.
    x = rows(torch.tensor([[0.0, 0, 0], [2, 0, 0], [1.0, 1.5, 0]], dtype=F64))
    faces = torch.tensor([[0, 1, 2]])
    gradient = torch.tensor([[0.1, 0.3, 0], [-0.2, 0.4, 0], [0.05, -0.07, 0]], dtype=F64)
    turn, strain = bend(sides(rows(x[:, 0].mT @ gradient.T), faces), frames(sides(x, faces)))
    assert strain.flatten().tolist() == pytest.approx([0.1, 0.05, 0.4])
    # The normal turns so that it stays normal: about x by dw/dy, about -y by dw/dx; about z by the spin.
    assert turn.flatten().tolist() == pytest.approx([-0.07, -0.05, 0.5 * (-0.2 - 0.3)])


def test_turns_become_finite_rotations(bars: Shapes) -> None:
    x, faces = rows(bars.keyframes[0]), bars.faces
    own = frames(sides(x, faces))
    zero = torch.zeros_like(own.e1)
    for omega in ([0.0, 0.0, 0.0], [2.0, -1.0, 0.7], [1e-9, 0.0, 0.0]):
        turn = torch.tensor(omega, dtype=F64)[:, None, None].expand_as(own.e1)
        found = bend_sides(turn, zero, own)
        rotation = exp(torch.tensor(omega, dtype=F64))
        for mine, its in zip(found, sides(x, faces), strict=True):
            torch.testing.assert_close(mine[:, 0], rotation @ its[:, 0])


def test_the_stretch_is_the_exponential_of_the_strain() -> None:
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 0.75**0.5, 0]], dtype=F64)  # its frame is that of the world
    x = rows(corners)
    own = frames(sides(x, torch.tensor([[0, 1, 2]])))
    for strain in ([[0.3, 0.2], [0.2, -0.1]], [[0.0, 0.4], [0.4, 0.0]], [[-3.0, 0.0], [0.0, -3.0]]):
        given = torch.tensor(strain, dtype=F64)
        entries = given[[0, 0, 1], [0, 1, 1]].view(3, 1, 1)
        found = bend_sides(torch.zeros_like(entries), entries, own)
        expected = torch.linalg.matrix_exp(given) @ corners[1:, :2].mT
        torch.testing.assert_close(torch.stack(found, 1)[:2, :, 0, 0], expected)


def test_slopes_of_a_bend_are_those_of_autograd(bars: Shapes, generator: torch.Generator) -> None:
    own = frames(sides(rows(bars.keyframes[0]), bars.faces))
    n = len(bars.faces)
    draw = partial(torch.randn, generator=generator, dtype=F64)
    turn, strain, axes = draw(3, 1, n) * torch.logspace(-5, 0.3, n, dtype=F64), 0.5 * draw(3, 1, n), draw(3, 3, 1, n)
    strain[..., :5], turn[..., :3] = 0, 0

    def ends(change: torch.Tensor) -> torch.Tensor:  # of all triangles, summed: each depends on its own change
        turned = turn + (axes * change[None, :3]).sum(1)
        return torch.cat(bend_sides(turned, strain + change[3:], own)).sum((1, 2))

    expected = torch.autograd.functional.jacobian(ends, torch.zeros(6, 1, n, dtype=F64))
    torch.testing.assert_close(torch.cat(bend_slopes(turn, strain, own, axes)), expected, rtol=1e-12, atol=1e-13)


def test_mirrored_sides_of_a_shear_follow_the_matrix_function() -> None:
    x = rows(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=F64))
    faces = torch.tensor([[0, 1, 2]])
    m = torch.tensor([[1.2, 0.4], [-0.3, 0.8]], dtype=F64)
    other = torch.zeros(3, 1, 3, dtype=F64)
    other[:2, 0, 1:] = m
    found = mirror_sides(frames(sides(x, faces)), frames(sides(other, faces)))
    u, s, vh = np.linalg.svd(m.numpy())
    stretch = vh.T @ np.diag(4 / (1 + s) ** 2) @ vh
    expected = (u @ vh).T @ stretch
    np.testing.assert_allclose(torch.stack(found, 1)[:2, :, 0, 0], expected, atol=1e-12)
    np.testing.assert_allclose(found[1][2, 0, 0], 0, atol=1e-12)


def test_a_triangle_without_area_stays_finite() -> None:
    x = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [0, 0, 0]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 3, 1]])
    own = frames(sides(rows(x), faces))
    field = torch.randn(3, 1, 4, dtype=F64, generator=torch.Generator().manual_seed(0))
    found = bend(sides(field, faces), own)
    for part in (*own, *found, *mirror_sides(own, own)):
        assert bool(part.isfinite().all())


# ------------------------------------------------------------------------------------------------ reconstruction
def test_reconstruction_returns_a_shape_from_its_sides(bars: Shapes) -> None:
    solver = Reconstruction(bars.keyframes[0], bars.faces)
    rest = bars.keyframes
    torch.testing.assert_close(solver(sides(rest.movedim(-1, 0), bars.faces), rest), rest)
    # Weighted by one key-frame, it returns any shape, its centroid where the rest has it.
    other = rest.roll(1, 0)
    found = solver(sides(other.movedim(-1, 0), bars.faces), rest)
    shift = found - other
    torch.testing.assert_close(shift, shift[:, :1].expand_as(shift))
    weights = solver.areas / solver.areas.sum()
    torch.testing.assert_close(weights @ found, weights @ rest)


def test_reconstruction_is_the_least_squares_solution(small_bars: Shapes) -> None:
    """Against a dense solve of the same sum of squares, for sides that no shape has."""
    x, faces = small_bars.keyframes[0], small_bars.faces
    solver = Reconstruction(x, faces)
    generator = torch.Generator().manual_seed(0)
    first, second = (torch.randn(3, 1, len(faces), dtype=F64, generator=generator) for _ in range(2))
    found = solver((first, second), x[None])[0]
    equations, targets = [], []
    between = {(0, 1): first, (0, 2): second, (1, 2): second - first}
    for f, face in enumerate(faces.tolist()):
        for (a, b), target in between.items():
            row = torch.zeros(len(x), dtype=F64)
            row[face[b]] += 1
            row[face[a]] -= 1
            side = {(0, 1): 0, (1, 2): 1, (0, 2): 2}[a, b]
            weight = solver.weights[side * len(faces) + f].sqrt()
            equations.append(weight * row)
            targets.append(weight * target[:, 0, f])
    expected = torch.linalg.lstsq(torch.stack(equations), torch.stack(targets), driver="gelsd").solution
    torch.testing.assert_close(found - found.mean(0), expected - expected.mean(0))


def test_weights_are_cotangents_within_bounds(small_bars: Shapes) -> None:
    x, faces = small_bars.keyframes[0], small_bars.faces
    solver = Reconstruction(x, faces)
    angles = trimesh.Trimesh(x.numpy(), faces.numpy(), process=False).face_angles
    across = angles[:, [2, 0, 1]].T.reshape(-1)
    np.testing.assert_allclose(solver.weights, np.clip(0.5 / np.tan(across), 0.02, 20), rtol=1e-9)


def test_a_loose_piece_goes_along_with_its_neighbourhood() -> None:
    """A ball in front of a bending bar keeps its place beside the bar's end, and a stray vertex stays."""
    bar = trimesh.creation.box((4.0, 1, 1))
    bar = bar.subdivide().subdivide().subdivide()
    bar.merge_vertices()
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.2)
    ball.apply_translation([1.9, 0.8, 0])
    both = trimesh.util.concatenate([ball, bar])
    x = torch.tensor(np.concatenate([both.vertices, [[9.0, 9, 9]]]))
    faces = torch.tensor(both.faces)
    angle = 1.2
    radius = 4.0 / angle
    along, up, deep = x[:-1].unbind(1)
    bent = torch.stack(
        [(radius - up) * torch.sin(along / radius), radius - (radius - up) * torch.cos(along / radius), deep], 1
    )
    solver = Reconstruction(x, faces)
    assert [len(piece) for piece, _ in solver.loose] == [len(ball.vertices)]
    target = torch.cat([bent, x[-1:]])
    found = solver(sides(rows(target), faces), x[None])[0]
    assert torch.equal(found[-1], x[-1])
    motion = best_fit(
        found[len(ball.vertices) : -1], bent[len(ball.vertices) :], torch.ones(len(bar.vertices)).double()
    )
    offset = motion.apply(found[:-1]) - bent
    assert float(offset[len(ball.vertices) :].abs().max()) < 1e-9
    # The piece follows a rigid fit of its surroundings: off by their bending, not by the half radian that they turn.
    assert float(offset[: len(ball.vertices)].norm(dim=1).max()) < 0.06


# ------------------------------------------------------------------------------------------------- edges to vertices
def edges_of(x: torch.Tensor, mesh: Connectivity) -> torch.Tensor:
    """Edge vectors. *Shape:* ``(3, B, V) -> (3, B, E)``."""
    start, end = torch.tensor(mesh.edges).T
    return x[..., end] - x[..., start]


@pytest.fixture
def two_pieces(bars: Shapes) -> tuple[Connectivity, torch.Tensor]:
    """Two bars and a vertex of no face, between them: the connectivity, and a batch of three shapes."""
    x, n = bars.keyframes.movedim(-1, 0), bars.keyframes.shape[1]
    faces = torch.cat([bars.faces, bars.faces + n + 1])
    return Connectivity(faces.numpy(), 2 * n + 1), torch.cat([x, x[..., :1], x.roll(1, 1) + 9.0], -1)


def test_mean_edges_of_a_shape_are_its_own(bars: Shapes) -> None:
    mesh, x = Connectivity(bars.faces.numpy()), bars.keyframes.movedim(-1, 0)
    sides_of, signs = torch.tensor(mesh.sides), torch.tensor(mesh.signs)
    weights = torch.rand(3, 3 * len(bars.faces), generator=torch.Generator().manual_seed(0), dtype=F64)
    for given in (weights, weights[0]):
        found = edge_means(sides(x, bars.faces), given, sides_of, signs, len(mesh.edges))
        torch.testing.assert_close(found, edges_of(x, mesh))
    # Of two faces that disagree, the mean by weight.
    mesh = Connectivity(np.array([[0, 1, 2], [1, 0, 3]]))
    wanted = torch.tensor([[1.0, -5.0], [0, 0], [0, 0]]), torch.zeros(3, 2)
    weights = torch.tensor([3.0, 1.0]).repeat(3)
    found = edge_means(wanted, weights, torch.tensor(mesh.sides), torch.tensor(mesh.signs).float(), 5)
    assert found[0, 0].item() == (3 * 1 + 1 * 5) / 4


def test_poisson_gives_shapes_back(two_pieces: tuple[Connectivity, torch.Tensor]) -> None:
    mesh, x = two_pieces
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(len(mesh.edges), generator=generator, dtype=F64) + 0.1
    mass = torch.rand(mesh.n_vertices, generator=generator, dtype=F64)
    near = torch.randn(x.shape, generator=generator, dtype=F64)
    for solver, share in ((Poisson(mesh, weights), torch.ones_like(mass)), (Poisson(mesh, weights, mass), mass)):
        pulls = solver.right_hand_side(edges_of(x, mesh))
        torch.testing.assert_close(solver(pulls, x.movedim(0, -1)), x.movedim(0, -1))
        found = solver(pulls, near.movedim(0, -1)).movedim(-1, 0)
        torch.testing.assert_close(edges_of(found, mesh), edges_of(x, mesh))
        for piece in np.unique(mesh.vertex_pieces):
            own = torch.tensor(mesh.vertex_pieces == piece)
            torch.testing.assert_close(found[..., own] @ share[own], near[..., own] @ share[own])
    lone = mesh.n_vertices // 2
    assert torch.equal(found[..., lone], near[..., lone])  # bit for bit


@pytest.mark.parametrize("has_cholespy", [True, False])
def test_sparse_solver(has_cholespy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a dense inverse: more columns than are solved at once, some unknowns only, with gradients, pickled."""
    if not has_cholespy:  # there is no wheel for every machine
        monkeypatch.setattr(sparse_systems, "cholespy", None)
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(12, 12, generator=generator, dtype=F64)
    dense = root @ root.T + torch.eye(12, dtype=F64)
    right = torch.randn(2, 20, 12, 3, generator=generator, dtype=F64)
    for free in (None, np.array([0, 2, 3, 7, 11])):
        solver = SparseSolver(sparse.csr_matrix(dense.numpy()), free)
        inverse = torch.zeros_like(dense)
        rows = torch.arange(12) if free is None else torch.from_numpy(free)
        inverse[rows[:, None], rows] = torch.linalg.inv(dense[rows][:, rows])
        torch.testing.assert_close(solver(right), inverse @ right, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(pickle.loads(pickle.dumps(solver))(right[0, 0]), solver(right)[0, 0])
        assert solver(right.float()).dtype == torch.float32
        assert solver(right[:0]).shape == (0, 20, 12, 3)
        assert torch.autograd.gradcheck(partial(solve_by, solver), right[0, :2].clone().requires_grad_())
    assert torch.equal(SparseSolver(sparse.eye(12), np.empty(0, dtype=np.int64))(right), torch.zeros_like(right))


def test_linear_maps_have_all_derivatives() -> None:
    """Of maps without any: against the same matrix, that torch differentiates."""
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(3, 5, generator=generator, dtype=F64)
    x, towards = torch.randn(2, 2, 5, 2, generator=generator, dtype=F64)

    def by_numpy(own: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(own.numpy() @ x.numpy())

    def linear(x: torch.Tensor) -> torch.Tensor:
        return linear_map(partial(by_numpy, matrix), partial(by_numpy, matrix.T), x)

    def known(x: torch.Tensor) -> torch.Tensor:
        return matrix @ x

    leaf = x.clone().requires_grad_()
    assert torch.autograd.gradcheck(linear, leaf) and torch.autograd.gradgradcheck(linear, leaf)
    found, expected = (torch.func.jvp(f, (x,), (towards,))[1] for f in (linear, known))
    torch.testing.assert_close(found, expected)

    def curved(f: Callable[[torch.Tensor], torch.Tensor], x: torch.Tensor) -> torch.Tensor:
        return f(f(x).sin().mean() * x).cos().sum()

    for outer in (torch.func.jacrev, torch.func.jacfwd):
        for inner in (torch.func.grad, torch.func.jacrev):
            found, expected = (torch.vmap(outer(inner(partial(curved, f))))(x) for f in (linear, known))
            torch.testing.assert_close(found, expected)


def test_sparse_solver_refuses_an_indefinite_matrix() -> None:
    pytest.importorskip("cholespy")
    with pytest.raises(ValueError, match="not positive definite"):
        SparseSolver(sparse.diags([1.0, -1.0, 1.0]))(torch.ones(3, 1, dtype=F64))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU with CUDA")
def test_sparse_solver_on_a_gpu() -> None:
    mesh = Connectivity(trimesh.creation.icosphere(4).faces)
    laplacian = graph_laplacian(mesh.edges, np.ones(len(mesh.edges)), mesh.n_vertices)
    solver = SparseSolver(laplacian, np.arange(1, mesh.n_vertices))
    right = torch.randn(70, mesh.n_vertices, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    truth = solver(right)
    with torch.cuda.stream(torch.cuda.Stream()):
        found = solver(right.cuda()).cpu()  # on this stream: another would not wait for it
    torch.testing.assert_close(found, truth, rtol=1e-9, atol=1e-9)
