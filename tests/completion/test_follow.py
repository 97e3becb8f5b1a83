"""Shapes that follow clouds: their volume, and all vertices after coarse ones."""

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import torch_modal as tm
from torch_modal.completion.clouds import Camera
from torch_modal.completion.details import Details
from torch_modal.completion.follow import follow, volumes_at
from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.pairs import MANY_FACES, SampledSurface
from torch_modal.geometry.inspect import volume_of
from torch_modal.modes.coarsening import coarsen

VIEW = np.array([0.6, 0.0, 0.8])


@pytest.fixture(scope="module")
def creature() -> tuple[Tensor, Tensor]:
    """Two key-frames at a size of 100."""
    sample = tm.load_sample("creature")
    x = sample.keyframes[:2].double()
    return 100 / float((x[0].amax(0) - x[0].amin(0)).norm()) * x, sample.faces


def problem_of(x: Tensor, faces: Tensor, times: list[float], only: np.ndarray | None = None) -> CompletionProblem:
    """A cloud of a shape at the time 1, all of it or the side that faces a view."""
    surface = SampledSurface(x[-1].numpy(), faces.numpy())
    some = np.arange(len(faces)) if only is None else np.flatnonzero(surface.face_normals @ only > 0.2)
    cloud = tm.Observation(1.0, *(torch.from_numpy(y[some]) for y in (surface.face_centres, surface.face_normals)))
    return CompletionProblem(x[: max(len(times), 1)].numpy(), faces, np.array(times), [cloud])


def swollen(problem: CompletionProblem, by: float) -> Tensor:
    """The template, thicker everywhere. *Shape:* ``(V, 3)``."""
    x = problem.template
    return x + by * torch.from_numpy(SampledSurface(x.numpy(), problem.mesh).vertex_normals)


def test_what_no_point_is_near_keeps_the_volume(creature: tuple[Tensor, Tensor]) -> None:
    x, faces = creature
    problem = problem_of(x[:1], faces, [], VIEW)
    (volume,) = volumes_at([1.0], problem.times, problem.whole, problem.mesh)
    assert volume is not None
    assert volume == pytest.approx(volume_of(problem.template.numpy(), problem.mesh.faces))
    thick, (frame,) = swollen(problem, 0.2), problem.frames
    off, misses = [], []
    for kept in (None, volume):
        y = follow(frame, thick, problem.mesh, 8, (6.0, 1.5), kept).numpy()
        off.append(volume_of(y, problem.mesh.faces) / volume - 1)
        misses.append(np.median(frame.seen[0].misses(SampledSurface(y, problem.mesh))[0]))
    assert off[0] > 0.06 and abs(off[1]) < 0.005
    assert misses[1] < 0.05


def test_a_volume_that_all_points_show_is_not_changed(creature: tuple[Tensor, Tensor]) -> None:
    """A heart contracts."""
    x, faces = creature
    problem = problem_of(x[:1], faces, [])
    (frame,), volume = problem.frames, volume_of(problem.template.numpy(), problem.mesh.faces)
    y = [follow(frame, problem.template, problem.mesh, 8, (6.0, 1.5), kept) for kept in (None, 1.3 * volume)]
    assert float((y[1] - y[0]).norm(dim=1).mean()) < 0.1
    assert volume_of(y[1].numpy(), problem.mesh.faces) < 1.05 * volume


def test_volumes_are_between_those_of_keyframes_and_none_of_open_ones(creature: tuple[Tensor, Tensor]) -> None:
    x, faces = creature
    problem = problem_of(x, faces, [0.0, 2.0])
    volumes = [volume_of(one.numpy(), problem.mesh.faces) for one in problem.whole]
    between = volumes_at([0.5, 2.0], problem.times, problem.whole, problem.mesh)
    assert between == pytest.approx([0.75 * volumes[0] + 0.25 * volumes[1], volumes[1]])
    opened = problem_of(x[:1], faces[: len(faces) // 2], [])
    assert volumes_at([1.0], opened.times, opened.whole, opened.mesh) == [None]


def test_vertices_follow_coarse_ones_with_their_details(creature: tuple[Tensor, Tensor]) -> None:
    """Ten vertices in each cluster."""
    x, faces = creature
    unused = x[:, :1] + 1.0
    x = torch.cat([x, unused], 1)
    problem = problem_of(x, faces, [])
    coarse = coarsen(problem.whole.numpy(), faces.numpy(), 1000)
    truth = torch.from_numpy(problem.to_canonical(x[1]))
    (y,) = Details(problem, coarse).add(1.0, torch.from_numpy(coarse.restrict(truth.numpy())))
    off = (y - truth).norm(dim=1)[:-1]
    moved = float((truth - problem.template).norm(dim=1).mean())
    assert float(off.mean()) < 0.03 * moved and float((y - truth)[-1].norm()) < moved
    with_keyframes = problem_of(x, faces, [0.0, 2.0])
    details = Details(with_keyframes, coarse)
    path = tm.Path(with_keyframes.whole, faces, times=[0.0, 2.0])(with_keyframes.whole, 1.0)
    (y,) = details.add(1.0, torch.from_numpy(coarse.restrict(path.numpy())))
    assert float((y - path).norm(dim=1).max()) < 1e-9


def test_a_mesh_of_few_faces_is_its_own_coarse_one(creature: tuple[Tensor, Tensor]) -> None:
    x, faces = creature
    problem = problem_of(x, faces, [])
    coarse, y = coarsen(problem.whole.numpy(), faces.numpy(), len(faces)), problem_of(x[1:], faces, []).template
    assert float((Details(problem, coarse).add(1.0, y)[0] - y).norm(dim=1).max()) < 1e-9


def test_points_are_paired_with_a_mesh_of_many_faces(creature: tuple[Tensor, Tensor]) -> None:
    """One place in each face finds as near ones as four, where faces are small."""
    x, faces = creature
    fine = SampledSurface(*trimesh.remesh.subdivide(x[0].numpy(), faces.numpy()))
    assert len(fine.faces) > MANY_FACES and len(fine.samples) == len(fine.faces)
    some = np.random.default_rng(0).choice(len(fine.faces), 2000)
    points = fine.face_centres[some] + 0.05 * fine.face_normals[some]
    distances = [
        each.most_alike(points, fine.face_normals[some])[2]
        for each in (fine, SampledSurface(x[0].numpy(), faces.numpy()))
    ]
    assert np.median(distances[0]) < 1.01 * np.median(distances[1]) and np.percentile(distances[0], 99) < 0.06
    seen = fine.visible(Camera(VIEW))
    assert 0.2 < len(seen) / len(fine.faces) < 0.6
