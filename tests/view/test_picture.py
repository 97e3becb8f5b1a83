"""Single images and sheets of them, looked at through their pixels."""

import numpy as np
import pytest
import torch
import trimesh
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from scipy import ndimage

from torch_modal.view import drawing, picture
from torch_modal.view.picture import render_sequence

BALL = trimesh.creation.icosphere(2)


def growing(n=5):
    """A ball that grows from radius 1 to 2."""
    return np.linspace(1, 2, n)[:, None, None] * np.asarray(BALL.vertices)


def drawn(image, level=250):
    return (np.asarray(image).astype(int)[..., :3] < level).any(axis=-1)


def draw(points, colors=(0.8, 0.24, 0.24), faces=BALL.faces):
    colors = np.broadcast_to(colors, np.shape(points))
    return drawing.draw_image(
        points, drawing.plain(colors, np.asarray(faces)), np.array([2.5, 2.5]), np.array([100, 100])
    )


def test_shapes_are_drawn_to_scale():
    """A ball of radius r at (x, y) covers a disc of known place and area: the camera, in pixels."""
    ball = np.asarray(BALL.vertices)
    images = [draw(x) for x in (ball, ball + np.array([1, 0.5, 0]), 2 * ball, ball + np.array([0, 0, 40]))]
    assert images[0].shape == (100, 100, 3) and images[0].dtype == np.uint8
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


def test_near_hides_far():
    """Two shapes in one: the nearer (larger z), green, covers the red one, in either order."""
    ball = np.asarray(BALL.vertices)
    vertices = np.concatenate([ball, 0.8 * ball + [0, 0, 3]])
    for flip in (False, True):
        points = vertices * [1, 1, -1] if flip else vertices
        colors = np.repeat([[0.8, 0, 0], [0, 0.8, 0]], len(ball), axis=0)
        faces = np.concatenate([BALL.faces, BALL.faces + len(ball)])
        middle = draw(points, colors, faces)[45:55, 45:55].mean(axis=(0, 1))
        assert (middle[0] > middle[1]) == flip


# ------------------------------------------------------------------------------------------------------------- sheets
def shapes_on(path):
    """The shapes on a sheet, in reading order: area, centre x, centre y, mean colour of each."""
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    labels, _ = ndimage.label(drawn(image))
    found = []
    for number, (rows, columns) in enumerate(ndimage.find_objects(labels), start=1):
        mask = labels[rows, columns] == number
        if mask.sum() > 3000:  # letters are smaller
            y, x = (s.start + c for s, c in zip((rows, columns), ndimage.center_of_mass(mask), strict=True))
            found.append((mask.sum(), x, y, image[rows, columns][mask].mean(axis=0)))
    return sorted(found, key=lambda shape: (round(shape[2] / 100), shape[1]))


def test_sheet_has_every_shape_at_its_place(tmp_path):
    """Rows and columns of discs: their radii are those of the frames, key-frames have the other colour."""
    frames = growing()
    out = tmp_path / "new" / "sheet.png"
    rows = {"grows": frames, "shrinks": torch.tensor(frames[::-1].copy(), requires_grad=True)}
    path = render_sequence(rows, torch.tensor(np.asarray(BALL.faces)), out)
    assert path == out and list(out.parent.iterdir()) == [out]
    shapes = shapes_on(out)
    assert len(shapes) == 10
    areas, x, y = (np.array([shape[i] for shape in shapes]).reshape(2, 5) for i in range(3))
    radius = picture.CELL_PIXELS / 2 / picture.CELL_MARGIN  # the largest ball fills its cell
    expected = np.pi * (radius * np.linspace(0.5, 1, 5)) ** 2
    np.testing.assert_allclose(areas, [expected, expected[::-1]], rtol=0.06)
    np.testing.assert_allclose(np.diff(x, axis=1), np.diff(x, axis=1)[0, 0], atol=1.5)
    np.testing.assert_allclose(x[0], x[1], atol=1.5)
    assert np.ptp(y, axis=1).max() < 1.5
    for number, shape in enumerate(shapes):
        red, _, blue = shape[3]
        assert (red > blue + 20) if number % 5 in (0, 4) else (blue > red + 20)


def test_columns_and_keyframes_are_chosen(tmp_path):
    options = {}
    rows, faces, out = {"a": growing(9)}, np.asarray(BALL.faces), tmp_path / "a.png"
    largest = np.pi * (picture.CELL_PIXELS / 2 / picture.CELL_MARGIN) ** 2

    def radii(**more):
        shapes = shapes_on(render_sequence(rows, faces, out, **options, **more))
        warm = [i for i, shape in enumerate(shapes) if shape[3][0] > shape[3][2]]
        return np.sqrt([shape[0] / largest for shape in shapes]), warm

    # Frame n of 9 has radius 1 + n / 8; the largest that is shown fills its cell.
    for more, frames, warm in [
        ({}, [0, 2, 4, 6, 8], [0, 4]),
        ({"columns": 3, "keyframe_indices": [4]}, [0, 4, 8], [1]),
        ({"columns": [1, 4], "keyframe_indices": [0, 4, 8]}, [1, 4], [1]),
        ({"columns": 1}, [0], [0]),
        ({"columns": 3, "keyframe_indices": []}, [0, 4, 8], []),
    ]:
        sizes, warm_found = radii(**more)
        expected = 1 + np.array(frames) / 8
        np.testing.assert_allclose(sizes, expected / expected[-1], rtol=0.03)
        assert warm_found == warm


def test_titles_stand_above_the_columns(tmp_path):
    rows, faces = {"a": growing(3)}, np.asarray(BALL.faces)
    sheets = []
    for titles in (None, ["t = 0", "mode 2", "t = 1"]):
        render_sequence(rows, faces, tmp_path / "a.png", titles=titles)
        sheets.append(np.asarray(Image.open(tmp_path / "a.png").convert("RGB")).astype(int))
    changed = np.argwhere(np.abs(sheets[0] - sheets[1]).sum(2) > 0)
    height, width = sheets[0].shape[:2]
    assert len(changed) and changed[:, 0].max() < height / 4, "only what is above the shapes"
    assert width / 3 < changed[:, 1].min() and changed[:, 1].max() < 5 * width / 6, "only the one in the middle"


def test_numbers_become_colours_with_one_bar(tmp_path):
    """The first row is 0 (the scale's light end), the second 5 (its dark end), the third has none."""
    frames, faces = growing(3), np.asarray(BALL.faces)
    colors = {"zero": np.zeros(frames.shape[:2]), "five": torch.full(frames.shape[:2], 5.0)}
    options = {"colors": colors, "color_label": "error (%)"}
    rows = {"zero": frames, "five": frames, "plain": frames}
    path = render_sequence(rows, faces, tmp_path / "a.png", **options)
    *_, last = everything = shapes_on(path)  # the bar stands to the right of the last column
    shapes = [shape for shape in everything if shape[1] < last[1] + 50]
    zero, five, plain = (shapes[3 * r + 1][3] for r in range(3))
    assert np.ptp(zero) < 10 and zero.min() > 130  # grey, light
    assert five[0] > 2 * five[1] and five.max() < 100  # dark red
    assert plain[2] > plain[0] + 20  # the colour of an in-between
    plain_sheet = render_sequence(rows, faces, tmp_path / "b.png")
    assert Image.open(path).width > Image.open(plain_sheet).width + 50  # room for the bar


def test_clouds_lie_where_their_shapes_are(tmp_path):
    """Dots on the surface fill the same disc as the shape below; what lies outside is cut."""
    dots = np.concatenate([trimesh.sample.sample_surface(BALL, 15_000, seed=0)[0], [[99.0, 0, 0]]])
    points = [torch.tensor(dots * radius + [7, 1, 0]) for radius in (1, 1.5, 2)]
    frames = growing(3) + np.array([7.0, 1, 0])
    options = {"view": (0, 0), "up": "y", "columns": [0, 2]}
    path = render_sequence({"ball": frames}, BALL.faces, tmp_path / "a.png", points={"seen": points}, **options)
    image = np.asarray(Image.open(path).convert("RGB")).astype(int)
    places = ndimage.find_objects(ndimage.label(ndimage.binary_closing(drawn(image), iterations=8))[0])
    discs = [place for place in places if image[place].size > 30_000]
    assert len(discs) == 4
    clouds = sorted(discs, key=lambda place: (place[0].start > 490, place[1].start))
    for (_, above), (_, below) in zip(clouds[:2], clouds[2:], strict=True):
        assert (above.start, above.stop) == pytest.approx((below.start, below.stop), abs=4)
    cloud = image[clouds[0]]
    middle = cloud[len(cloud) // 2 - 9 : len(cloud) // 2 + 9, cloud.shape[1] // 2 - 9 : cloud.shape[1] // 2 + 9]
    assert (middle[..., 0] - middle[..., 2]).mean() > 80  # given, not computed


def test_near_dots_are_darker_and_hide_far_ones():
    for order in ([0, 1, 2], [2, 1, 0]):
        points = np.array([[0.0, 0, 1], [0, 0, -1], [0.5, 0.5, -1]])[order]
        ((cell,),) = drawing.make_cells(1, 1, np.array([1.0, 1.0]), np.array([80, 80]))
        drawing.draw_points(cell, points, (0.8, 0, 0))
        canvas = FigureCanvasAgg(cell.figure)
        canvas.draw()
        image = np.asarray(canvas.buffer_rgba())[..., 1]
        assert image[40, 40] == 0 and 0 < image[20, 60] < 200 and image[60, 60] == 255


def test_automatic_camera():
    """Which way is up, and from where a flat shape is seen, in three worlds."""
    plate = np.asarray(trimesh.creation.box((4, 6, 0.5)).vertices)  # stands in a Y-up world, faces Z
    right, up, front = picture.view_rotation(plate, None, None)
    assert up[1] > 0.9 and right[1] == pytest.approx(0) and front[2] > 0.85
    z_up = plate[:, [0, 2, 1]] * [1, -1, 1]  # the same in a Z-up world, where front is -Y
    right, up, front = picture.view_rotation(z_up, None, None)
    assert up[2] > 0.9 and front[1] < -0.85
    from_side = plate[:, [2, 1, 0]]  # faces X: the camera walks round, and Y stays up
    right, up, front = picture.view_rotation(from_side, None, None)
    assert up[1] > 0.9 and abs(front[0]) > 0.85


@pytest.mark.parametrize(
    ("view", "up", "expected"),
    [
        ((0, 0), "y", np.eye(3)),
        ((90, 0), "y", [[0, 0, -1], [0, 1, 0], [1, 0, 0]]),
        ((0, 90), "y", [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
        ((0, 0), "z", [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),
        ((90, 0), "z", [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    ],
)
def test_camera_directions(view, up, expected):
    """Right, up and to the viewer, by hand."""
    np.testing.assert_allclose(picture.view_rotation(np.eye(3), view, up), expected, atol=1e-12)


def test_what_rests_stays_and_what_travels_is_followed():
    ball = np.asarray(BALL.vertices)
    rest = np.stack([ball, 1.2 * ball + np.array([0.2, 0, 0])])[None]
    moved, _ = picture.fit_into_cells(rest)
    np.testing.assert_allclose(moved[0, 1] - moved[0, 0], rest[0, 1] - rest[0, 0], atol=1e-12)
    far = np.stack([ball, ball + np.array([9, 0, 0])])[None]
    both = np.concatenate([far, far + np.array([0, 0.3, 0])])
    moved, half = picture.fit_into_cells(both)
    np.testing.assert_allclose(moved[:, 1], moved[:, 0], atol=1e-12)  # followed
    np.testing.assert_allclose(moved[1] - moved[0], np.broadcast_to([0, 0.3, 0], moved[0].shape), atol=1e-12)
    assert half[0] == pytest.approx(1.06 * 1, rel=0.03)
    moved, half = picture.fit_into_cells(np.concatenate([far, far + np.array([0, 7, 0])]))  # rows apart, too
    assert np.abs(moved).max() <= 1.0 + 1e-12


def test_half_of_the_panels_are_in_betweens() -> None:
    for n_keys, levels in ((2, 4), (3, 2), (4, 2), (7, 2), (7, 3), (6, 1), (13, 2)):
        keys = [2**levels * i for i in range(n_keys)]
        chosen = picture.choose_columns(None, keys[-1] + 1, keys)
        assert 2 * len(set(chosen) - set(keys)) >= len(chosen) and chosen[0] == 0 and chosen[-1] == keys[-1]
    assert picture.choose_columns(7, 25, list(range(0, 25, 4))) == list(range(0, 25, 4))  # as asked


def test_existing_pictures_are_replaced(tmp_path):
    rows, faces, out = {"a": growing(2)}, np.asarray(BALL.faces), tmp_path / "a.png"
    out.write_text("mine")
    render_sequence(rows, faces, out)
    assert Image.open(out).format == "PNG"
    assert render_sequence(rows, faces, tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frames_by_row": {}}, "empty"),
        ({"frames_by_row": {"a": growing(3), "b": growing(4)}}, r"'a' \(3, 162, 3\), 'b' \(4, 162, 3\)"),
        ({"frames_by_row": {"a": growing(3)[0]}}, r"frames_by_row\['a'\].*frames\[None\]|\(162, 3\)"),
        ({"out": "a.jpg"}, r"\.png or \.pdf.*a\.jpg"),
        ({"columns": 0}, "columns must be at least 1"),
        ({"titles": ["first"]}, "titles stand above 3 columns, got 1"),
        ({"columns": [0, 3]}, r"columns.*0 to 2.*\[0, 3\]"),
        ({"columns": []}, "columns.*one or more"),
        ({"keyframe_indices": [3]}, "keyframe_indices.*0 to 2"),
        ({"view": (0,)}, "azimuth and elevation"),
        ({"view": (0, float("inf"))}, "azimuth and elevation"),
        ({"up": "x"}, "up must be"),
        ({"points": {"seen": [np.zeros((5, 3))] * 2}}, r"points\['seen'\] must be 3 clouds"),
        ({"points": {"seen": [np.zeros((5, 2))] * 3}}, r"\(n, 3\), got \[\(5, 2\)"),
        ({"colors": {"b": np.zeros((3, 162))}}, "shape of a row a, got"),
        ({"colors": {"a": np.zeros((2, 162))}}, r"\(3, 162\).*\(2, 162\)"),
        ({"colors": {"a": np.full((3, 162), np.nan)}}, "finite"),
    ],
)
def test_wrong_input_is_refused(tmp_path, options, message):
    arguments = {"frames_by_row": {"a": growing(3)}, "faces": BALL.faces, "out": "a.png"} | options
    arguments["out"] = tmp_path / arguments["out"]
    with pytest.raises(ValueError, match=message):
        render_sequence(**arguments)
    assert not list(tmp_path.iterdir())
