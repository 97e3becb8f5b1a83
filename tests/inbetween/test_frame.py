"""The working frame: scale, alignment, coarse mesh and independent columns."""

import pytest
import torch
from conftest import Shapes, random_rotation
from torch import Tensor
from torch_modal.inbetween.columns import Directions
from torch_modal.inbetween.frame import Frame

from torch_modal.geometry.canonical import CANONICAL_SIZE, size


@pytest.fixture(scope="module")
def frame(bars: Shapes) -> Frame:
    return Frame(bars.keyframes[:2], bars.faces, coarse_faces=200)


@pytest.fixture
def moved(bars: Shapes, generator: torch.Generator) -> Tensor:
    """The straight and the bent bar, each with its own rigid motion, in a batch of one. *Shape:* (2, 1, V, 3)."""
    turns = torch.stack([random_rotation(generator), random_rotation(generator)])
    return (bars.keyframes[:2] @ turns.mT + torch.tensor([[[30.0, -20, 10]], [[-5, 0, 8]]]))[:, None]


def test_size_is_100_and_centred(frame: Frame, bars: Shapes) -> None:
    reference = frame.reference
    sizes = [size(x.numpy(), bars.faces.numpy()) for x in bars.keyframes[:2]]
    assert size(reference.numpy(), bars.faces.numpy()) == pytest.approx(
        2 * CANONICAL_SIZE * sizes[0] / sum(sizes), rel=1e-13
    )
    assert (frame.weights[:, None] * reference).sum(0).abs().max() < 1e-11
    assert float(frame.weights.sum()) == pytest.approx(1)
    assert float(frame.coarse.weights.sum()) == pytest.approx(1)
    straight = bars.keyframes[0]
    torch.testing.assert_close(reference / frame.scale, straight - (frame.weights[:, None] * straight).sum(0))


def test_collapses_are_chosen_on_aligned_keyframes(frame: Frame, bars: Shapes, generator: torch.Generator) -> None:
    """A rigid motion of the second basis changes nothing: same clusters, same space."""
    turn = random_rotation(generator)
    basis = bars.bases[1]
    shapes = torch.stack([bars.keyframes[0], basis.reference @ turn.mT + 9])
    other = Frame(shapes, bars.faces, coarse_faces=200)
    assert torch.equal(other.coarse.clusters, frame.coarse.clusters)
    first = bars.bases[0].modes
    turned, straight = other.modes(first, basis.modes @ turn.mT)[1], frame.modes(first, basis.modes)[1]
    torch.testing.assert_close(turned.turned(turned.given), straight.turned(straight.given), atol=1e-11, rtol=0)


def test_orthonormal_columns(frame: Frame, bars: Shapes, generator: torch.Generator) -> None:
    directions = torch.randn(5, *bars.keyframes[0].shape, dtype=torch.float64, generator=generator)
    mixed = torch.cat([directions, 3 * directions[:2] - directions[2:4], torch.zeros_like(directions[:1])])
    columns = frame.elastic_columns(Directions(mixed))
    assert len(columns.fine) == len(columns.coarse) == 5, "three of eight are dependent"
    weighted = columns.coarse * frame.coarse.weights[:, None]
    gram = torch.einsum("mvc,nvc->mn", weighted, columns.coarse)
    torch.testing.assert_close(gram, torch.eye(5, dtype=torch.float64), atol=1e-9, rtol=0)
    torch.testing.assert_close(frame.coarsen(columns.fine), columns.coarse, atol=1e-9, rtol=0)
    # With the rigid motions, the same space as the directions'.
    span = torch.cat([frame.rigid.fine, columns.fine]).flatten(1)
    fit = torch.linalg.lstsq(span.T, directions.flatten(1).T).solution
    torch.testing.assert_close(fit.T @ span, directions.flatten(1), atol=1e-9, rtol=0)
    a = torch.randn(2, 5, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(columns.combine(a), torch.einsum("bn,nvc->bvc", a, columns.fine))


def test_one_basis_for_both_ends(bars: Shapes) -> None:
    frame = Frame(bars.keyframes[[0, 0]], bars.faces, 200)
    first, second = frame.modes(bars.bases[0].modes, bars.bases[0].modes)
    torch.testing.assert_close(first.given, second.turned(second.given))
    assert len(frame.elastic_columns(first, second).fine) == 8, "the second eight are the first eight"


def test_points_are_brought_where_shapes_are(frame: Frame, moved: Tensor) -> None:
    pair, t = frame.place(*moved), torch.tensor([0.3], dtype=torch.float64)
    x = pair.first + 1
    torch.testing.assert_close(frame.bring(frame.restore(x, pair, t), pair, t), x, atol=1e-9, rtol=0)
