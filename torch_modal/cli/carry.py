"""``torch-modal carry``: points that follow meshes."""

import argparse
from collections.abc import Iterator
from pathlib import Path

from torch_modal.cli.arguments import add_out, reporter
from torch_modal.cli.output import check_output

SUMMARY = "points, scans or splats that follow a sequence of meshes"
DESCRIPTION = """\
Bind the points of a PLY file to the first mesh, and move them with all others: a scan,
markers, an accessory, or the splats of 3D Gaussian splatting, whose axes, scales and
harmonics turn along. All that the file has besides stays as it is."""
EXAMPLES = """\
examples:
  torch-modal subdivide open.obj fist.obj --out hand/
  torch-modal carry hand/frame-*.obj --points scene.ply --out splats/"""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``carry`` besides the common ones."""
    sub.add_argument(
        "meshes", nargs="+", type=Path, metavar="MESH", help="meshes of one connectivity; the points lie on the first"
    )
    sub.add_argument("--points", type=Path, required=True, metavar="FILE.ply", help="points, or splats")
    add_out(sub, "FOLDER", "for a PLY file for each mesh")


def run(args: argparse.Namespace) -> None:
    """Run ``torch-modal carry``."""
    files = [args.out / f"{args.points.stem}-{i:04d}.ply" for i in range(len(args.meshes))]
    check_output(files, [*args.meshes, args.points], args.overwrite)

    import torch

    import torch_modal as tm
    from torch_modal.io.files import write_files
    from torch_modal.io.points import PointFile
    from torch_modal.progress import ProgressReport

    report = reporter(args)
    try:
        given = PointFile(args.points)
    except (OSError, ValueError) as error:
        args.fail(str(error))
    shapes, faces = tm.load_keyframes(args.meshes)
    passengers = tm.Passengers(shapes[0], faces, torch.from_numpy(given.positions).to(shapes))
    with ProgressReport(len(files), "meshes", False if args.quiet else None) as bar, torch.no_grad():

        def moved() -> Iterator[tuple[Path, bytes]]:
            for file, x in zip(files, shapes, strict=True):
                parts = (passengers(x), passengers.rotations(x), passengers.gradients(x))
                yield file, given.moved(*(part.double().numpy() for part in parts))
                bar.update()

        write_files(moved())
    report(f"{len(passengers)} {'splats' if given.is_splats else 'points'}: {files[0]} to {files[-1].name}")
