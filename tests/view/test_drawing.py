"""Single images by both renderers, looked at through their pixels."""

import numpy as np
import pytest
import trimesh

from torch_modal.view import drawing

BALL = trimesh.creation.icosphere(2)


def scene(points, pixels=100, color=(200, 60, 60)):
    points = np.asarray(points, dtype=float)
    colors = np.broadcast_to(np.array(color, dtype=np.uint8), points.shape).copy()
    return drawing.Scene(points, colors, np.asarray(BALL.faces), np.array([2.5, 2.5]), np.array([pixels, pixels]))


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """Smooth shading by ten thousands of faces is not what these tests look at."""
    monkeypatch.setattr(drawing, "SMOOTH_FACES", 1000)


def drawn(image, level=250):
    return (np.asarray(image).astype(int)[..., :3] < level).any(axis=-1)


@pytest.fixture(params=["pyvista", "matplotlib"])
def draw(request):
    if request.param == "matplotlib":
        return drawing._draw_matplotlib

    def in_child(what):
        try:
            return drawing._draw_in_child(what)
        except RuntimeError as error:
            pytest.skip(f"pyvista cannot render on this machine: {error}")

    return in_child


def test_both_renderers_draw_to_scale(draw):
    """A ball of radius r at (x, y) covers a disc of known place and area: the camera, in pixels."""
    ball = np.asarray(BALL.vertices)
    images = draw(scene([ball, ball + np.array([1, 0.5, 0]), 2 * ball, ball + np.array([0, 0, 40])]))
    assert images.shape == (4, 100, 100, 3) and images.dtype == np.uint8
    for image, (x, y, radius) in zip(images, [(0, 0, 1), (1, 0.5, 1), (0, 0, 2), (0, 0, 1)], strict=True):
        mask = drawn(image, level=160)  # between paper and paint: half of a pixel on the rim is covered
        rows, columns = np.nonzero(mask)
        assert mask.sum() == pytest.approx(np.pi * (20 * radius) ** 2, rel=0.06)
        assert (columns.mean(), rows.mean()) == pytest.approx((49.5 + 20 * x, 49.5 - 20 * y), abs=1.0)
        assert (image[[0, 0, -1, -1], [0, -1, 0, -1]] == 255).all()  # white paper
        inside = image[mask].astype(float).mean(axis=0)
        assert inside[0] > 1.8 * inside[1]  # the colour that was asked for
    upper, lower = images[0][35:48, 40:60].mean(), images[0][52:65, 40:60].mean()
    assert upper > lower + 8  # the light comes from above


def test_near_hides_far(draw):
    """Two shapes in one: the nearer (larger z), green, covers the red one, in either order."""
    ball = np.asarray(BALL.vertices)
    vertices = np.concatenate([ball, 0.8 * ball + [0, 0, 3]])
    for flip in (False, True):
        points = vertices * [1, 1, -1] if flip else vertices
        colors = np.repeat(np.array([[200, 0, 0], [0, 200, 0]], dtype=np.uint8), len(ball), axis=0)
        faces = np.concatenate([BALL.faces, BALL.faces + len(ball)])
        what = drawing.Scene(points[None], colors[None], faces, np.array([2.5, 2.5]), np.array([100, 100]))
        middle = draw(what)[0, 45:55, 45:55].mean(axis=(0, 1))
        assert (middle[0] > middle[1]) == flip
