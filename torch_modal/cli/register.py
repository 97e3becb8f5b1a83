"""``torch-modal register``, and the registration that other commands do on the way, kept in the cache."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

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
FORMATS = (".obj", ".ply", ".off", ".glb")
VERSION = 1
"""Part of the key of kept results: raise it when the algorithm changes."""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``register`` besides the common ones."""
    sub.add_argument("meshes", nargs=2, type=Path, metavar="MESH", help="the template, and the target")
    sub.add_argument(
        "--out", type=Path, metavar="FILE", help="the template laid onto the target, .obj, .ply, .off or .glb"
    )
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
    if args.out and args.out.suffix.lower() not in FORMATS:
        args.fail(f"--out must end in {', '.join(FORMATS)}, got {args.out.name!r}")
    if args.suggest and args.suggest.suffix.lower() not in (".png", ".pdf"):
        args.fail(f"--suggest must end in .png or .pdf, got {args.suggest.name!r}")
    file = args.out or args.suggest
    if file.resolve() in {mesh.resolve() for mesh in args.meshes}:
        raise ValueError(f"{file} is one of the meshes; choose another file")

    from torch_modal.io.write import refuse_existing

    refuse_existing(file, args.overwrite)
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
    from torch_modal.keyframes.registration.sequence import ADVICE, landmark_table

    (vertices, faces), (there, there_faces) = (read_mesh(mesh) for mesh in args.meshes)
    marks = landmark_table(args.landmarks, [vertices, there])
    found = registrar(args)(
        vertices,
        faces,
        there,
        there_faces,
        landmarks=None if marks is None else (marks[:, 0], marks[:, 1]),
        same_subject=not args.across,
        progress=False if args.quiet else None,
    )
    if not args.quiet:
        print(found.summary())
    if found.doubtful:
        why = f"the result is doubtful: {'; '.join(found.warnings)}"
        if not args.keep_doubtful:
            raise ValueError(f"{why}. To help it, {ADVICE}; --keep-doubtful writes it all the same")
        warnings.warn(why, stacklevel=2)
    save_mesh(found.positions, faces, args.out, args.overwrite, open_asset(args.meshes[0]))
    if not args.quiet:
        print(f"written: {args.out}")


def registrar(args: argparse.Namespace) -> Callable[..., Any]:
    """A `register` that keeps its results in the cache, by the content of meshes and landmarks."""
    import numpy as np
    import torch

    from torch_modal.keyframes.registration.register import register
    from torch_modal.keyframes.registration.report import Distances, Registration
    from torch_modal.precompute.cache import Cache

    cache = Cache.at(args.cache_dir, enabled=not args.no_cache)

    def kept(template: Any, faces: Any, target: Any, target_faces: Any, **options: Any) -> Registration:
        marks = options.get("landmarks")
        inputs = {"template": template, "faces": faces, "target": target, "target_faces": target_faces}
        if marks is not None:
            inputs |= {"here": marks[0], "there": marks[1]}

        def compute() -> dict[str, Any]:
            found = register(template, faces, target, target_faces, **options)
            arrays = {name: np.array(value) for name, value in found._asdict().items() if name != "warnings"}
            return arrays | {"warnings": np.frombuffer("\n".join(found.warnings).encode(), dtype=np.uint8)}

        parameters = {"same_subject": options["same_subject"], "version": VERSION}
        stored = cache.get("registration", inputs, parameters, compute)
        fields: dict[str, Any] = {}
        for name, array in stored.items():
            if name == "warnings":
                fields[name] = tuple(line for line in array.tobytes().decode().split("\n") if line)
            elif name in ("to_target", "from_target"):
                fields[name] = Distances(*array.tolist())
            elif Registration.__annotations__[name] in (float, int):
                fields[name] = array.reshape(-1)[0].item()
            else:
                fields[name] = torch.from_numpy(array)
        return Registration(**fields)

    return kept
