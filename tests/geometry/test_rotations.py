"""Where the minimisation starts: edges of triangles that turn part of the way."""

import math
import warnings

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.sheets import cylinder as cylinder_of
from helpers.sheets import rectangle, rolled
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.elastic.backend import TorchBackend, choose
from torch_modal.elastic.rotations import WarpRotations
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.poisson import Poisson
from torch_modal.geometry.rigid import best_rotation
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.triangle_frames import frames_of
from torch_modal.inbetween.blend import RotationBlend
from torch_modal.motion.spline import Spline

T = torch.tensor([0.0, 0.3, 0.5, 1.0], dtype=torch.float64)
TURNS = 3


def ribbon(turn: float, n: int = 13) -> tuple[Tensor, Tensor]:
    """Rigid plates, each turned against the last one about the edge between them: the last by ``turn`` in all."""
    angles = torch.linspace(0, turn, n, dtype=torch.float64)
    steps = torch.stack([angles.cos(), torch.zeros_like(angles), angles.sin()], -1)
    spine = torch.cat([torch.zeros(1, 3, dtype=torch.float64), steps.cumsum(0)])
    x = torch.cat([spine, spine + torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)])
    i = torch.arange(n)
    m = n + 1
    faces = torch.cat([torch.stack([i, i + 1, i + m], -1), torch.stack([i + 1, i + 1 + m, i + m], -1)])
    return x, faces


def strip(turns: float, time: float = 1.0) -> Tensor:
    """An irregular strip of 156 vertices, rolled up, and bent a little across, so that no axis is that of another."""
    x = cylinder_of(rectangle(6.0, 1.0, 0.25)[0], time, lambda s: rolled(s, 6.0, turns), math.radians(80))
    return torch.from_numpy(x)


def rotations_of(first: Tensor, second: Tensor, faces: Tensor) -> tuple[LocalRotations, Connectivity]:
    mesh = Connectivity(faces.numpy())
    return LocalRotations(mesh, torch.stack([first, second])), mesh


def pair(first: Tensor, second: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Two shapes of each sample, and their weights."""
    return torch.stack([first, second], 1), torch.stack([1 - t, t], -1)


def blended(blend: RotationBlend, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
    return blend(*pair(first, second, t), torch.lerp(first, second, t[:, None, None]))


def edges(x: Tensor, mesh: Connectivity) -> Tensor:
    start, end = torch.tensor(mesh.edges).T
    return x[..., end, :] - x[..., start, :]


@pytest.mark.parametrize("degrees", [0, 90, 170, 250, 340, -792, 432, 1080])
def test_plates_turn_at_constant_speed(degrees: int) -> None:
    """Also where a plate alone would take the other way round; beyond a turn, up to the rotation of the whole."""
    turn, n = math.radians(degrees), 13 if abs(degrees) < 360 else 60
    (x_a, faces), (x_b, _) = ribbon(0.0, n), ribbon(turn, n)
    rotations, mesh = rotations_of(x_a, x_b, faces)
    found = rotations(*pair(x_a.expand(len(T), -1, -1), x_b.expand(len(T), -1, -1), T)).movedim(0, -1)
    for t, row in zip(T, found, strict=True):
        wanted = edges(ribbon(float(t) * turn, n)[0], mesh)
        row = row if n == 13 else row @ best_rotation(wanted.mT @ row).mT
        torch.testing.assert_close(row, wanted, rtol=0, atol=1e-11)
    torch.testing.assert_close(found[-1], edges(x_b, mesh), rtol=0, atol=1e-12)
    if n == 13:
        half_scale = rotations(*pair(x_a[None], 2 * x_b[None], T[2:3]))[:, 0].mT
        torch.testing.assert_close(half_scale, 1.5 * edges(ribbon(0.5 * turn)[0], mesh), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", [LocalRotations, WarpRotations])
@pytest.mark.parametrize(
    ("degrees", "weights", "wanted"),
    [((170, 190, 200), (0.3, 0.5, 0.2), 186), ((-80, 60, 120), (0.1, 0.45, 0.45), 73)],
)
def test_shapes_that_turn_alike_keep_together_half_a_turn_from_the_reference(
    kind: type[LocalRotations], degrees: tuple[float, ...], weights: tuple[float, ...], wanted: float
) -> None:
    """190 and 200 degrees are -170 and -160; the first may be far from one of the others. A second piece is at rest."""
    x, faces = ribbon(0.0)
    mesh = Connectivity(torch.cat([faces, faces + len(x)]).numpy())

    def shape(angle: float) -> Tensor:
        return torch.cat([x @ exp(math.radians(angle) * torch.tensor([0.0, 0.6, 0.8]).double()).mT, x])

    rotations = kind(mesh, shape(0).expand(2, -1, -1))
    shapes = torch.stack([shape(each) for each in degrees])
    found = rotations(shapes[None], torch.tensor([weights], dtype=torch.float64))[:, 0].mT
    torch.testing.assert_close(found, edges(shape(wanted), mesh), rtol=0, atol=1e-12)


@pytest.mark.parametrize("fused", [False, True])
def test_most_of_the_area_of_a_piece_says_which_way_it_turns(fused: bool) -> None:
    """Many small plates turn by more than half a turn, few large ones by less. A tree has its root at either end."""
    if fused:
        pytest.importorskip("warp")
    angles = torch.tensor([*range(300, 190, -10), 160, 120, 80, 40, 0], dtype=torch.float64).deg2rad()
    lengths = torch.tensor([1.0] * 11 + [10.0] * 5, dtype=torch.float64)

    def rolled(part: float, backwards: bool) -> Tensor:
        own, long = (x.flip(0) if backwards else x for x in (part * angles, lengths))
        spine = torch.stack([long * own.cos(), 0 * own, long * own.sin()], -1).cumsum(0)
        spine = torch.cat([torch.zeros_like(spine[:1]), spine])
        return torch.cat([spine, spine + torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)])

    n_vertices, faces = 2 * len(angles) + 2, ribbon(0.0, len(angles))[1]
    first, second = (torch.cat([rolled(part, False), rolled(part, True)]) for part in (0.0, 1.0))
    kind = WarpRotations if fused else LocalRotations
    mesh = Connectivity(torch.cat([faces, faces + n_vertices]).numpy())
    rotations = kind(mesh, torch.stack([first, second]))
    wanted = torch.cat([angles, angles, angles.flip(0), angles.flip(0)])
    roots = wanted[rotations.ancestors[0] == torch.arange(len(wanted))]
    assert len(roots) == 2 and float(roots.min()) < math.pi < float(roots.max())
    found = rotations.quaternions(*(frames_of(x[None], rotations.faces) for x in (first, second)))[0, 0]
    torch.testing.assert_close(found, (0.5 * wanted).cos(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("kind", [LocalRotations, WarpRotations])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_triangles_without_area_are_survived(kind: type[LocalRotations], dtype: torch.dtype) -> None:
    (x_a, faces), (x_b, _) = ribbon(0.0), ribbon(2.0)
    x_a[3], x_b[5] = x_a[4], 0.5 * (x_b[4] + x_b[6])
    x_a[:2], x_a[14] = x_a[2], x_a[2]  # one triangle is a point
    x_a, x_b = x_a.to(dtype), x_b.to(dtype)
    mesh = Connectivity(faces.numpy())
    rotations = kind(mesh, torch.stack([x_a, x_b]))
    given = [x.requires_grad_() for x in (x_a[None], x_b[None], torch.tensor([0.5], dtype=dtype))]
    found = rotations.right_hand_side(*pair(*given), Poisson(mesh, torch.ones(len(mesh.edges), dtype=dtype)))
    assert found.isfinite().all()
    for gradient in torch.autograd.grad(found.square().sum(), given):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("kind", ["torch", "warp"])
@pytest.mark.parametrize("name", ["hand", "creature"])
def test_the_corner_that_faces_begin_with_changes_nothing(name: str, kind: str, generator: torch.Generator) -> None:
    """Between two shapes, among three, and along a motion."""
    sample = load_sample(name)
    x, faces = torch.cat([sample.keyframes, sample.truth])[:3].contiguous(), sample.faces
    first = torch.randint(3, (len(faces), 1), generator=generator)
    half, times, backend = T[2:3], torch.arange(3, dtype=torch.float64), choose(kind)
    shapes = []
    for corners in (faces, faces.gather(1, (first + torch.arange(3)) % 3)):
        mesh = Connectivity(corners.numpy())
        blend, spline = RotationBlend(mesh, x, backend), Spline(mesh, x, times, None, backend)
        place = spline.knots(x[None]), 1, torch.tensor([0]), half
        bent = spline(*place, spline.straight(*place)) / spline.alignment.scale
        mean = blend(x[None], torch.tensor([[0.5, 0.2, 0.3]], dtype=torch.float64), x[:1])
        shapes.append(torch.cat([blended(blend, x[:1], x[1:2], half), mean, bent]))
    size = (x[0].amax(0) - x[0].amin(0)).norm()
    assert float((shapes[0] - shapes[1]).norm(dim=-1).max() / size) < 1e-12


@pytest.mark.parametrize("degrees", [0, 120, 300])
def test_blend_is_the_shape_of_these_edges(degrees: int) -> None:
    """Two ribbons that touch in nothing but a vertex, one apart, and a vertex of no face: each at its place."""
    turn = math.radians(degrees)
    x_a, faces = ribbon(0.0)
    first, second, halfway = (
        torch.cat([ribbon(s * turn)[0], ribbon(s * -turn)[0] + torch.tensor([0, 0, 40 * s]), torch.full((1, 3), s)])
        for s in (0.0, 1.0, 0.5)
    )
    faces = torch.cat([faces, faces + len(x_a)])
    mesh = Connectivity(faces.numpy(), len(first))
    blend = RotationBlend(mesh, torch.stack([first, second]), TorchBackend())
    found = blended(blend, first[None], second[None], T[2:3])[0]
    torch.testing.assert_close(edges(found, mesh), edges(halfway, mesh), rtol=0, atol=1e-9)
    for piece in (slice(0, len(x_a)), slice(len(x_a), -1), slice(-1, None)):
        centre = 0.5 * (first + second)[piece].mean(0)
        torch.testing.assert_close(found[piece].mean(0), centre, rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["torch", "warp"])
def test_intervals_share_rotations_where_no_tree_would_tell_another_sense(
    kind: str, small_bars: Shapes, generator: torch.Generator
) -> None:
    if kind == "warp":
        pytest.importorskip("warp")
    # Torn to pieces: neighbours turn any way, so that it matters which of them are compared.
    x = small_bars.keyframes
    torn = x[:1] + 0.5 * torch.randn(x[:1].shape, dtype=x.dtype, generator=generator)
    mesh, shapes = Connectivity(small_bars.faces.numpy()), torch.cat([x, torn])
    shared, also, own = Spline(mesh, shapes, torch.arange(4.0).double(), None, choose(kind)).rotations
    assert also is shared and own is not shared
    assert torch.equal(own.ancestors, LocalRotations(mesh, shapes[2:]).ancestors)
    assert not torch.equal(own.ancestors, shared.ancestors)


def test_a_tree_of_another_pair_tells_the_way_round() -> None:
    (x, faces), half, whole = ribbon(0.0), ribbon(math.radians(130))[0], ribbon(math.radians(300))[0]
    mesh = Connectivity(faces.numpy())
    blend = RotationBlend(mesh, torch.stack([x, half, whole]), TorchBackend())
    found = blended(blend, x[None], whole[None], T[2:3])[0]
    torch.testing.assert_close(edges(found, mesh), edges(ribbon(math.radians(150))[0], mesh), rtol=0, atol=1e-9)


def test_pieces_that_share_a_vertex_stay_together() -> None:
    (x, faces), other = ribbon(0.0), ribbon(1.0)[0]
    joined = torch.cat([faces, torch.where(faces == 0, 0, faces + len(x) - 1)])
    first = torch.cat([x, x[1:] * torch.tensor([-1.0, 1.0, 1.0])])
    second = torch.cat([other, other[1:] * torch.tensor([-1.0, 1.0, 1.0])])
    mesh = Connectivity(joined.numpy())
    blend = RotationBlend(mesh, torch.stack([first, second]), TorchBackend())
    half = ribbon(0.5)[0]
    wanted = torch.cat([half, half[1:] * torch.tensor([-1.0, 1.0, 1.0])])
    torch.testing.assert_close(
        edges(blended(blend, first[None], second[None], T[2:3])[0], mesh), edges(wanted, mesh), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("degrees", [0, 1e-7, 1, 120, 300])
def test_derivatives_of_local_rotations_where_little_turns(degrees: float, generator: torch.Generator) -> None:
    """Where nothing turns, too: most of a shape does not."""
    (x_a, faces), (x_b, _) = ribbon(0.0, 5), ribbon(math.radians(degrees), 5)
    roughness = 0.0 if degrees == 0 else 0.01
    x_b = x_b + roughness * torch.randn(x_b.shape, generator=generator, dtype=torch.float64)
    rotations, _ = rotations_of(x_a, x_b, faces)

    def run(*given: Tensor) -> Tensor:
        return rotations(*pair(*given))

    inputs = tuple(x.clone().requires_grad_() for x in (x_a[None], x_b[None], T[1:2]))
    assert torch.autograd.gradcheck(run, inputs, eps=1e-6, atol=1e-7, rtol=1e-6)
    assert torch.autograd.gradgradcheck(run, inputs, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


# --------------------------------------------------------------------------------------------- beyond a full turn


@pytest.fixture(scope="module")
def strip_mesh() -> Connectivity:
    return Connectivity(rectangle(6.0, 1.0, 0.25)[1])


@pytest.mark.parametrize("turns, torn", [(0, False), (1, True)])
def test_a_ring_twisted_by_a_full_turn_is_told(turns: int, torn: bool) -> None:
    """The rotations of its triangles have no signs that agree all around it."""

    def ring(turns: int, n: int = 40, m: int = 12) -> tuple[Tensor, np.ndarray]:
        i, j = (x.flatten() for x in np.meshgrid(np.arange(n), np.arange(m), indexing="ij"))
        u, v = 2 * np.pi * i / n, 2 * np.pi * j / m
        r = 1 + 0.3 * np.cos(2 * v)
        out, up = 5 + r * np.cos(v + turns * u), r * np.sin(v + turns * u)
        a, b, c, d = (x % n * m + y % m for x, y in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
        x = np.stack([out * np.cos(u), out * np.sin(u), up], -1)
        return torch.from_numpy(x), np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])

    start, faces = ring(0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        LocalRotations(Connectivity(faces), torch.stack([start, start + 1, ring(turns)[0]]))
    assert [w.category for w in caught] == [tm.MeshWarning] * torn
    assert not torn or "turn by a full turn" in str(caught[0].message)


def test_the_pose_of_a_key_frame_does_not_matter(strip_mesh: Connectivity) -> None:
    """Neither for whether there are clusters nor for the shape in between."""
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
    turn = turn * torch.linalg.det(turn)
    half = T[2:3]
    lengths = []
    for second in (strip(TURNS), strip(TURNS) @ turn):
        rotations = LocalRotations(strip_mesh, torch.stack([strip(0), second]))
        lengths.append(rotations(*pair(strip(0)[None], second[None], half)).norm(dim=0))
    torch.testing.assert_close(*lengths, rtol=1e-11, atol=0)
    assert LocalRotations(strip_mesh, torch.stack([strip(0), strip(0.9) @ turn])).beyond_a_turn is False


@pytest.mark.parametrize("kind", [LocalRotations, WarpRotations])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_roll_keeps_its_lengths(strip_mesh: Connectivity, kind: type[LocalRotations], dtype: torch.dtype) -> None:
    """At all times of a batch, as alone; below 2 % at eight edges a turn."""
    rotations = kind(strip_mesh, torch.stack([strip(0), strip(TURNS)])).to(dtype)
    x_a, x_b, t = strip(0).to(dtype), strip(TURNS).to(dtype), T.to(dtype)
    found = rotations(*pair(x_a.expand(4, -1, -1), x_b.expand(4, -1, -1), t))
    assert found.dtype == dtype
    for k, time in enumerate(t):
        wanted = edges(strip(TURNS, float(time)), strip_mesh).norm(dim=-1)
        assert ((found[:, k].norm(dim=0) - wanted).abs() / wanted).mean() < 0.02
        torch.testing.assert_close(rotations(*pair(x_a[None], x_b[None], t[k : k + 1]))[:, 0], found[:, k])
    mapped = torch.vmap(lambda t: rotations(*pair(x_a[None], x_b[None], t[None]))[:, 0], out_dims=1)(t)
    torch.testing.assert_close(mapped, found)


@pytest.mark.parametrize("kind", [LocalRotations, WarpRotations])
def test_gradients_of_local_rotations_beyond_a_full_turn(strip_mesh: Connectivity, kind: type[LocalRotations]) -> None:
    """Away from where triangles turn by whole turns exactly, and there."""
    rotations = kind(strip_mesh, torch.stack([strip(0), strip(TURNS)]))
    noise = 0.01 * torch.randn(2, len(strip(0)), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x_a, x_b = strip(0) + noise[0], strip(TURNS) + noise[1]
    given = [value.clone().requires_grad_() for value in (x_a[None], x_b[None], T[1:2])]
    assert torch.autograd.gradcheck(lambda *given: rotations(*pair(*given)), given, fast_mode=True)


def test_intervals_of_a_motion_have_clusters_of_their_own(strip_mesh: Connectivity) -> None:
    shapes, times = torch.stack([strip(0), strip(0.5), strip(TURNS)]), torch.arange(3).double()
    for order, wanted in (([0, 1, 2], [False, True]), ([2, 0, 1], [True, False])):
        spline = Spline(strip_mesh, shapes[order], times, None, TorchBackend())
        assert [rotations.beyond_a_turn for rotations in spline.rotations] == wanted
