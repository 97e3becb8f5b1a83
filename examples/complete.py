"""A whole motion from two whole key-frames and scans that see one side.

    python examples/complete.py [FOLDER]

The sample creature gallops. Known are two key-frames of the six, and five scans between them: noisy points of the side
that a camera sees, which walks around the animal. Written are the motion (complete.glb), and a picture of what was seen
above what was completed (complete.png). Errors are mean distances of all vertices to the truth, in % of the diagonal.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

import torch_modal as tm

FIRST, LAST = 0, 3
"""Key-frames that are known."""
NOISE = 0.003
"""Of the points, over the diagonal."""


def scan(shape: Tensor, faces: Tensor, view: Tensor, n: int, noise: float, seed: int) -> tuple[Tensor, Tensor]:
    """Points of the surface that a camera far away in a direction sees, and their normals. *Shape of each:* ``(n, 3)``.

    Visible is what faces the camera, and is the first in its cell of a depth image.
    """
    mesh = trimesh.Trimesh(shape.numpy(), faces.numpy(), process=False)
    points, index = trimesh.sample.sample_surface(mesh, 60 * n, seed=seed)
    normals, axis = mesh.face_normals[index], view.numpy() / np.linalg.norm(view)
    points, normals = points[normals @ axis > 0.15], normals[normals @ axis > 0.15]
    side = np.linalg.svd(axis[None])[2][1:]  # directions of the image
    cells = np.floor(points @ side.T / (mesh.scale / 150)).astype(int)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    nearest = np.full(cell.max() + 1, -np.inf)
    np.maximum.at(nearest, cell, points @ axis)
    rng = np.random.default_rng(seed)
    visible = rng.permutation(np.flatnonzero(points @ axis > nearest[cell] - mesh.scale / 75))[:n]
    noisy = points[visible] + noise * rng.standard_normal((len(visible), 3))
    return torch.from_numpy(noisy), torch.from_numpy(normals[visible])


def main(folder: Path, n_points: int = 1500) -> dict[str, float]:
    """Errors of the path through the key-frames alone, and of the completed motion, over the diagonal.

    Args:
        folder: For both files.
        n_points: Of each scan.
    """
    sample = tm.load_sample("creature")
    known = dict(enumerate(sample.keyframes)) | dict(zip(sample.true_times, sample.truth, strict=True))
    times = [time for time in sorted(known) if FIRST < time < LAST]
    truth = torch.stack([known[time] for time in times])
    diagonal = float((truth[0].amax(0) - truth[0].amin(0)).norm())
    observations = []
    for seed, time in enumerate(times):
        azimuth, elevation = np.radians([sample.view[0] + 45 * seed, 15])
        view = torch.tensor(
            [np.sin(azimuth) * np.cos(elevation), np.sin(elevation), np.cos(azimuth) * np.cos(elevation)]
        )
        points, normals = scan(known[time], sample.faces, view, n_points, NOISE * diagonal, seed)
        observations.append(tm.Observation(time, points, normals, noise=NOISE * diagonal, view=view))

    keyframes = sample.keyframes[[FIRST, LAST]]
    completion = tm.complete(keyframes, sample.faces, observations, times=[FIRST, LAST])
    alone = tm.Path(keyframes, sample.faces, times=[FIRST, LAST])(keyframes, completion.times)

    folder.mkdir(parents=True, exist_ok=True)
    frames = torch.linspace(FIRST, LAST, 25, dtype=torch.float64)
    ends = [0, len(frames) - 1]
    tm.save_animation(completion(frames), sample.faces, folder / "complete.glb", fps=24, keyframe_indices=ends)
    tm.render_sequence(
        {"completed": completion.shapes, "true": truth},
        sample.faces,
        folder / "complete.png",
        titles=[f"t = {time:g}" for time in times],
        keyframe_indices=[],
        view=sample.view,
        colors={"completed": 100 * completion.errors / diagonal},
        color_label="expected error in % of the diagonal",
        points={"seen": [one.points for one in observations]},
    )
    return {
        name: float((x - truth).norm(dim=-1).mean()) / diagonal
        for name, x in (("path", alone), ("completed", completion.shapes))
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("out/complete"))
    for name, error in main(parser.parse_args().folder).items():
        print(f"{name}: {100 * error:.2f} % of the diagonal")
