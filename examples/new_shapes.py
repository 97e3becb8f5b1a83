"""Two hundred new shapes from six poses, and a pose followed by its markers.

    python examples/new_shapes.py [--out out/new-shapes] [--n 200]

The six poses of the sample creature are taken for a space of shapes (:class:`torch_modal.ShapeSpace`). ``shapes.png``
shows some of its members beside the poses, ``all.png`` every one. Then three of the poses are left out in turn and
fitted from 20 of their vertices to the other five: ``markers.png``, beside the linear span of the same five, whose
weights are least squares with a ridge.
"""

import argparse
from pathlib import Path

import matplotlib.image
import numpy as np
import torch
import trimesh
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.rigid import best_fit

N_MARKERS, LEFT_OUT = 20, (1, 3, 5)
RIDGE = 0.03
"""Of the linear span, over the diagonal: the best of seven by the truth (tests/benchmarks/spaces.py)."""


def markers(x: Tensor) -> Tensor:
    """Vertices that are far from each other. *Shape:* ``(V, 3) -> (N_MARKERS,)``."""
    vertices, distances = [0], (x - x[0]).norm(dim=-1)
    while len(vertices) < N_MARKERS:
        vertices.append(int(distances.argmax()))
        distances = torch.minimum(distances, (x - x[vertices[-1]]).norm(dim=-1))
    return torch.tensor(vertices)


def linear_fit(poses: Tensor, points: Tensor, vertices: Tensor) -> Tensor:
    """The pose of the linear span, moved rigidly, that meets points. *Shape:* ``(K, V, 3) -> (V, 3)``."""
    poses = best_fit(poses[:, vertices], points).apply(poses)
    mean, off = poses.mean(0), poses - poses.mean(0)
    columns = off[:, vertices].flatten(1).mT
    size = float((mean.amax(0) - mean.amin(0)).norm())
    system = columns.mT @ columns + N_MARKERS * (RIDGE * size) ** 2 * torch.eye(len(poses)).to(poses)
    x = mean
    for _ in range(20):
        wanted = tm.align(points, x[vertices]) - mean[vertices]
        x = mean + torch.einsum("k,kvc->vc", torch.linalg.solve(system, columns.mT @ wanted.flatten()), off)
    return best_fit(x[vertices], points).apply(x)


def draw_members(poses: Tensor, members: Tensor, faces: Tensor, view: tuple[float, float] | None, out: Path) -> None:
    """The poses above some members, and all members."""
    width = len(poses)
    some = {f"new{' ' * i}": members[width * i : width * (i + 1)] for i in range(min(4, len(members) // width))}
    tm.render_sequence(
        {"given": poses, **some},
        faces,
        out / "shapes.png",
        titles=[""] * width,
        keyframe_indices=[],
        columns=range(width),
        view=view,
        overwrite=True,
    )
    width = max(1, min(20, len(members) // 5))
    rows = {f"{i * width + 1}": members[i * width : (i + 1) * width] for i in range(len(members) // width)}
    sheet = tm.render_sequence(
        rows,
        faces,
        out / "all.png",
        titles=[""] * width,
        keyframe_indices=[],
        columns=range(width),
        view=view,
        overwrite=True,
    )
    # A quarter of the pixels: two hundred shapes are looked at as a whole.
    pixels = matplotlib.image.imread(sheet)
    high, wide = (n // 2 * 2 for n in pixels.shape[:2])
    small = pixels[:high, :wide].reshape(high // 2, 2, wide // 2, 2, -1).mean((1, 3))
    matplotlib.image.imsave(sheet, np.clip(small, 0, 1))


def with_dots(x: Tensor, faces: Tensor, points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """The mesh with a small ball at each point."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    dots, corners = torch.from_numpy(ball.vertices.copy()), torch.from_numpy(ball.faces.copy())
    many = (points[:, None] + dots).flatten(0, 1)
    own = torch.cat([corners + len(x) + len(dots) * i for i in range(len(points))])
    return torch.cat([x, many]), torch.cat([faces, own])


def main(out: Path, n: int = 200, n_modes: int = 15) -> dict[str, list[float]]:
    """Draw members, fit poses, and draw them.

    Args:
        out: Folder of the pictures.
        n: How many new shapes.
        n_modes: Modes of each key-frame.

    Returns:
        Mean distances of all vertices of the poses that were left out, in % of the diagonal, by method.
    """
    out.mkdir(parents=True, exist_ok=True)
    sample = load_sample("creature")
    poses, faces = sample.keyframes, sample.faces
    bases = tm.extract_bases(poses, faces, n_modes)
    members = tm.ShapeSpace(bases, faces).sample(n, torch.Generator().manual_seed(0))
    draw_members(poses, members, faces, sample.view, out)

    diagonal = float((poses[0].amax(0) - poses[0].amin(0)).norm())
    errors: dict[str, list[float]] = {"fitted": [], "linear span": []}
    rows: dict[str, list[Tensor]] = {"20 markers": [], **{name: [] for name in errors}}
    colors: dict[str, list[Tensor]] = {name: [] for name in errors}
    all_faces = faces
    for k in LEFT_OUT:
        rest = [i for i in range(len(poses)) if i != k]
        vertices = markers(poses[k])
        points = poses[k, vertices]
        space = tm.ShapeSpace([bases[i] for i in rest], faces)
        fitted = {"fitted": space.fit(points, vertices).shape, "linear span": linear_fit(poses[rest], points, vertices)}
        for name, x in {"20 markers": poses[k], **fitted}.items():
            shown, all_faces = with_dots(x, faces, points, 0.012 * diagonal)
            rows[name].append(shown)
        for name, x in fitted.items():
            off = 100 * (x - poses[k]).norm(dim=-1) / diagonal
            errors[name].append(float(off.mean()))
            colors[name].append(torch.nn.functional.pad(off, (0, len(shown) - len(off))))
        print(f"pose {k + 1} from {N_MARKERS} markers: ", end="")
        print(", ".join(f"{name} {value[-1]:.2f} %" for name, value in errors.items()))
    tm.render_sequence(
        {name: torch.stack(shapes) for name, shapes in rows.items()},
        all_faces,
        out / "markers.png",
        titles=[f"pose {k + 1}" for k in LEFT_OUT],
        keyframe_indices=[],
        view=sample.view,
        colors={name: torch.stack(values) for name, values in colors.items()},
        color_label="distance from the truth [% of the diagonal]",
        overwrite=True,
    )
    print(f"pictures: {out}")
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out") / "new-shapes")
    parser.add_argument("--n", type=int, default=200)
    given = parser.parse_args()
    main(given.out, given.n)
