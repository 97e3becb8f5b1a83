"""``torch-modal complete``: from a template and what was seen of a motion to files."""

import argparse
import warnings
from dataclasses import replace
from pathlib import Path

from torch_modal.cli.arguments import pick_options
from torch_modal.cli.subdivide import add_output, check_files, write_sequence

MOST_FRAMES = 100_000
"""An hour at 24 a second has 86,400."""


def add_arguments(sub: argparse.ArgumentParser) -> None:
    """Arguments of ``complete``."""
    add = sub.add_argument
    add("mesh", type=Path, metavar="MESH", help="a whole mesh: the template, or the first key-frame")
    text = "clouds (PLY), meshes of any connectivity as clouds, markers (CSV with time,vertex,x,y,z)"
    add("observations", nargs="+", type=Path, metavar="SEEN", help=text)
    text = "when the clouds were seen, in their order (default: 0 1 2 ...)"
    add("--times", nargs="+", type=float, metavar="T", help=text)
    add("--keyframes", nargs="+", type=Path, default=[], metavar="MESH", help="further whole, exact meshes")
    text = "when the whole meshes are, the first included (default: that is a template of no time)"
    add("--keyframe-times", nargs="+", type=float, metavar="T", help=text)
    add("--noise", type=float, metavar="X", help="standard deviation of the points (default: estimated)")
    add("--estimate-times", action="store_true", help="times between the first and the last are not exact")
    add("--contact", action="store_true", help="keep parts from passing through each other (extra contact)")
    for name, text in (("--view", "direction to the camera, far away"), ("--camera", "place of the camera")):
        add(name, nargs="+", type=float, metavar="X", help=f"{text}: three numbers, or three for each cloud")
    add_output(sub, "what was seen above the result, coloured by its expected error")
    add("--frames", type=int, metavar="N", help="evenly in time (default: 1 to 8 for each interval)")
    add("--fps", type=float, metavar="X", default=24.0, help="frames a second (default: %(default)g)")


def run(args: argparse.Namespace) -> None:
    """Scans and markers in, the whole motion out.

    Complete a motion of which parts were seen: clouds from one side, markers, noisy meshes.

    The result has the faces and vertices of the first mesh. All files have the same
    coordinates and unit. What was not seen is inferred from the neighbours in time: the last
    line and the picture say how much that is.

    Examples:
      a template, and a scan at each time:
        torch-modal complete template.obj scans/*.ply --times 0 1 2 3 --out motion.glb
      two exact key-frames, and markers between them:
        torch-modal complete open.obj markers.csv --keyframes fist.obj --keyframe-times 0 1 --out hand.glb
    """
    whole, times = [args.mesh, *args.keyframes], args.keyframe_times
    if (times or args.keyframes) and len(times or ()) != len(whole):
        args.fail(f"--keyframe-times needs a time for each of {', '.join(map(str, whole))}; got {len(times or ())}")
    for name, numbers in (("--view", args.view), ("--camera", args.camera)):
        if len(numbers or ()) % 3:
            args.fail(f"{name} takes three numbers, or three for each cloud; got {len(numbers)}")
    if args.frames is not None and not 2 <= args.frames <= MOST_FRAMES:
        args.fail(f"--frames must be 2 or more, and {MOST_FRAMES} at most; got {args.frames}")
    animation = check_files(args, [*whole, *args.observations])

    import torch

    import torch_modal as tm
    from torch_modal.data.tree import natural
    from torch_modal.times import fill_linear

    names = [f.as_posix() for f in args.observations if f.suffix.lower() != ".csv"]
    if not args.times and names != sorted(names, key=natural):
        message = f"{', '.join(names[:3])}, ... were seen at 0, 1, 2, ..., in this order; --times says other times"
        warnings.warn(message, stacklevel=2)
    keyframes, faces = tm.load_keyframes(whole)
    given = {name: getattr(args, name) for name in ("view", "camera") if getattr(args, name)}
    cameras = {name: torch.tensor(numbers, dtype=torch.float64).view(-1, 3) for name, numbers in given.items()}
    seen = tm.load_observations(args.observations, keyframes.shape[1], args.times, noise=args.noise, **cameras)
    args.report(f"{len(seen)} observations of {sum(len(one.points) for one in seen)} points")
    welded = tm.weld_seams(keyframes, faces)
    seen = [one if one.is_cloud else replace(one, vertices=welded.vertex_of[one.vertices]) for one in seen]
    rests = welded.keyframes if times else welded.keyframes[0]
    options = pick_options(args, "estimate_times", "contact", "progress")
    completion = tm.complete(rests, welded.faces, seen, times=times, **options)
    knots, when = completion.path.times if completion.path else completion.times, completion.times
    if len(knots) > 1 and args.frames:
        when = torch.linspace(float(knots[0]), float(knots[-1]), args.frames, dtype=torch.float64)
    elif len(knots) > 1:
        step = 2 ** min(3, max(0, 6 - (len(knots) - 2).bit_length()))
        when = fill_linear(knots, range(0, step * len(knots), step))
    frames, asset = welded.scatter(completion(when)), tm.open_asset(args.mesh)
    keys = [i for i, t in enumerate(when.tolist()) if t in (times or ())]
    write_sequence(args, animation, frames, faces, asset, keyframe_indices=keys, times=when.tolist())
    used = welded.keyframes[0, welded.faces.unique()]
    diagonal = (used.amax(0) - used.amin(0)).norm()
    if args.picture:
        chosen = torch.linspace(0, len(completion.times) - 1, min(8, len(completion.times))).round().long().tolist()
        moments = sorted({one.time for one in seen})  # in the order of completion.times, which may be estimated
        at = [moments.index(one.time) for one in seen]
        tm.render_sequence(
            {"completed": completion.shapes[chosen]},
            welded.faces,
            args.picture,
            columns=len(chosen),
            titles=[f"t = {t:.4g}" for t in completion.times[chosen].tolist()],
            keyframe_indices=[],
            colors={"completed": 100 * completion.errors[chosen] / diagonal},
            color_label="expected error in % of the diagonal",
            points={"seen": [torch.cat([o.points for o, n in zip(seen, at, strict=True) if n == i]) for i in chosen]},
        )
        args.report(f"picture:   {args.picture}")
    miss, expected = (100 * x / diagonal for x in (torch.cat(completion.misses).mean(), completion.errors.mean(1)))
    args.report(f"points lie {miss:.2f} % of the diagonal off the surface, in the mean")
    most = f"most at t = {completion.times[expected.argmax()]:g} ({expected.max():.2f} %)"
    args.report(f"nine of ten vertices are expected within {expected.mean():.2f} %, {most}")
