"""Motions completed from scans, markers and noisy meshes, beside what is simpler.

    python tests/benchmarks/completion.py [--motions husky fox] [--samples scans template markers noise]

Errors are mean distances of all vertices from the truth at the times of the samples, in percent of the diagonal.

- scans: whole key-frames every few frames, and between them a scan of 1,500 points of one side, with a noise of 0.3 %,
  of every second frame. Beside it the path through the key-frames, and that path fitted to each scan by closest points
  whose normals agree, with as-rigid-as-possible steps.
- template: the first frame alone, and such a scan of every other one. Beside it the template held still, and the
  closest points of each scan from the frame before.
- markers: key-frames as for scans, and 20 vertices of all other frames, with a noise of 1 %, a tenth of them lost.
  Beside it the path, and ``ShapeSpace.fit`` frame by frame.
- noise: all vertices of all frames with a noise of 1 %. Beside it the noise, and the mean over three times.

Hidden over seen is the error of the vertices that no point of the scan is near, over that of the others. Within is the
part of the vertices that are nearer to the truth than their expected errors, of which nine of ten should be, and rank
the correlation of the ranks of both. Volume is the largest difference from the true one. Seconds are of the processor.
"""

import argparse
import time
import warnings
from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from cases import animal, keyframes_of
from measures import NAN
from numpy.typing import NDArray
from results import Table, add_keep
from scipy.spatial import cKDTree
from scipy.stats import spearmanr
from spaces import markers
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.completion.pairs import SampledSurface
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.inspect import volume_of
from torch_modal.registration.fit import ElasticSurface
from torch_modal.registration.surface import places_between

MOTIONS = {
    "creature": ("", 2),
    "mh-hand-path": ("", 4),
    "husky": ("Gallop", 6),
    "fox": ("Gallop", 6),
    "trex": ("TRex_Run", 8),
    "cow": ("Gallop", 7),
    "velociraptor": ("Velociraptor_Run", 6),
}
"""Clip of each, and frames from one key-frame to the next."""
SAMPLES = {
    "scans": ("mh-hand-path", "husky", "fox", "trex", "cow"),
    "template": ("husky", "fox", "trex", "velociraptor"),
    "markers": ("creature", "mh-hand-path", "husky", "trex"),
    "noise": ("mh-hand-path", "husky", "trex"),
}
N_POINTS, LOST = 1500, 0.1
NOISE_OF_SCANS, NOISE = 0.003, 0.01
NEAR = 0.02  # of the diagonal, between a vertex that counts as seen and a point
Array = NDArray[np.float64]


def motion(name: str) -> tuple[Tensor, Tensor]:
    """Frames and faces."""
    clip = MOTIONS[name][0]
    if name == "creature":
        sample = tm.load_sample(name)
        frames = torch.stack([sample.keyframes, sample.truth], 1).flatten(0, 1)
        return frames[:-1].double(), sample.faces  # the last leads on to the first
    if not clip:
        return keyframes_of(name)
    frames, faces, clips = animal(name)
    start, end = next((i, j) for label, i, j in clips if label == clip)
    return frames[start:end], faces


def scan(x: Array, faces: NDArray[np.int64], view: Array, size: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points and normals of what is seen from a direction: front faces with nothing before them."""
    view = view / np.linalg.norm(view)
    across = np.cross(view, [0, 1, 0.1])
    across /= np.linalg.norm(across)
    mesh = trimesh.Trimesh(x, faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, 12 * N_POINTS, seed=int(rng.integers(1 << 30)))
    normals, depth = mesh.face_normals[face], points @ view
    cells = np.floor(points @ np.stack([across, np.cross(view, across)], 1) / (0.012 * size)).astype(int)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    nearest = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(nearest, cell.ravel(), depth)
    seen = np.flatnonzero((normals @ view > 0.15) & (nearest[cell.ravel()] - depth < 0.03 * size))
    seen = rng.permutation(seen)[:N_POINTS]
    return points[seen] + NOISE_OF_SCANS * size * rng.standard_normal((len(seen), 3)), normals[seen]


def closest_points(start: Array, rest: Array, faces: NDArray[np.int64], observation: tm.Observation) -> Array:
    """Fit a shape by closest points, from far to near, with as-rigid-as-possible steps."""
    scale = CANONICAL_SIZE / float(np.linalg.norm(rest.max(0) - rest.min(0)))
    points, normals = scale * observation.points.numpy(), observation.normals.numpy()
    surface, x = ElasticSurface(SampledSurface(scale * rest, faces)), scale * start
    for weight, reach in zip(np.geomspace(0.02, 1, 30), np.geomspace(15, 3, 30), strict=True):
        face, barycentric, distances, agree = SampledSurface(x, faces).most_alike(points, normals)
        used = agree & (distances < reach)
        places = places_between(faces[face[used]], barycentric[used], len(x))
        share = weight * surface.stiffness * min(1.0, len(x) / max(int(used.sum()), 1) / 2)
        x = surface.follow(x, [(places, points[used], np.full(int(used.sum()), share))], rounds=3)
    return x / scale


def scans(frames: Tensor, faces: Tensor, at: Sequence[int], size: float) -> list[tm.Observation]:
    """Scans of frames, from a camera that turns."""
    rng, observations = np.random.default_rng(0), []
    for i in at:
        view = np.array([np.cos(0.3 * i), 0.2, np.sin(0.3 * i)])
        points, normals = map(torch.from_numpy, scan(frames[i].numpy(), faces.numpy(), view, size, rng))
        noise = NOISE_OF_SCANS * size
        observations.append(tm.Observation(i, points, normals, view=torch.from_numpy(view), noise=noise))
    return observations


def noisy(frames: Tensor, at: Sequence[int], vertices: Tensor, lost: float, size: float) -> list[tm.Observation]:
    """Places of vertices, some of them lost."""
    rng, noise, observations = np.random.default_rng(0), NOISE * size / 3**0.5, []
    for i in at:
        kept = vertices[torch.from_numpy(rng.random(len(vertices)) >= lost)]
        points = frames[i, kept] + noise * torch.from_numpy(rng.standard_normal((len(kept), 3)))
        observations.append(tm.Observation(i, points, vertices=kept, noise=noise))
    return observations


def complete(name: str, samples: str) -> tuple[list[float], float]:
    """Errors without samples, of what is simple, and completed; hidden over seen; within, rank, volume; seconds."""
    frames, faces = motion(name)
    step = MOTIONS[name][1]
    size = float((frames[0].amax(0) - frames[0].amin(0)).norm())
    whole = list(range(0, len(frames), step)) if samples in ("scans", "markers") else []
    frames = frames[: whole[-1] + 1] if whole else frames
    skipped = 2 if samples == "scans" else 1
    at = [i for i in range(0 if samples == "noise" else 1, len(frames)) if i not in whole and i % skipped == 0]
    truth, keyframes = frames[at], frames[whole] if whole else frames[0]
    if whole:
        path = tm.Path(keyframes, faces, times=whole)
        without = path(keyframes, torch.tensor(at, dtype=torch.float64))
    else:
        without = frames[:1].expand_as(truth)
    if samples in ("scans", "template"):
        observations, fits = scans(frames, faces, at, size), []
        for i, one in enumerate(observations):
            rest = without[i].numpy()
            start = fits[-1] if samples == "template" and i else rest
            fits.append(closest_points(start, rest, faces.numpy(), one))
        simple = torch.from_numpy(np.stack(fits))
    elif samples == "markers":
        observations = noisy(frames, at, markers(frames[0]), LOST, size)
        space = tm.ShapeSpace(tm.extract_bases(keyframes, faces, 10), faces)
        simple = torch.stack([space.fit(one.points, one.vertices).shape for one in observations])
    else:
        observations = noisy(frames, at, torch.arange(frames.shape[1]), 0, size)
        without = torch.stack([one.points for one in observations])
        simple = without.clone()
        simple[1:-1] = (without[:-2] + without[1:-1] + without[2:]) / 3
    start = time.process_time()
    result = tm.complete(keyframes, faces, observations, times=whole or None)
    seconds = time.process_time() - start
    off = (result.shapes - truth).norm(dim=-1)
    near = [cKDTree(one.points).query(x)[0] < NEAR * size for one, x in zip(observations, truth, strict=True)]
    seen = torch.from_numpy(np.stack(near))
    hidden = float(off[~seen].mean() / off[seen].mean()) if (~seen).any() else NAN
    within = 100 * float((off <= result.errors).double().mean())
    rank = float(spearmanr(result.errors.flatten(), off.flatten()).statistic)
    errors = [100 / size * float((x - truth).norm(dim=-1).mean()) for x in (without, simple, result.shapes)]
    volumes = np.array([[volume_of(x.numpy(), faces.numpy()) for x in shapes] for shapes in (result.shapes, truth)])
    return [*errors, hidden, within, rank, 100 * float(abs(volumes[0] / volumes[1] - 1).max())], seconds


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--motions", nargs="+", choices=MOTIONS, default=list(MOTIONS))
    parser.add_argument("--samples", nargs="+", choices=SAMPLES, default=list(SAMPLES))
    add_keep(parser)
    options = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")
    columns = [
        "samples",
        "motion",
        "without, %",
        "simple, %",
        "completed, %",
        "hidden over seen",
        "within, %",
        "rank",
        "volume, %",
        "s",
    ]
    check = "--samples markers --motions mh-hand-path"
    with Table("completion", columns, options.keep, columns[-1:], check, labels=2) as table:
        for samples in options.samples:
            for name in SAMPLES[samples]:
                if name in options.motions:
                    values, seconds = complete(name, samples)
                    table.add(samples, name, *(f"{v:.2f}" if np.isfinite(v) else "-" for v in values), f"{seconds:.0f}")


if __name__ == "__main__":
    main()
