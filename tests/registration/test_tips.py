"""Maps from the tips of limbs, and what tells front from back."""

import numpy as np
import pytest
import trimesh

from torch_modal.registration.maps import CoarsePair, SpectralShape
from torch_modal.registration.register import register
from torch_modal.registration.report import Registration
from torch_modal.registration.surface import MeshSurface

for library in ("robust_laplacian", "potpourri3d", "igl"):
    pytest.importorskip(library, reason=f"{library} is not installed; it is part of the extra 'register'")

HEIGHTS = np.array([1.6, 2.6, 2.6, 3.0, 3.0])  # of a head, two arms and two legs


def figure(heights: np.ndarray = HEIGHTS, level: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A flat body with five limbs, a bulge in front, and left and right alike; X is its left, Y up, Z its front."""
    ball = trimesh.creation.icosphere(subdivisions=level)
    points = np.array(ball.vertices)
    ends = np.array([[0, 1, 0], [1, 0.55, 0], [-1, 0.55, 0], [0.45, -1, 0], [-0.45, -1, 0]])
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    radius = 1 + np.exp(18 * (points @ ends.T - 1)) @ heights
    front = 0.5 * np.exp(6 * (points @ [0, -0.2, 1] - 1))
    shaped = points * (radius + front)[:, None] * [1, 1.3, 0.7]
    return shaped, np.array(ball.faces, dtype=np.int64)


def shape(points: np.ndarray, faces: np.ndarray) -> SpectralShape:
    return SpectralShape(MeshSurface(points, faces))


def test_tips_are_the_ends_of_limbs() -> None:
    one = shape(*figure())
    assert len(one.tips) == 5
    ends = one.coarse.vertices[one.tips]
    ends /= np.linalg.norm(ends, axis=1, keepdims=True)
    assert (ends[:, 1] > 0.9).sum() == 1 and (np.abs(ends[:, 0]) > 0.6).sum() == 2 and (ends[:, 1] < -0.8).sum() == 2
    ball = trimesh.creation.icosphere(3)
    assert len(shape(np.array(ball.vertices), np.array(ball.faces)).tips) < 5


def test_tips_are_matched_where_limbs_have_grown() -> None:
    """Arms become longer than legs were, and legs shorter than arms: the trunk between them tells them apart."""
    first, second = shape(*figure()), shape(*figure(np.array([1.6, 3.8, 3.8, 2.0, 2.0])))
    direct, mirrored = CoarsePair(first, second).from_tips()[:2]
    own = first.coarse.vertices
    sides = []
    for found in (direct, mirrored):
        image = second.coarse.vertices[found.vertices]
        ends = image[first.tips]
        assert (np.sign(ends[:, 1]) == np.sign(own[first.tips][:, 1])).all(), "up stays up"
        sides.append(np.sign(ends[:, 0] * own[first.tips][:, 0])[np.abs(own[first.tips][:, 0]) > 0.1])
        assert found.score > 0, "the surface keeps its orientation"
        # Left and right are exchanged together with front and back.
        flat = np.abs(own[:, 2]) > 0.6 * np.abs(own[:, 2]).max()
        agreement = np.sign(image[flat, 2] * own[flat, 2]).mean()
        assert agreement * sides[-1][0] > 0.8
    assert {side[0] for side in sides} == {1.0, -1.0} and all(abs(side.sum()) == len(side) for side in sides)


def test_places_along_limbs_are_relative_to_their_lengths() -> None:
    """Where limbs have grown by a quarter or shrunk by a third, the middle of a limb maps to the middle of a limb."""
    first, second = shape(*figure(level=3)), shape(*figure(np.array([1.6, 3.8, 3.8, 2.0, 2.0]), level=3))
    found = CoarsePair(first, second).from_limbs(np.stack([first.tips, first.tips], axis=1))
    own = second.coarse.vertices
    off = np.linalg.norm(own[found.vertices] - own, axis=1)
    assert off.mean() < 0.045, "twice as much if distances are not relative"


def test_likeness_tells_front_from_back() -> None:
    first, second = shape(*figure()), shape(*figure(HEIGHTS * 1.1))
    maps = CoarsePair(first, second).from_tips()[:2]
    pair = maps[0].pair
    own, image = first.coarse.vertices, [second.coarse.vertices[found.vertices] for found in maps]
    right = [float((own[:, 2] * points[:, 2]).mean()) > 0 for points in image]
    values = [pair.likeness(found.vertices) for found in maps]
    assert sorted(right) == [False, True]
    assert values[right.index(True)] > values[right.index(False)] + 0.05
    assert CoarsePair(first, first).likeness(np.arange(len(first))) == pytest.approx(1)
    assert pair.likeness(np.zeros(len(first), dtype=np.int64)) == pytest.approx(0), "constant on the target"


@pytest.mark.slow
def test_other_proportions_need_no_landmarks() -> None:
    rest, faces = figure()
    target, _ = figure(np.array([1.6, 3.8, 3.8, 2.0, 2.0]))
    order = np.random.default_rng(0).permutation(len(target))
    meshes = rest, faces, target[order], np.argsort(order)[faces]
    found: Registration = register(*meshes, same_subject=False, cache=False, progress=False)
    size = np.linalg.norm(np.ptp(target, axis=0))
    assert np.linalg.norm(found.positions.numpy() - target, axis=1).mean() < 0.05 * size
