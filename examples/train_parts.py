"""Learn to tell the parts of a shape from two or three poses of it, and be tested on the poses between them.

A small PointNet labels each point of a noisy, turned cloud of points with its part: the palm and finger bones of the
sample hand, learned from its two key-frames, open and closed; body parts of the sample creature, learned from every
other one of its six key-frames. Each arm has the same labelled key-frames to learn from:

- ``none``: the key-frames alone;
- ``linear``: also shapes between them on straight lines;
- ``torch_modal``: shapes between them by :class:`torch_modal.RandomInBetween` instead;
- ``+ modes``: these deformed along their vibration modes, by :class:`torch_modal.RandomModalDeformation`.

All else (steps, batches, points, noise, turns, seeds) is the same. They are tested on the true shapes between and, for
the creature, on the key-frames that were left out: shapes that none of them has seen.

    python examples/train_parts.py --out out/parts.png      # five seeds of four arms on two samples: about 15 minutes
    python examples/train_parts.py --samples hand --seeds 1 --steps 300      # a short form: a minute
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from make_samples import SAMPLES as MODELS
from make_samples import place_bones
from scipy.spatial.transform import Rotation
from torch import Tensor, nn
from torch.utils.data import DataLoader

import torch_modal as tm
from torch_modal.data.samples import load_sample

TRAINED_ON = {"hand": (0, 1), "creature": (0, 2, 4)}
ARMS = ("none", "linear", "torch_modal", "+ modes")
COLORS = {"none": "#777777", "linear": "#b2182b", "torch_modal": "#2166ac", "+ modes": "#1b7837"}
TURNS = 15.0
"""Clouds are turned by up to so many degrees, about any axis."""


class Task(NamedTuple):
    """Labelled shapes."""

    name: str
    faces: Tensor
    parts: Tensor
    """Part of each vertex. *Shape:* ``(V,)``."""
    part_names: list[str]
    train: Tensor
    """*Shape:* ``(K, V, 3)``."""
    test: Tensor
    """*Shape:* ``(N, V, 3)``."""


class Learned(NamedTuple):
    """One network, tested."""

    accuracy: float
    """Share of points with the right part."""
    iou: float
    """Intersection over union, mean over the parts."""
    right: Tensor
    """How often each vertex of each test shape was right. *Shape:* ``(N, V)``."""


class RandomLinear(tm.RandomInBetween):
    """Straight lines instead, with the same pairs and times."""

    def moved(self, pair: Any, t: Tensor) -> Tensor:
        """Linear interpolation."""
        return torch.lerp(pair.x_a, pair.x_b, t[:, None, None])


# ---------------------------------------------------------------------------------------------------------- data
def load_task(name: str) -> Task:
    """A sample with its parts."""
    sample = load_sample(name)
    chosen = list(TRAINED_ON[name])
    rest = [i for i in range(len(sample.keyframes)) if i not in chosen]
    parts, part_names = label(name, sample.keyframes[0])
    test = torch.cat([sample.truth, sample.keyframes[rest]])
    return Task(name, sample.faces, parts, part_names, sample.keyframes[chosen], test)


def label(name: str, shape: Tensor) -> tuple[Tensor, list[str]]:
    """Part of each vertex of the first key-frame: the bone whose flesh, posed as it is there, is nearest."""
    model, motion, *_ = MODELS[name]
    bones, flesh = model()
    quaternions, translations = place_bones(bones, *motion(bones, 0.0))
    order = list(bones)
    distances = []
    for cone in flesh:
        number = order.index(cone.bone)
        turn = Rotation.from_quat(quaternions[number])
        distances.append(cone.distance(turn.inv().apply(shape.numpy() - translations[number]))[0])
    names = sorted({cone.bone for cone in flesh})
    owner = np.array([names.index(cone.bone) for cone in flesh])
    return torch.from_numpy(owner[np.argmin(distances, axis=0)]), names


def store(task: Task, root: Path) -> None:
    """The labelled key-frames as a stored set: what ``torch-modal precompute`` makes of a folder of meshes."""
    bases = tm.extract_bases(task.train, task.faces, n_modes=30)
    tm.write_set(root / task.name, task.train, task.faces, bases, [f"{i}" for i in TRAINED_ON[task.name]])


def shapes_of(arm: str, task: Task, root: Path, seed: int, n: int) -> tm.ShapeDataset:
    """The labelled shapes that an arm is trained on: ``n`` in an epoch."""
    first = {"none": [], "linear": [RandomLinear(p=0.8)]}.get(arm, [tm.RandomInBetween(p=0.8)])
    deform = [tm.RandomModalDeformation(strain=(0.0, 0.03), p=0.8)] if arm == "+ modes" else []
    transform = tm.AugmentationSequential(*first, *deform, tm.RandomRigidMotion(degrees=TURNS, p=1.0))
    return tm.ShapeDataset(
        root / task.name,
        transform,
        samples_per_set=n,
        labels=lambda _: {"vertex_labels": task.parts},
        seed=seed,
    )


def clouds(x: Tensor, generator: torch.Generator, n_points: int, noise: float = 0.005) -> tuple[Tensor, Tensor]:
    """Noisy points of shapes, centred and of size one, and which vertices they are.

    *Shape:* ``(B, V, 3) -> (B, n, 3), (B, n)``.
    """
    chosen = torch.rand(x.shape[:2], generator=generator).argsort(1)[:, :n_points]
    points = x.gather(1, chosen[..., None].expand(-1, -1, 3))
    points = points - points.mean(1, keepdim=True)
    points = points / points.norm(dim=-1).amax(1)[:, None, None]
    return points + noise * torch.randn(points.shape, generator=generator), chosen


# --------------------------------------------------------------------------------------------------------- network
class PointNet(nn.Module):
    """Each point is judged by its own place and by the maximum over all points (Qi et al. 2017), which is the pose."""

    def __init__(self, n_parts: int, seed: int) -> None:
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.local = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 64), nn.ReLU())
            self.whole = nn.Sequential(nn.Linear(64, 128), nn.ReLU())
            self.place, self.pose = nn.Linear(64, 96), nn.Linear(128, 96)
            self.head = nn.Sequential(nn.ReLU(), nn.Linear(96, 64), nn.ReLU(), nn.Linear(64, n_parts))

    def forward(self, points: Tensor) -> Tensor:
        """Scores. *Shape:* ``(B, n, 3) -> (B, n, parts)``."""
        local = self.local(points)
        pose = self.whole(local).amax(1)
        return self.head(self.place(local) + self.pose(pose)[:, None])


def train(arm: str, task: Task, root: Path, seed: int, steps: int, n_points: int = 256, batch: int = 16) -> Learned:
    """Train one network and test it."""
    network = PointNet(len(task.part_names), seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=5e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, steps)
    generator = torch.Generator().manual_seed(seed)
    data = shapes_of(arm, task, root, seed, steps * batch)
    for given in DataLoader(data, batch):
        points, chosen = clouds(given["vertices"], generator, n_points)
        loss = nn.functional.cross_entropy(network(points).mT, given["vertex_labels"].gather(1, chosen))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return test(network, task, n_points)


def test(network: PointNet, task: Task, n_points: int, rounds: int = 60) -> Learned:
    """Judge a network by many noisy, turned clouds of the test shapes, the same for every network."""
    generator = torch.Generator().manual_seed(12345)
    turn = tm.RandomRigidMotion(degrees=TURNS, p=1.0, generator=generator)
    n = len(task.part_names)
    right, seen = torch.zeros(2, *task.test.shape[:2])
    confusion = torch.zeros(n * n)
    with torch.no_grad():
        for _ in range(rounds):
            points, chosen = clouds(turn(task.test.float()), generator, n_points)
            found, truth = network(points).argmax(-1), task.parts[chosen]
            right.scatter_add_(1, chosen, (found == truth).float())
            seen.scatter_add_(1, chosen, torch.ones_like(chosen, dtype=torch.float32))
            confusion += torch.bincount((truth * n + found).flatten(), minlength=n * n)
    confusion = confusion.reshape(n, n)
    both = confusion.diagonal()
    iou = both / (confusion.sum(0) + confusion.sum(1) - both)
    return Learned(float(right.sum() / seen.sum()), float(iou.mean()), right / seen.clamp_min(1))


# ----------------------------------------------------------------------------------------------------------- report
def table(name: str, learned: dict[str, list[Learned]]) -> str:
    """Mean and spread over the seeds."""
    lines = [f"{name:16s}{'points right':>20s}{'mean IoU of the parts':>26s}"]
    for arm, runs in learned.items():
        line = f"  {arm:14s}"
        for width, values in ((12, [run.accuracy for run in runs]), (18, [run.iou for run in runs])):
            found = 100 * torch.tensor(values)
            spread = float(found.std()) if len(runs) > 1 else 0.0
            line += f"{float(found.mean()):{width}.1f} ± {spread:.1f} %"
        lines.append(line)
    return "\n".join(lines)


def draw(tasks: Sequence[Task], results: dict[str, dict[str, list[Learned]]], out: Path) -> None:
    """Every network's score, and where on the test shapes the arms are wrong."""
    from matplotlib.figure import Figure
    from matplotlib.image import imread

    figure = Figure(figsize=(14, 5.2 * len(tasks)), layout="constrained")
    rows = figure.subfigures(len(tasks), 1, squeeze=False)[:, 0]
    for row, task in zip(rows, tasks, strict=True):
        learned = results[task.name]
        left, right = row.subfigures(1, 2, width_ratios=(1, 2.4))
        axes = left.subplots()
        for place, (arm, runs) in enumerate(learned.items()):
            values = 100 * torch.tensor([run.iou for run in runs])
            axes.plot(torch.full_like(values, place), values, "o", color=COLORS[arm], alpha=0.6)
            axes.plot([place - 0.25, place + 0.25], [float(values.mean())] * 2, color=COLORS[arm], lw=2)
        axes.set_xticks(range(len(learned)), [f"{arm}" for arm in learned])
        axes.set(ylabel="mean IoU of the parts [%]", xlim=(-0.5, len(learned) - 0.5))
        axes.set_title(f"{task.name}: learned from {len(task.train)} poses; a dot is a seed")
        axes.grid(axis="y", alpha=0.3)
        wrong = {arm: 100 * (1 - sum(run.right for run in runs) / len(runs)) for arm, runs in learned.items()}
        shown = torch.linspace(0, len(task.test) - 1, min(4, len(task.test))).round().long().tolist()
        with tempfile.TemporaryDirectory() as folder:
            sheet = tm.render_sequence(
                {arm: task.test for arm in wrong},
                task.faces,
                Path(folder) / "sheet.png",
                columns=shown,
                view=load_sample(task.name).view,
                colors=wrong,
                color_label="how often a point is given the wrong part [%]",
            )
            picture = right.subplots()
            picture.imshow(imread(sheet))
            picture.axis("off")
            picture.set_title("unseen poses")
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=110)


def main(
    samples: Sequence[str] = ("hand", "creature"),
    seeds: int = 5,
    steps: int = 600,
    out: Path | None = None,
    arms: Sequence[str] = ARMS,
) -> dict[str, dict[str, list[Learned]]]:
    """Train and test all arms.

    Args:
        samples: Of ``"hand"`` and ``"creature"``.
        seeds: How many networks of each arm.
        steps: Steps of Adam for each.
        out: Where the picture goes, if anywhere.
        arms: Of ``ARMS``.

    Returns:
        By sample and arm, one result for each seed.
    """
    results: dict[str, dict[str, list[Learned]]] = {}
    tasks = [load_task(name) for name in samples]
    with tempfile.TemporaryDirectory() as place:
        for task in tasks:
            store(task, Path(place))
            results[task.name] = {
                arm: [train(arm, task, Path(place), seed, steps) for seed in range(seeds)] for arm in arms
            }
            print(table(task.name, results[task.name]), flush=True)
    if out is not None:
        draw(tasks, results, out)
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", nargs="+", choices=TRAINED_ON, default=list(TRAINED_ON))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--out", type=Path, default=Path("out") / "parts.png")
    given = parser.parse_args()
    started = time.perf_counter()
    main(given.samples, given.seeds, given.steps, given.out)
    print(f"{time.perf_counter() - started:.0f} s; picture: {given.out}")
