"""Shape spaces of a handful of poses: a pose left out from 20 of its vertices, by components, and among new members.

    python tests/benchmarks/spaces.py [--sets fox creature] [--step 1] [--draws 200]

Of each set, every pose is left out in turn (every second with ``--step 2``); the others are the space. Distances are
means over the vertices, in percent of the diagonal; edges are mean errors of length, in percent. Means over poses and
sets are geometric. The linear span has the same unknowns without variation over the surface (a weight for each pose and
a rigid motion), and of seven ridges the one that is best by the truth. The nearest pose is the one that is nearest by
the truth, moved rigidly by the 20 vertices.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator

import numpy as np
import torch
from cases import DATA, animal, keyframes_of
from measures import distance_and_edges
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

ANIMALS = ("fox", "husky", "cow", "trex", "velociraptor", "frog")
FOLDERS = ("mh-hand", "mh-hand-path", "mh-woman", "ict-face")
N_POSES, N_MARKERS = 8, 20
RIDGES = (0.0, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3)


def sets(names: list[str]) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Name, poses and faces of each; of the animals eight poses, even over all of their clips."""
    for name in names:
        if name in ANIMALS:
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


def by_components(space: tm.ShapeSpace, poses: Tensor, truth: Tensor, faces: Tensor) -> tuple[float, float]:
    """Distance of a pose from its projections to all components: of rotations and strains, and of displacements."""
    everywhere = torch.arange(len(truth))
    components = space.components()
    own = moved(components.shapes(components.coordinates(truth)), truth, everywhere)
    poses = moved(poses, truth, everywhere)
    left = (poses - poses.mean(0)).flatten(1)
    off = (truth - poses.mean(0)).flatten()
    weights = torch.linalg.lstsq(left.mT, off[:, None], driver="gelsd").solution
    straight = poses.mean(0) + (left.mT @ weights).view_as(truth)
    return errors(own, truth, faces)[0], errors(straight, truth, faces)[0]


def coverage(space: tm.ShapeSpace, poses: Tensor, truth: Tensor, n: int) -> tuple[float, float, int, float, float]:
    """Distance to the nearest of n members, and of n linear mixtures; folds more than poses have; volume's range."""
    everywhere, variation = torch.arange(len(truth)), space.variation()
    members = space.sample(n, torch.Generator().manual_seed(0)).double()
    poses = moved(poses, poses[0], everywhere)
    weights = -torch.rand(n, len(poses), generator=torch.Generator().manual_seed(0), dtype=torch.float64).log()
    mixtures = torch.einsum("nk,kvc->nvc", weights / weights.sum(1, keepdim=True), poses)

    def nearest(shapes: Tensor) -> float:
        return float((moved(shapes, truth, everywhere) - truth).norm(dim=-1).mean(-1).min())

    most = max(variation.folds(x) for x in poses)
    more = sum(variation.folds(x) > most for x in members)
    a, b, c = members[:, space.faces].unbind(2)
    volumes = (a * torch.linalg.cross(b, c)).sum((-1, -2))
    a, b, c = poses[:, space.faces].unbind(2)
    own = (a * torch.linalg.cross(b, c)).sum((-1, -2)).mean()
    return nearest(members), nearest(mixtures), more, float(volumes.min() / own), float(volumes.max() / own)


def row(label: str, rows: dict[str, list[tuple[float, float]]], covered: list[tuple[float, ...]]) -> None:
    """Print means of several poses."""
    mean = {name: np.exp(np.log(np.maximum(values, 1e-3)).mean(0)) for name, values in rows.items()}
    over, near, parts = mean["fit"] / mean["linear"], mean["fit"] / mean["nearest"], mean["components"]
    text = f"{label:<14}{mean['fit'][0]:>7.2f}{mean['fit'][1]:>7.2f}{over[0]:>9.2f}{over[1]:>7.2f}{near[0]:>9.2f}"
    text += f"{near[1]:>7.2f}{parts[0] / parts[1]:>12.2f}"
    if covered:
        ratio = float(np.exp(np.mean([np.log(one / other) for one, other, *_ in covered])))
        more, low, high = sum(one[2] for one in covered), min(one[3] for one in covered), max(one[4] for one in covered)
        text += f"{ratio:>10.2f}{more:>7.0f}{low:>8.2f} to {high:.2f}"
    print(text, flush=True)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=["creature", *(ANIMALS + FOLDERS if DATA.is_dir() else ())])
    parser.add_argument("--step", type=int, default=1, help="every so many poses are left out")
    parser.add_argument("--draws", type=int, default=200, help="new members; 0: none")
    parser.add_argument("--modes", type=int, default=10, help="of each key-frame")
    arguments = parser.parse_args()
    limit_threads()
    print(
        f"{'':<14}{'fit, %':^14}{'/ linear':^16}{'/ nearest':^16}{'components':>12}{'coverage':>10}{'folds':>7}  volume"
    )
    halves = f"{'dist.':>9}{'edges':>7}"
    print(f"{'':<14}{'dist.':>7}{'edges':>7}{halves}{halves}{'/ linear':>12}{'/ linear':>10}")
    every: dict[str, list[tuple[float, float]]] = defaultdict(list)
    all_covered: list[tuple[float, ...]] = []
    seconds = []
    for name, poses, faces in sets(arguments.sets):
        bases = tm.extract_bases(poses, faces, arguments.modes)
        rows: dict[str, list[tuple[float, float]]] = defaultdict(list)
        covered = []
        for out in range(0, len(poses), arguments.step):
            kept, truth = [k for k in range(len(poses)) if k != out], poses[out]
            picked, others = markers(truth), poses[kept]
            space = tm.ShapeSpace([bases[k] for k in kept], faces)
            space.variation()
            start = time.process_time()
            found = space.fit(truth[picked], picked)
            seconds.append(time.process_time() - start)
            rows["fit"].append(errors(found.shape, truth, faces))
            rows["linear"].append(linear(others, truth, picked, faces))
            rows["nearest"].append(min(errors(x, truth, faces) for x in moved(others, truth, picked)))
            rows["components"].append(by_components(space, others, truth, faces))
            if arguments.draws:
                covered.append(coverage(space, others, truth, arguments.draws))
        row(f"{name}, {len(poses)}", rows, covered)
        for key, values in rows.items():
            every[key] += values
        all_covered += covered
    row("all", every, all_covered)
    print(f"seconds of a fit: {np.median(seconds):.1f}, at most {max(seconds):.1f}")


if __name__ == "__main__":
    main()
