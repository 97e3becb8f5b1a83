"""The frame of a layer: scale, alignment, coarse mesh and independent directions."""

import pytest
import torch
from conftest import Shapes, random_rotation
from torch import Tensor

from torch_modal.elastic.backend import TorchBackend
from torch_modal.elastic.term import Mesh
from torch_modal.geometry.canonical import CANONICAL_SIZE, size
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.rotations import exp, log
from torch_modal.inbetween.alignment import KeyframeAlignment
from torch_modal.inbetween.coarse import CoarseMesh
from torch_modal.inbetween.subspace import elastic_subspace

DOUBLE = torch.float64


def frame_of(shapes: Tensor, faces: Tensor) -> tuple[KeyframeAlignment, CoarseMesh]:
    mesh = Mesh(Connectivity(faces.numpy()))
    alignment = KeyframeAlignment(shapes, mesh.connectivity, TorchBackend())
    return alignment, CoarseMesh(alignment.references, mesh, 200, alignment.weights, [])


@pytest.fixture(scope="module")
def frame(bars: Shapes) -> tuple[KeyframeAlignment, CoarseMesh]:
    return frame_of(bars.keyframes[:2], bars.faces)


@pytest.fixture
def moved(bars: Shapes, generator: torch.Generator) -> Tensor:
    """The straight and the bent bar, each with its own rigid motion, in a batch of one. *Shape:* (1, 2, V, 3)."""
    turns = torch.stack([random_rotation(generator), random_rotation(generator)])
    return (bars.keyframes[:2] @ turns.mT + torch.tensor([[[30.0, -20, 10]], [[-5, 0, 8]]]))[None]


def test_size_is_100_and_centred(frame: tuple[KeyframeAlignment, CoarseMesh], bars: Shapes) -> None:
    alignment, coarse = frame
    reference, weights = alignment.reference, alignment.weights
    sizes = [size(x.numpy(), bars.faces.numpy()) for x in bars.keyframes[:2]]
    assert size(reference.numpy(), bars.faces.numpy()) == pytest.approx(
        2 * CANONICAL_SIZE * sizes[0] / sum(sizes), rel=1e-13
    )
    assert (weights[:, None] * reference).sum(0).abs().max() < 1e-11
    assert float(weights.sum()) == pytest.approx(1)
    assert float(coarse.weights.sum()) == pytest.approx(1)
    straight = bars.keyframes[0]
    torch.testing.assert_close(reference / alignment.scale, straight - (weights[:, None] * straight).sum(0))


def test_collapses_are_chosen_on_aligned_keyframes(
    frame: tuple[KeyframeAlignment, CoarseMesh], bars: Shapes, generator: torch.Generator
) -> None:
    """A rigid motion of the second basis changes nothing: same clusters, same space."""
    turn = random_rotation(generator)
    alignment, coarse = frame_of(torch.stack([bars.keyframes[0], bars.keyframes[1] @ turn.mT + 9]), bars.faces)
    assert torch.equal(coarse.clusters, frame[1].clusters)
    torch.testing.assert_close(alignment.references, frame[0].references, atol=1e-10, rtol=0)
    modes = bars.bases[1].modes
    turned, straight = modes @ turn.mT @ alignment.turns[1].mT, modes @ frame[0].turns[1].mT
    torch.testing.assert_close(turned, straight, atol=1e-11, rtol=0)


def test_orthonormal_directions(
    frame: tuple[KeyframeAlignment, CoarseMesh], bars: Shapes, generator: torch.Generator
) -> None:
    alignment, coarse = frame
    directions = torch.randn(5, *bars.keyframes[0].shape, dtype=DOUBLE, generator=generator)
    mixed = torch.cat([directions, 3 * directions[:2] - directions[2:4], torch.zeros_like(directions[:1])])
    basis, on_coarse = elastic_subspace([mixed], alignment, coarse)
    assert len(basis) == len(on_coarse) == 5, "three of eight are dependent"
    gram = torch.einsum("mvc,nvc->mn", on_coarse * coarse.weights[:, None], on_coarse)
    torch.testing.assert_close(gram, torch.eye(5, dtype=DOUBLE), atol=1e-9, rtol=0)
    torch.testing.assert_close(coarse.restrict(basis), on_coarse, atol=1e-9, rtol=0)
    # With the rigid motions, the same space as the directions'.
    x = alignment.references.mean(0)
    axes = torch.eye(3, dtype=DOUBLE)[:, None].expand(3, *x.shape)
    span = torch.cat([axes, torch.linalg.cross(axes, x.expand(3, *x.shape)), basis]).flatten(1)
    fit = torch.linalg.lstsq(span.T, directions.flatten(1).T).solution
    torch.testing.assert_close(fit.T @ span, directions.flatten(1), atol=1e-9, rtol=0)


def test_one_basis_for_both_ends(bars: Shapes) -> None:
    alignment, coarse = frame_of(bars.keyframes[[0, 0]], bars.faces)
    modes = bars.bases[0].modes @ alignment.turns.mT[:, None]
    assert len(elastic_subspace(list(modes), alignment, coarse)[0]) == 8, "the second eight are the first eight"


def test_points_are_brought_where_shapes_are(frame: tuple[KeyframeAlignment, CoarseMesh], moved: Tensor) -> None:
    alignment, _ = frame
    shapes, pose, usable = alignment(moved, torch.tensor([[0.7, 0.3]], dtype=DOUBLE))
    x = shapes[:, 0] + 1
    assert usable.all()
    torch.testing.assert_close(alignment.to_frame(alignment.to_caller(x, pose), pose), x, atol=1e-9, rtol=0)


def test_all_the_weight_is_the_pose_of_a_key_frame(frame: tuple[KeyframeAlignment, CoarseMesh], moved: Tensor) -> None:
    alignment, _ = frame
    for k, weights in enumerate(torch.eye(2, dtype=DOUBLE)):
        shapes, pose, _ = alignment(moved, weights[None])
        torch.testing.assert_close(alignment.to_caller(shapes[:, k], pose), moved[:, k], atol=1e-10, rtol=0)


def test_the_pose_of_two_takes_the_short_way(bars: Shapes, generator: torch.Generator) -> None:
    """Whatever signs their quaternions have: 20 pairs of poses, most of them far from each other."""
    x = bars.keyframes[0]
    alignment = frame_of(x.expand(2, -1, -1), bars.faces)[0]
    x = x - (alignment.weights[:, None] * x).sum(0)
    first = torch.stack([random_rotation(generator) for _ in range(20)])
    step = 0.5 * log(torch.stack([random_rotation(generator) for _ in range(20)]))
    keyframes = torch.stack([x @ first.mT, x @ exp(2 * step).mT @ first.mT], 1)
    shapes, pose, _ = alignment(keyframes, torch.full((20, 2), 0.5, dtype=DOUBLE))
    found = alignment.to_caller(shapes[:, 0], pose)
    torch.testing.assert_close(found, x @ exp(step).mT @ first.mT, atol=1e-9, rtol=0)
