"""Write the meshes that README and the documentation name, so that what stands there can be tried as it stands.

    python examples/write_meshes.py [FOLDER]

They are the samples under other names: a hand that closes (open.obj, fist.obj, pose-1.obj to pose-5.obj), its true
motion (truth), what a depth camera sees of that (scans) and where 20 vertices are (markers.csv), the same fist with
other vertices and faces (scan.ply; landmarks in pairs.txt), a galloping creature (gait-1.obj to gait-6.obj), and both
in a folder tree (shapes/hand, shapes/creature).
"""

import argparse
from pathlib import Path

import numpy as np
import torch
import trimesh
from complete import scan

from torch_modal.data.samples import load_sample
from torch_modal.geometry.decimation import decimate


def write(path: Path, shape: torch.Tensor, faces: torch.Tensor) -> None:
    """One mesh; its format follows from the name."""
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(shape.numpy(), faces.numpy(), process=False).export(path)


def write_scan(path: Path, shape: torch.Tensor, faces: torch.Tensor) -> None:
    """The same surface with half of the faces, its vertices in another order, turned and moved; and five landmarks."""
    points, triangles, _ = decimate(shape.numpy(), faces.numpy(), len(faces) // 2)
    order = np.random.default_rng(0).permutation(len(points))
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    marks = np.linspace(0, len(shape) - 1, 5).astype(int)
    nearest = ((shape.numpy()[marks, None] - points) ** 2).sum(-1).argmin(1)
    lines = [f"{mark} {place[near]}\n" for mark, near in zip(marks, nearest, strict=True)]
    path.with_name("pairs.txt").write_text("".join(["# open.obj scan.ply\n", *lines]))
    turn = trimesh.transformations.rotation_matrix(0.5, (0, 1, 0))[:3, :3]
    write(path, torch.from_numpy(points[order] @ turn.T + 0.2), torch.from_numpy(place[triangles]))


def write_observations(folder: Path, times: tuple[float, ...], shapes: torch.Tensor, faces: torch.Tensor) -> None:
    """A cloud with normals of each shape, seen from +Z, and a table of markers, a tenth of which is lost."""
    noise = 0.003 * float((shapes[0].amax(0) - shapes[0].amin(0)).norm())
    rows, view = ["time,vertex,x,y,z"], torch.tensor([0.0, 0.0, 1.0])
    lost = np.random.default_rng(0).random((len(times), 20)) < 0.1
    for k, shape in enumerate(shapes):
        points, normals = scan(shape, faces, view, 1500, noise, seed=k)
        names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{names}end_header\n"
        path = folder / "scans" / f"scan-{k + 1}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(head.encode() + torch.cat([points, normals], 1).numpy().astype("<f4").tobytes())
        rows += [
            f"{times[k]},{v}," + (",," if gone else ",".join(map(str, shape[v].tolist())))
            for v, gone in zip(range(0, 3600, 180), lost[k], strict=True)
        ]
    (folder / "markers.csv").write_text("\n".join(rows) + "\n")


def main(folder: Path) -> None:
    """Write them all into a folder."""
    hand, creature = load_sample("hand"), load_sample("creature")
    opened, fist = hand.keyframes
    write(folder / "open.obj", opened, hand.faces)
    write(folder / "fist.obj", fist, hand.faces)
    write_scan(folder / "scan.ply", fist, hand.faces)
    for number, shape in enumerate([opened, *hand.truth, fist], 1):
        write(folder / f"pose-{number}.obj", shape, hand.faces)
        write(folder / "truth" / f"frame-{number}.obj", shape, hand.faces)
    write_observations(folder, hand.true_times, hand.truth, hand.faces)
    for number, shape in enumerate(creature.keyframes, 1):
        write(folder / f"gait-{number}.obj", shape, creature.faces)
    for name, shape in zip("abc", [opened, hand.truth[1], fist], strict=True):
        write(folder / "shapes" / "hand" / f"{name}.obj", shape, hand.faces)
    for name, shape in zip("abc", creature.keyframes[:3], strict=True):
        write(folder / "shapes" / "creature" / f"{name}.obj", shape, creature.faces)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path())
    main(parser.parse_args().folder)
