"""Commands ``register``, ``carry``, ``modes``, ``precompute`` and ``demo`` of ``torch-modal``."""

import argparse
import warnings
from pathlib import Path

from torch_modal.cli import arguments, subdivide
from torch_modal.cli.arguments import check_output, pick_options
from torch_modal.io.files import csv_bytes, write_files
from torch_modal.io.formats import MESH_FORMATS
from torch_modal.io.write import check_suffix

DEMO_SAMPLES = ("creature", "hand")
INCOMPLETE = 3  # exit status of `precompute` when some sets have no bases, of `register` when some are doubtful
TABLE = ["target", "confidence", "to target (%)", "from target (%)", "stretch", "warnings"]


def add_register(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``register``."""
    text = "the template, and the target; or several targets, or a folder of them"
    sub.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help=text)
    text = f"the template laid onto the target, {', '.join(MESH_FORMATS)}; of several, a folder, also for report.csv"
    sub.add_argument("--out", type=Path, required=True, metavar="FILE_OR_FOLDER", help=text)
    sub.add_argument("--keep-doubtful", action="store_true", help="write a doubtful result too, with a warning")
    arguments.add_registration(sub)
    arguments.add_cache(sub)


def register(args: argparse.Namespace) -> int:
    """Lay one mesh's connectivity onto another.

    Lay the connectivity of the first mesh onto another mesh of the same subject, or,
    with --across, of another one. Key-frames of different connectivity
    become key-frames of one.

    A report is printed; a doubtful result is an error. Landmarks help: a text file
    with a line for each, which names one vertex of each mesh, counted from 0.

    Of several targets, each result is a mesh with the target's name in the folder, beside
    a table of their confidence, distances and stretch. Doubtful ones are left out.

    exit status: 3 if some of several are doubtful, 1 if one alone is

    Examples:
      torch-modal register open.obj scan.ply --out wrapped.obj
      torch-modal register template.obj scans/ --across --out wrapped
      landmarks are picked on a page, and saved there as pairs.txt:
        torch-modal view cat.obj dog.obj --landmarks
        torch-modal register cat.obj dog.obj --across --landmarks pairs.txt --out wrapped.obj
    """
    from torch_modal.data.tree import mesh_files

    first, *targets = args.meshes
    several = len(targets) > 1 or any(path.is_dir() for path in targets)
    targets = [file for path in targets for file in (mesh_files(path) if path.is_dir() else [path])]
    targets = [path for path in targets if path.resolve() != first.resolve()]
    if not targets:
        args.fail("register needs a template and one target or more")
    files, table = [args.out], args.out / "report.csv"
    if several:
        files = [args.out / path.with_suffix(first.suffix).name for path in targets]
        if len(set(files)) < len(files):
            raise ValueError("several targets have the same name; each names the file of its result")
    for path in files:
        check_suffix(path, MESH_FORMATS)
    check_output(args, [*files, *[table] * several], [first, *targets])

    import torch_modal as tm
    from torch_modal.registration.landmarks import landmark_vertices
    from torch_modal.registration.load import ADVICE

    template, *assets = map(tm.open_asset, [first, *targets])
    options, rows, doubtful = pick_options(args, *arguments.REGISTRATION), [TABLE], 0
    if marks := options.pop("landmarks"):
        marks = landmark_vertices(marks, [each.positions for each in (template, *assets)])
    for i, (path, target, out) in enumerate(zip(targets, assets, files, strict=True), 1):
        pair = {} if marks is None else {"landmarks": marks[:, [0, i]]}
        result = tm.register(template.positions, template.faces, target.positions, target.faces, **pair, **options)
        args.report(f"{path.name}: {result.summary()}" if several else result.summary())
        if several:
            distances = f"{result.to_target.mean:.3f}", f"{result.from_target.mean:.3f}", f"{result.stretch:.4f}"
            rows.append([path.name, f"{result.confidence:.3f}", *distances, "; ".join(result.warnings)])
        if result.doubtful:
            doubtful += 1
            why = f"the result is doubtful: {'; '.join(result.warnings)}"
            if not args.keep_doubtful and not several:
                raise ValueError(f"{why}. To help it, {ADVICE}; --keep-doubtful writes it all the same")
            warnings.warn(f"{path.name}: {why}" if several else why, stacklevel=2)
            if not args.keep_doubtful:
                continue
        tm.save_mesh(result.positions, template.faces, out, overwrite=args.overwrite, asset=template)
        args.report(f"written: {out}")
    if several:
        write_files([(table, csv_bytes(rows))])
        args.report(f"report:  {table}, {doubtful} of {len(targets)} doubtful")
    return INCOMPLETE if several and doubtful else 0


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


def add_modes(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``modes``."""
    sub.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help="key-frames of one connectivity")
    text = "FILE.safetensors for one mesh, or a folder for a file of each mesh's name"
    sub.add_argument("--out", type=Path, required=True, metavar="FILE_OR_FOLDER", help=text)
    arguments.add_modes(sub)
    arguments.add_cache(sub)


def modes(args: argparse.Namespace) -> None:
    """Compute vibration modes of key-frames, as safetensors.

    Compute the vibration modes of key-frames: the lowest elastic modes of the solid
    that each surface encloses, restricted to the surface, or of the surface itself
    where it is open or thin.

    They are what `subdivide` computes first. Read the files with
    torch_modal.ModalBasis.load. With --mesher tetwild, which is not deterministic, two
    runs without the cache give slightly different modes.

    Examples:
      torch-modal modes horse.obj --out horse.safetensors
      torch-modal modes gait-?.ply --modes 50 --out bases
    """
    files = [args.out]
    if not arguments.is_file(args, [".safetensors"]):
        files = [args.out / f"{mesh.stem}.safetensors" for mesh in args.meshes]
        if len(set(files)) < len(files):
            args.fail("two meshes have the same file name, so their bases would too; take them one by one")
    elif len(args.meshes) > 1:
        args.fail(f"--out {args.out} is one file, but there are {len(args.meshes)} meshes; name a folder")
    check_output(args, files, args.meshes)

    import torch_modal as tm

    keyframes, faces = tm.load_keyframes(args.meshes)
    bases = tm.extract_bases(keyframes, faces, **pick_options(args, *arguments.MODES))
    for file, basis in zip(files, bases, strict=True):
        file.parent.mkdir(parents=True, exist_ok=True)
        basis.save(file)
    args.report(f"bases: {files[0]}" + (f" to {files[-1].name}" if len(files) > 1 else ""))


def add_precompute(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``precompute``."""
    add = sub.add_argument
    add("root", type=Path, metavar="DIR", help="the folder tree with the key-frames")
    add("--out", type=Path, required=True, metavar="DIR", help="where the bases go")
    text = "sets at a time, each in a process with one thread (default: one for each processor)"
    add("--workers", type=int, metavar="N", help=text)
    add("--scheduler", metavar="ADDRESS", help="run on the Dask cluster with this scheduler instead")
    add("--timeout", type=float, metavar="S", default=600.0, help="for a set (default: 600)")
    text = "the meshes of a folder are a motion, in the order of their names, perhaps with a file times.txt"
    add("--sequence", action="store_true", help=text)
    arguments.add_modes(sub)


def precompute(args: argparse.Namespace) -> int:
    """Compute the bases of every key-frame set of a folder tree, on one or several machines.

    Compute the bases of every key-frame set below a folder.

    A set is a folder that directly holds two or more meshes of one connectivity. The output
    mirrors the tree, with the key-frames and bases of each set as safetensors. Every set has a
    process and a time limit of its own: one that crashes, hangs or is refused is named at the
    end, and the others go on. The same command again continues where it stopped: it computes
    the sets that have no bases, and those whose files or options changed. Stored sets that
    this command did not write are replaced with --overwrite only.

    exit status: 0 all sets have their bases, 3 some have not, 1 an error, 130 interrupted

    Examples:
      torch-modal precompute shapes --out bases
      torch-modal precompute shapes --out bases --workers 4 --timeout 120
      on machines that share their files, with a Dask cluster:
        torch-modal precompute shapes --out bases --scheduler tcp://HOST:8786
    """
    if args.scheduler and args.workers:
        args.fail("--scheduler shares the sets among the workers of its cluster; leave out --workers")

    from torch_modal.data.precompute import DONE, Options, precompute_tree

    options = Options(**pick_options(args, "n_modes", "method", "mesher", "timeout", "overwrite", "sequence"))
    where = pick_options(args, "workers", "scheduler")
    records = precompute_tree(args.root, args.out, options, **where, say=args.report)
    return 0 if all(record.status == DONE for record in records.values()) else INCOMPLETE


def add_demo(sub: argparse.ArgumentParser) -> None:
    """Add the arguments of ``demo``."""
    add, folder = sub.add_argument, Path("torch-modal-demo")
    add("--out", type=Path, default=folder, metavar="FOLDER", help="where the files go (default: %(default)s)")
    add("--sample", choices=DEMO_SAMPLES, help="only this one (default: both)")
    arguments.add_levels(sub)


def demo(args: argparse.Namespace) -> None:
    """Try it on the samples that come with it.

    Run the main job on the samples that come with the package: a galloping creature
    (a cycle of six key-frames) and a closing hand (two key-frames).

    For each it runs `interpolate`, which writes an animation (GLB) and a picture of the sequence
    next to linear interpolation.

    Examples:
      torch-modal demo --sample hand --out hand-demo
    """
    names = [args.sample] if args.sample else DEMO_SAMPLES
    check_output(args, [args.out / f"{name}{suffix}" for name in names for suffix in (".glb", ".png")], ())

    from torch_modal.data.samples import SAMPLES, sample_files

    for name in names:
        plays = ["--cyclic" if SAMPLES[name]["cyclic"] else "--ping-pong", "--duration", str(SAMPLES[name]["seconds"])]
        command = ["interpolate", *map(str, sample_files(name)), "--levels", str(args.levels), *plays, "--overwrite"]
        command += ["--out", str(args.out / f"{name}.glb"), "--picture", str(args.out / f"{name}.png")]
        args.report(" ".join(["torch-modal", *command]))
        subdivide.run(args.parse(command, argparse.Namespace(progress=args.progress, report=args.report)))
