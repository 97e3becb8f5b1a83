"""The synthetic bodies: what their motions promise, by hand and by numbers of another kind."""

import numpy as np
import pytest
from bodies import BAR, BODIES, WALL, Body, bend, body, squeeze, twist
from scipy.spatial import cKDTree

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.inspect import consistent_winding, degenerate_faces, repeated_faces, signed_volume

HOLLOW = [name for name in BODIES if name.startswith(("tube", "vessel"))]

SHEETS = ("sheet", "gutter")


def lengths(x: np.ndarray, edges: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x[edges[:, 0]] - x[edges[:, 1]], axis=1)


@pytest.mark.parametrize("jittered", [False, True], ids=["regular", "irregular"])
@pytest.mark.parametrize("name", BODIES)
def test_one_manifold_surface_of_the_promised_size(name: str, jittered: bool) -> None:
    shape = body(name, jittered)
    mesh = Connectivity(shape.faces)
    edges, counts = mesh.edges, mesh.counts
    assert 2000 <= len(shape.rest) <= 4000
    assert np.array_equal(np.unique(shape.faces), np.arange(len(shape.rest)))
    assert not degenerate_faces(shape.faces).any() and not repeated_faces(shape.faces).any()
    assert len(consistent_winding(mesh).flipped) == 0
    euler = len(shape.rest) - len(edges) + len(shape.faces)
    if name.startswith(SHEETS):
        assert set(counts) == {1, 2} and euler == 1  # a disc
    else:
        assert set(counts) == {2} and euler == (0 if name.startswith("tube") else 2)
        assert signed_volume(shape.rest, shape.faces) > 0


@pytest.mark.parametrize("name", BODIES)
def test_motion_starts_at_rest(name: str) -> None:
    shape = body(name)
    start = bend(shape.rest, 1.0, np.radians(90), 0, BAR) if name.startswith("gutter") else shape.rest
    assert np.allclose(shape.pose(0.0), start, atol=1e-13)
    assert np.ptp(shape.pose(1.0) - shape.pose(0.0)) > 0.3


@pytest.mark.parametrize("jittered", [False, True], ids=["regular", "irregular"])
@pytest.mark.parametrize("name", BODIES)
def test_no_face_turns_over_and_no_face_degenerates(name: str, jittered: bool) -> None:
    """Normals against the motion's own derivative, by differences: a normal goes along with the inverse transpose."""
    shape = body(name, jittered)

    def normals(x: np.ndarray) -> np.ndarray:
        corners = x[shape.faces]
        return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])

    centre, step = shape.rest[shape.faces].mean(1), 1e-5
    for time in (0.5, 1.0):
        jacobian = np.stack(
            [(shape.motion(centre + d, time) - shape.motion(centre - d, time)) / (2 * step) for d in step * np.eye(3)],
            axis=-1,
        )
        assert (np.linalg.det(jacobian) > 0.1).all()  # the motion itself does not fold
        wanted = np.einsum("fji,fj->fi", np.linalg.inv(jacobian), normals(shape.rest))
        found = normals(shape.pose(time))
        cosine = np.einsum("fi,fi->f", wanted, found)
        cosine /= np.linalg.norm(wanted, axis=1) * np.linalg.norm(found, axis=1)
        assert cosine.min() > 0.8
        assert (np.linalg.norm(found, axis=1) > 0.2 * np.linalg.norm(normals(shape.rest), axis=1)).all()


@pytest.mark.parametrize("name", [name for name in BODIES if not name.startswith(SHEETS)])
def test_volume_stays(name: str) -> None:
    """Pappus: sections that are symmetric about the centre line sweep the volume of the straight body."""
    shape = body(name)
    volumes = [signed_volume(shape.pose(time), shape.faces) for time in (0.0, 0.5, 1.0)]
    assert volumes == pytest.approx([volumes[0]] * 3, rel=5e-3)


def test_bar_bent_by_hand() -> None:
    """Half a turn: the far end points back, above the near one by the diameter of the arc."""
    angle, diameter = np.pi, 2 * BAR / np.pi
    ends = bend(np.array([[0.0, 0, 0], [BAR, 0, 0], [BAR, 0.5, 0.3], [BAR / 2, 0, 0]]), 1.0, angle, 0, BAR)
    wanted = [[0, 0, 0], [0, diameter, 0], [0, diameter - 0.5, 0.3], [diameter / 2, diameter / 2, 0]]
    assert np.allclose(ends, wanted, atol=1e-14)


@pytest.mark.parametrize("time", [0.3, 1.0])
@pytest.mark.parametrize("name", ["bar bent 180", "sheet rolled 270"])
def test_edges_of_a_bent_body_have_the_lengths_of_chords(name: str, time: float) -> None:
    shape = body(name)
    angle = np.radians(float(name.split()[-1])) * time
    edges = Connectivity(shape.faces).edges
    start, stop = shape.rest[edges[:, 0]], shape.rest[edges[:, 1]]
    level = np.abs(start[:, 1] - stop[:, 1]) < 1e-12  # both ends on one arc
    radius = BAR / angle - start[:, 1]
    along = 2 * radius * np.sin(np.abs(start[:, 0] - stop[:, 0]) * angle / BAR / 2)
    wanted = np.hypot(along, start[:, 2] - stop[:, 2])
    assert np.allclose(lengths(shape.pose(time), edges)[level], wanted[level], rtol=1e-12)


def test_sheet_is_rolled_without_stretch() -> None:
    shape = body("sheet rolled 270")
    edges = Connectivity(shape.faces).edges
    assert np.abs(lengths(shape.pose(1.0), edges) / lengths(shape.rest, edges) - 1).max() < 3e-4


def test_twisted_sections_turn_evenly_and_keep_their_shape() -> None:
    shape = body("bar twisted 180")
    half, whole = shape.pose(0.5), shape.pose(1.0)
    far = np.isclose(shape.rest[:, 0], BAR)
    assert np.allclose(whole[far][:, 1:], -shape.rest[far][:, 1:])  # half a turn
    assert np.allclose(half[far][:, 1:], np.stack([-shape.rest[far][:, 2], shape.rest[far][:, 1]], 1))  # a quarter
    middle = np.isclose(shape.rest[:, 0], BAR / 2)
    assert np.allclose(whole[middle], half[middle] @ rotation_about_x(np.pi / 4).T)
    assert np.allclose(twist(shape.rest, 0.5, np.pi, 0, BAR), twist(shape.rest, 1.0, np.pi / 2, 0, BAR))


def rotation_about_x(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def test_squeezed_circle_closes_keeps_its_length_and_has_the_curvature_it_should() -> None:
    n, amount, radius = 20_000, 1.2, 0.6
    theta = np.linspace(0, 2 * np.pi, n, endpoint=False)
    circle = radius * np.stack([0 * theta, np.cos(theta), np.sin(theta)], axis=1)
    oval = squeeze(circle, 1.0, amount, radius)
    chords = np.roll(oval, -1, axis=0) - oval
    length = np.linalg.norm(chords, axis=1)
    assert length.sum() == pytest.approx(2 * np.pi * radius, rel=1e-7)
    assert length.max() == pytest.approx(2 * np.pi * radius / n, rel=1e-6)  # the last chord too: it closes
    turned = np.cross(chords, np.roll(chords, -1, axis=0))[:, 0] / length**2 / (2 * np.pi * radius / n)
    wanted = (1 + amount * np.cos(2 * np.roll(theta, -1))) / radius
    assert np.allclose(turned, wanted, atol=1e-3 / radius)


@pytest.mark.parametrize("name", ["tube bent 90", "tube squeezed"])
def test_wall_keeps_its_thickness(name: str) -> None:
    shape = body(name)
    radius = np.linalg.norm(shape.rest[:, 1:], axis=1)
    far_from_rims = (shape.rest[:, 0] > 0.5) & (shape.rest[:, 0] < BAR - 0.5)
    outer, inner = far_from_rims & (radius > 0.6), far_from_rims & (radius < 0.6)
    assert outer.any() and inner.any()
    samples = dense(shape, radius > 0.6)
    distance = cKDTree(shape.motion(samples, 1.0)).query(shape.pose(1.0)[inner])[0]
    assert distance == pytest.approx(WALL, rel=0.1)


def dense(shape: Body, chosen: np.ndarray) -> np.ndarray:
    """Points all over the faces whose corners are chosen. *Shape:* ``(n, 3)``."""
    faces = shape.faces[chosen[shape.faces].all(1)]
    weights = np.array([(i, j, 12 - i - j) for i in range(13) for j in range(13 - i)]) / 12
    return np.einsum("wc,fci->wfi", weights, shape.rest[faces]).reshape(-1, 3)


@pytest.mark.parametrize("name", HOLLOW)
def test_hollow_bodies_are_mostly_air(name: str) -> None:
    shape = body(name)
    hull = np.ptp(shape.rest, axis=0).prod() * np.pi / 4  # a cylinder
    assert signed_volume(shape.rest, shape.faces) < 0.25 * hull


def test_limb_is_slender_and_moves_alone() -> None:
    shape = body("limb bent 120")
    x, r = shape.rest[:, 0], np.linalg.norm(shape.rest[:, 1:], axis=1)
    limb = x > 1.2
    assert r[limb].max() < 0.105 and r[~limb].max() > 0.99
    assert np.array_equal(shape.pose(1.0)[~limb], shape.rest[~limb])
    tip = shape.rest[np.argmax(x)]
    assert tip[1] == 0 and tip[2] == 0
    # The tip's own length beyond the arc is rigid and points along the last tangent.
    arc = 3.5 / np.radians(120)
    end = np.array([1.5 + arc * np.sin(np.radians(120)), arc * 1.5, 0])
    tangent = np.array([np.cos(np.radians(120)), np.sin(np.radians(120)), 0])
    assert np.allclose(shape.pose(1.0)[np.argmax(x)], end + 0.1 * tangent)


@pytest.mark.parametrize("name", ["bar bent 90", "vessel bent 60", "sheet rolled 270"])
def test_irregular_is_the_same_surface_otherwise_triangulated(name: str) -> None:
    regular, other = body(name), body(name, jittered=True)
    assert len(regular.rest) == len(other.rest) and len(regular.faces) == len(other.faces)
    edges = [Connectivity(shape.faces).edges for shape in (regular, other)]
    assert len(set(map(tuple, edges[0])) ^ set(map(tuple, edges[1]))) > 0.1 * len(edges[0])  # edges were turned
    spread = [np.std(lengths(shape.rest, e)) for shape, e in zip((regular, other), edges, strict=True)]
    assert spread[1] > 1.5 * spread[0]
    degrees = np.bincount(edges[1].reshape(-1))
    assert degrees.max() > np.bincount(edges[0].reshape(-1)).max()
    if name.startswith("bar"):
        assert signed_volume(other.rest, other.faces) == pytest.approx(BAR, rel=1e-12)  # flat sides stay flat
    if name.startswith("sheet"):
        assert (other.rest[:, 1] == 0).all()
        assert np.array_equal(*(Connectivity(shape.faces).boundary_edges for shape in (other, regular)))
    again = body(name, jittered=True)
    assert np.array_equal(again.rest, other.rest) and np.array_equal(again.faces, other.faces)


def test_names_carry_angles_and_unknown_ones_are_refused() -> None:
    assert np.allclose(body("bar bent 90").pose(1.0), body("bar bent 360").pose(0.25))
    for name in ("bar", "bar bent", "bar bent far", "rope bent 90"):
        with pytest.raises(ValueError, match="there is no body"):
            body(name)


def test_a_body_too_thick_for_its_arc_is_refused() -> None:
    with pytest.raises(ValueError, match="folds"):
        bend(np.array([[1.0, 1.5, 0]]), 1.0, np.pi, 0, BAR)
