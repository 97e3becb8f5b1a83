"""Commands on meshes: ``register``, ``check`` and ``carry`` of ``torch-modal``."""

import argparse
from pathlib import Path

from torch_modal.cli import arguments
from torch_modal.cli.arguments import check_output, file_name, pick_options
from torch_modal.io.formats import MESH_FORMATS, PICTURES

CROSSES = 3  # exit status of `check` when parts newly pass through each other


def add_register(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``register``."""
    sub.add_argument("meshes", nargs=2, type=Path, metavar="MESH", help="the template, and the target")
    text = f"the template laid onto the target, {', '.join(MESH_FORMATS)}"
    sub.add_argument("--out", type=file_name(MESH_FORMATS), required=True, metavar="FILE", help=text)
    arguments.add_registration(sub)
    arguments.add_cache(sub)


def register(args: argparse.Namespace) -> None:
    """Lay one mesh's connectivity onto another.

    Lay the connectivity of the first mesh onto another mesh of the same subject, or,
    with --across, of another one. Key-frames of different connectivity
    become key-frames of one.

    A report is printed; a doubtful result is an error. Landmarks help: a text file
    with a line for each, which names one vertex of each mesh, counted from 0.

    Examples:
      torch-modal register open.obj scan.ply --out wrapped.obj
      landmarks are picked on a page, and saved there as pairs.txt:
        torch-modal view cat.obj dog.obj --landmarks
        torch-modal register cat.obj dog.obj --across --landmarks pairs.txt --out wrapped.obj
    """
    check_output(args, [args.out], args.meshes)

    import torch_modal as tm
    from torch_modal.registration.load import ADVICE

    template, target = map(tm.open_asset, args.meshes)
    options = pick_options(args, *arguments.REGISTRATION)
    result = tm.register(template.positions, template.faces, target.positions, target.faces, **options)
    args.report(result.summary())
    if result.doubtful:
        raise ValueError(f"the result is doubtful: {'; '.join(result.warnings)}. To help it, {ADVICE}")
    tm.save_mesh(result.positions, template.faces, args.out, args.overwrite, template)
    args.report(f"written: {args.out}")


def add_check(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``check``."""
    add = sub.add_argument
    add("meshes", nargs="+", type=Path, metavar="MESH", help="meshes of one connectivity")
    add("--keyframes", nargs="+", type=Path, default=[], metavar="FILE", help="meshes whose own crossings are known")
    text = "draw the meshes with crossings in colour, as .png or .pdf"
    add("--picture", type=file_name(PICTURES), metavar="FILE", help=text)


def check(args: argparse.Namespace) -> int:
    """Find parts that pass through each other, in key-frames and results.

    Count for each mesh the triangles that pass through others, and colour them in a
    picture. All meshes have the same faces.

    With --keyframes, crossings of the key-frames are not counted as new; far ones are of
    two parts that went through each other, not crossings that grew or folds. Without, all
    are new.

    exit status: 0 nothing passes through anything far, 3 something does

    Examples:
      torch-modal check open.obj fist.obj
      torch-modal check out/frame-*.obj --keyframes open.obj fist.obj --picture crossings.png
    """
    if args.picture:
        check_output(args, [args.picture], [*args.meshes, *args.keyframes])

    import torch_modal as tm

    shapes, faces = tm.load_keyframes([*args.keyframes, *args.meshes])
    welded = tm.weld_seams(shapes, faces)
    keyframes, shapes = welded.keyframes.split([len(args.keyframes), len(args.meshes)])
    names = [str(mesh) for mesh in args.meshes]
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
        marks = shapes.new_zeros(shapes.shape[:2])  # of each vertex: 0, 1 for a crossing, 2 for a new one
        for value, chosen in ((1.0, slice(None)), (2.0, contacts.new)):
            marks[contacts.shape[chosen].repeat_interleave(6), welded.faces[contacts.pairs[chosen]].flatten()] = value
        tm.render_sequence(
            {"crossings": shapes},
            welded.faces,
            args.picture,
            columns=min(len(names), 8),
            keyframe_indices=[0],
            colors={"crossings": marks},
            color_label="1: crosses, 2: new",
            overwrite=args.overwrite,
        )
        args.report(f"picture: {args.picture}")
    return CROSSES if bool(contacts.n_far.any()) else 0


def add_carry(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``carry``."""
    add, text = sub.add_argument, "meshes of one connectivity; the points lie on the first"
    add("meshes", nargs="+", type=Path, metavar="MESH", help=text)
    add("--points", type=Path, required=True, metavar="FILE.ply", help="points, or splats")
    add("--out", type=Path, required=True, metavar="FOLDER", help="for a PLY file for each mesh")


def carry(args: argparse.Namespace) -> None:
    """Move points, scans or splats with a sequence of meshes.

    Bind the points of a PLY file to the first mesh, and move them with all others: a scan,
    markers, an accessory, or the splats of 3D Gaussian splatting, whose axes, scales and
    harmonics follow. Everything else in the file stays as it is.

    Examples:
      torch-modal subdivide open.obj fist.obj --out hand/
      torch-modal carry hand/frame-*.obj --points scene.ply --out splats/
    """
    files = [args.out / f"{args.points.stem}-{i:04d}.ply" for i in range(len(args.meshes))]
    check_output(args, files, [*args.meshes, args.points])

    import torch

    import torch_modal as tm
    from torch_modal.io.files import write_files
    from torch_modal.io.points import PointFile

    cloud = PointFile(args.points)
    shapes, faces = tm.load_keyframes(args.meshes)
    passengers = tm.Passengers(shapes[0], faces, torch.from_numpy(cloud.positions).to(shapes))
    with torch.no_grad():
        # Files are made while they are written, as all would fill the memory.
        moved = ((passengers(x), passengers.rotations(x), passengers.gradients(x)) for x in shapes)
        contents = (cloud.move(*(values.double().numpy() for values in parts)) for parts in moved)
        write_files(zip(files, contents, strict=True))
    kind = "splats" if cloud.is_splats else "points"
    args.report(f"{len(passengers)} {kind}: {files[0]} to {files[-1].name}")
