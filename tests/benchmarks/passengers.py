"""Fine meshes by a proxy against the whole mesh, and a million points that follow a shape.

    python tests/benchmarks/passengers.py [--levels 3] [--proxy 20000] [--points 1000000] [--picture relief.png]

Two key-frames of the sample creature are refined by Loop's subdivision (four times the faces each level: 310,000
vertices with three) and get a relief. One in-between, half-way, is made by the whole mesh and by a proxy of 20,000
vertices that carries the relief: seconds of one core after set-up, distance in percent of the diagonal, and mean error
of edges against the mean of both ends.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
import trimesh
from measures import edge_lengths, mean_ratio
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


def fine_meshes(levels: int, n_proxy: int, picture: Path | None) -> None:
    """The proxy against the whole."""
    keyframes, faces = relief(levels)
    start = time.process_time()
    proxy = Proxy(keyframes, faces, n_proxy)
    set_up = time.process_time() - start
    by_proxy = tm.InBetween(tm.extract_bases(proxy.keyframes, proxy.faces, 30), proxy.faces)
    whole = tm.InBetween(tm.extract_bases(keyframes, faces, 30), faces)

    def carried() -> Tensor:
        between = by_proxy(*proxy.keyframes, 0.5)
        return proxy.carried(torch.stack([proxy.keyframes[0], between, proxy.keyframes[1]]), [0, 2], keyframes)

    with torch.no_grad():
        (found, own_time), (full, whole_time) = timed(carried), timed(lambda: whole(*keyframes, 0.5))
    diagonal = float((keyframes[0].amax(0) - keyframes[0].amin(0)).norm())
    lengths = edge_lengths(keyframes, faces).mean(0)
    errors = [mean_ratio(edge_lengths(x, faces), lengths) for x in (found[1], full)]
    print(f"{keyframes.shape[1]} vertices, proxy of {proxy.keyframes.shape[1]}, set-up {set_up:.1f} s")
    print(f"an in-between: {own_time:.2f} s, whole mesh {whole_time:.2f} s, ratio {own_time / whole_time:.2f}")
    distance = 100 * float((found[1] - full).norm(dim=-1).mean()) / diagonal
    print(f"distance to the whole solve {distance:.3f} %; edge error over the whole's {errors[0] / errors[1]:.2f}")
    print(f"key-frames bit for bit: {torch.equal(found[::2], keyframes)}")
    if picture is not None:
        rows = {"by proxy": found, "whole mesh": torch.stack([keyframes[0], full, keyframes[1]])}
        tm.render_sequence(rows, faces, picture, view=load_sample("creature").view, overwrite=True)


def many_points(n: int) -> None:
    """One shape and its gradient."""
    sample = load_sample("creature")
    x, y = sample.keyframes[:2]
    mesh = trimesh.Trimesh(x.numpy(), sample.faces.numpy(), process=False)
    points = torch.from_numpy(trimesh.sample.sample_surface(mesh, n, seed=0)[0].copy())
    points = points + 0.01 * torch.randn(n, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    start = time.process_time()
    passengers = tm.Passengers(x, sample.faces, points)
    print(f"{n} points on {len(x)} vertices: bound in {time.process_time() - start:.1f} s")
    for dtype in (torch.float32, torch.float64):
        own, shape = passengers.to(dtype), y.to(dtype)

        def with_gradient(own: tm.Passengers = own, shape: Tensor = shape) -> None:
            leaf = shape.clone().requires_grad_()
            own(leaf).square().sum().backward()

        with torch.no_grad():
            forward = timed(lambda own=own, shape=shape: own(shape))[1]  # type: ignore[misc]
        print(f"  {str(dtype)[6:]}: forward {forward:.2f} s, with gradient {timed(with_gradient)[1]:.2f} s")


def main() -> None:
    """Print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", type=int, default=3, help="of refinement")
    parser.add_argument("--proxy", type=int, default=20_000, help="vertices of the carrier")
    parser.add_argument("--points", type=int, default=1_000_000, help="that follow the creature")
    parser.add_argument("--picture", type=Path, help="the in-betweens side by side")
    given = parser.parse_args()
    limit_threads()
    many_points(given.points)
    fine_meshes(given.levels, given.proxy, given.picture)


if __name__ == "__main__":
    main()
