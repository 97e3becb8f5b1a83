"""Shape spaces of a handful of poses: a pose left out from 20 of its vertices.

    python tests/benchmarks/spaces.py [--sets fox creature] [--step 2]

Of each set, every second pose is left out in turn (every one with ``--step 1``); the others are the space. Distances
are means over the vertices, in percent of the diagonal; edges are mean errors of length, in percent. Means over poses
are geometric. The linear span has the same unknowns without variation over the surface (a weight for each pose
and a rigid motion), and of seven ridges the one that is best by the truth. The nearest pose is the one that is nearest
by the truth, moved rigidly by the 20 vertices. Seconds are of the processor, on one thread.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np
import torch
from cases import DATA, animal, keyframes_of
from measures import distance_and_edges
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

SETS = ("creature", "fox", "frog", "mh-hand", "mh-hand-path", "mh-woman", "ict-face")
N_POSES, N_MARKERS = 8, 20
RIDGES = (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3)


def sets(names: list[str]) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Name, poses and faces of each; of the animals eight poses, even over all of their clips."""
    for name in names:
        if (DATA / "animals" / f"{name}.npz").exists():
            frames, faces, _ = animal(name)
            yield name, frames[np.linspace(0, len(frames) - 1, N_POSES).round().astype(int)], faces
        elif found := keyframes_of(name):
            yield name, *found


def moved(x: Tensor, to: Tensor, picked: Tensor) -> Tensor:
    """The best rigid motion by some vertices. *Shape:* ``(..., V, 3), (V, 3)``."""
    seen = x[..., picked, :]
    return best_fit(seen, to[picked].expand_as(seen), torch.ones(len(picked)).to(x)).apply(x)


def markers(x: Tensor) -> Tensor:
    """Vertices that are far from each other."""
    found, distances = [0], (x - x[0]).norm(dim=-1)
    while len(found) < N_MARKERS:
        found.append(int(distances.argmax()))
        distances = torch.minimum(distances, (x - x[found[-1]]).norm(dim=-1))
    return torch.tensor(found)


def errors(x: Tensor, truth: Tensor, faces: Tensor) -> tuple[float, float]:
    """Distance, and error of edges, in percent."""
    return distance_and_edges(x, truth, faces, float((truth.amax(0) - truth.amin(0)).norm()))


def linear(poses: Tensor, truth: Tensor, picked: Tensor, faces: Tensor) -> tuple[float, float]:
    """Of the linear span, with the best ridge."""
    everywhere = torch.arange(len(truth))
    poses = moved(poses, moved(poses, poses[0], everywhere).mean(0), everywhere)
    mean, off = poses.mean(0), poses - poses.mean(0)
    size = float((truth.amax(0) - truth.amin(0)).norm())
    columns = off[:, picked] - off[:, picked].mean(1, keepdim=True)
    columns = columns.flatten(1).mT / size
    found = []
    for ridge in RIDGES:
        system = columns.mT @ columns + (N_MARKERS * ridge**2 + 1e-12) * torch.eye(len(poses)).to(poses)
        x = mean
        for _ in range(30):
            seen = x[picked]
            back = best_fit(seen, truth[picked], torch.ones(N_MARKERS).to(x)).inverse().apply(truth[picked])
            wanted = back - mean[picked]
            right = columns.mT @ ((wanted - wanted.mean(0)).flatten() / size)
            x = mean + torch.einsum("k,kvc->vc", torch.linalg.solve(system, right), off)
        found.append(errors(moved(x, truth, picked), truth, faces))
    return min(found)


def left_out(poses: Tensor, faces: Tensor, bases: list[tm.ModalBasis], step: int) -> Iterator[list[float]]:
    """Distance and edges of the fit, the linear span and the nearest pose, and seconds of the fit: of each pose."""
    for out in range(0, len(poses), step):
        kept, truth = [k for k in range(len(poses)) if k != out], poses[out]
        picked, others = markers(truth), poses[kept]
        space = tm.ShapeSpace([bases[k] for k in kept], faces)
        space.variation()
        start = time.process_time()
        found = space.fit(truth[picked], picked)
        seconds = time.process_time() - start
        nearest = min(errors(x, truth, faces) for x in moved(others, truth, picked))
        yield [*errors(found.shape, truth, faces), *linear(others, truth, picked, faces), *nearest, seconds]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=SETS, help="animals and folders of the data beside")
    parser.add_argument("--step", type=int, default=2, help="every so many poses are left out")
    parser.add_argument("--modes", type=int, default=10, help="of each key-frame")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    ways = "fit", "linear span", "nearest pose"
    columns = ["set, poses", *(f"{way}: {what}, %" for way in ways for what in ("distance", "edges")), "s per fit"]
    with Table("spaces", columns, given.keep, columns[-1:], "--sets creature") as table:
        for name, poses, faces in sets(given.sets):
            rows = list(left_out(poses, faces, tm.extract_bases(poses, faces, given.modes), given.step))
            *values, seconds = np.exp(np.log(np.maximum(rows, 1e-3)).mean(0))
            table.add(f"{name}, {len(poses)}", *(f"{value:.2f}" for value in values), f"{seconds:.1f}")


if __name__ == "__main__":
    main()
