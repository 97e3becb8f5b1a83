"""Points that follow a shape: rigid motions, the surface, fingers, gradients, dtypes, errors."""

import numpy as np
import pytest
import torch
import trimesh
from conftest import Shapes
from helpers.bodies import sheet_surface
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.closest import ClosestFaces, closest_on_triangles
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.rotations import exp
from torch_modal.passengers import binding as bound

DOUBLE = torch.float64
TURN = exp(torch.tensor([0.4, -1.1, 2.3], dtype=DOUBLE))


def around(x: Tensor, faces: Tensor, n: int, off: float) -> Tensor:
    """Points near a surface. *Shape:* ``(n, 3)``."""
    mesh = trimesh.Trimesh(x.numpy(), faces.numpy(), process=False)
    found = torch.from_numpy(trimesh.sample.sample_surface(mesh, n, seed=0)[0].copy())
    size = float((x.amax(0) - x.amin(0)).norm())
    return found + off * size * torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)


@pytest.mark.parametrize("name", ["hand", "creature"])
def test_rigid_motions_are_followed_exactly(name: str) -> None:
    sample = load_sample(name)
    x = sample.keyframes[0]
    points = around(x, sample.faces, 5000, 0.02)
    passengers = tm.Passengers(x, sample.faces, points)
    torch.testing.assert_close(passengers(x), points, rtol=0, atol=1e-12)
    moved = x @ TURN.mT + 3
    torch.testing.assert_close(passengers(moved), points @ TURN.mT + 3, rtol=0, atol=1e-12)
    for found in (passengers.rotations(moved), passengers.gradients(moved)):
        torch.testing.assert_close(found, TURN.expand(5000, 3, 3), rtol=0, atol=1e-12)
    turned = passengers.rotations(sample.keyframes[1])
    torch.testing.assert_close(turned @ turned.mT, torch.eye(3).double().expand(5000, 3, 3), rtol=0, atol=1e-9)
    torch.testing.assert_close(torch.linalg.det(turned), torch.ones(5000, dtype=DOUBLE))


def test_points_of_the_surface_stay_near_it(bars: Shapes) -> None:
    x, y = bars.keyframes[:2]
    weights = torch.rand(len(bars.faces), 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    weights = weights / weights.sum(1, keepdim=True)
    passengers = tm.Passengers(x, bars.faces, torch.einsum("fi,fic->fc", weights, x[bars.faces]))
    found = passengers(y)
    off = (found - torch.einsum("fi,fic->fc", weights, y[bars.faces])).norm(dim=1)
    edges = (y[bars.faces[:, 0]] - y[bars.faces[:, 1]]).norm(dim=1)
    # Rounder than the facets, but for corners of triangles: here by less than a tenth of an edge.
    assert float(off.max()) < 0.1 * float(edges.mean())
    corners = tm.Passengers(x, bars.faces, x)
    torch.testing.assert_close(corners(y), y, rtol=0, atol=1e-12)


def test_middles_of_triangles_stay_on_the_surface() -> None:
    """Of a coarse strip that is rolled up, whose corners turn apart: within 1 % of the diagonal."""
    along, across = torch.meshgrid(torch.arange(7.0), torch.arange(3.0), indexing="ij")
    x = torch.stack([along, across, 0 * along], -1).view(-1, 3).double()
    i = (3 * torch.arange(6)[:, None] + torch.arange(2)).view(-1, 1)
    faces = torch.cat([i + torch.tensor([0, 3, 1]), i + torch.tensor([1, 3, 4])])
    y = torch.stack([(1.2 * x[:, 0]).sin(), x[:, 1], 1 - (1.2 * x[:, 0]).cos()], 1)
    passengers = tm.Passengers(x, faces, x[faces].mean(1))
    off = (passengers(y) - y[faces].mean(1)).norm(dim=1) / (x.amax(0) - x.amin(0)).norm()
    assert 1e-3 < float(off.max()) < 1e-2


def test_closest_faces_are_exact() -> None:
    """Against all triangles, long ones among them, for points near and far."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.randn(300, 3, 3, generator=generator, dtype=DOUBLE)
    corners[:200] = corners[:200, :1] + 0.05 * corners[:200]
    points = torch.randn(500, 3, generator=generator, dtype=DOUBLE) * torch.logspace(-2, 1, 500, dtype=DOUBLE)[:, None]
    for n in (1, 2, 3, 7, 300):
        faces = np.arange(3 * n).reshape(n, 3)
        found = ClosestFaces(corners.view(-1, 3).numpy(), faces)(points.numpy())
        distances = closest_on_triangles(points[:, None].numpy(), corners[None, :n].numpy())[1]
        np.testing.assert_array_equal(distances[np.arange(500), found], distances.min(1))


def test_neighbours_stay_neighbours() -> None:
    """Points that are close to each other and to one part of the surface do not tear apart."""
    sample = load_sample("hand")
    x, y = sample.keyframes[:2]
    points = around(x, sample.faces, 4000, 0.003)
    step = 1e-5 * torch.randn(4000, 3, generator=torch.Generator().manual_seed(1), dtype=DOUBLE)
    one, other = (tm.Passengers(x, sample.faces, p)(y) for p in (points, points + step))
    stretch = (one - other).norm(dim=1) / step.norm(dim=1)
    assert float(stretch.median()) < 1.5 and float(stretch.quantile(0.995)) < 6


def test_fingers_keep_their_points() -> None:
    """What a point follows lies around one place of the surface, though fingers touch."""
    sample = load_sample("hand")
    x = sample.keyframes[1]
    passengers = tm.Passengers(x, sample.faces, around(x, sample.faces, 4000, 0.02))
    i, j = torch.tensor(Connectivity(sample.faces.numpy()).edges).unbind(1)
    lengths = (x[i] - x[j]).norm(dim=1).numpy()
    graph = coo_matrix((lengths, (i.numpy(), j.numpy())), shape=(len(x), len(x)))
    graph = graph + graph.T
    reach = 6 * float(lengths.max())
    for row in passengers.weights:
        assert dijkstra(graph, indices=row.indices[0], limit=reach)[row.indices].max() < reach


def test_anchors_decide_between_parts() -> None:
    """Two sheets on each other: points in the middle follow the one that they are said to belong to."""
    sheet, faces = map(torch.from_numpy, sheet_surface((4, 4), (1, 1)))
    upper = torch.tensor([0.0, 0.1, 0.0])
    x, both = torch.cat([sheet, sheet + upper]), torch.cat([faces, faces + 25])
    y = torch.cat([sheet, sheet + upper + 1])
    points = sheet[[6, 12]] + 0.4 * upper
    assert float((tm.Passengers(x, both, points)(y) - points).abs().max()) < 1e-12
    anchored = tm.Passengers(x, both, points, torch.tensor([25 + 6, -1]))(y)
    torch.testing.assert_close(anchored, points + torch.tensor([[1.0], [0.0]]))


def test_float32_far_from_the_origin(bars: Shapes) -> None:
    x, y = bars.keyframes[:2]
    points = around(x, bars.faces, 300, 0.02)
    passengers = tm.Passengers((x + 100).float(), bars.faces, (points + 100).float())
    expected = tm.Passengers(x, bars.faces, points)(y)
    found = passengers((y + 100).float())
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double() - 100, expected, rtol=0, atol=1e-4)
    with pytest.raises(ValueError, match=r"passengers\.to\(shapes\.dtype\)"):
        passengers(y)


def test_broken_shapes_stay_alone(bars: Shapes) -> None:
    x = bars.keyframes[0]
    passengers = tm.Passengers(x, bars.faces, around(x, bars.faces, 50, 0.02))
    broken = bars.keyframes.clone()
    broken[1, 3, 0] = torch.nan
    for function in (passengers, passengers.rotations, passengers.gradients):
        found = function(broken)
        assert bool(found[1].isnan().all())
        torch.testing.assert_close(found[[0, 2]], function(bars.keyframes)[[0, 2]])


@pytest.mark.parametrize(
    "change, words",
    [
        ({"points": torch.zeros(4, 2)}, r"points must be floating-point of shape \(n, 3\)"),
        ({"points": torch.full((4, 3), torch.nan)}, "points has entries that are not finite"),
        ({"faces": torch.tensor([[0, 1, -2]])}, "1 faces use vertices that do not exist"),
        ({"anchors": torch.tensor([0])}, "anchors hold a vertex"),
        ({"anchors": torch.tensor([0, 1, -1, -2])}, "anchors hold a vertex"),
        ({"reference": torch.ones(164, 3)}, "no face of the reference has an area"),
    ],
)
def test_arguments_that_passengers_refuse(bars: Shapes, change: dict[str, Tensor], words: str) -> None:
    given = {"reference": bars.keyframes[0], "faces": bars.faces, "points": torch.zeros(4, 3)} | change
    with pytest.raises(ValueError, match=words):
        tm.Passengers(**given)


def test_closest_points_on_triangles() -> None:
    """Against trimesh; triangles that are lines too."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.randn(500, 3, 3, generator=generator, dtype=DOUBLE)
    corners[-20:, 2] = 0.5 * (corners[-20:, 0] + corners[-20:, 1])
    points = 2 * torch.randn(500, 3, generator=generator, dtype=DOUBLE)
    weights, distances = closest_on_triangles(points.numpy(), corners.numpy())
    assert weights.min() >= 0 and abs(weights.sum(1) - 1).max() < 1e-12
    expected = torch.from_numpy(trimesh.triangles.closest_point(corners[:480].numpy(), points[:480].numpy()))
    found = torch.einsum("ni,nic->nc", torch.from_numpy(weights), corners)
    torch.testing.assert_close(found[:480], expected, rtol=0, atol=1e-9)
    torch.testing.assert_close((found - points).norm(dim=1), torch.from_numpy(distances))
    ends = torch.minimum(*((points[480:] - corners[480:, k]).norm(dim=1) for k in (0, 1)))
    assert bool((torch.from_numpy(distances[480:]) <= ends + 1e-12).all())


def test_all_sides_of_a_pit_are_followed_alike() -> None:
    """A point on the axis is equally near to all eight."""
    angle = torch.arange(8, dtype=DOUBLE) * torch.pi / 4
    rim = torch.stack([angle.cos(), angle.sin(), torch.ones_like(angle)], 1)
    i = torch.arange(8)
    faces = torch.stack([torch.full_like(i, 8), i, (i + 1) % 8], 1)
    x = torch.cat([rim, torch.zeros(1, 3, dtype=DOUBLE)])
    weights = tm.Passengers(x, faces, torch.tensor([[0.0, 0.0, 0.8]], dtype=DOUBLE)).weights.toarray()[0]
    np.testing.assert_allclose(weights[:8], weights[0], rtol=1e-9)
    assert weights[0] > 0.01


def test_many_points_are_bound_in_parts(bars: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    x, points = bars.keyframes[0], around(bars.keyframes[0], bars.faces, 50, 0.02)
    anchors = torch.randint(-1, len(x), (50,), generator=torch.Generator().manual_seed(0))
    whole = tm.Passengers(x, bars.faces, points, anchors).weights.toarray()
    monkeypatch.setattr(bound, "POINTS_AT_ONCE", 7)
    np.testing.assert_array_equal(tm.Passengers(x, bars.faces, points, anchors).weights.toarray(), whole)


def test_triangles_without_area_have_no_say(bars: Shapes) -> None:
    x = bars.keyframes[0].clone()
    x[bars.faces[40, 1]] = x[bars.faces[40, 0]]
    points = around(x, bars.faces, 100, 0.02)
    passengers = tm.Passengers(x, bars.faces, points)
    torch.testing.assert_close(passengers(x @ TURN.mT + 3), points @ TURN.mT + 3, rtol=0, atol=1e-12)


def test_a_triangle_cut_in_two_has_the_same_say() -> None:
    """A vertex turns as the surface around it, however that is cut into triangles."""
    x = torch.tensor([[0, 0, 0], [2, 0, 0], [0, 2, 0], [-2, -1, 0], [1, 1, 0]], dtype=DOUBLE)
    y = x + torch.tensor([[0, 0, 0], [0, 0, 0.5], [0, 0, -0.2], [0, 0.3, 0.4], [0, 0, 0.15]], dtype=DOUBLE)
    whole, cut = [[0, 1, 2], [0, 2, 3], [0, 3, 1]], [[0, 1, 4], [0, 4, 2], [0, 2, 3], [0, 3, 1]]
    one, other = (
        tm.Passengers(x[:n], torch.tensor(faces), x[:1]).gradients(y[:n]) for n, faces in ((4, whole), (5, cut))
    )
    torch.testing.assert_close(one, other)


@pytest.mark.parametrize("along", [0.0, 0.3, 0.55])
def test_the_other_side_of_a_groove_fades_out(along: float) -> None:
    """Two walls at a right angle: that at twice the distance of the nearer one has no influence any more."""
    floor, one = map(torch.from_numpy, sheet_surface((4, 4), (4, 4)))
    vertices, number = torch.cat([floor, floor[:, [1, 0, 2]]]).unique(dim=0, return_inverse=True)
    height = 0.5
    point = torch.tensor([[height * (1 + 2 * along), height, 0.1]], dtype=DOUBLE)
    weights = tm.Passengers(vertices, number[torch.cat([one, one + 25])], point).weights.toarray()[0]
    share = float(weights[(vertices[:, 1] > 0).numpy()].sum())
    assert (share > 0) == (along < 0.5) and share < 0.51
