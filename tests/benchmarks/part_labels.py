"""Parts and landmarks of a hand from few labelled poses: what each augmentation brings.

    python tests/benchmarks/part_labels.py [--poses 4] [--seeds 2] [--steps 800]

The body is the sample hand in 49 gestures, each digit closed by a random amount, with labels from its bones. The poses
with labels are far from each other: the first frame, then always the one that is farthest from those chosen. 24 others
are the test. A small PointNet labels the points of noisy clouds that are turned by up to 15 degrees; another tells
where 12 landmarks are. Of each arm, 300 more shapes are made once: on straight lines between two poses
(``linear mixtures``), or by a transform of the package; modal deformations have strains up to 0.03.

IoU is the mean over the parts, landmarks are mean distances over the diagonal; means of the seeds.
"""

import argparse
import sys
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit

sys.path.insert(0, str(Path(__file__).parents[2] / "examples"))
from augment_segmentation import BATCH, N_MORE, N_POINTS, NOISE, TURNS, PointNet, mean_iou, trained
from samples.make_samples import gesture, parts_of, sculpted
from train_timing import farthest_points

N_FRAMES, N_TEST, N_LANDMARKS, N_MODES = 49, 24, 12, 30
LINEAR, MODAL, BETWEEN, BLEND = "linear mixtures", "`RandomModalDeformation`", "`RandomInBetween`", "`RandomBlend`"
ARMS = ("none", LINEAR, MODAL, BETWEEN, BLEND)


class Task(NamedTuple):
    """A body with labels."""

    x: Tensor
    """All frames, aligned with the first. *Shape:* ``(T, V, 3)``."""
    faces: Tensor
    parts: Tensor
    """*Shape:* ``(V,)``."""
    landmarks: Tensor
    """Vertices that are far from each other. *Shape:* ``(N_LANDMARKS,)``."""


def gestures() -> Task:
    """Poses of the sample hand."""
    made = sculpted("hand", gesture)
    x = torch.tensor(np.stack([made.frame(t) for t in range(N_FRAMES)]))
    parts = torch.tensor(parts_of("hand", x[0].numpy()))
    x = best_fit(x, x[0].expand_as(x), torch.ones(x.shape[1]).to(x)).apply(x)
    return Task(x.float(), torch.tensor(made.faces).long(), parts, farthest_points(x[0], N_LANDMARKS, first=0))


def further(arm: str, space: tm.ShapeSpace) -> Tensor:
    """Shapes beside the poses. *Shape:* ``(N, V, 3)``."""
    generator, poses = torch.Generator().manual_seed(0), space.keyframes()
    i, j = torch.stack([torch.randperm(len(poses), generator=generator)[:2] for _ in range(N_MORE)]).T
    if arm == LINEAR:
        return torch.lerp(poses[i], poses[j], torch.rand(N_MORE, 1, 1, generator=generator))
    if arm == BLEND:
        return space.sample(N_MORE, generator)
    if arm == "none":
        return poses[:0]
    transform = tm.RandomInBetween if arm == BETWEEN else tm.RandomModalDeformation
    options: dict[str, Any] = {} if arm == BETWEEN else {"strain": (0.0, 0.03)}
    made: Tensor = transform(p=1.0, space=space, generator=generator, **options)(poses[i])
    return made


def landmark_error(task: Task, pool: Tensor, test: Tensor, seed: int, steps: int) -> float:
    """Of a network that is trained on a pool of shapes, over the diagonal."""
    torch.manual_seed(seed)
    network = PointNet(1)
    network.head = nn.Sequential(nn.ReLU(), nn.Linear(96, 64), nn.ReLU(), nn.Linear(64, 3 * N_LANDMARKS))
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, steps)
    generator = torch.Generator().manual_seed(seed)
    size = (task.x[0].amax(0) - task.x[0].amin(0)).norm()

    def predicted(x: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Where the landmarks are found and where they are, from the middle of the cloud, in sizes of the body."""
        chosen = torch.rand(x.shape[:2], generator=generator).argsort(1)[:, :N_POINTS]
        both = torch.cat([x.gather(1, chosen[..., None].expand(-1, -1, 3)), x[:, task.landmarks]], 1) / size
        both = both - both[:, :N_POINTS].mean(1, keepdim=True)
        both = tm.RandomRigidMotion(degrees=TURNS, p=1.0, generator=generator)(both)
        points, truth = both[:, :N_POINTS], both[:, N_POINTS:]
        points = points + NOISE / 2 * torch.randn(points.shape, generator=generator)
        return network(points).mean(1).view(truth.shape), truth

    for _ in range(steps):
        found, truth = predicted(pool[torch.randint(len(pool), (BATCH,), generator=generator)], generator)
        loss = (found - truth).norm(dim=-1).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    generator = torch.Generator().manual_seed(12345)
    with torch.no_grad():
        pairs = [predicted(test, generator) for _ in range(10)]
    return float(torch.stack([(found - truth).norm(dim=-1).mean() for found, truth in pairs]).mean())


def compare(n_poses: int, seeds: int, steps: int, table: Table) -> None:
    """Add a line for each arm."""
    task = gestures()
    given = farthest_points(task.x.flatten(1), n_poses, first=0)
    others = torch.arange(len(task.x))[(task.x[:, None] - task.x[given]).abs().amax((2, 3)).amin(1) > 0]
    test = task.x[others[torch.linspace(0, len(others) - 1, N_TEST).round().long()]]
    poses = task.x[given]
    space = tm.ShapeSpace(tm.extract_bases(poses, task.faces, N_MODES, progress=False), task.faces)
    for arm in ARMS:
        more = further(arm, space)
        pool = torch.cat([poses.repeat(max(1, len(more) // (4 * n_poses)), 1, 1), more])
        found = []
        for seed in range(seeds):
            iou = mean_iou(trained(pool, task.parts, seed, steps), test, task.parts)
            found.append((iou, landmark_error(task, pool, test, seed, steps)))
        table.add(arm, *(f"{100 * value:.1f} %" for value in np.mean(found, 0)))


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--poses", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--steps", type=int, default=800)
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")  # in-betweens that did not converge
    with Table("part-labels", ["further shapes", "IoU", "landmarks"], given.keep) as table:
        compare(given.poses, given.seeds, given.steps, table)


if __name__ == "__main__":
    main()
