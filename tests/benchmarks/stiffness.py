"""First eigenvalues of bodies that are hard to fill, by every mesher, over those of fine quadratic tetrahedra.

python tests/benchmarks/stiffness.py [--only TEXT ...]
"""

import argparse
import threading
from collections.abc import Iterator

import numpy as np
from cases import keyframes_of
from helpers.solids import eigenmodes
from known_motions import make_samples  # noqa: F401 (the examples are found from here on)
from quadratic_tetrahedra import quadratic_modes
from results import Table, add_keep, wanted
from timing import limit_threads

from torch_modal.geometry.surface import Surface
from torch_modal.modes.extract import MESHERS
from torch_modal.modes.solid import without_small_pieces
from torch_modal.modes.stiffness import HessianForm, arap_hessian, mass_matrix
from torch_modal.modes.surface import CanonicalSurface
from torch_modal.modes.tetrahedra import Mesher, Tetrahedra
from torch_modal.modes.tetwild import TetWild

N = 3
FINE = TetWild(0.03, 2e-3, stop_energy=10.0, max_surface_faces=10**8, timeout=3600.0)
WAYS: tuple[tuple[str, HessianForm], ...] = (
    ("auto", "edge"),
    ("lattice", "edge"),
    ("tetwild", "edge"),
    ("lattice", "vertex"),
)
COLUMNS = ["", "`mesher`", "`form`", "tetrahedra's vertices", "first", "second", "third"]


def bodies() -> Iterator[tuple[str, CanonicalSurface]]:
    """A closed fist without the other poses of its hand, and a bird on slender legs."""
    from samples.bipeds import biped

    if (fist := keyframes_of("mh-hand-path", "08")) is not None:
        yield "closed fist alone", CanonicalSurface(fist[0][0].numpy(), fist[1].numpy())
    bird = biped("wader", None)
    yield "bird on slender legs", CanonicalSurface(bird.pose(0.0), bird.faces)


def filled(mesher: Mesher, surface: Surface) -> Tetrahedra:
    """Tetrahedra without small loose pieces, which fTetWild may leave."""
    return without_small_pieces(mesher.fill(surface, threading.Event()))


def main() -> None:
    """Print and keep the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", default=[""], metavar="TEXT", help="bodies whose names hold one of these")
    add_keep(parser)
    given = parser.parse_args()
    limit_threads()
    with Table("stiffness", COLUMNS, given.keep, labels=3) as table:
        for name, surface in bodies():
            if wanted(name, given.only):
                truth = quadratic_modes(filled(FINE, surface), N).eigenvalues
                for mesher, form in WAYS:
                    tetrahedra = filled(MESHERS[mesher](), surface)
                    k, mass = arap_hessian(tetrahedra, form), mass_matrix(tetrahedra)
                    ratios = eigenmodes(k, mass, tetrahedra.vertices, N).eigenvalues[-N:] / np.asarray(truth)
                    size = f"{len(tetrahedra.vertices):,}"
                    table.add(name, f"`{mesher}`", f"`{form}`", size, *(f"{ratio:.2f}" for ratio in ratios))


if __name__ == "__main__":
    main()
