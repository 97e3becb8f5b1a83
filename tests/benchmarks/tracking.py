"""Motions tracked through clouds of points, scored as learned methods that track them are.

    python tests/benchmarks/tracking.py FOLDER [--only NAME ...]

The folder has clouds with normals, ``NAME00.ply``, ``NAME01.ply``, ..., and for each name the meshes that they were
sampled from, of one connectivity, ``NAME/*.obj``, as many as clouds. ``complete`` gets the first mesh alone, as a
template, and the clouds. From 100,000 samples of each surface, in the units of the files:

- Chamfer: the sum of the mean squared distances from either surface to the other, halved;
- consistency: the mean cosine between the normals of nearest samples, whatever their signs;
- F: the harmonic mean of both fractions of samples that are nearer than 0.005;
- correspondence: the mean distance of 20,000 points of the first surface, followed through all frames, from their true
  places;
- vertices: the mean distance of all vertices in percent of the diagonal, of all frames, the first and the last.

Seconds are of one processor.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import torch
import trimesh
from results import Table, add_keep
from scipy.spatial import cKDTree
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.arrays import FloatArray, IntArray

N_SAMPLES, N_FOLLOWED, NEAR = 100_000, 20_000, 0.005
COLUMNS = [
    "",
    "frames",
    "Chamfer, e-5",
    "consistency",
    "F",
    "correspondence",
    "vertices, %",
    "first, %",
    "last, %",
    "s",
]


def surface_scores(x: FloatArray, truth: FloatArray, faces: IntArray) -> list[float]:
    """Chamfer distance, normal consistency and F of a shape. *Shape:* ``(V, 3)``."""
    meshes = [trimesh.Trimesh(each, faces, process=False) for each in (x, truth)]
    (p, at_p), (q, at_q) = (trimesh.sample.sample_surface(mesh, N_SAMPLES, seed=0) for mesh in meshes)
    n, m = meshes[0].face_normals[at_p], meshes[1].face_normals[at_q]
    (there, i), (back, j) = cKDTree(q).query(p), cKDTree(p).query(q)
    cosines = [np.abs((n * m[i]).sum(1)).mean(), np.abs((m * n[j]).sum(1)).mean()]
    precision, recall = (there < NEAR).mean(), (back < NEAR).mean()
    f = 2 * precision * recall / max(precision + recall, 1e-12)
    return [0.5 * float((there**2).mean() + (back**2).mean()), float(np.mean(cosines)), float(f)]


def scores(found: Tensor, truth: Tensor, faces: Tensor) -> list[float]:
    """All scores but the time. *Shape:* ``(T, V, 3)``, the first of which is the template."""
    x, y, triangles = found.numpy(), truth.numpy(), faces.numpy()
    surface = np.mean([surface_scores(*pair, triangles) for pair in zip(x[1:], y[1:], strict=True)], 0)
    points, at = trimesh.sample.sample_surface(trimesh.Trimesh(y[0], triangles, process=False), N_FOLLOWED, seed=1)
    weights = trimesh.triangles.points_to_barycentric(y[0][triangles[at]], points)
    followed = np.einsum("nc,tncx->tnx", weights, (x - y)[1:, triangles[at]])
    size = np.linalg.norm(np.ptp(y[0], axis=0))
    off = 100 / size * np.linalg.norm(x - y, axis=-1).mean(1)[1:]
    return [*surface, float(np.linalg.norm(followed, axis=-1).mean()), off.mean(), off[0], off[-1]]


def track(folder: Path, name: str) -> tuple[int, list[float]]:
    """Number of frames, and all scores."""
    meshes, clouds = sorted((folder / name).glob("*.obj")), sorted(folder.glob(f"{name}[0-9]*.ply"))
    if len(meshes) != len(clouds) or len(meshes) < 2:
        raise SystemExit(f"{folder / name} has {len(meshes)} meshes (*.obj), and {folder} {len(clouds)} clouds of it")
    truth, faces = tm.load_keyframes(meshes)
    seen = tm.load_observations(clouds[1:], truth.shape[1], [float(i) for i in range(1, len(clouds))])
    start = time.process_time()
    shapes = tm.complete(truth[0], faces, seen).shapes
    seconds = time.process_time() - start
    return len(meshes), [*scores(torch.cat([truth[:1], shapes]), truth, faces), seconds]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", nargs="+", help="names of motions")
    add_keep(parser)
    options = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")
    names = options.only or sorted(each.name for each in options.folder.iterdir() if each.is_dir())
    with Table("tracking", COLUMNS, options.keep, COLUMNS[-1:]) as table:
        for name in names:
            n, (chamfer, consistency, f, correspondence, *rest) = track(options.folder, name)
            errors = [f"{value:.2f}" for value in rest[:-1]]
            numbers = f"{1e5 * chamfer:.2f}", f"{consistency:.3f}", f"{f:.3f}", f"{correspondence:.4f}"
            table.add(name, str(n), *numbers, *errors, f"{rest[-1]:.0f}")


if __name__ == "__main__":
    main()
