"""Contact: intersections that are left, cost, and accelerations.

    python tests/benchmarks/contact.py
    python tests/benchmarks/contact.py --cases hand legs --rows crossings cost
    python tests/benchmarks/contact.py --pictures docs/images

Each case is two key-frames, subdivided into 33 shapes with and without contact. *Far* pairs of triangles are those of
parts that pass through each other (docs/contact.md). Energies are those of Eq. 5 without the contact term, at each time
between both key-frames, over those without contact after as many steps of all vertices (the sum, and the most of a
shape). Times are of the processor, with one thread. The legs are the sample creature's, made by
``examples/make_samples.py``: they swing past each other in one line. Gradients are compared with central differences,
with the active contacts kept. Random draws with contact: ``draws.py --contact``.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from cases import keyframes_of
from measures import edge_lengths, mean_ratio
from timing import limit_threads
from torch import Tensor

import torch_modal as tm
from torch_modal.contact.active import ContactSearch
from torch_modal.contact.separate import ROUNDS
from torch_modal.data.samples import load_sample

EXAMPLES = Path(__file__).parents[2] / "examples"
LEVELS = 5


class Case(NamedTuple):
    """Two key-frames."""

    name: str
    keyframes: Tensor
    faces: Tensor


def legs(inward: float = 10.0, swing: float = 14.0) -> Case:
    """A creature whose legs of each pair swing past each other, and would meet in the middle."""
    sys.path.append(str(EXAMPLES))
    import make_samples as made
    import trimesh
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


def subdivided(case: Case, bases: list[tm.ModalBasis], **options: Any) -> tuple[Tensor, float]:
    """33 shapes, and the processor's time."""
    start = time.process_time()
    frames = tm.subdivide(case.keyframes, case.faces, LEVELS, bases=bases, progress=False, **options)
    return frames, time.process_time() - start


def run(case: Case) -> Run:
    """Both, one after the other."""
    bases = tm.extract_bases(case.keyframes, case.faces, 30, progress=False)
    subdivided(case, bases, contact=False)  # what is made once
    plain, without = subdivided(case, bases, contact=False)
    apart, with_ = subdivided(case, bases, contact=True)
    polished, _ = subdivided(case, bases, solver=tm.Solver(polish=ROUNDS[1]), contact=False)
    return Run(plain, apart, polished, (without, with_))


def energies(frames: Tensor, case: Case) -> Tensor:
    """Of Eq. 5, between both key-frames at a diagonal of 100. *Shape:* ``(T,)``."""
    scale = 100 / (case.keyframes[0].amax(0) - case.keyframes[0].amin(0)).norm()
    shell = tm.ShellEnergy(case.faces)
    t = torch.linspace(0, 1, len(frames), dtype=frames.dtype)[1:-1]
    to_first, to_last = (torch.stack([shell(scale * x, scale * key) for x in frames[1:-1]]) for key in case.keyframes)
    return torch.lerp(to_first, to_last, t)


def peak(frames: Tensor) -> float:
    """Largest second difference in time, in % of the diagonal."""
    diagonal = (frames[0].amax(0) - frames[0].amin(0)).norm()
    return float(100 * (frames[2:] - 2 * frames[1:-1] + frames[:-2]).norm(dim=-1).max() / diagonal)


def crossings(names: list[str]) -> Iterator[tuple[Case, Run]]:
    """The main table."""
    head = ("far, sum", "most", "left", "frames", "deepest", "energy", "most", "peak", "ratio", "s", "times")
    print(f"\n{'':16s}" + "".join(f"{word:>10s}" for word in head))
    for name in names:
        case = CASES[name]()
        if case is None:
            continue
        found = run(case)
        before, after = (
            tm.self_contacts(frames, case.faces, ignore=case.keyframes) for frames in (found.plain, found.apart)
        )
        deepest = 100 * float(after.depth.max() / (case.keyframes[0].amax(0) - case.keyframes[0].amin(0)).norm())
        apart, polished = (energies(x, case) for x in (found.apart, found.polished))
        peaks = peak(found.plain), peak(found.apart)
        line = f"{case.name:16s}{int(before.n_far.sum()):10d}{int(before.n_far.max()):10d}{int(after.n_far.sum()):10d}"
        line += f"{int((after.n_far > 0).sum()):10d}{deepest:8.2f} %{float(apart.sum() / polished.sum()):10.4f}"
        line += f"{float((apart / polished).max()):10.4f}{peaks[1]:8.3f} %{peaks[1] / peaks[0]:10.2f}"
        print(line + f"{found.seconds[1]:10.2f}{found.seconds[1] / found.seconds[0]:10.2f}", flush=True)
        yield case, found


def edges(case: Case, found: Run) -> None:
    """Edge errors of the sample hand against its true frames."""
    sample = load_sample("hand")
    print("\nedge error of the sample hand, %, without contact, after as many steps, and with contact")
    for t, true in zip(sample.true_times, sample.truth, strict=True):
        k, lengths = round(t * 2**LEVELS), edge_lengths(true, case.faces)
        shapes = (x[k] for x in (found.plain, found.polished, found.apart))
        errors = [100 * mean_ratio(edge_lengths(x, case.faces), lengths) for x in shapes]
        print(f"  t = {t:.2f}" + "".join(f"{error:10.3f}" for error in errors))


def singles(names: list[str]) -> None:
    """Far pairs of one ``InBetween`` at each eighth, without and with contact."""
    t = torch.arange(1, 8, dtype=torch.float64) / 8
    print("\nfar pairs of single in-betweens at t = 1/8 to 7/8, without and with contact")
    for name in names:
        case = CASES[name]()
        if case is None:
            continue
        bases = tm.extract_bases(case.keyframes, case.faces, 30, progress=False)
        found = []
        for contact in (False, True):
            with torch.no_grad():
                shapes = tm.InBetween(bases, case.faces, contact=contact)(*case.keyframes, t)
            found.append(tm.self_contacts(shapes, case.faces, ignore=case.keyframes).n_far.tolist())
        print(f"{case.name:16s} {found[0]} {found[1]}", flush=True)


def untouched() -> None:
    """What the search costs where it finds nothing."""
    sample = load_sample("creature")
    case = Case("creature 0/1", sample.keyframes[:2], sample.faces)
    found = run(case)
    same = torch.equal(found.plain, found.apart)
    print(f"\nnothing touches ({case.name}): {found.seconds[1] / found.seconds[0]:.2f} times, same shapes: {same}")


def gradients() -> None:
    """Of a weighted sum of the sample hand's vertices at t = 7/8, against central differences."""
    case = Case("sample hand", *load_sample("hand")[:2])
    layer = tm.InBetween(tm.extract_bases(case.keyframes, case.faces, 20, progress=False), case.faces, contact=True)
    search, found = ContactSearch.__call__, []
    calls = 0

    def held(*given: Any) -> Any:
        nonlocal calls
        if calls == len(found):
            found.append(search(*given))
        calls += 1
        return found[calls - 1]

    def shape(given: list[Tensor]) -> Tensor:
        nonlocal calls
        calls = 0
        return layer(given[0], given[1], given[2])

    x_a, x_b = case.keyframes
    weights, way = torch.cos(7 * x_a), 0.01 * torch.sin(9 * x_a + 1)
    given = [x.clone().requires_grad_() for x in (x_a, x_b, torch.tensor(0.875, dtype=x_a.dtype))]
    try:
        ContactSearch.__call__ = held  # type: ignore[method-assign]
        gradient = torch.autograd.grad((shape(given) * weights).sum(), given)
        print(f"\ngradients with {len(found[0][0].shapes)} vertices held, relative difference")
        parts = (("first key-frame", way, 1e-4), ("second", way, 1e-4), ("t", torch.ones_like(given[2]), 1e-6))
        for i, (name, moved, size) in enumerate(parts):
            values = []
            for sign in (1, -1):
                there = [x.detach() + sign * size * moved if k == i else x.detach() for k, x in enumerate(given)]
                values.append(float((shape([x.requires_grad_() for x in there]).detach() * weights).sum()))
            true = (values[0] - values[1]) / (2 * size)
            print(f"  {name:16s}{abs(float((gradient[i] * moved).sum()) / true - 1):10.1e}", flush=True)
    finally:
        ContactSearch.__call__ = search  # type: ignore[method-assign]


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
        overwrite=True,
    )
    print(f"picture: {path}")


if __name__ == "__main__":
    limit_threads()
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--rows", nargs="+", default=["crossings", "singles", "cost", "gradients"])
    parser.add_argument("--pictures", type=Path, help="folder for pictures of the sample hand and the legs")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    if "crossings" in given.rows:
        for case, found in crossings(given.cases):
            if case.name == "sample hand":
                edges(case, found)
            if given.pictures and case.name in ("sample hand", "swapped legs"):
                pictures(given.pictures, case, found)
    if "singles" in given.rows:
        singles(given.cases)
    if "cost" in given.rows:
        untouched()
    if "gradients" in given.rows:
        gradients()
