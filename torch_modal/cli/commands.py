"""The commands of the command line, from parsed arguments to files and printed lines.

Each checks its output paths before any heavy import and any work.
"""

import argparse
import re
import warnings
from pathlib import Path
from typing import Any

from torch_modal.cli.arguments import caching, reporter
from torch_modal.cli.output import check_name, check_output
from torch_modal.io.formats import ANIMATION_FORMATS, PICTURES


def subdivide(args: argparse.Namespace) -> None:
    """Run ``torch-modal subdivide``."""
    if len(args.meshes) < 2:
        args.fail("subdivide needs two key-frames or more")
    if args.contact and args.preset == "paper":
        args.fail("--contact needs one shape for each in-between; --preset paper has two")
    if (args.landmarks or args.across) and not args.register:
        args.fail("--landmarks and --across are for --register")
    check_name(args, "--picture", args.picture, PICTURES)
    if args.cyclic and (args.ping_pong or args.ease):
        args.fail(
            f"--{'ping-pong' if args.ping_pong else 'ease'} is for sequences that begin and end; a cycle does not"
        )
    from torch_modal.view.animation import require_packages

    single = _is_file(args, *ANIMATION_FORMATS)
    animation = args.out if single else args.out / "animation.glb"
    files = [animation, *([args.picture] if args.picture else [])]
    fmt = args.format or {".gltf": "glb"}.get(args.meshes[0].suffix.lower(), args.meshes[0].suffix.lower()[1:])
    pattern = None if single else f"frame-*.{fmt}"
    check_output(files, args.meshes, args.overwrite, folder=args.out, pattern=pattern)
    require_packages(animation)

    import torch_modal as tm
    from torch_modal.passengers.proxy import Proxy, proxy_size

    n, spread = len(args.meshes), {"cyclic": args.cyclic, "n_frames": args.frames, "times": args.times}
    places = tm.keyframe_places(n, args.levels, **spread)
    when = tm.frame_times(n, args.levels, **spread).tolist() + args.times[-1:] * args.cyclic if args.times else None
    report = reporter(args)
    registration = {"register": args.register, "landmarks": args.landmarks, "same_subject": not args.across}
    keyframes, faces = tm.load_keyframes(args.meshes, **registration, **caching(args), report=report)
    asset = tm.open_asset(args.meshes[0])
    welded = tm.weld_seams(keyframes, faces)
    progress = False if args.quiet else None
    n_proxy = proxy_size(args.proxy, welded.keyframes.shape[1])
    carrier = Proxy(welded.keyframes, welded.faces, n_proxy) if n_proxy else None
    moving = (carrier.keyframes, carrier.faces) if carrier else (welded.keyframes, welded.faces)
    bases = tm.extract_bases(*moving, args.modes, **_precompute_options(args))
    solved = tm.subdivide(
        *moving,
        args.levels,
        bases=bases,
        **spread,
        smooth=args.smooth,
        progress=progress,
        preset=args.preset,
        contact=args.contact,
    )
    if carrier:
        report(f"moved by a proxy of {carrier.keyframes.shape[1]} vertices (--proxy 0: by the whole mesh)")
        solved = carrier.carried(solved, places, welded.keyframes)
    frames = welded.scatter(solved)
    keys = [place for place in places if place < len(frames)]
    frames[keys] = keyframes
    seams = f", {welded.n_merged} of them copies along seams" if welded.n_merged else ""
    report(f"{len(keyframes)} key-frames of {keyframes.shape[1]} vertices{seams} -> {len(frames)} frames")
    if not single:
        written = tm.save_frames(frames, faces, args.out, fmt, overwrite=args.overwrite, asset=asset)
        report(f"frames:    {written[0]} to {written[-1].name}")
        _warn_of_leftovers(args.out, pattern, written)
    tm.save_animation(
        frames,
        faces,
        animation,
        args.fps,
        keyframe_indices=keys,
        cyclic=args.cyclic,
        overwrite=args.overwrite,
        duration=args.duration,
        ping_pong=args.ping_pong,
        ease=args.ease,
        times=when,
        asset=asset,
        progress=progress,
    )
    report(f"animation: {animation}")
    if args.picture:
        rows = {"torch_modal": frames, "linear": tm.linear_sequence(keyframes, places)}
        tm.render_sequence(rows, faces, args.picture, keyframe_indices=keys, overwrite=args.overwrite)
        report(f"picture:   {args.picture}")


def modes(args: argparse.Namespace) -> None:
    """Run ``torch-modal modes``."""
    if _is_file(args, ".safetensors"):
        if len(args.meshes) > 1:
            args.fail(f"--out {args.out} is one file, but there are {len(args.meshes)} meshes; name a folder")
        files = [args.out]
    else:
        files = [args.out / f"{mesh.stem}.safetensors" for mesh in args.meshes]
        if len(set(files)) < len(files):
            args.fail("two meshes have the same file name, so their bases would too; take them one by one")
    check_output(files, args.meshes, args.overwrite)

    import torch_modal as tm

    keyframes, faces = tm.load_keyframes(args.meshes)
    bases = tm.extract_bases(keyframes, faces, args.modes, **_precompute_options(args))
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


def demo(args: argparse.Namespace) -> None:
    """Run ``torch-modal demo``."""
    names = [args.sample] if args.sample else ["creature", "hand"]
    if _looks_like_file(args.out):
        args.fail(f"--out is a folder here, got the file name {args.out.name!r}")
    check_output([args.out / f"{name}{suffix}" for name in names for suffix in (".glb", ".png")], (), args.overwrite)

    from torch_modal.cli.demo import run_demo

    run_demo(
        names,
        args.out,
        levels=args.levels,
        n_modes=args.modes,
        precompute=_precompute_options(args),
        report=reporter(args),
    )


def cache(args: argparse.Namespace) -> None:
    """Run ``torch-modal cache``."""
    from torch_modal.io import cache as cached

    folder = args.cache_dir or cached.default_cache_dir()
    removed = None
    if args.clear:
        removed = cached.clear_cache(folder)
    elif args.shrink is not None:
        removed = cached.shrink_cache(cached.parse_size(args.shrink), folder)
    n_entries, n_bytes = removed or cached.cache_content(folder)
    size = f"{n_entries} entries, {n_bytes / 2**20:.1f} MiB"
    limit = f"{cached.size_limit() / 2**20:g} MiB"
    print(f"{size} removed from {folder}" if removed else f"{size} in {folder} (limit: {limit})")


def _precompute_options(args: argparse.Namespace) -> dict[str, Any]:
    """Options of `extract_bases`."""
    return {"method": args.method, "mesher": args.mesher, **caching(args)}


def _is_file(args: argparse.Namespace, *suffixes: str) -> bool:
    """Whether --out names a file of one of these suffixes rather than a folder."""
    if args.out.suffix.lower() in suffixes:
        return True
    if _looks_like_file(args.out):
        args.fail(
            f"--out is a file ending in {', '.join(suffixes)}, or a folder, got {args.out.name!r}; a folder whose name "
            "has an ending must exist"
        )
    return False


def _looks_like_file(out: Path) -> bool:
    """Whether a name has an ending: letters, not the number of a version, and no folder has it already."""
    return re.fullmatch(r"\.\w*[A-Za-z]\w*", out.suffix) is not None and not out.is_dir()


def _warn_of_leftovers(folder: Path, pattern: str | None, written: list[Path]) -> None:
    """Warn of frames of an earlier, longer run, which look like the end of this one."""
    left = sorted(set(folder.glob(pattern or "")) - set(written))
    if left:
        warnings.warn(f"{folder} also holds {len(left)} frames of an earlier run, from {left[0].name}", stacklevel=2)
