"""Commands on meshes: ``register``, ``check`` and ``carry`` of ``torch-modal``."""

import argparse
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

from torch_modal.cli.arguments import add_common, add_registration, check_output, file_name, register_options, reporter
from torch_modal.io.formats import MESH_FORMATS, PICTURES

CROSSES = 3  # exit status of `check` when parts newly pass through each other


def add_register(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``register``."""
    sub.add_argument("meshes", nargs=2, type=Path, metavar="MESH", help="the template, and the target")
    text = f"the template laid onto the target, {', '.join(MESH_FORMATS)}"
    sub.add_argument("--out", type=file_name(MESH_FORMATS), required=True, metavar="FILE", help=text)
    sub.add_argument("--keep-doubtful", action="store_true", help="write a doubtful result too, with a warning")
    add_registration(sub)
    add_common(sub)


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
    check_output([args.out], args.meshes, args.overwrite)

    import torch_modal as tm
    from torch_modal.io.frames import save_mesh
    from torch_modal.registration.load import ADVICE

    template, target = map(tm.open_asset, args.meshes)
    report, options = reporter(args), register_options(args)
    result = tm.register(template.positions, template.faces, target.positions, target.faces, **options)
    report(result.summary())
    if result.doubtful:
        why = f"the result is doubtful: {'; '.join(result.warnings)}"
        if not args.keep_doubtful:
            raise ValueError(f"{why}. To help it, {ADVICE}; --keep-doubtful writes it all the same")
        warnings.warn(why, stacklevel=2)
    save_mesh(result.positions, template.faces, args.out, args.overwrite, template)
    report(f"written: {args.out}")


def add_check(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``check``."""
    add = sub.add_argument
    add("meshes", nargs="+", type=Path, metavar="MESH", help="meshes of one connectivity")
    add("--keyframes", nargs="+", type=Path, default=[], metavar="FILE", help="meshes whose own crossings are known")
    text = "check the motion through the meshes: seven shapes between any two, with its shell energy and seconds"
    add("--between", action="store_true", help=text)
    add("--contact", action="store_true", help="with --between: keep parts from passing through each other")
    text = "draw the meshes with crossings in colour, as .png or .pdf"
    add("--picture", type=file_name(PICTURES), metavar="FILE", help=text)
    add_common(sub, "replace the picture if it exists (default: refuse)", cache_dir=None)


def check(args: argparse.Namespace) -> int:
    """Find parts that pass through each other, in key-frames and results.

    Count for each mesh the triangles that pass through others, and colour them in a
    picture. All meshes have the same faces.

    With --keyframes, crossings of the key-frames are not counted as new; far ones are of
    two parts that went through each other, not crossings that grew or folds. Without, all
    are new.

    With --between, shapes between the meshes are computed and checked too; crossings of the
    meshes themselves are then known. The shell energy of the motion, of n steps, is n times
    the sum of ShellLoss from each shape to the next: free of units, and less is better.

    exit status: 0 nothing passes through anything far, 3 something does

    Examples:
      torch-modal check open.obj fist.obj
      torch-modal check open.obj fist.obj --between --contact
      torch-modal check out/frame-*.obj --keyframes open.obj fist.obj --picture crossings.png
    """
    if args.picture:
        check_output([args.picture], [*args.meshes, *args.keyframes], args.overwrite)
    if args.contact and not args.between:
        args.fail("--contact is for the shapes that --between computes")
    from torch_modal.geometry.crossings import require_contact

    require_contact()

    import torch_modal as tm

    report, n = reporter(args), len(args.keyframes)
    shapes, faces = tm.load_keyframes([*args.keyframes, *args.meshes])
    welded = tm.weld_seams(shapes, faces)
    keyframes, shapes = welded.keyframes[:n], welded.keyframes[n:]
    names = [str(mesh) for mesh in args.meshes]
    if args.between:
        keyframes, places, n = welded.keyframes, tm.keyframe_places(len(names), 3), len(welded.keyframes)
        started = time.perf_counter()
        frames = tm.subdivide(shapes, welded.faces, 3, contact=args.contact, progress=False if args.quiet else None)
        seconds, shell = time.perf_counter() - started, tm.losses.ShellLoss(welded.faces)
        ours, linear = (
            float((len(x) - 1) * shell(x[1:], x[:-1]).sum()) for x in (frames, tm.linear_sequence(shapes, places))
        )
        report(f"shell energy of the motion: {ours:.4g}, of linear interpolation: {linear:.4g}; {seconds:.1f} s")
        names, shapes = [f"t = {i / 8:g}" for i in range(len(frames))], frames
    contacts = tm.self_contacts(shapes, welded.faces, keyframes if n else None)
    used = shapes[0][welded.faces.unique()]
    diagonal = float((used.amax(0) - used.amin(0)).norm())
    columns = {"pairs": contacts.number, **({"new": contacts.n_new} if n else {}), "far": contacts.n_far}
    width = max(map(len, names))
    report(" " * width + "".join(f"{name:>9s}" for name in (*columns, "depth")))
    for i, name in enumerate(names):
        deepest = 100 * float(contacts.depth[i].max()) / diagonal
        report(f"{name:{width}s}" + "".join(f"{int(c[i]):9d}" for c in columns.values()) + f"{deepest:7.2f} %")
    report(
        "pairs of triangles that cross; far: of two parts that went through each other"
        + (", and cross in no key-frame" if n else "")
        + "; depth: of the deepest vertex there, in % of the diagonal"
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
            color_label="1: crosses, 2: new" if n else "2: crosses",
            overwrite=args.overwrite,
        )
        report(f"picture: {args.picture}")
    return CROSSES if bool(contacts.n_far.any()) else 0


def add_carry(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``carry``."""
    add, text = sub.add_argument, "meshes of one connectivity; the points lie on the first"
    add("meshes", nargs="+", type=Path, metavar="MESH", help=text)
    add("--points", type=Path, required=True, metavar="FILE.ply", help="points, or splats")
    add("--out", type=Path, required=True, metavar="FOLDER", help="for a PLY file for each mesh")
    add_common(sub, cache_dir=None)


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
    check_output(files, [*args.meshes, args.points], args.overwrite)

    import torch

    import torch_modal as tm
    from torch_modal.io.files import write_files
    from torch_modal.io.points import PointFile
    from torch_modal.progress import ProgressReport

    cloud = PointFile(args.points)
    shapes, faces = tm.load_keyframes(args.meshes)
    passengers = tm.Passengers(shapes[0], faces, torch.from_numpy(cloud.positions).to(shapes))
    with ProgressReport(len(files), "meshes", False if args.quiet else None) as bar, torch.no_grad():

        def carry_each() -> Iterator[tuple[Path, bytes]]:
            for file, x in zip(files, shapes, strict=True):
                parts = (passengers(x), passengers.rotations(x), passengers.gradients(x))
                yield file, cloud.move(*(values.double().numpy() for values in parts))
                bar.update()

        write_files(carry_each())
    kind = "splats" if cloud.is_splats else "points"
    reporter(args)(f"{len(passengers)} {kind}: {files[0]} to {files[-1].name}")
