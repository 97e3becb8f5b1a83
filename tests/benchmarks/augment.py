"""In-betweens a second through ShapeDataset and DataLoader, and the memory of a dataset of many sets.

    python tests/benchmarks/augment.py throughput
    python tests/benchmarks/augment.py memory

Everything compared is measured in one run, in turns and through the same loader, so that a busy machine slows all of
it: what to read are the ratios. Two workers, batches of 16, float32; key-frames, bases and tables stand on disk, and
each way has made what it keeps (tables, layers, factorisations, compiled code) in an epoch before. ``morphomatics``
(``pip install morphomatics``, or in an environment of its own) is measured where it is installed: geodesics of its
differential coordinates, with those of the key-frames, and the tangents between them, computed before.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Any

os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import numpy as np
import torch
from threads import limit_threads
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

import torch_modal as tm

DATA = Path(__file__).parents[2].parent / "shared" / "data"
MESHES = {
    "hand": [DATA / "mh-hand-path" / f"{i:02}.obj" for i in (0, 4, 8)],
    "woman": [DATA / "mh-woman" / f"{name}.obj" for name in ("00-rest", "02-walk-a", "03-walk-b")],
}
WORKERS, BATCH, ROUNDS = 2, 16, 3


class RandomLinear(tm.RandomInBetween):
    """What all is compared with: linear interpolation, everything else being the same."""

    def shapes(self, batch: tm.ShapeBatch, partners: tm.ShapeBatch, t: Tensor, space: tm.ShapeSpace) -> Tensor:
        """Linear mixtures."""
        return torch.lerp(batch.shapes, partners.shapes, t[:, None, None])


class Morphomatics(Dataset[dict[str, Any]]):
    """The same in-betweens as geodesics of differential coordinates."""

    def __init__(self, folder: Path, length: int) -> None:
        self.stored = tm.open_set(folder)
        self.length = length
        self.made: Any = None

    def __len__(self) -> int:
        """As many as the others."""
        return self.length

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "made": None}

    def __getitem__(self, index: int) -> dict[str, Any]:
        """One in-between."""
        if self.made is None:
            import jax
            from morphomatics.geom import Surface
            from morphomatics.manifold import DifferentialCoords

            shapes = self.stored.keyframes.numpy()
            manifold = DifferentialCoords(Surface(shapes[0].copy(), self.stored.faces.numpy()))
            coords = [jax.numpy.asarray(manifold.to_coords(x.copy())) for x in shapes]
            connection = manifold.M.connec
            logarithm = jax.jit(connection.log)
            ways = [[logarithm(p, q) if p is not q else None for q in coords] for p in coords]
            self.made = manifold, coords, ways, jax.jit(lambda p, way, t: connection.exp(p, t * way))
        manifold, coords, ways, geodesic = self.made
        i, j = index % len(coords), (index + 1 + index // len(coords) % (len(coords) - 1)) % len(coords)
        t = float(torch.rand((), generator=torch.Generator().manual_seed(index)))
        shape = np.array(manifold.from_coords(geodesic(coords[i], ways[i][j], t)))
        return {"vertices": torch.from_numpy(shape).float(), "set": 0, "keyframe": i}


def stored(name: str, root: Path) -> Path | None:
    """A set of the mesh, in a folder of its own; None, with a word, where the data is not there."""
    paths = MESHES[name]
    if not paths[0].is_file():
        print(f"(no {name}: {paths[0]} is not there)")
        return None
    keyframes, faces = tm.load_keyframes(paths)
    folder = root / name / "set"
    tm.write_set(folder, keyframes, faces, tm.extract_bases(keyframes, faces, 30), [path.name for path in paths])
    return folder


def throughput(arguments: argparse.Namespace) -> None:
    """Print shapes a second."""
    with tempfile.TemporaryDirectory() as place:
        for name in arguments.meshes:
            folder = stored(name, Path(place))
            if folder is not None:
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
    ways: dict[str, Dataset[Any]] = {
        "linear": tm.ShapeDataset(folder.parent, RandomLinear(p=1.0), **options),
        "in-between, from the table": tm.ShapeDataset(folder.parent, between, **options),
        "in-between, each solved": tm.ShapeDataset(
            folder.parent, between, times=None, samples_per_set=max(BATCH * 4, arguments.shapes // 8)
        ),
        "modal deformation": tm.ShapeDataset(folder.parent, deform, samples_per_set=arguments.shapes // 4),
        "extrapolation": tm.ShapeDataset(folder.parent, beyond, samples_per_set=arguments.shapes // 4),
        "in-between, deformation, motion": tm.ShapeDataset(folder.parent, every, samples_per_set=arguments.shapes // 4),
    }
    try:
        import morphomatics  # noqa: F401

        ways["morphomatics"] = Morphomatics(folder, max(BATCH * 4, arguments.shapes // 8))
    except ImportError:
        print("(morphomatics is not installed)")
    loaders = {}
    for way, data in ways.items():
        # XLA does not survive a fork.
        method = "spawn" if way == "morphomatics" else "fork"
        loaders[way] = DataLoader(
            data, BATCH, num_workers=WORKERS, persistent_workers=True, multiprocessing_context=method
        )
        list(loaders[way])
    rates: dict[str, list[float]] = {way: [] for way in ways}
    for _ in range(ROUNDS):
        for way, loader in loaders.items():
            started = time.perf_counter()
            n = sum(len(batch["vertices"]) for batch in loader)
            rates[way].append(n / (time.perf_counter() - started))
    n_vertices = tm.open_set(folder).n_vertices
    print(f"\n{name}, {n_vertices} vertices, {WORKERS} workers, batches of {BATCH}; first 16 shapes {cold:.1f} s")
    base = median(rates["linear"])
    other = median(rates["morphomatics"]) if "morphomatics" in rates else float("nan")
    print(f"{'':34s}{'shapes / s':>12s}{'of linear':>12s}{'morphomatics':>14s}")
    for way, found in rates.items():
        rate = median(found)
        print(f"{way:34s}{rate:12.1f}{rate / base:12.3f}{rate / other:14.1f}")


# ------------------------------------------------------------------------------------------------------- memory
def memory(arguments: argparse.Namespace) -> None:
    """Print the memory of a process that reads all of a dataset, for different numbers of sets."""
    with tempfile.TemporaryDirectory() as place:
        folder = stored("hand", Path(place) / "source")
        if folder is None:
            return
        list(tm.ShapeDataset(folder.parent, samples_per_set=6))
        print(f"{'sets':>6s}{'own memory, MiB':>18s}{'mapped files, MiB':>20s}{'peak, MiB':>12s}")
        for n in arguments.sets:
            root = Path(place) / f"{n}"
            for number in range(n):
                target = root / f"{number // 100:02}" / f"{number:05}"
                target.mkdir(parents=True)
                for file in folder.iterdir():
                    os.link(file, target / file.name)
            command = [sys.executable, __file__, "read", str(root), "--samples", str(arguments.samples)]
            print(subprocess.run(command, capture_output=True, text=True, check=True).stdout.rstrip())


def read(arguments: argparse.Namespace) -> None:
    """In a process of its own: read samples all over a dataset."""
    transform = tm.AugmentationSequential(tm.RandomInBetween(p=1.0), tm.RandomModalDeformation(p=0.5))
    data = tm.ShapeDataset(arguments.root, transform, samples_per_set=2)
    generator = torch.Generator().manual_seed(0)
    for index in torch.randperm(len(data), generator=generator).repeat(arguments.samples)[: arguments.samples].tolist():
        data[index]
    found = dict(status())
    own, mapped, peak = (found[name] / 1024 for name in ("RssAnon", "RssFile", "VmHWM"))
    print(f"{len(data.sets):6d}{own:18.0f}{mapped:20.0f}{peak:12.0f}")


def status() -> Iterator[tuple[str, int]]:
    """Sizes of this process in KiB, as Linux tells them."""
    for line in Path("/proc/self/status").read_text().splitlines():
        name, _, value = line.partition(":")
        if value.strip().endswith("kB"):
            yield name, int(value.split()[0])


if __name__ == "__main__":
    limit_threads()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser("throughput")
    command.add_argument("--meshes", nargs="+", choices=MESHES, default=list(MESHES))
    command.add_argument("--shapes", type=int, default=1024, help="in an epoch of the fastest ways")
    command.set_defaults(run=throughput)
    command = commands.add_parser("memory")
    command.add_argument("--sets", type=int, nargs="+", default=[10, 100, 1000])
    command.add_argument("--samples", type=int, default=400)
    command.set_defaults(run=memory)
    command = commands.add_parser("read")
    command.add_argument("root", type=Path)
    command.add_argument("--samples", type=int, default=400)
    command.set_defaults(run=read)
    given = parser.parse_args()
    given.run(given)
