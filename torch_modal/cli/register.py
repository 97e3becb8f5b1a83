"""``torch-modal register``: one mesh laid onto another."""

import argparse
import warnings
from pathlib import Path

from torch_modal.cli.arguments import add_out, caching, reporter
from torch_modal.cli.output import check_name, check_output
from torch_modal.io.formats import MESH_FORMATS

SUMMARY = "one mesh's connectivity laid onto others"
DESCRIPTION = """\
Lay the connectivity of the first mesh onto another mesh of the same subject, or,
with --across and landmarks, of another one. Key-frames of different connectivity
become key-frames of one.

A report is printed; a doubtful result is an error. Landmarks help: a text file
with a line for each, which names one vertex of each mesh, counted from 0."""
EXAMPLES = """\
examples:
  torch-modal register open.obj scan.ply --out wrapped.obj
  landmarks are picked on a page, and saved there as pairs.txt:
    torch-modal view cat.obj dog.obj --landmarks
    torch-modal register cat.obj dog.obj --across --landmarks pairs.txt --out wrapped.obj"""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``register`` besides the common ones."""
    sub.add_argument("meshes", nargs=2, type=Path, metavar="MESH", help="the template, and the target")
    add_out(sub, "FILE", f"the template laid onto the target, {', '.join(MESH_FORMATS)}")
    sub.add_argument("--keep-doubtful", action="store_true", help="write a doubtful result too, with a warning")
    add_options(sub)


def add_options(sub: argparse.ArgumentParser) -> None:
    """What `register` and `subdivide --register` share."""
    sub.add_argument(
        "--landmarks",
        type=Path,
        metavar="FILE",
        help="lines of vertex numbers, counted from 0, or of coordinates: a column for each mesh",
    )
    sub.add_argument(
        "--across", action="store_true", help="the meshes are different subjects; needs five landmarks or more"
    )


def run(args: argparse.Namespace) -> None:
    """Run ``torch-modal register``."""
    from torch_modal.io.frames import save_mesh
    from torch_modal.io.read import open_asset, read_mesh
    from torch_modal.registration.landmarks import landmark_table
    from torch_modal.registration.load import ADVICE
    from torch_modal.registration.register import register

    check_name(args, "--out", args.out, MESH_FORMATS)
    check_output([args.out], args.meshes, args.overwrite)
    asset = open_asset(args.meshes[0])
    vertices, faces = asset.positions, asset.faces
    there, there_faces = read_mesh(args.meshes[1])
    marks = None if args.landmarks is None else landmark_table(args.landmarks, [vertices, there])
    found = register(
        vertices,
        faces,
        there,
        there_faces,
        landmarks=None if marks is None else (marks[:, 0], marks[:, 1]),
        same_subject=not args.across,
        **caching(args),
    )
    report = reporter(args)
    report(found.summary())
    if found.doubtful:
        why = f"the result is doubtful: {'; '.join(found.warnings)}"
        if not args.keep_doubtful:
            raise ValueError(f"{why}. To help it, {ADVICE}; --keep-doubtful writes it all the same")
        warnings.warn(why, stacklevel=2)
    save_mesh(found.positions, faces, args.out, args.overwrite, asset)
    report(f"written: {args.out}")
