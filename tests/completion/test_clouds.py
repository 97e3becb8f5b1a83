"""Clouds as sensors give them: without normals, with normals inside out, of a camera that is near, turned, scaled."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch import Tensor

import torch_modal as tm
from torch_modal.completion.clouds import Camera, estimate_normals, find_view, outwardness
from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.pairs import SampledSurface
from torch_modal.completion.poses import FramePoses
from torch_modal.modes.coarsening import coarsen

Body = tuple[Tensor, Tensor, float]


def gallop(n: int) -> Body:
    """The first shapes, with few faces, and the diagonal."""
    sample = tm.load_sample("creature")
    shapes = torch.stack([sample.keyframes, sample.truth], 1).flatten(0, 1)[:n].double().numpy()
    coarse = coarsen(shapes, sample.faces.numpy(), 1600)
    x = torch.from_numpy(np.stack([coarse.restrict(one) for one in shapes]))
    return x, torch.from_numpy(coarse.faces), float((x[0].amax(0) - x[0].amin(0)).norm())


@pytest.fixture(scope="module")
def animal() -> Body:
    """Three shapes of a gallop with few faces, and the diagonal."""
    return gallop(3)


def cloud(x: Tensor, faces: Tensor, camera: Camera | None = None, n: int = 1500, **given: Any) -> tm.Observation:
    """Points of a surface, all or what a camera sees, with normals."""
    scale = 100 / np.ptp(x.numpy(), axis=0).max()  # cells and depths of the visible are those of this size
    surface = SampledSurface(scale * x.numpy(), faces.numpy())
    some = np.arange(len(surface.samples)) if camera is None else surface.visible(camera)
    weights = surface.face_areas[surface.sample_faces[some]]
    some = np.random.default_rng(0).choice(some, n, p=weights / weights.sum())
    corners = x.numpy()[faces.numpy()][surface.sample_faces[some]]
    points = (np.random.default_rng(1).dirichlet([1, 1, 1], n)[..., None] * corners).sum(1)
    normals = torch.from_numpy(surface.face_normals[surface.sample_faces[some]])
    return tm.Observation(1.0, torch.from_numpy(points), normals, **given)


def error(found: Tensor, truth: Tensor, diagonal: float) -> float:
    """Mean distance in percent of the diagonal."""
    return 100 * float((found - truth).norm(dim=-1).mean()) / diagonal


VIEW = np.array([0.6, 0.0, 0.8])


def test_the_view_of_one_side_is_found(animal: Body) -> None:
    """Within 11 degrees; a whole cloud has none."""
    x, faces, _ = animal
    seen, whole = cloud(x[1], faces, Camera(VIEW)), cloud(x[1], faces)
    assert seen.normals is not None and whole.normals is not None
    view = find_view(seen.normals.numpy())
    assert view is not None and float(view @ VIEW) > 0.98
    assert find_view(whole.normals.numpy()) is None


@pytest.mark.parametrize("side", ["one", "all"])
def test_normals_are_estimated(animal: Body, side: str) -> None:
    x, faces, _ = animal
    seen = cloud(x[1], faces, Camera(VIEW) if side == "one" else None, n=3000)
    assert seen.normals is not None
    found = estimate_normals(seen.points.numpy(), VIEW if side == "one" else None)
    assert np.mean((found * seen.normals.numpy()).sum(1) > 0.7) > 0.85
    assert outwardness(seen.points.numpy(), seen.normals.numpy()) > 0.1


def test_clouds_without_normals_are_followed(animal: Body) -> None:
    x, faces, diagonal = animal
    seen = cloud(x[1], faces, Camera(VIEW), view=torch.from_numpy(VIEW))
    shapes = [tm.complete(x[0], faces, [one]).shapes for one in (seen, replace(seen, normals=None))]
    errors = [error(one, x[1:2], diagonal) for one in shapes]
    assert errors[1] < 0.25 * error(x[:1], x[1:2], diagonal)


def test_normals_that_point_inward_are_turned_over(animal: Body) -> None:
    x, faces, diagonal = animal
    seen = cloud(x[1], faces)
    assert seen.normals is not None
    with pytest.warns(tm.MeshWarning, match="point into the body"):
        found = tm.complete(x[0], faces, [replace(seen, normals=-seen.normals)])
    assert error(found.shapes, tm.complete(x[0], faces, [seen]).shapes, diagonal) < 1e-6


def test_a_turned_template_is_turned_back(animal: Body) -> None:
    x, faces, diagonal = animal
    rotation = torch.from_numpy(Rotation.from_euler("y", 180, degrees=True).as_matrix())
    found = tm.complete(x[0] @ rotation.mT, faces, [cloud(x[1], faces)])
    assert error(found.shapes, x[1:2], diagonal) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("turn", [("y", 90), ("z", -90)])
def test_a_turned_template_starts_where_it_fits_best_once_it_is_turned_back(turn: tuple[str, int]) -> None:
    """As it is, it fits a later frame as badly as the first."""
    (x, faces, _), view = gallop(5), torch.from_numpy(VIEW)
    seen = [replace(cloud(one, faces, Camera(VIEW), view=view), time=float(i)) for i, one in enumerate(x[1:])]
    rotation = torch.from_numpy(Rotation.from_euler(*turn, degrees=True).as_matrix())
    problem = CompletionProblem((x[:1] @ rotation.mT).numpy(), faces, np.zeros(0), seen)
    poses = FramePoses(problem)
    ((first, fit),) = poses._first(poses.template).items()
    truth = torch.from_numpy(problem.to_canonical(x[1]))
    assert first == 0 and float((fit.x - truth).norm(dim=1).mean()) < 0.5


def test_another_size_is_said(animal: Body) -> None:
    x, faces, _ = animal
    with pytest.warns(tm.MeshWarning, match="are the points in another unit"):
        tm.complete(1.25 * x[0], faces, [cloud(x[1], faces)])


def test_a_near_camera_sees_less_than_a_far_one() -> None:
    """Of a ball with the radius 50 at twice the radius, a half less than a half."""
    sphere = trimesh.creation.icosphere(4, 50.0)
    surface = SampledSurface(np.asarray(sphere.vertices), np.asarray(sphere.faces))
    far, near = Camera(np.array([0.0, 0, 1])), Camera(np.array([0.0, 0, 1]), np.array([0.0, 0, 100]))
    heights = [surface.samples[surface.visible(camera)][:, 2].min() for camera in (far, near)]
    assert 0 < heights[0] < 12 and 25 < heights[1] < 35  # the horizon, and normals at an angle of more than 81 degrees


def test_a_camera_has_a_place_or_a_view() -> None:
    points = torch.rand(9, 3)
    with pytest.raises(ValueError, match="a view, from far, or a place; got both"):
        tm.Observation(0.0, points, view=torch.ones(3), camera=torch.ones(3))
    with pytest.raises(ValueError, match="normals and views are for clouds"):
        tm.Observation(0.0, points, vertices=torch.arange(9), camera=torch.ones(3))


def test_the_place_of_a_camera_guides_as_its_view_does(animal: Body) -> None:
    """From far away both are the same."""
    x, faces, diagonal = animal
    seen = cloud(x[1], faces, Camera(VIEW), view=torch.from_numpy(VIEW))
    place = x[1].mean(0) + 1e4 * diagonal * torch.from_numpy(VIEW)
    shapes = [tm.complete(x[0], faces, [one]).shapes for one in (seen, replace(seen, view=None, camera=place))]
    assert error(*shapes, diagonal) < 0.1
