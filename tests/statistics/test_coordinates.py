"""Rotations and strains of triangles as coordinates, and principal components in them."""

import dataclasses

import pytest
import torch
from conftest import Shapes
from helpers.shapes import edge_lengths

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.rotations import exp
from torch_modal.statistics.components import Components
from torch_modal.statistics.coordinates import BendingCoordinates
from torch_modal.statistics.variation import Variation


def far(x: torch.Tensor, y: torch.Tensor) -> float:
    """Largest distance after the best rigid motion, over the diagonal."""
    return float((tm.align(x, y) - y).norm(dim=-1).max() / (y.amax(0) - y.amin(0)).norm())


@pytest.mark.parametrize("name", ["hand", "creature"])
def test_shapes_have_coordinates_that_give_them_back(name: str) -> None:
    sample = load_sample(name)
    coordinates = BendingCoordinates(sample.keyframes[0], sample.faces)
    turn = exp(torch.tensor([0.4, -1.1, 0.3], dtype=torch.float64))
    found = coordinates.of(sample.keyframes @ turn.mT + 3)
    torch.testing.assert_close(found[0], torch.zeros_like(found[0]), rtol=0, atol=1e-9)
    assert max(far(x, y) for x, y in zip(coordinates.shapes(found), sample.keyframes, strict=True)) < 1e-10


def with_second_piece(shapes: torch.Tensor, faces: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A tetrahedron that circles and turns next to each shape, and three vertices of no face."""
    corners = 0.2 * torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=shapes.dtype)
    first = shapes.shape[1]
    more = []
    unused = corners[:3] + torch.tensor([0.0, 3.0, 0.0])
    for k in range(len(shapes)):
        turn = exp(torch.tensor([0.3, 0.8, -0.4], dtype=shapes.dtype) * k)
        piece = (corners + torch.tensor([1.5, 0.0, 2.0], dtype=shapes.dtype)) @ turn.mT
        more.append(torch.cat([piece, unused]))
    own = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]) + first
    return torch.cat([shapes, torch.stack(more)], 1), torch.cat([faces, own])


def test_second_pieces_and_vertices_of_no_face(bars: Shapes) -> None:
    shapes, faces = with_second_piece(bars.keyframes, bars.faces)
    variation = Variation(shapes + 100, faces)
    components = Components(variation, 2)
    back, used = components.shapes(components.coordinates(shapes)), faces.unique()
    assert max(far(x[used], y[used]) for x, y in zip(back, shapes, strict=True)) < 1e-9
    assert components.coordinates(shapes[:0]).shape == (0, 2) and components.shapes(torch.zeros(0, 2)).shape[0] == 0


def test_collapsed_triangles_turn_with_their_neighbours(bars: Shapes) -> None:
    corners = bars.faces[40]
    for places in ([1], [0, 1, 2]):  # in one shape, and in all
        shapes = bars.keyframes.clone()
        shapes[places, corners[1]] = shapes[places, corners[0]]
        coordinates = BendingCoordinates(shapes[0], bars.faces)
        found = coordinates.of(shapes)
        assert bool(found.isfinite().all())
        assert max(far(x, y) for x, y in zip(coordinates.shapes(found), shapes, strict=True)) < 0.02


def test_large_stretches_are_kept(bars: Shapes) -> None:
    x = bars.keyframes[0]
    coordinates = BendingCoordinates(x, bars.faces)
    found = coordinates.of(5 * x[None])
    assert far(coordinates.shapes(found)[0], 5 * x) < 1e-9


class TestComponents:
    def test_all_of_them_span_the_keyframes(self, bars: Shapes) -> None:
        components = tm.ShapeSpace(bars.bases, bars.faces).components()
        found = components.coordinates(bars.keyframes)
        assert found.shape == (3, 2)
        back = components.shapes(found)
        torch.testing.assert_close(components.shapes(found, like=bars.keyframes), tm.align(back, bars.keyframes))
        torch.testing.assert_close(components.shapes(found[0], bars.keyframes[0]), tm.align(back[0], bars.keyframes[0]))
        assert max(far(x, y) for x, y in zip(back, bars.keyframes, strict=True)) < 1e-9
        torch.testing.assert_close(found.var(0), components.variances)
        assert float(components.shares.sum()) == pytest.approx(1)
        torch.testing.assert_close(found.mean(0), torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-9)

    def test_one_bends_where_a_displacement_would_shear(self) -> None:
        sample = load_sample("hand")
        bases = tm.extract_bases(sample.keyframes, sample.faces, 8, progress=False)
        components = tm.ShapeSpace(bases, sample.faces).components(1)
        middle = components.shapes(components.coordinates(sample.keyframes).mean(0, keepdim=True))[0]
        lengths = [edge_lengths(x, sample.faces) for x in (*sample.keyframes, middle, sample.keyframes.mean(0))]
        wanted = 0.5 * (lengths[0] + lengths[1])
        bent, straight = (float((one - wanted).abs().mean()) for one in lengths[2:])
        assert bent < 0.3 * straight

    def test_the_farthest_shape_is_on_the_positive_side(self, bars: Shapes) -> None:
        for order in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
            own = bars.pick(*order)
            found = tm.ShapeSpace(own.bases, own.faces).components().coordinates(own.keyframes)
            assert bool((found.gather(0, found.abs().argmax(0, keepdim=True)) > 0).all())

    def test_the_corner_that_faces_begin_with_changes_nothing(self, bars: Shapes) -> None:
        rolled = torch.stack([face.roll(i % 3) for i, face in enumerate(bars.faces)])
        shapes = bars.keyframes * torch.tensor([[1.0, 1, 1], [1.3, 1, 1], [1, 1.2, 1]])[:, None]
        bases = [dataclasses.replace(b, reference=x) for b, x in zip(bars.bases, shapes, strict=True)]
        one, other = (tm.ShapeSpace(bases, faces).components() for faces in (bars.faces, rolled))
        torch.testing.assert_close(one.variances, other.variances)

    def test_too_many(self, bars: Shapes) -> None:
        space = tm.ShapeSpace(bars.bases, bars.faces)
        with pytest.raises(ValueError, match="3 key-frames have 2 components"):
            space.components(3)
        with pytest.raises(ValueError, match="one key-frame alone does not vary"):
            tm.ShapeSpace(bars.bases[:1], bars.faces).variation()

    def test_shapes_of_another_mesh_are_refused(self, bars: Shapes) -> None:
        components = tm.ShapeSpace(bars.bases, bars.faces).components()
        with pytest.raises(ValueError, match=r"shapes must be floating-point of shape \(\.\.\., 164, 3\)"):
            components.coordinates(bars.keyframes[:, :-1])


def test_the_mean_has_the_shape_of_a_blend(bars: Shapes) -> None:
    space = tm.ShapeSpace(bars.bases, bars.faces)
    weights = torch.full((3,), 1 / 3, dtype=torch.float64)
    torch.testing.assert_close(space.mean(), tm.Blend(bars.bases, bars.faces, "fast")(bars.keyframes, weights))
    one = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    assert torch.equal(space.mean(one), space.keyframes(one)[1])
