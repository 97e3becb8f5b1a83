"""Commands on modes: ``modes`` and ``precompute`` of ``torch-modal``."""

import argparse
from pathlib import Path

from torch_modal.cli import arguments
from torch_modal.cli.arguments import number, pick_options

INCOMPLETE = 3  # exit status of `precompute` when some sets have no bases


def add_modes_command(sub: argparse.ArgumentParser) -> None:
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
    arguments.check_output(args, files, args.meshes)

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
    add("--workers", type=number(int, 1), metavar="N", help=text)
    add("--scheduler", metavar="ADDRESS", help="run on the Dask cluster with this scheduler instead")
    add("--timeout", type=number(float), metavar="S", default=600.0, help="for a set (default: 600)")
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
