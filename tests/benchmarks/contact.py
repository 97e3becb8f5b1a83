"""Contact: intersections that are left, energy, accelerations and cost.

    python tests/benchmarks/contact.py [--cases hand legs]
    python tests/benchmarks/contact.py --pictures docs/images

Each case is two key-frames, and 33 shapes of a path between them with and without contact. *Far* pairs of triangles
are those of parts that pass through each other (docs/contact.md), summed over the shapes. The energy is that of Eq. 5
without the contact term, towards both key-frames, summed, over that without contact after as many steps of all
vertices. The peak is the largest second difference in time, over that without contact, as is the processor's time on
one thread. The legs are the sample creature's, made by ``examples/samples/make_samples.py``: they swing past each other
in one line.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from cases import keyframes_of
from results import Table, add_keep
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.contact.separate import SEPARATION_ROUNDS

EXAMPLES = Path(__file__).parents[2] / "examples"
N_SHAPES = 33
COLUMNS = ["", "far pairs: without", "with", "in shapes", "energy", "peak", "time"]


class Case(NamedTuple):
    """Two key-frames."""

    name: str
    keyframes: Tensor
    faces: Tensor


def legs(inward: float = 10.0, swing: float = 14.0) -> Case:
    """A creature whose legs of each pair swing past each other, and would meet in the middle."""
    sys.path.append(str(EXAMPLES))
    import trimesh
    from samples import make_samples as made
    from scipy.spatial.transform import Rotation

    bones, flesh = made.creature()
    rest, faces = made.sculpt(flesh, 0.0270)
    weights, radius = made.bind(flesh, bones, rest, faces, 1.15)
    volume = trimesh.Trimesh(rest, faces, process=False).volume
    poses = []
    for sign in (1, -1):
        turns = {name: Rotation.identity() for name in bones}
        for root in ("scapula", "thigh"):
            for side, way in (("right", 1), ("left", -1)):
                angles = [way * inward, sign * way * swing]
                turns[f"{root}-{side}"] = Rotation.from_euler("xz", angles, degrees=True)
        posed = made.skin(rest, weights, *made.place_bones(bones, turns, np.zeros(3)))
        poses.append(made.restore_volume(posed, faces, volume, radius))
    return Case("swapped legs", torch.from_numpy(np.stack(poses)), torch.from_numpy(faces.astype(np.int64)))


def pair(name: str, folder: str, *files: str) -> Case | None:
    """A sample, or two of the larger meshes; None where they are not there."""
    found = keyframes_of(folder, *files)
    return found and Case(name, *found)


CASES: dict[str, Callable[[], Case | None]] = {
    "hand": lambda: pair("sample hand", "hand"),
    "legs": legs,
    "mh-hand": lambda: pair("mh-hand 02/04", "mh-hand", "02", "04"),
    "woman-02": lambda: pair("mh-woman 00/02", "mh-woman", "00", "02"),
    "woman-23": lambda: pair("mh-woman 02/03", "mh-woman", "02", "03"),
}


class Run(NamedTuple):
    """The same with and without contact."""

    plain: Tensor
    apart: Tensor
    polished: Tensor
    """Without contact, after as many steps of all vertices."""
    seconds: tuple[float, float]


def sequence(case: Case, bases: list[tm.ModalBasis], **options: Any) -> tuple[Tensor, float]:
    """The shapes of a path, and the processor's time."""
    start = time.process_time()
    with torch.no_grad():
        frames = tm.Path(bases, case.faces, smooth=False, **options)(
            case.keyframes, torch.linspace(0, 1, N_SHAPES).double()
        )
    return frames, time.process_time() - start


def run(case: Case) -> Run:
    """Both, one after the other."""
    bases = tm.extract_bases(case.keyframes, case.faces, 30, progress=False)
    sequence(case, bases, contact=False)  # what is made once
    plain, without = sequence(case, bases, contact=False)
    apart, with_ = sequence(case, bases, contact=True)
    polished, _ = sequence(case, bases, solver=tm.Solver(polish=SEPARATION_ROUNDS[1]), contact=False)
    return Run(plain, apart, polished, (without, with_))


def energy(frames: Tensor, case: Case) -> float:
    """Of Eq. 5, between both key-frames at a diagonal of 100, summed."""
    scale = 100 / (case.keyframes[0].amax(0) - case.keyframes[0].amin(0)).norm()
    shell = tm.ShellEnergy(case.faces)
    t = torch.linspace(0, 1, len(frames), dtype=frames.dtype)[1:-1]
    to_first, to_last = (torch.stack([shell(scale * x, scale * key) for x in frames[1:-1]]) for key in case.keyframes)
    return float(torch.lerp(to_first, to_last, t).sum())


def peak(frames: Tensor) -> float:
    """Largest second difference in time."""
    return float((frames[2:] - 2 * frames[1:-1] + frames[:-2]).norm(dim=-1).max())


def measure(case: Case, found: Run) -> list[str]:
    """A line of the table."""
    before, after = (
        tm.self_contacts(frames, case.faces, ignore=case.keyframes).n_far for frames in (found.plain, found.apart)
    )
    apart, polished = (energy(x, case) for x in (found.apart, found.polished))
    cells = [f"{int(before.sum()):,}", f"{int(after.sum()):,}", str(int((after > 0).sum())), f"{apart / polished:.3f}"]
    ratios = peak(found.apart) / peak(found.plain), found.seconds[1] / found.seconds[0]
    return [f"{case.name}, {case.keyframes.shape[1]:,} vertices", *cells, *(f"{ratio:.2f}" for ratio in ratios)]


def pictures(folder: Path, case: Case, found: Run) -> None:
    """Before and after, with what crosses in colour."""
    before, after = (
        tm.self_contacts(frames, case.faces, ignore=case.keyframes) for frames in (found.plain, found.apart)
    )
    marks = {}
    for name, frames, contacts in (("without", found.plain, before), ("contact", found.apart, after)):
        mark = torch.zeros(frames.shape[:2])
        which = contacts.shape[contacts.far].repeat_interleave(6)
        mark[which, case.faces[contacts.pairs[contacts.far]].flatten()] = 1
        marks[name] = mark
    worst = int(before.n_far.argmax())
    columns = sorted({max(1, worst - 4), max(1, worst - 2), worst, min(31, worst + 2)})
    path = folder / f"contact-{case.name.replace(' ', '-')}.png"
    view = (30.0, 15.0) if "legs" in case.name else None
    tm.render_sequence(
        {"without": found.plain, "contact": found.apart},
        case.faces,
        path,
        columns=columns,
        keyframe_indices=[0],
        view=view,
        colors=marks,
        color_label="1: passes through",
    )
    print(f"picture: {path}")


def main() -> None:
    """Print and keep the table, and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the sample hand and the legs")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")
    with Table("contact", COLUMNS, given.keep, COLUMNS[-1:], "--cases hand") as table:
        for name in given.cases:
            case = CASES[name]()
            if case is None:
                continue
            found = run(case)
            table.add(*measure(case, found))
            if given.pictures and name in ("hand", "legs"):
                pictures(given.pictures, case, found)


if __name__ == "__main__":
    main()
