"""Fine meshes by a proxy against the whole mesh, and a million points that follow a shape.

    python tests/benchmarks/passengers.py [--levels 2 3] [--proxy 20000] [--points 1000000] [--picture relief.png]

Two key-frames of the sample creature are refined by Loop's subdivision (four times the faces each level: 310,000
vertices with three) and get a relief. One in-between, half-way, is made by the whole mesh and by a proxy of 20,000
vertices that carries the relief: seconds of one core, alone and for all that is made before (of the proxy the coarse
mesh and the binding, of both modes and layer); the mean distance of both over the diagonal; and the mean error of edges
against the mean of both ends, of the proxy over the whole.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
import trimesh
from measures import edge_lengths, mean_ratio
from results import Table, add_keep, number, percent
from timing import limit_threads, timed
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.passengers.proxy import Proxy

RELIEF, WAVES = 0.004, 60


def relief(levels: int) -> tuple[Tensor, Tensor]:
    """Two key-frames with a relief. *Shape:* ``(2, V, 3)``, ``(F, 3)``."""
    sample = load_sample("creature")
    faces, shapes = sample.faces.numpy(), [x.numpy() for x in sample.keyframes[:2]]
    for _ in range(levels):
        finer = [trimesh.remesh.subdivide_loop(x, faces, 1) for x in shapes]
        shapes, faces = [x for x, _ in finer], finer[0][1]
    size = np.linalg.norm(np.ptp(shapes[0], axis=0))
    height = RELIEF * size * np.sin(WAVES / size * shapes[0] * 2 * np.pi).prod(1)[:, None]
    normals = [trimesh.Trimesh(x, faces, process=False).vertex_normals for x in shapes]
    rough = np.stack([x + height * normal for x, normal in zip(shapes, normals, strict=True)])
    return torch.from_numpy(rough), torch.from_numpy(faces)


def fine_meshes(levels: int, n_proxy: int, picture: Path | None) -> list[str]:
    """The proxy against the whole: a line of the table."""
    keyframes, faces = relief(levels)
    start = time.process_time()
    proxy = Proxy(keyframes, faces, n_proxy)
    by_proxy = tm.InBetween(tm.extract_bases(proxy.keyframes, proxy.faces, 30, cache=False), proxy.faces)
    middle = time.process_time()
    whole = tm.InBetween(tm.extract_bases(keyframes, faces, 30, cache=False), faces)
    set_up = middle - start, time.process_time() - middle

    def carried() -> Tensor:
        between = by_proxy(*proxy.keyframes, 0.5)
        return proxy.carry(torch.stack([proxy.keyframes[0], between, proxy.keyframes[1]]), [0, 2], keyframes)

    with torch.no_grad():
        (found, own_time), (full, whole_time) = timed(carried), timed(lambda: whole(*keyframes, 0.5))
    diagonal = float((keyframes[0].amax(0) - keyframes[0].amin(0)).norm())
    lengths = edge_lengths(keyframes, faces).mean(0)
    errors = [mean_ratio(edge_lengths(x, faces), lengths) for x in (found[1], full)]
    distance = float((found[1] - full).norm(dim=-1).mean()) / diagonal
    if picture is not None:
        rows = {"by proxy": found, "whole mesh": torch.stack([keyframes[0], full, keyframes[1]])}
        tm.render_sequence(rows, faces, picture, view=load_sample("creature").view)
    times = f"{own_time:.2f}; {whole_time:.2f} s", f"{set_up[0]:.0f}; {set_up[1]:.0f} s"
    return [f"{keyframes.shape[1]:,}", *times, percent(distance), number(errors[0] / errors[1], ".2f")]


def many_points(n: int) -> list[str]:
    """One shape and its gradient: a line of the other table."""
    sample = load_sample("creature")
    x, y = sample.keyframes[:2]
    mesh = trimesh.Trimesh(x.numpy(), sample.faces.numpy(), process=False)
    points = torch.from_numpy(trimesh.sample.sample_surface(mesh, n, seed=0)[0].copy())
    points = points + 0.01 * torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    start = time.process_time()
    passengers = tm.Passengers(x, sample.faces, points)
    cells = [f"{n:,} on {len(x):,} vertices", f"{time.process_time() - start:.0f} s"]
    for dtype in (torch.float32, torch.float64):
        own, shape = passengers.to(dtype), y.to(dtype)

        def with_gradient(own: tm.Passengers = own, shape: Tensor = shape) -> None:
            leaf = shape.clone().requires_grad_()
            own(leaf).square().sum().backward()

        with torch.no_grad():
            forward = timed(lambda own=own, shape=shape: own(shape))[1]  # type: ignore[misc]
        cells.append(f"{forward:.2f}; {timed(with_gradient)[1]:.2f} s")
    return cells


def main() -> None:
    """Print and keep both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", type=int, nargs="*", default=[2, 3], help="of refinement")
    parser.add_argument("--proxy", type=int, default=20_000, help="vertices of the carrier")
    parser.add_argument("--points", type=int, nargs="*", default=[1_000_000], help="that follow the creature")
    parser.add_argument("--picture", type=Path, help="the in-betweens of the finest side by side")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    columns = ["points", "binding", "float32: a shape; with gradient", "float64"]
    with Table("passengers-points", columns, given.keep, columns[1:], "--levels --points 1000000") as table:
        for n in given.points:
            table.add(*many_points(n))
    columns = ["vertices", "an in-between: proxy; whole", "set-up: proxy; whole", "distance", "edge error"]
    with Table("passengers", columns, given.keep, columns[1:3], "--levels 2 --points") as table:
        for levels in given.levels:
            table.add(*fine_meshes(levels, given.proxy, given.picture if levels == max(given.levels) else None))


if __name__ == "__main__":
    main()
