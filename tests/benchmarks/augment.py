"""In-betweens a second through ShapeDataset and DataLoader, over those of linear interpolation.

    python tests/benchmarks/augment.py

Everything compared is measured in one run, in turns and through the same loader, so that a busy machine slows all of
it: what to read are the ratios. Two workers, batches of 16, float32; key-frames, bases and tables stand on disk, and
each way has made what it keeps (tables, layers, factorisations, compiled code) in an epoch before.
"""

import argparse
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch
from cases import keyframes_of
from timing import limit_threads
from torch import Tensor
from torch.utils.data import DataLoader

import torch_modal as tm

MESHES = {"hand": ("mh-hand-path", "00", "04", "08"), "woman": ("mh-woman",)}
"""Folders beside the project, and the files of them."""
WORKERS, BATCH, ROUNDS = 2, 16, 3


class RandomLinear(tm.RandomInBetween):
    """What all is compared with: linear interpolation, everything else being the same."""

    def shapes(self, batch: tm.ShapeBatch, partners: tm.ShapeBatch, t: Tensor, space: tm.ShapeSpace) -> Tensor:
        """Linear mixtures."""
        return torch.lerp(batch.shapes, partners.shapes, t[:, None, None])


def throughput(arguments: argparse.Namespace) -> None:
    """Print shapes a second."""
    with tempfile.TemporaryDirectory() as place:
        for name in arguments.meshes:
            found = keyframes_of(*MESHES[name])
            if found is not None:
                folder = Path(place) / name / "set"
                tm.write_set(folder, *found, tm.extract_bases(*found, 30), [f"{i}.obj" for i in range(len(found[0]))])
                compare(name, folder, arguments)


def compare(name: str, folder: Path, arguments: argparse.Namespace) -> None:
    """All ways on one mesh."""
    options: dict[str, Any] = {"samples_per_set": arguments.shapes}
    between = tm.RandomInBetween(p=1.0)
    started = time.perf_counter()
    list(tm.ShapeDataset(folder.parent, between, samples_per_set=16).__getitems__(range(16)))
    cold = time.perf_counter() - started
    deform, beyond = tm.RandomModalDeformation(p=1.0), tm.RandomExtrapolation(p=1.0)
    every = tm.AugmentationSequential(between, deform, tm.RandomRigidMotion(p=1.0))
    ways = {
        "linear": tm.ShapeDataset(folder.parent, RandomLinear(p=1.0), **options),
        "in-between, from the table": tm.ShapeDataset(folder.parent, between, **options),
        "in-between, each solved": tm.ShapeDataset(
            folder.parent, between, times=None, samples_per_set=max(BATCH * 4, arguments.shapes // 8)
        ),
        "modal deformation": tm.ShapeDataset(folder.parent, deform, samples_per_set=arguments.shapes // 4),
        "extrapolation": tm.ShapeDataset(folder.parent, beyond, samples_per_set=arguments.shapes // 4),
        "in-between, deformation, motion": tm.ShapeDataset(folder.parent, every, samples_per_set=arguments.shapes // 4),
    }
    loaders = {}
    for way, data in ways.items():
        loaders[way] = DataLoader(data, BATCH, num_workers=WORKERS, persistent_workers=True)
        list(loaders[way])
    rates: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(ROUNDS):
        for way, loader in loaders.items():
            started = time.perf_counter()
            n = sum(len(batch["vertices"]) for batch in loader)
            rates[way].append(n / (time.perf_counter() - started))
    n_vertices = tm.StoredSet(folder).n_vertices
    print(f"\n{name}, {n_vertices} vertices, {WORKERS} workers, batches of {BATCH}; first 16 shapes {cold:.1f} s")
    base = median(rates["linear"])
    print(f"{'':34s}{'shapes / s':>12s}{'of linear':>12s}")
    for way, found in rates.items():
        rate = median(found)
        print(f"{way:34s}{rate:12.1f}{rate / base:12.3f}")


if __name__ == "__main__":
    limit_threads()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--meshes", nargs="+", choices=MESHES, default=list(MESHES))
    parser.add_argument("--shapes", type=int, default=1024, help="in an epoch of the fastest ways")
    throughput(parser.parse_args())
