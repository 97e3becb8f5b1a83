"""``torch-modal register``: one mesh laid onto another, or numbered suggestions for landmarks."""

import argparse
from pathlib import Path

from torch_modal.cli.output import check_name, check_output
from torch_modal.io.formats import MESH_FORMATS, PICTURES

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
  numbered suggestions for landmarks, in a picture:
    torch-modal register cat.obj dog.obj --suggest numbers.png
  and with the pairs that were typed from it, one a line:
    torch-modal register cat.obj dog.obj --across --landmarks pairs.txt --out wrapped.obj"""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``register`` besides the common ones."""
    sub.add_argument("meshes", nargs=2, type=Path, metavar="MESH", help="the template, and the target")
    suffixes = ", ".join(MESH_FORMATS)
    sub.add_argument("--out", type=Path, metavar="FILE", help=f"the template laid onto the target, {suffixes}")
    sub.add_argument(
        "--suggest",
        type=Path,
        metavar="PICTURE",
        help="only draw both meshes with the numbers of vertices that make good landmarks, as .png or .pdf",
    )
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
    if (args.out is None) == (args.suggest is None):
        args.fail("register needs either --out FILE or --suggest PICTURE")
    file, option = (args.out, "--out") if args.out else (args.suggest, "--suggest")
    check_name(args, option, file, MESH_FORMATS if args.out else PICTURES)
    check_output([file], args.meshes, args.overwrite, option=option)
    if args.suggest:
        _suggest(args)
    else:
        _register(args)


def _suggest(args: argparse.Namespace) -> None:
    from torch_modal.io.read import read_mesh
    from torch_modal.keyframes.registration.landmarks import suggest_landmarks
    from torch_modal.view.landmarks import MarkedMesh, render_landmarks

    marked = []
    for mesh in args.meshes:
        vertices, faces = read_mesh(mesh)
        marked.append(MarkedMesh(mesh.name, vertices, faces, suggest_landmarks(vertices, faces)))
    render_landmarks(marked, args.suggest, overwrite=args.overwrite)
    if not args.quiet:
        for mesh in marked:
            print(f"{mesh.label}: " + " ".join(map(str, mesh.marked)))
        print(f"picture: {args.suggest}; type pairs of its numbers that belong together, one a line, for --landmarks")


def _register(args: argparse.Namespace) -> None:
    import warnings

    from torch_modal.io.frames import save_mesh
    from torch_modal.io.read import open_asset, read_mesh
    from torch_modal.keyframes.registration.register import register
    from torch_modal.keyframes.registration.sequence import ADVICE, landmark_table

    asset = open_asset(args.meshes[0])
    vertices, faces = asset.positions, asset.faces
    there, there_faces = read_mesh(args.meshes[1])
    marks = landmark_table(args.landmarks, [vertices, there])
    found = register(
        vertices,
        faces,
        there,
        there_faces,
        landmarks=None if marks is None else (marks[:, 0], marks[:, 1]),
        same_subject=not args.across,
        cache_dir=args.cache_dir,
        cache=not args.no_cache,
        progress=False if args.quiet else None,
    )
    if not args.quiet:
        print(found.summary())
    if found.doubtful:
        why = f"the result is doubtful: {'; '.join(found.warnings)}"
        if not args.keep_doubtful:
            raise ValueError(f"{why}. To help it, {ADVICE}; --keep-doubtful writes it all the same")
        warnings.warn(why, stacklevel=2)
    save_mesh(found.positions, faces, args.out, args.overwrite, asset)
    if not args.quiet:
        print(f"written: {args.out}")
