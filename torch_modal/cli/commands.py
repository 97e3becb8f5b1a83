"""Commands of one step each: ``register``, ``check``, ``carry``, ``modes`` and ``cache`` of ``torch-modal``.

Each checks its output paths before any heavy import and any work.
"""

import argparse
import warnings
from collections.abc import Iterator
from pathlib import Path

from torch_modal.cli.arguments import (
    CACHE_DIR,
    add_common,
    add_meshes,
    add_modes,
    add_out,
    add_picture,
    add_registration,
    caching,
    check_output,
    file_name,
    is_file,
    mode_options,
    reporter,
)
from torch_modal.io.formats import MESH_FORMATS

CROSSES = 3
"""Exit status of `check` when parts newly pass through each other."""


def add_register(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``register``."""
    sub.add_argument("meshes", nargs=2, type=Path, metavar="MESH", help="the template, and the target")
    text = f"the template laid onto the target, {', '.join(MESH_FORMATS)}"
    add_out(sub, "FILE", text, file_name(MESH_FORMATS))
    sub.add_argument("--keep-doubtful", action="store_true", help="write a doubtful result too, with a warning")
    add_registration(sub)
    add_common(sub)


def register(args: argparse.Namespace) -> None:
    """One mesh's connectivity laid onto others.

    Lay the connectivity of the first mesh onto another mesh of the same subject, or,
    with --across and landmarks, of another one. Key-frames of different connectivity
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
    from torch_modal.registration.landmarks import landmark_table
    from torch_modal.registration.load import ADVICE

    template, target = map(tm.open_asset, args.meshes)
    marks = None
    if args.landmarks is not None:
        table = landmark_table(args.landmarks, [template.positions, target.positions])
        marks = table[:, 0], table[:, 1]
    found = tm.register(
        template.positions,
        template.faces,
        target.positions,
        target.faces,
        landmarks=marks,
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
    save_mesh(found.positions, template.faces, args.out, args.overwrite, template)
    report(f"written: {args.out}")


def add_check(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``check``."""
    add_meshes(sub, "meshes of one connectivity")
    sub.add_argument(
        "--keyframes", nargs="+", type=Path, default=[], metavar="FILE", help="meshes whose own crossings are known"
    )
    add_picture(sub, "draw the meshes with crossings in colour")
    add_common(sub, overwrite="replace the picture if it exists (default: refuse)", cache_dir=None, all_of=False)


def check(args: argparse.Namespace) -> int:
    """Parts that pass through each other, in key-frames and results.

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
        check_output([args.picture], [*args.meshes, *args.keyframes], args.overwrite)
    from torch_modal.geometry.crossings import require_contact

    require_contact()

    import torch_modal as tm

    report, n = reporter(args), len(args.keyframes)
    shapes, faces = tm.load_keyframes([*args.keyframes, *args.meshes])
    welded = tm.weld_seams(shapes, faces)
    keyframes, shapes = welded.keyframes[:n], welded.keyframes[n:]
    found = tm.self_contacts(shapes, welded.faces, keyframes if n else None)
    used = shapes[0][welded.faces.unique()]
    diagonal = float((used.amax(0) - used.amin(0)).norm())
    columns = {"pairs": found.number, **({"new": found.n_new} if n else {}), "far": found.n_far}
    width = max(len(str(mesh)) for mesh in args.meshes)
    report(" " * width + "".join(f"{name:>9s}" for name in (*columns, "depth")))
    for i, mesh in enumerate(args.meshes):
        deepest = 100 * float(found.depth[i].max()) / diagonal
        report(f"{mesh!s:{width}s}" + "".join(f"{int(c[i]):9d}" for c in columns.values()) + f"{deepest:7.2f} %")
    report(
        "pairs of triangles that cross; far: of two parts that went through each other"
        + (", and cross in no key-frame" if n else "")
        + "; depth: of the deepest vertex there, in % of the diagonal"
    )
    if args.picture:
        marks = shapes.new_zeros(shapes.shape[:2])  # of each vertex: 0, 1 for a crossing, 2 for a new one
        for value, chosen in ((1.0, slice(None)), (2.0, found.new)):
            marks[found.shape[chosen].repeat_interleave(6), welded.faces[found.pairs[chosen]].flatten()] = value
        tm.render_sequence(
            {"crossings": shapes},
            welded.faces,
            args.picture,
            columns=min(len(args.meshes), 8),
            keyframe_indices=[0],
            colors={"crossings": marks},
            color_label="1: crosses, 2: new" if n else "2: crosses",
            overwrite=args.overwrite,
        )
        report(f"picture: {args.picture}")
    return CROSSES if bool(found.n_far.any()) else 0


def add_carry(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``carry``."""
    add_meshes(sub, "meshes of one connectivity; the points lie on the first")
    sub.add_argument("--points", type=Path, required=True, metavar="FILE.ply", help="points, or splats")
    add_out(sub, "FOLDER", "for a PLY file for each mesh")
    add_common(sub, cache_dir=None, all_of=False)


def carry(args: argparse.Namespace) -> None:
    """Points, scans or splats that follow a sequence of meshes.

    Bind the points of a PLY file to the first mesh, and move them with all others: a scan,
    markers, an accessory, or the splats of 3D Gaussian splatting, whose axes, scales and
    harmonics turn along. All that the file has besides stays as it is.

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

    given = PointFile(args.points)
    shapes, faces = tm.load_keyframes(args.meshes)
    passengers = tm.Passengers(shapes[0], faces, torch.from_numpy(given.positions).to(shapes))
    with ProgressReport(len(files), "meshes", False if args.quiet else None) as bar, torch.no_grad():

        def moved() -> Iterator[tuple[Path, bytes]]:
            for file, x in zip(files, shapes, strict=True):
                parts = (passengers(x), passengers.rotations(x), passengers.gradients(x))
                yield file, given.moved(*(part.double().numpy() for part in parts))
                bar.update()

        write_files(moved())
    kind = "splats" if given.is_splats else "points"
    reporter(args)(f"{len(passengers)} {kind}: {files[0]} to {files[-1].name}")


def add_modes_command(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``modes``."""
    add_meshes(sub, "key-frames of one connectivity")
    add_out(sub, "FILE_OR_FOLDER", "FILE.safetensors for one mesh, or a folder for a file of each mesh's name")
    add_modes(sub)
    add_common(sub)


def modes(args: argparse.Namespace) -> None:
    """Vibration modes of key-frames, as safetensors.

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
    if not is_file(args, [".safetensors"]):
        files = [args.out / f"{mesh.stem}.safetensors" for mesh in args.meshes]
        if len(set(files)) < len(files):
            args.fail("two meshes have the same file name, so their bases would too; take them one by one")
    elif len(args.meshes) > 1:
        args.fail(f"--out {args.out} is one file, but there are {len(args.meshes)} meshes; name a folder")
    check_output(files, args.meshes, args.overwrite)

    import torch_modal as tm

    keyframes, faces = tm.load_keyframes(args.meshes)
    bases = tm.extract_bases(keyframes, faces, args.modes, **mode_options(args))
    report = reporter(args)
    shown = min(8, args.modes)
    report(f"{'lowest elastic modes':24s}" + "".join(f"{i + 1:>10d}" for i in range(shown)))
    for file, mesh, basis in zip(files, args.meshes, bases, strict=True):
        file.parent.mkdir(parents=True, exist_ok=True)
        basis.save(file)
        values = basis.eigenvalues[:shown].tolist()
        first = next((value for value in basis.eigenvalues.tolist() if value > 0), 1.0)
        report(f"{mesh.name:24s}" + "".join(f"{value:>10.3g}" for value in values))
        report(f"{'  frequency / first':24s}" + "".join(f"{(value / first) ** 0.5:>10.3f}" for value in values))
    report("eigenvalues are squared frequencies, in 1 / (unit of the mesh)^2; solids and shells differ in stiffness")
    report(f"bases: {files[0]}" + (f" to {files[-1].name}" if len(files) > 1 else ""))


def add_cache(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``cache``."""
    sub.add_argument("--clear", action="store_true", help="remove what is in it; other files in the folder stay")
    sub.add_argument("--cache-dir", metavar="DIR", help=CACHE_DIR)


def cache(args: argparse.Namespace) -> None:
    """Size of the cache of tetrahedra and modes.

    Say how large the cache is, where tetrahedra and modes are kept between runs.

    It never takes more than 4 GiB, or what the environment variable TORCH_MODAL_CACHE_LIMIT
    says (500M, 10G): what was not used for the longest makes room for what is new.

    Examples:
      torch-modal cache --clear
    """
    from torch_modal.io import cache as cached

    folder = args.cache_dir or cached.default_cache_dir()
    n_entries, n_bytes = cached.clear_cache(folder) if args.clear else cached.cache_content(folder)
    size = f"{n_entries} entries, {n_bytes / 2**20:.1f} MiB"
    limit = f"{cached.size_limit() / 2**20:g} MiB"
    print(f"{size} removed from {folder}" if args.clear else f"{size} in {folder} (limit: {limit})")
