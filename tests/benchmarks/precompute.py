"""Cost of the bases of a set of key-frames, and how far the meshers' modes agree.

    python tests/benchmarks/precompute.py [--only TEXT ...]

Times are those of all bases with 50 modes, with nothing cached, children included, over one call of
``pytetwild.tetrahedralize`` on the first key-frame in a process of its own: on the wall clock and of the processors.
The last column is the part that the spaces of the first 30 modes of the first key-frame by both meshers have in common.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from cases import keyframes_of
from numpy.typing import NDArray
from results import Table, add_keep, wanted
from timing import limit_threads

import torch_modal as tm

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
MESHERS = {"lattice": "lattice", "fTetWild": "tetwild"}
BARE = {"edge_length_fac": 0.03, "epsilon": 2e-3}
CODE = (
    "import json, sys, numpy as np, pytetwild\nd = np.load(sys.argv[1])\n"
    "pytetwild.tetrahedralize(d['v'], d['f'].astype(np.int32), **json.loads(sys.argv[2]))"
)


class Cost(NamedTuple):
    """Seconds."""

    wall: float
    processor: float


def measured(work: Callable[[], Any]) -> tuple[Any, Cost]:
    """What the work gives and costs, child processes included."""

    def processor() -> float:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return sum(u.ru_utime + u.ru_stime for u in used)

    wall, before = time.perf_counter(), processor()
    found = work()
    return found, Cost(time.perf_counter() - wall, processor() - before)


def bare_call(vertices: FloatArray, faces: IntArray) -> Cost:
    """One call of the mesher, in a process of its own like ours: it replaces signal handlers. Its start counts."""
    command = [sys.executable, "-c", CODE, "bare.npz", json.dumps(BARE)]
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "bare.npz", v=vertices, f=faces)
        return measured(partial(subprocess.run, command, check=True, cwd=folder))[1]


def shared(basis: tm.ModalBasis, other: tm.ModalBasis, n: int = 30) -> float:
    """The part of the space of the first modes that two bases have in common."""
    own, theirs = (torch.linalg.qr(each.modes[:n].flatten(1).mT)[0] for each in (basis, other))
    return float((own.mT @ theirs).square().sum() / n)


def meshes(only: list[str]) -> Iterator[tuple[str, FloatArray, IntArray]]:
    """Sets of key-frames."""
    for name, given in (("creature", keyframes_of("creature")), ("woman", keyframes_of("mh-woman", "0"))):
        if given is not None and wanted(name, only):
            x, faces = (array.numpy() for array in given)
            yield f"{name}, {len(x)} key-frames, {x.shape[1]:,} vertices", x, faces


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="sets with one of these in their names")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    warnings.simplefilter("ignore")
    times = [f"{mesher}, {clock}" for mesher in MESHERS for clock in ("wall clock", "processors")]
    with Table("precompute", ["", *times, "modes in common"], given.keep, times) as table:
        for name, x, faces in meshes(given.only):
            bare, cells, bases = bare_call(x[0], faces), [], []
            for mesher in MESHERS:
                found, cost = measured(partial(tm.extract_bases, x, faces, 50, cache=False, mesher=MESHERS[mesher]))
                cells += [f"{spent / of:.2f}" for spent, of in zip(cost, bare, strict=True)]
                bases.append(found[0])
            table.add(name, *cells, f"{shared(*bases):.3f}")


if __name__ == "__main__":
    main()
