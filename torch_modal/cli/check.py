"""``torch-modal check``: crossings, volumes and strains of meshes and of the motion through them."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING

from torch_modal.cli.arguments import check_output, pick_options
from torch_modal.io.files import write_files
from torch_modal.io.formats import PICTURES
from torch_modal.io.write import check_suffix

if TYPE_CHECKING:
    from torch import Tensor

    from torch_modal.contact.self_contacts import SelfContacts

CROSSES = 3  # exit status when parts newly pass through each other


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``check``."""
    add = sub.add_argument
    add("meshes", nargs="+", type=Path, metavar="MESH", help="meshes of one connectivity")
    add("--keyframes", nargs="+", type=Path, default=[], metavar="FILE", help="meshes whose own crossings are known")
    text = "check the motion through the meshes: seven shapes between any two, with its shell energy and seconds"
    add("--between", action="store_true", help=text)
    add("--contact", action="store_true", help="with --between: keep parts from passing through each other")
    text = "draw the meshes with crossings in colour, as .png or .pdf"
    add("--picture", type=Path, metavar="FILE", help=text)
    text = "write the volume of each shape, and the principal strains of each face from the first shape, as .csv"
    add("--table", type=Path, metavar="FILE", help=text)


def run(args: argparse.Namespace) -> int:
    """Find parts that pass through each other, in key-frames and results.

    Count for each mesh the triangles that pass through others, and colour them in a
    picture. All meshes have the same faces.

    With --keyframes, crossings of the key-frames are not counted as new; far ones are of
    two parts that went through each other, not crossings that grew or folds. Without, all
    are new.

    With --between, shapes between the meshes are computed and checked too; crossings of the
    meshes themselves are then known. The shell energy of the motion, of n steps, is n times
    the sum of ShellLoss from each shape to the next: free of units, and less is better.

    The table of --table has a line for each shape and face: the volume of the shape, the area
    of the face, and its least and largest principal strain relative to the first shape, 0.1 for
    10 % longer. Faces are numbered as in the file, after polygons are cut into triangles, from 0;
    faces without area in the first shape have no strain. Open surfaces have the volume that
    they enclose with their centroid.

    exit status: 0 nothing passes through anything far, 3 something does

    Examples:
      torch-modal check open.obj fist.obj
      torch-modal check open.obj fist.obj --between --contact
      torch-modal check out/frame-*.obj --keyframes open.obj fist.obj --picture crossings.png
      torch-modal check out/frame-*.obj --table strains.csv
    """
    if args.contact and not args.between:
        args.fail("--contact is for the shapes that --between computes")
    outputs = ((args.picture, PICTURES), (args.table, (".csv",)))
    for path, suffixes in outputs:
        if path:
            check_suffix(path, suffixes)
    check_output(args, [path for path, _ in outputs if path], [*args.meshes, *args.keyframes])

    import torch_modal as tm
    from torch_modal.data.strain import strain_table
    from torch_modal.times import fill_linear

    shapes, faces = tm.load_keyframes([*args.keyframes, *args.meshes])
    welded = tm.weld_seams(shapes, faces)
    keyframes, shapes = welded.keyframes.split([len(args.keyframes), len(args.meshes)])
    names = [str(mesh) for mesh in args.meshes]
    if args.between:
        keyframes, started = welded.keyframes, time.perf_counter()
        frames = tm.interpolate(shapes, welded.faces, 3, **pick_options(args, "contact", "progress"))
        seconds, shell = time.perf_counter() - started, tm.losses.ShellLoss(welded.faces)
        motions = frames, fill_linear(shapes, range(0, 8 * len(names), 8))
        ours, linear = (float((len(x) - 1) * shell(x[1:], x[:-1]).sum()) for x in motions)
        args.report(f"shell energy of the motion: {ours:.4g}, of linear interpolation: {linear:.4g}; {seconds:.1f} s")
        names, shapes = [f"t = {i / 8:g}" for i in range(len(frames))], frames
    contacts = tm.self_contacts(shapes, welded.faces, keyframes if len(keyframes) else None)
    used = shapes[0][welded.faces.unique()]
    depths = 100 * contacts.depth.amax(1) / (used.amax(0) - used.amin(0)).norm()
    columns = {"pairs": contacts.number, "new": contacts.n_new, "far": contacts.n_far}
    width = max(map(len, names))
    args.report(" " * width + "".join(f"{name:>9s}" for name in (*columns, "depth")))
    for name, depth, *numbers in zip(names, depths.tolist(), *columns.values(), strict=True):
        args.report(f"{name:{width}s}" + "".join(f"{int(n):9d}" for n in numbers) + f"{depth:7.2f} %")
    args.report(
        "pairs of triangles that cross; new: in no key-frame; far: new, and of two parts that went through each other; "
        "depth: of the deepest vertex there, in % of the diagonal"
    )
    if args.picture:
        _draw(args, shapes, welded.faces, contacts)
    if args.table:
        write_files([(args.table, strain_table(names, welded.scatter(shapes), faces))])
        args.report(f"table:   {args.table}")
    return CROSSES if bool(contacts.n_far.any()) else 0


def _draw(args: argparse.Namespace, shapes: Tensor, faces: Tensor, contacts: SelfContacts) -> None:
    """Draw the shapes with their crossings in colour."""
    import torch_modal as tm

    marks = shapes.new_zeros(shapes.shape[:2])  # of each vertex: 0, 1 for a crossing, 2 for a new one
    for value, chosen in ((1.0, slice(None)), (2.0, contacts.new)):
        marks[contacts.shape[chosen].repeat_interleave(6), faces[contacts.pairs[chosen]].flatten()] = value
    tm.render_sequence(
        {"crossings": shapes},
        faces,
        args.picture,
        columns=min(len(shapes), 8),
        keyframe_indices=[0],
        colors={"crossings": marks},
        color_label="1: crosses, 2: new",
    )
    args.report(f"picture: {args.picture}")
