"""``torch-modal check``: self-contacts of meshes."""

import argparse
from pathlib import Path
from typing import Any

from torch_modal.cli.arguments import add_debug
from torch_modal.cli.output import check_name, check_output
from torch_modal.io.formats import PICTURES

SUMMARY = "parts that pass through each other, in key-frames and results"
DESCRIPTION = """\
Count for each mesh the triangles that pass through others, and colour them in a
picture. All meshes have the same faces.

With --keyframes, crossings of the key-frames are not counted as new; far ones are of
two parts that went through each other, not crossings that grew or folds. Without, all
are new."""
EXAMPLES = """\
examples:
  torch-modal check open.obj fist.obj
  torch-modal check out/frame-*.obj --keyframes open.obj fist.obj --picture crossings.png"""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``check`` besides the common ones."""
    sub.add_argument("meshes", nargs="+", type=Path, metavar="FILE", help="meshes of one connectivity")
    sub.add_argument(
        "--keyframes", nargs="+", type=Path, default=[], metavar="FILE", help="meshes whose own crossings are known"
    )
    sub.add_argument(
        "--picture", type=Path, metavar="FILE", help="draw the meshes with crossings in colour, as .png or .pdf"
    )
    sub.add_argument("--overwrite", action="store_true", help="replace the picture if it exists (default: refuse)")
    add_debug(sub)
    sub.set_defaults(quiet=False, verbose=False)


def run(args: argparse.Namespace) -> int:
    """Run ``torch-modal check``: 3 if parts newly pass through each other, else 0."""
    check_name(args, "--picture", args.picture, PICTURES)
    if args.picture:
        check_output([args.picture], [*args.meshes, *args.keyframes], args.overwrite, option="--picture")
    from torch_modal.geometry.crossings import require_contact

    require_contact()

    import torch_modal as tm

    shapes, faces = tm.load_keyframes([*args.keyframes, *args.meshes])
    n = len(args.keyframes)
    welded = tm.weld_seams(shapes, faces)
    found = tm.self_contacts(welded.keyframes[n:], welded.faces, welded.keyframes[:n] if n else None)
    used = welded.keyframes[0][welded.faces.unique()]
    diagonal = float((used.amax(0) - used.amin(0)).norm())
    head = ("pairs", "new", "far", "depth") if n else ("pairs", "far", "depth")
    width = max(len(str(mesh)) for mesh in args.meshes)
    print(" " * width + "".join(f"{name:>9s}" for name in head))
    for i, mesh in enumerate(args.meshes):
        counts = [found.number[i], *([found.n_new[i]] if n else []), found.n_far[i]]
        deep = 100 * float(found.depth[i].max()) / diagonal
        print(f"{mesh!s:{width}s}" + "".join(f"{int(c):9d}" for c in counts) + f"{deep:7.2f} %")
    total = int(found.n_far.sum())
    print(
        "pairs of triangles that cross; far: of two parts that went through each other"
        + (", and cross in no key-frame" if n else "")
        + "; depth: of the deepest vertex there, in % of the diagonal"
    )
    if args.picture:
        tm.render_sequence(
            {"crossings": welded.keyframes[n:]},
            welded.faces,
            args.picture,
            columns=min(len(args.meshes), 8),
            keyframe_indices=[0],
            colors={"crossings": _marks(found, welded.faces, welded.keyframes[n:])},
            color_label="1: crosses, 2: new" if n else "2: crosses",
            overwrite=args.overwrite,
        )
        print(f"picture: {args.picture}")
    return 3 if total else 0


def _marks(found: Any, faces: Any, shapes: Any) -> Any:
    """Of each vertex: 0, 1 for a crossing, 2 for a new one. *Shape:* ``(N, V)``."""
    marks = shapes.new_zeros(shapes.shape[:2])
    for value, chosen in ((1.0, found.new == found.new), (2.0, found.new)):
        which = found.shape[chosen].repeat_interleave(6)
        marks[which, faces[found.pairs[chosen]].flatten()] = value
    return marks
