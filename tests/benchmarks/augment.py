"""Shapes a second that a training loop gets from two workers, and what placed shapes bring to a task of aligned clips.

    python tests/benchmarks/augment.py [--meshes creature] [--shapes 1024]
    python tests/benchmarks/augment.py --aligned fox trex husky [--seeds 3] [--steps 800]

Through ``ShapeDataset`` and ``DataLoader``, in batches of 16, float32. Key-frames, bases and tables stand on disk, and
each way has made what it keeps (tables, layers, factorisations) in an epoch before. Of an epoch, the shapes a second on
the clock, and the milliseconds of the workers' processors for each, which other work on the machine hardly changes.
Meshes from disk are OBJ files of the key-frames.

With ``--aligned``, a network tells a mesh from 20 of its vertices, with noise. It learns six poses of a body and 400
shapes made of them; all frames of the clips are aligned with the first, and nothing is aligned afterwards. Means of the
distances of all vertices in 24 other frames, over the diagonal.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from autoencoder import BATCH as AT_ONCE
from autoencoder import N_HIDDEN, N_MORE, N_TEST, body, farthest_points
from cases import keyframes_of
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset, default_collate

import torch_modal as tm
from torch_modal.data.augmentation import ShapeAugmentation
from torch_modal.data.shape_batch import ShapeBatch

MESHES = {"creature": ("creature",), "hand": ("mh-hand-path", "00", "04", "08"), "woman": ("mh-woman",)}
"""A sample, and folders beside the project with the files of them."""
WORKERS, BATCH = 2, 16
N_POSES, N_MARKERS, MARKER_NOISE = 6, 20, 0.005
"""Of the task of aligned clips; noise over the diagonal."""


class RandomLinear(tm.RandomInBetween):
    """What all is compared with: linear interpolation, everything else being the same."""

    def shapes(self, batch: ShapeBatch, partners: ShapeBatch, t: Tensor, space: tm.ShapeSpace) -> Tensor:
        """Linear mixtures."""
        return torch.lerp(batch.shapes, partners.shapes, t[:, None, None])


class Files(Dataset[dict[str, Tensor]]):
    """Meshes that are read from disk, each time."""

    def __init__(self, folder: Path, n: int) -> None:
        self.files, self.n = sorted(folder.glob("*.obj")), n

    def __len__(self) -> int:
        return self.n

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        return {"vertices": tm.load_keyframes([self.files[index % len(self.files)]])[0][0].float()}


def ways(folder: Path, n: int) -> dict[str, Callable[[], Dataset[Any]]]:
    """The data sets by their names; an epoch of slow ones has fewer shapes."""

    def of(transform: ShapeAugmentation, share: int = 1, **options: Any) -> Callable[[], Dataset[Any]]:
        return lambda: tm.ShapeDataset(folder, transform, samples_per_set=max(2 * BATCH, n // share), **options)

    return {
        "meshes read from disk": lambda: Files(folder, max(2 * BATCH, n // 8)),
        "linear mixtures": of(RandomLinear(p=1.0)),
        "`RandomInBetween`": of(tm.RandomInBetween(p=1.0), 8),
        "`RandomBlend(members=64)`, from a table": of(tm.RandomBlend(p=1.0, members=64)),
        "`RandomBlend`, each solved": of(tm.RandomBlend(p=1.0), 16),
        "`RandomModalDeformation`, always new": of(tm.RandomModalDeformation(p=1.0), 4),
    }


def spent(samples: list[dict[str, Tensor]]) -> tuple[Any, int, float]:
    """A batch, with the process that made it and the time that its processor has spent."""
    return default_collate(samples), os.getpid(), time.process_time()


def rate(data: Dataset[Any]) -> str:
    """Shapes a second, and milliseconds for each."""
    loader = DataLoader(data, BATCH, num_workers=WORKERS, persistent_workers=True, collate_fn=spent)
    before = {process: seconds for _, process, seconds in loader}
    started, n, after = time.perf_counter(), 0, dict(before)
    for batch, process, seconds in loader:
        n, after[process] = n + len(batch["vertices"]), seconds
    wall = time.perf_counter() - started
    busy = 1e3 * sum(after[process] - before[process] for process in before) / n
    return f"{n / wall:,.0f}; {busy:.{2 if busy < 1 else 0 if busy > 10 else 1}f}"


def learned(poses: Tensor, further: Tensor, test: Tensor, markers: Tensor, seed: int, steps: int) -> float:
    """Error of a network from noisy markers to the mesh; a third of each batch are poses. *Shape:* ``(n, V, 3)``."""
    torch.manual_seed(seed)
    mean, inner = poses.mean(0), 2 * N_HIDDEN
    layers = [nn.Flatten(), nn.Linear(3 * N_MARKERS, inner), nn.ELU(), nn.Linear(inner, inner), nn.ELU()]
    network = nn.Sequential(*layers, nn.Linear(inner, mean.numel()), nn.Unflatten(1, mean.shape))
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    def distance(x: Tensor) -> Tensor:
        seen = x[:, markers] + MARKER_NOISE * torch.randn(len(x), N_MARKERS, 3, generator=generator)
        return (mean + network(seen - mean[markers]) - x).norm(dim=-1).mean()

    for _ in range(steps):
        n = AT_ONCE if len(further) == 0 else AT_ONCE // 3
        x = poses[torch.randint(len(poses), (n,), generator=generator)]
        if len(further):
            x = torch.cat([x, further[torch.randint(len(further), (AT_ONCE - n,), generator=generator)]])
        optimizer.zero_grad()
        distance(x).backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return float(distance(test.repeat(8, 1, 1)))


def aligned(name: str, seeds: int, steps: int) -> list[float]:
    """Errors of a body in percent, without further shapes, with members of the space, and with the transform's."""
    x, faces = body(name)
    poses = x[farthest_points(x.flatten(1), N_POSES, first=0)]
    others = torch.arange(len(x))[(x[:, None] - poses).abs().amax((2, 3)).amin(1) > 0]
    test, markers = (
        x[others[torch.linspace(0, len(others) - 1, N_TEST).round().long()]],
        farthest_points(x[0], N_MARKERS, 0),
    )
    space = tm.ShapeSpace(tm.extract_bases(poses, faces, 10, progress=False), faces)
    errors = []
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)
        sampled = space.sample(N_MORE, generator)
        given = poses[torch.randint(N_POSES, (N_MORE,), generator=generator)]
        blended = tm.RandomBlend(p=1.0, space=space, generator=generator)(given)
        arms = (further.float() for further in (poses[:0], sampled, blended))
        errors.append([learned(poses.float(), further, test.float(), markers, seed, steps) for further in arms])
        print(f"({name}, seed {seed}: {', '.join(f'{100 * error:.2f} %' for error in errors[-1])})", flush=True)
    return [100 * sum(each) / seeds for each in zip(*errors, strict=True)]


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", choices=MESHES, default=list(MESHES))
    parser.add_argument("--shapes", type=int, default=1024, help="in an epoch of the fastest ways")
    parser.add_argument(
        "--aligned", nargs="+", metavar="BODY", help="the task instead: hand, or animals of the data set"
    )
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=800)
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    if given.aligned:
        errors = [aligned(name, given.seeds, given.steps) for name in given.aligned]
        with Table("augment-aligned", ["further shapes", *given.aligned], given.keep) as table:
            for arm, row in zip(
                ("none", "`ShapeSpace.sample`", "`RandomBlend`"), zip(*errors, strict=True), strict=True
            ):
                table.add(arm, *(f"{error:.2f} %" for error in row))
        return
    with tempfile.TemporaryDirectory() as place:
        data: dict[str, dict[str, Callable[[], Dataset[Any]]]] = {}
        for name in given.meshes:
            found = keyframes_of(*MESHES[name])
            if found is not None:
                keyframes, faces = found
                folder = Path(place) / name
                names = [f"{i}.obj" for i in range(len(keyframes))]
                tm.write_set(folder, keyframes, faces, tm.extract_bases(keyframes, faces, 30), names)
                for own, x in zip(names, keyframes, strict=True):
                    tm.save_mesh(x, faces, folder / own)
                data[f"{name}, {keyframes.shape[1]:,} vertices"] = ways(folder, given.shapes)
        with Table("augment", ["", *data], given.keep, data, "--meshes creature --shapes 16") as table:
            for way in next(iter(data.values())):
                table.add(way, *(rate(own[way]()) for own in data.values()))


if __name__ == "__main__":
    main()
