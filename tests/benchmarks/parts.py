"""Parts and landmarks of a body from few labelled poses: what each augmentation brings.

    python tests/benchmarks/parts.py [--bodies gestures fox] [--poses 2 4 8] [--seeds 5] [--arms rigid linear]

The sample hand and creature have labels from their bones, and their motion is known at any time; ``gestures`` are 49
poses of the hand with each digit closed by a random amount; the parts of the animals beside the repository are clusters
of vertices that turn alike in all frames. The poses with labels are far from each other: the first frame, then always
the one that is farthest from those chosen. 24 others are the test. A small PointNet labels the points of noisy clouds
that are turned by up to 15 degrees; another tells where 12 landmarks are. Of each arm, 300 more shapes are made once:

- ``none``: only the poses, as they are; ``rigid``: turned as in the test, as in all arms below;
- ``linear``: on straight lines between two poses;
- ``modal``: ``RandomModalDeformation`` of a pose, of strains up to 0.03;
- ``in-between``: ``RandomInBetween``; ``weighted``: ``ShapeSpace.sample``; ``both``: half of each;
- ``all frames``: every other frame of the body, for comparison.

IoU is the mean over the parts, in percent, landmarks are mean distances in percent of the diagonal; means and standard
deviations of the seeds. Seconds are those of one seed with its share of the shapes.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from cases import DATA, animal
from scipy.cluster.vq import kmeans2
from timing import limit_threads
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.triangle_frames import frames, sides

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from augment_segmentation import BATCH, N_MORE, N_POINTS, NOISE, TURNS, PointNet, mean_iou, trained
from make_samples import gesture, parts_of, sculpted
from train_timing import farthest_points

N_FRAMES, N_TEST, N_PARTS, N_LANDMARKS, N_MODES = 49, 24, 12, 12, 30
SCULPTED = {  # sample, motion if not its own, times
    "gestures": ("hand", gesture, np.arange(N_FRAMES)),
    "hand": ("hand", None, np.linspace(0, 1, N_FRAMES)),
    "creature": ("creature", None, np.linspace(0, 6, N_FRAMES)),
}
ARMS = ("none", "rigid", "linear", "modal", "in-between", "weighted", "both", "all frames")


class Task(NamedTuple):
    """A body with labels."""

    x: Tensor
    """All frames, aligned with the first. *Shape:* ``(T, V, 3)``."""
    faces: Tensor
    parts: Tensor
    """*Shape:* ``(V,)``."""
    landmarks: Tensor
    """Vertices that are far from each other. *Shape:* ``(N_LANDMARKS,)``."""


def load(body: str) -> Task:
    """A body of either kind."""
    if body in SCULPTED:
        sample, motion, times = SCULPTED[body]
        made = sculpted(sample, motion)
        x, faces = torch.tensor(np.stack([made.frame(t) for t in times])), torch.tensor(made.faces).long()
        parts = torch.tensor(parts_of(sample, x[0].numpy()))
    else:
        x, faces, _ = animal(body)
        parts = co_moving(x[:: max(1, len(x) // N_FRAMES)], faces)
    x = best_fit(x, x[0].expand_as(x), torch.ones(x.shape[1]).to(x)).apply(x)
    return Task(x.float(), faces, parts, farthest_points(x[0], N_LANDMARKS, first=0))


def co_moving(x: Tensor, faces: Tensor) -> Tensor:
    """Clusters of vertices that turn alike, near each other. *Shape:* ``(T, V, 3) -> (V,)``."""
    found = frames(sides(x.movedim(-1, 0).contiguous(), faces))
    axes = torch.stack([found.e1, found.e2, found.normal])  # (3, 3, T, F)
    turned = torch.einsum("aitf,ajf->ijtf", axes, axes[:, :, 0]).flatten(0, 2) / len(x) ** 0.5
    vertices = torch.zeros(x.shape[1], len(turned)).to(x).index_add(0, faces.T.flatten(), turned.T.repeat(3, 1))
    vertices = vertices / torch.bincount(faces.flatten(), minlength=x.shape[1])[:, None]
    place = x[0] / (x[0].amax(0) - x[0].amin(0)).norm()
    features = torch.cat([vertices, 3 * place], 1).numpy()
    labels = kmeans2(features, N_PARTS, iter=50, minit="++", seed=0)[1]
    return torch.unique(torch.tensor(labels), return_inverse=True)[1]


def further(arm: str, space: tm.ShapeSpace, rest: Tensor) -> Tensor:
    """Shapes beside the poses. *Shape:* ``(N, V, 3)``."""
    generator, poses = torch.Generator().manual_seed(0), space.keyframes()
    i, j = torch.stack([torch.randperm(len(poses), generator=generator)[:2] for _ in range(N_MORE)]).T
    if arm == "linear":
        return torch.lerp(poses[i], poses[j], torch.rand(N_MORE, 1, 1, generator=generator))
    if arm == "modal":
        return tm.RandomModalDeformation(strain=(0.0, 0.03), p=1.0, space=space, generator=generator)(poses[i])
    if arm == "all frames":
        return rest
    made = [poses[:0]]
    share = N_MORE // (1 + (arm == "both"))
    if arm in ("in-between", "both"):
        made.append(tm.RandomInBetween(p=1.0, space=space, generator=generator)(poses[i[:share]]))
    if arm in ("weighted", "both"):
        made.append(space.sample(share, generator))
    return torch.cat(made)


def landmark_error(task: Task, pool: Tensor, test: Tensor, seed: int, steps: int, turns: float) -> float:
    """Of a network that is trained on a pool of shapes, in percent of the diagonal."""
    torch.manual_seed(seed)
    network = PointNet(1)
    network.head = nn.Sequential(nn.ReLU(), nn.Linear(96, 64), nn.ReLU(), nn.Linear(64, 3 * N_LANDMARKS))
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, steps)
    generator = torch.Generator().manual_seed(seed)
    size = (task.x[0].amax(0) - task.x[0].amin(0)).norm()

    def predicted(x: Tensor, generator: torch.Generator, turns: float) -> tuple[Tensor, Tensor]:
        """Where the landmarks are found and where they are, from the middle of the cloud, in sizes of the body."""
        chosen = torch.rand(x.shape[:2], generator=generator).argsort(1)[:, :N_POINTS]
        both = torch.cat([x.gather(1, chosen[..., None].expand(-1, -1, 3)), x[:, task.landmarks]], 1) / size
        both = both - both[:, :N_POINTS].mean(1, keepdim=True)
        both = tm.RandomRigidMotion(degrees=turns, p=1.0, generator=generator)(both)
        points, truth = both[:, :N_POINTS], both[:, N_POINTS:]
        points = points + NOISE / 2 * torch.randn(points.shape, generator=generator)
        return network(points).mean(1).view(truth.shape), truth

    for _ in range(steps):
        found, truth = predicted(pool[torch.randint(len(pool), (BATCH,), generator=generator)], generator, turns)
        loss = (found - truth).norm(dim=-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    generator = torch.Generator().manual_seed(12345)
    with torch.no_grad():
        pairs = [predicted(test, generator, TURNS) for _ in range(10)]
    return 100 * float(torch.stack([(found - truth).norm(dim=-1).mean() for found, truth in pairs]).mean())


def run(body: str, n_poses: int, arms: list[str], seeds: int, steps: int) -> None:
    """Print a table."""
    task = load(body)
    given = farthest_points(task.x.flatten(1), n_poses, first=0)
    others = torch.arange(len(task.x))[(task.x[:, None] - task.x[given]).abs().amax((2, 3)).amin(1) > 0]
    test = others[torch.linspace(0, len(others) - 1, N_TEST).round().long()]
    rest = torch.tensor([i for i in others.tolist() if i not in set(test.tolist())])
    poses = task.x[given]
    bases = tm.extract_bases(poses, task.faces, N_MODES, progress=False)
    space = tm.ShapeSpace(bases, task.faces)
    print(f"\n| {body}, {n_poses} poses | IoU, % | landmarks, % | s |\n|---|---|---|---|", flush=True)
    for arm in arms:
        start = time.process_time()
        more = further(arm, space, task.x[rest])
        turns = 0.0 if arm == "none" else TURNS
        pool = torch.cat([poses.repeat(max(1, len(more) // (4 * n_poses)), 1, 1), more])
        iou, distance = [], []
        for seed in range(seeds):
            network = trained(pool, task.parts, seed, steps, turns)
            iou.append(100 * mean_iou(network, task.x[test], task.parts))
            distance.append(landmark_error(task, pool, task.x[test], seed, steps, turns))
        cells = [f"{np.mean(values):.1f} ± {np.std(values):.1f}" for values in (iou, distance)]
        print(f"| {arm} | {' | '.join(cells)} | {(time.process_time() - start) / seeds:.0f} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    animals = ["fox", "trex"] if DATA.is_dir() else []
    parser.add_argument("--bodies", nargs="+", default=["gestures", "hand", "creature", *animals])
    parser.add_argument("--poses", nargs="+", type=int, default=[2, 4, 8])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=ARMS)
    given = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")  # in-betweens that did not converge
    for body in given.bodies:
        for n_poses in given.poses:
            run(body, n_poses, given.arms, given.seeds, given.steps)


if __name__ == "__main__":
    main()
