"""New shapes from six poses, and a pose followed by its markers.

    python examples/new_shapes.py [--out out/new-shapes]

The six poses of the sample creature are taken for a space of shapes (:class:`torch_modal.ShapeSpace`). ``shapes.png``
shows some of its members below the poses. Then three of the poses are left out in turn and fitted from 20 of their
vertices to the other five: ``markers.png``, compared with the linear span of the same five, whose weights are least
squares with a ridge.
"""

import argparse
from pathlib import Path

import torch
import trimesh
from torch import Tensor
from train_timing import farthest_points

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.geometry.rigid import best_fit

N_MARKERS, LEFT_OUT = 20, (1, 3, 5)
RIDGE = 0.03
"""Of the linear span, over the diagonal: the best of seven by the truth (tests/benchmarks/spaces.py)."""


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


def with_dots(x: Tensor, faces: Tensor, points: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """The mesh with a small ball at each point."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    dots, corners = torch.from_numpy(ball.vertices.copy()), torch.from_numpy(ball.faces.copy())
    many = (points[:, None] + dots).flatten(0, 1)
    own = torch.cat([corners + len(x) + len(dots) * i for i in range(len(points))])
    return torch.cat([x, many]), torch.cat([faces, own])


def main(out: Path) -> dict[str, list[float]]:
    """Draw members, fit poses, and draw them.

    Args:
        out: Folder of the pictures.

    Returns:
        Mean distances of all vertices of the poses that were left out, in % of the diagonal, by method.
    """
    out.mkdir(parents=True, exist_ok=True)
    sample = load_sample("creature")
    poses, faces = sample.keyframes, sample.faces
    members = tm.ShapeSpace(poses, faces).sample(4 * len(poses), torch.Generator().manual_seed(0))
    tm.render_sequence(
        {"given": poses, **{f"new{' ' * i}": row for i, row in enumerate(members.split(len(poses)))}},
        faces,
        out / "shapes.png",
        titles=[""] * len(poses),
        keyframe_indices=[],
        columns=range(len(poses)),
        view=sample.view,
    )

    diagonal = float((poses[0].amax(0) - poses[0].amin(0)).norm())
    errors: dict[str, list[float]] = {"fitted": [], "linear span": []}
    rows: dict[str, list[Tensor]] = {"20 markers": [], **{name: [] for name in errors}}
    colors: dict[str, list[Tensor]] = {name: [] for name in errors}
    all_faces = faces
    for k in LEFT_OUT:
        rest = [i for i in range(len(poses)) if i != k]
        vertices = farthest_points(poses[k], N_MARKERS, first=0)
        points = poses[k, vertices]
        space = tm.ShapeSpace(poses[rest], faces)
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
    )
    print(f"pictures: {out}")
    return errors


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out") / "new-shapes")
    main(parser.parse_args().out)
