"""What the pre-computation costs and gives, as ratios measured in one run, with nothing taken from a cache.

    python tests/benchmarks/precompute.py [--samples DIR] [--data DIR] [--parts PART ...]

Each line says what is asked for, in brackets. ``--parts capture`` prints the table of modes against fine references:
half an hour, most of it for the references, which ``--keep DIR`` keeps for the next time. ``--parts stiffness`` prints
the first eigenvalues of bodies that are hard to fill, over a reference. Times are wall-clock and
processor seconds of this run and its children; compare the ratios, and the processor seconds if the machine is shared.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import motions  # noqa: F401 (the examples are found from here on)
import numpy as np
from _bipeds import biped
from capture import stiffness, table
from numpy.typing import NDArray
from timing import limit_threads

import torch_modal as tm
from torch_modal.geometry.connectivity import Connectivity

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
ROOT = Path(__file__).parents[2]
BARE = {"edge_length_fac": 0.03, "epsilon": 2e-3}
PARTS = ("speed", "threads", "memory", "stiffness", "capture")
MORE = {"hand": "mh-hand-path", "woman": "mh-woman"}


class Cost(NamedTuple):
    """Seconds."""

    wall: float
    processor: float


def measured(work: Callable[[], object]) -> Cost:
    """What the work costs, child processes included."""

    def processor() -> float:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(u.ru_utime + u.ru_stime for u in used)

    wall, before = time.perf_counter(), processor()
    work()
    return Cost(time.perf_counter() - wall, processor() - before)


def refined(keyframes: FloatArray, faces: IntArray, n_vertices: int) -> tuple[FloatArray, IntArray]:
    """The same surfaces with more vertices: the longest edges of the first are split at their middle, in all."""
    while keyframes.shape[1] < n_vertices:
        edges = Connectivity(faces).edges
        length = np.linalg.norm(keyframes[0][edges[:, 0]] - keyframes[0][edges[:, 1]], axis=1)
        sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
        base = keyframes.shape[1]
        of_face = np.searchsorted(edges[:, 0] * base + edges[:, 1], sides[..., 0] * base + sides[..., 1])
        at = length[of_face].argmax(axis=1)
        longest = of_face[np.arange(len(faces)), at]
        # The longest edge of both its faces: so no face is split twice in a round.
        chosen = np.flatnonzero(np.bincount(longest, minlength=len(edges)) == 2)
        chosen = chosen[np.argsort(-length[chosen])][: n_vertices - base]
        middle = np.full(len(edges), -1)
        middle[chosen] = base + np.arange(len(chosen))
        keyframes = np.concatenate([keyframes, keyframes[:, edges[chosen]].mean(axis=2)], axis=1)
        split = middle[longest] >= 0
        turns = (at[split, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(faces[split], turns, axis=1).T
        m = middle[longest[split]]
        faces = np.concatenate([faces[~split], np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)])
    return keyframes, faces


def sample(folder: Path, pattern: str = "key-*") -> tuple[FloatArray, IntArray]:
    """Key-frames and faces from a folder."""
    keyframes, faces = tm.load_keyframes(sorted(p for p in folder.glob(pattern) if p.suffix in (".ply", ".obj")))
    return keyframes.numpy(), faces.numpy()


def bare_call(vertices: FloatArray, faces: IntArray) -> Cost:
    """One call of the mesher, in a process of its own like ours: it replaces signal handlers. Its start counts."""
    code = (
        "import json, sys, numpy as np, pytetwild\nd = np.load(sys.argv[1])\n"
        "pytetwild.tetrahedralize(d['v'], d['f'].astype(np.int32), **json.loads(sys.argv[2]))"
    )
    command = [sys.executable, "-c", code, "bare.npz", json.dumps(BARE)]
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "bare.npz", v=vertices, f=faces)
        return measured(lambda: subprocess.run(command, check=True, cwd=folder))


def speed(name: str, keyframes: FloatArray, faces: IntArray) -> None:
    """Bases of all key-frames against one bare call of the mesher on one of them."""
    reference = bare_call(keyframes[0], faces)
    what = f"{len(keyframes)} bases of 50 modes, {name}, {keyframes.shape[1]} vertices"
    print(f"{name}, one bare pytetwild call: {reference.wall:.1f} s, {reference.processor:.1f} cpu")
    for mesher, bound in (("tetwild", 0.7), ("lattice", 0.4)):
        cost = measured(lambda mesher=mesher: tm.extract_bases(keyframes, faces, 50, cache=False, mesher=mesher))
        print(
            f"{what}, {mesher}: {cost.wall:.1f} s, {cost.processor:.1f} cpu; against the bare call: "
            f"{cost.wall / reference.wall:.2f} wall [at most {bound}], {cost.processor / reference.processor:.2f} cpu",
            flush=True,
        )


def threads(folder: Path, mesher: str, repeats: int = 3) -> None:
    """Six key-frames of 8k vertices to a sequence, with no variable set against ``OMP_NUM_THREADS=1``, in turns."""
    if "--in-child" in sys.argv:
        keyframes, faces = refined(*sample(folder), 8000)
        bases: list[tm.ModalBasis] = []
        first = measured(lambda: bases.extend(tm.extract_bases(keyframes, faces, mesher=mesher, cache=False)))
        second = measured(lambda: tm.subdivide(keyframes[:3], faces, levels=2, bases=bases[:3]))
        print(json.dumps([*first, *second]))
        return
    command = [sys.executable, __file__, *sys.argv[1:], "--in-child", "--parts", "threads", "--mesher", mesher]
    unset = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    costs: dict[str, list[list[float]]] = {"unset": [], "one": []}
    for _ in range(repeats):
        for way, variables in (("unset", unset), ("one", {**unset, "OMP_NUM_THREADS": "1"})):
            run = subprocess.run(command, check=True, capture_output=True, text=True, env=variables)
            costs[way].append(json.loads(run.stdout))
    ratios = np.median(np.array(costs["unset"]) / np.array(costs["one"]), axis=0)
    for what, (wall, processor) in {"bases": ratios[:2], "subdivide": ratios[2:]}.items():
        print(
            f"{what}, six key-frames of 8,000 vertices, {mesher}, no variable set, against OMP_NUM_THREADS=1: "
            f"{wall:.2f} wall [not above 1], {processor:.2f} cpu"
        )


def memory(keyframes: FloatArray, faces: IntArray) -> None:
    """Peak memory of a process that makes two bases of 26k vertices, and of its worker."""
    if "--in-child" not in sys.argv:
        command = [sys.executable, __file__, *sys.argv[1:], "--in-child", "--parts", "memory"]
        print(subprocess.run(command, check=True, capture_output=True, text=True).stdout, end="")
        return
    keyframes, faces = refined(keyframes[:2], faces, 26_000)
    tm.extract_bases(keyframes, faces, 50, cache=False)
    own, child = (resource.getrusage(w).ru_maxrss / 2**20 for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    print(
        f"peak memory, {keyframes.shape[1]} vertices, two key-frames: {own:.2f} GiB, its worker {child:.2f} [below 2]"
    )


def main() -> None:
    """Run the parts asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=Path, default=ROOT / "torch_modal" / "samples")
    more = ROOT.parent / "shared" / "data"
    parser.add_argument("--data", type=Path, default=more, help="more meshes, if they are there")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--mesher", choices=("lattice", "tetwild"), default="lattice", help="of the part threads")
    parser.add_argument("--runs", type=int, default=3, help="of the default in the table of captured modes")
    parser.add_argument("--keep", type=Path, help="folder in which references are kept")
    parser.add_argument("--in-child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if not (arguments.in_child and "threads" in arguments.parts):
        limit_threads()
    warnings.simplefilter("ignore")
    creature = sample(arguments.samples / "creature")
    if "speed" in arguments.parts:
        speed("creature, split edges", *refined(*creature, 8431))
        speed("creature", *creature)
        if arguments.data.is_dir():
            speed("woman", *sample(arguments.data / MORE["woman"], "0*"))
    if "threads" in arguments.parts:
        threads(arguments.samples / "creature", arguments.mesher)
    if "memory" in arguments.parts:
        memory(*creature)
    if "stiffness" in arguments.parts:
        if arguments.data.is_dir():
            keyframes, faces = sample(arguments.data / MORE["hand"], "08*")
            stiffness("closed fist alone", keyframes[0], faces, 1.25, arguments.keep)
        bird = biped("wader", None)
        stiffness("slender leg", bird.pose(0.0), bird.faces, 1.1, arguments.keep)
    if "capture" in arguments.parts:
        meshes = [("creature", creature[0][0], creature[1])]
        if arguments.data.is_dir():
            for name in ("hand", "woman"):
                keyframes, faces = sample(arguments.data / MORE[name], "0*")
                meshes.append((name, keyframes[0], faces))
        table(meshes, arguments.runs, arguments.keep)


if __name__ == "__main__":
    main()
